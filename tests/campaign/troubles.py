"""What else happens to a command: neighbours, full disks, little memory, odd outputs."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from random import Random
from typing import Any, get_args, get_type_hints

import typer.main
from campaign import forks, world
from campaign.subjects import contents, leftovers, own_copy, wrong_end

from aegis_cli.cli.app import app
from aegis_cli.recipes import Recipe

_SHORT = ("--set", "train.steps=12", "--set", "train.checkpoint_every=3")
_TRAIN = ("train", world.RECIPE, *world.TRAIN, *_SHORT)
# Commands and the option that names what they write.
_WRITERS: tuple[tuple[tuple[str, ...], str], ...] = (
    (_TRAIN, "--out"),
    (("demos", "point", "--episodes", "2"), "--out"),
    (("anchor", "--backbone", "model", "--vqa", world.ASKED, "--samples", "14"), "--out"),
    (("export", "run", "--format", "lerobot"), "--out"),
    (("merge", "run", "--method", "linear", "--strength", "0.5"), "--out"),
    (("report", "jobs/job"), "--out"),
    (("probe", "model", "--vqa", world.ASKED, "--questions", "14"), "--predictions"),
    (("evaluate", "run", "--demos", world.DEMOS, "--frames", "4"), "--plot"),
    (("recipes", "cp"), "quickstart"),  # which the path follows, as it does an option
)
_READERS: tuple[tuple[str, ...], ...] = (
    ("inspect", "run"),
    ("inspect", world.ANCHOR, "--json"),
    ("inspect", "dataset"),
    ("compare", "jobs/job"),
    ("probe", "model", "--vqa", world.ASKED, "--questions", "14"),
    ("evaluate", "run", "--demos", world.DEMOS, "--frames", "4", "--json"),
    ("train", world.RECIPE, *world.TRAIN, "--out", "run"),  # refused, for it is there
    ("inspect", "nothing"),
)
_COUNTING: tuple[tuple[str, ...], ...] = (
    *_READERS[4:6],
    *((*command, option, f"new-{command[0]}") for command, option in _WRITERS[1:3]),
    ("merge", "run", "--method", "factors", "--vqa", world.ASKED, "--out", "new-merge"),
)
# The limits of options and keys, and values beyond. Large counts are valid, and take long.
_ODD: dict[type, tuple[str, ...]] = {
    int: ("-100000000000000000000", "-1", "0", "1", "2"),
    float: ("-1", "-0.0", "0", "1e-300", "1e-30", "1", "1e30", "1e300", "inf", "nan"),
}


@dataclass(frozen=True)
class Verdict:
    """The result of a case; `problem` is "" if all is well."""

    case: int
    trouble: str
    what: str
    code: int
    problem: str


@dataclass
class Case:
    """A folder to work in, and the random choices."""

    place: Path
    rng: Random
    whole: dict[str, str]  # what the short training leaves where nothing happens
    seconds: float  # that it takes

    def fails(self, ended: forks.Ended, *, may: tuple[int, ...] = ()) -> str:
        """What is wrong with how a command ended, which `may` have some codes besides 0 and 2."""
        problem = "" if ended.code in may and not ended.hung else wrong_end(ended)
        if not problem and (left := leftovers(self.place)):
            return f"left behind: {', '.join(left)}"
        return problem


Outcome = tuple[str, int, str]  # what was tried, the exit code, a problem or ""


def two_writers(case: Case) -> Outcome:
    """Two trainings into one folder: one of them is refused, and the other is unaffected."""
    first = forks.start([*_TRAIN, "--out", "new"], case.place)
    time.sleep(case.rng.uniform(0, case.seconds))
    second = forks.start([*_TRAIN, "--out", "new"], case.place).wait()
    ended = first.wait()
    problem = case.fails(ended) or case.fails(second)
    if not problem and sorted((ended.code, second.code)) != [0, 2]:
        problem = f"exit {ended.code} and {second.code}: {ended.err} {second.err}"
    if not problem and contents(case.place / "new", case.place) != case.whole:
        problem = "other files than those of one training"
    return "train", second.code, problem


def overwritten_input(case: Case) -> Outcome:
    """Bytes of an input change during training: an error, or none of them were read."""
    name = case.rng.choice((world.DEMOS, world.ANCHOR))
    child = forks.start([*_TRAIN, "--out", "new"], case.place)
    done = child.has_ended(case.rng.uniform(0, case.seconds))
    path = case.place / name
    with open(path, "r+b") as file:
        file.seek(case.rng.randrange(path.stat().st_size))
        file.write(case.rng.randbytes(64))
    ended = child.wait()
    problem = case.fails(ended)
    if (
        not problem
        and ended.code == 0
        and not done
        and contents(case.place / "new", case.place) != case.whole
    ):
        problem = "other files without an error"
    return name, ended.code, problem


def cut_input(case: Case) -> Outcome:
    """An input is truncated while it is mapped: an error, or the system's signal with a message."""
    child = forks.start([*_TRAIN, "--out", "new"], case.place)
    child.has_ended(case.rng.uniform(0, case.seconds))
    os.truncate(case.place / world.DEMOS, 4096)
    ended = child.wait()
    if ended.code == -signal.SIGBUS:
        said = "Bus error" in ended.err
        return world.DEMOS, ended.code, "" if said else "a bus error without a message"
    return world.DEMOS, ended.code, case.fails(ended)


