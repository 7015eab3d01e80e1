"""Trainings that are ended by signals, at random moments, and resumed."""

from __future__ import annotations

import shutil
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from random import Random

from campaign import forks, world
from campaign.subjects import contents, leftovers, own_copy, wrong_end

_SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
_MOST_KILLS = 3  # per training


@dataclass(frozen=True)
class Work:
    """A command that can be interrupted and resumed.

    Attributes:
        begin: the command, with its output `new`.
        again: what is added to resume it.
        weight: how often it is drawn.
    """

    name: str
    begin: tuple[str, ...]
    again: tuple[str, ...] = ("--resume",)
    weight: int = 4


_STEPS = 12  # per training
_SHORT = ("--set", f"train.steps={_STEPS}", "--set", "train.checkpoint_every=3")
WORKS: tuple[Work, ...] = (
    Work("train aegis", ("train", world.RECIPE, *world.TRAIN, *_SHORT, "--out", "new")),
    Work(
        "train nullspace",
        ("train", world.RECIPE, "--method", "nullspace", *world.TRAIN[2:], *_SHORT, "--out", "new"),
    ),
    Work(
        "train naive",
        ("train", world.RECIPE, "--method", "naive", *world.TRAIN[2:4], *_SHORT, "--out", "new"),
    ),
    Work("train a stream", ("train", "stream.yaml", "--out", "new"), weight=1),
    Work("run", ("run", "job.yaml", "--out", "new"), again=(), weight=1),
    Work("demos", ("demos", "point", "--episodes", "8", "--out", "new.safetensors"), (), 1),
)
_LOGGING = ("train aegis", "train nullspace", "train naive")  # a line of metrics a step


@dataclass(frozen=True)
class Verdict:
    """The result of a case; `problem` is "" if all is well."""

    case: int
    work: str
    signals: tuple[str, ...]
    codes: tuple[int, ...]
    problem: str


class Cases:
    """Numbered cases: the same number gives the same signals and moments."""

    def __init__(self, root: Path, scratch: Path, seed: int = 0) -> None:
        self._root, self._scratch, self._seed = root, scratch, seed
        self._whole: dict[Work, tuple[float, dict[str, str]]] = {}

    def run(self, number: int) -> Verdict:
        """Interrupt a command once or several times, resume it, and compare its output."""
        rng = Random(f"{self._seed} kill {number}")
        work = rng.choices(WORKS, [work.weight for work in WORKS])[0]
        seconds, tree = self._undisturbed(work)
        place = self._fresh(f"kill-{number}")
        sent: list[str] = []
        codes: list[int] = []
        problem = ""
        try:
            for _ in range(rng.randint(1, _MOST_KILLS)):
                name, code, problem = self._kill(work, place, rng, seconds, bool(sent))
                sent.append(name)
                codes.append(code)
                if problem or not code:
                    break
            problem = problem or self._finish(work, place, tree)
        finally:
            shutil.rmtree(place)
        return Verdict(number, work.name, tuple(sent), tuple(codes), problem)

    def _kill(
        self, work: Work, place: Path, rng: Random, seconds: float, again: bool
    ) -> tuple[str, int, str]:
        """Start the command and send a signal; returns the signal, the exit code and a problem."""
        number = rng.choice(_SIGNALS)
        before = set(leftovers(place))
        after, more = rng.randrange(_STEPS), rng.uniform(0.0, 0.1)
        child = forks.start([*work.begin, *(work.again if again else ())], place)
        if work.name in _LOGGING:
            # By its steps: on a fast machine, a moment by the clock would come too late.
            while not child.has_ended(0.005) and _steps(place) < after:
                pass
            moment = more
        else:
            moment = seconds * rng.random() * 0.8
        if not child.has_ended(moment):
            child.kill(number, group=number == signal.SIGINT)
        ended = child.wait()
        return number.name, ended.code, self._wrong(ended, number, set(leftovers(place)) - before)

    def _wrong(self, ended: forks.Ended, number: signal.Signals, left: set[str]) -> str:
        if ended.code == 0:  # it was done before the signal arrived
            return wrong_end(ended)
        killed = number == signal.SIGKILL
        # Before the command has its handlers, a signal ends the process as usual.
        expected = {-number} if killed else {128 + number, -number}
        if ended.code not in expected:
            return f"{number.name}: {ended.code}: {ended.err[-1500:]}"
        if ended.orphans or ended.hung:
            return f"{number.name}: orphans {ended.orphans}, hung {ended.hung}"
        if "Traceback" in ended.err and ended.code > 0:
            return f"{number.name}: a traceback: {ended.err[-1500:]}"
        if not killed and ended.code > 0 and left:
            return f"{number.name}: left behind: {', '.join(sorted(left))}"
        return ""

    def _finish(self, work: Work, place: Path, tree: dict[str, str]) -> str:
        ended = forks.run([*work.begin, *work.again], place)
        if problem := wrong_end(ended):
            return problem
        if ended.code:
            return f"exit {ended.code}: {ended.err}"
        found = output(place)
        other = sorted(name for name in tree | found if tree.get(name) != found.get(name))
        return f"other files: {', '.join(other)}" if other else ""

    def _undisturbed(self, work: Work) -> tuple[float, dict[str, str]]:
        """How long the command takes, in seconds, and what it leaves."""
        if work not in self._whole:
            place = self._fresh("whole")
            started = time.monotonic()
            ended = forks.run(work.begin, place)
            seconds = time.monotonic() - started
            if ended.code:
                raise RuntimeError(f"{work.name}: {ended.code}\n{ended.err}")
            self._whole[work] = seconds, output(place)
            shutil.rmtree(place)
        return self._whole[work]

    def _fresh(self, name: str) -> Path:
        place = self._scratch / name
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        own_copy(self._root, place, set())
        return place


def _steps(place: Path) -> int:
    """The number of logged steps."""
    log = place / "new" / "metrics.jsonl"
    return log.read_bytes().count(b"\n") if log.is_file() else 0


def output(place: Path) -> dict[str, str]:
    """What a command has left beside the world, except pages, which contain times."""
    return {
        name: digest
        for name, digest in contents(place, place).items()
        if name.startswith("new") and not name.endswith((".html", ".md"))
    }