def touched_input(case: Case) -> Outcome:
    """The time of an input changes during training: nothing happens."""
    child = forks.start([*_TRAIN, "--out", "new"], case.place)
    while not child.has_ended(0.02):
        os.utime(case.place / world.DEMOS)
        os.utime(case.place / world.ANCHOR)
    ended = child.wait()
    problem = case.fails(ended) or (f"exit {ended.code}: {ended.err}" if ended.code else "")
    if not problem and contents(case.place / "new", case.place) != case.whole:
        problem = "other files"
    return "both", ended.code, problem


def full_disk(case: Case) -> Outcome:
    """No more room: an error, and once there is room again the training resumes."""
    room = int(2 ** case.rng.uniform(10, 22))
    with _full(case.place / "disk", room) as (how, limits):
        command = [*_TRAIN, "--out", "disk/new"]
        ended = forks.start(command, case.place, limits).wait()
        problem = case.fails(ended)
        kept = case.place / "kept"
        if (case.place / "disk" / "new").is_dir():
            shutil.copytree(case.place / "disk" / "new", kept, symlinks=True)
    if not problem:
        again = forks.run([*_TRAIN, "--out", "kept", "--resume"], case.place)
        problem = case.fails(again) or (f"exit {again.code}: {again.err}" if again.code else "")
        if not problem and contents(kept, case.place) != case.whole:
            problem = "other files after going on"
    return f"{room} bytes, {how}", ended.code, problem


def odd_output(case: Case) -> Outcome:
    """An output that is a device, a pipe, a folder, or in a missing folder."""
    command, option = case.rng.choice(_WRITERS)
    kind = case.rng.choice(("device", "pipe", "link to a device", "no folder", "long name"))
    suffix = {"--plot": ".png", "--predictions": ".jsonl"}.get(option, "")
    suffix = ".html" if command[0] == "report" else suffix
    path = case.place / f"odd{suffix}"
    target = f"odd{suffix}"
    if kind == "device":
        os.mknod(path, 0o666 | 0o020000, os.makedev(1, 3))
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "link to a device":
        path.symlink_to("/dev/null")
    else:
        target = f"nothing/odd{suffix}" if kind == "no folder" else "x" * 300 + suffix
    before = Path("/dev/null").stat().st_rdev
    ended = forks.run([*command, option, target], case.place)
    problem = case.fails(ended)
    if Path("/dev/null").stat().st_rdev != before:
        problem = "the device was replaced"
    made = ended.code == 0 and kind != "no folder"
    return f"{command[0]} {option} to a {kind}", ended.code, problem or ("exit 0" if made else "")


def closed_streams(case: Case) -> Outcome:
    """No reader, or no stdout at all: the exit code is unchanged, or reports that."""
    command = case.rng.choice(_READERS)
    usual = forks.run(command, case.place).code
    how = case.rng.choice(("closed", "nobody reads", "full"))
    stdout = -1
    if how == "nobody reads":
        reader, stdout = os.pipe()
        os.close(reader)
    elif how == "full":
        stdout = os.open("/dev/full", os.O_WRONLY)
    ended = forks.start(command, case.place, stdout=stdout).wait()
    if stdout != -1:
        os.close(stdout)
    expected = {usual} if how == "closed" else {usual, 2, 128 + signal.SIGPIPE}
    problem = "" if ended.code in expected else f"exit {ended.code}, not {usual}: {ended.err}"
    return f"{' '.join(command[:2])}, {how}", ended.code, problem or _no_traceback(ended)


def little_memory(case: Case) -> Outcome:
    """`ulimit -v`: success, or an error that names memory."""
    command = case.rng.choice((*_READERS[:6], (*_TRAIN, "--out", "new")))
    more = int(2 ** case.rng.uniform(12, 28))
    ended = forks.start(command, case.place, lambda: forks.limit_memory(more)).wait()
    return f"{' '.join(command[:2])}, {more >> 10} KB more", ended.code, case.fails(ended)


def odd_value(case: Case) -> Outcome:
    """An unusual number: it is accepted, or refused by its name."""
    if case.rng.random() < 0.5:
        name, kind = case.rng.choice(_keys())
        given = f"--set {name}={case.rng.choice(_ODD[kind])}"
        command: tuple[str, ...] = (*_TRAIN, "--out", "new", *given.split(maxsplit=1))
    else:
        command = case.rng.choice(_COUNTING)
        option, kind = case.rng.choice(_options(command[0]))
        given = f"{option}={case.rng.choice(_ODD[kind])}"
        command = (*command, given)
    ended = forks.run(command, case.place)
    return f"{command[0]} {given}", ended.code, case.fails(ended, may=(1,))


@cache
def _keys() -> list[tuple[str, type]]:
    """The numeric keys of a training with `aegis`, with their types."""
    hints = get_type_hints(Recipe)
    found = []
    for section in ("train", "expert", "aegis"):
        for field, hint in get_type_hints(hints[section]).items():
            if (kind := _number(hint)) is not None:
                found.append((f"{section}.{field}", kind))
    return found


@cache
def _options(name: str) -> list[tuple[str, type]]:
    """The numeric options of a command, with their types."""
    command: Any = typer.main.get_command(app)
    found = []
    for option in command.commands[name].params:
        kind = _number(option.type_descriptor.annotation)
        if option.param_type_name == "option" and kind is not None:
            found.append((option.opts[0], kind))
    return found


def _number(hint: Any) -> type | None:
    """int or float, if a value is one of them or may be omitted; else None."""
    kinds = [kind for kind in (hint, *get_args(hint)) if kind in (int, float)]
    return kinds[0] if kinds else None


TROUBLES: dict[str, Callable[[Case], Outcome]] = {
    "two writers": two_writers,
    "an input overwritten": overwritten_input,
    "an input cut": cut_input,
    "inputs touched": touched_input,
    "a full disk": full_disk,
    "an odd output": odd_output,
    "closed streams": closed_streams,
    "little memory": little_memory,
    "an odd value": odd_value,
}


class Cases:
    """Numbered cases: the same number gives the same trouble."""

    def __init__(self, root: Path, scratch: Path, seed: int = 0, only: str = "") -> None:
        self._root, self._scratch, self._seed = root, scratch, seed
        self._names = [name for name in TROUBLES if only in name] or list(TROUBLES)
        self._undisturbed: tuple[dict[str, str], float] | None = None

    def run(self, number: int) -> Verdict:
        """Cause a trouble and judge how the command ends."""
        rng = Random(f"{self._seed} trouble {number}")
        name = self._names[number % len(self._names)]
        whole, seconds = self._whole()
        place = self._fresh(f"trouble-{number}")
        try:
            what, code, problem = TROUBLES[name](Case(place, rng, whole, seconds))
        finally:
            shutil.rmtree(place)
        return Verdict(number, name, what, code, problem)

    def _whole(self) -> tuple[dict[str, str], float]:
        if self._undisturbed is None:
            place = self._fresh("undisturbed")
            started = time.monotonic()
            ended = forks.run([*_TRAIN, "--out", "new"], place)
            if ended.code:
                raise RuntimeError(ended.err)
            self._undisturbed = contents(place / "new", place), time.monotonic() - started
            shutil.rmtree(place)
        return self._undisturbed

    def _fresh(self, name: str) -> Path:
        place = self._scratch / name
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        own_copy(self._root, place, {world.DEMOS, world.ANCHOR})
        return place


@contextmanager
def _full(folder: Path, room: int) -> Iterator[tuple[str, Callable[[], None] | None]]:
    """A folder with `room` bytes: a file system of that size, or where that may not be mounted, a
    limit to each file's size.

    Yields:
        Which of them it is, and what a child has to do for it.
    """
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={room}", "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True, check=False).returncode == 0:
        try:
            yield "a full file system", None
        finally:
            subprocess.run(["umount", str(folder)], check=True)
    else:
        yield (
            "files of a limited size",
            lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (room, room)),
        )


def _no_traceback(ended: forks.Ended) -> str:
    return f"a traceback: {ended.err[-1500:]}" if "Traceback" in ended.err else ""
