"""Files to damage, and the commands that read them."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

from campaign import forks, world
from campaign.mutations import damage

# Values of a report or a log that differ between repetitions.
_TIMES = {
    *("data_s", "update_s", "step_s", "samples_per_s", "episodes_per_s", "step_time_ratio"),
    *("minutes", "seconds", "out", "outputs", "trained_on", "split"),
}
_ERROR = ("found:", "expected:", "fix:")


@dataclass(frozen=True)
class Subject:
    """A kind of file, and a command that reads it.

    Attributes:
        files: patterns of the files to damage, relative to the world's folder.
        args: arguments of the command that reads them.
        digest: whether a digest verifies their content; a file without one may be read as another
            valid file of its kind.
        weight: how often it is drawn.
        writes: the folder that the command writes, whose content is compared too.
    """

    name: str
    files: tuple[str, ...]
    args: tuple[str, ...]
    digest: bool
    weight: int
    writes: str | None = None


_RESUME = ("train", "small.yaml", *world.TRAIN, "--out", "begun", "--resume", "--json")
_STATE = "begun/checkpoints/last/training_state/state.safetensors"
_ASKED = ("--questions", "14", "--json")
_POLICY = ("run/checkpoints/last/backbone/*.safetensors", "run/checkpoints/last/expert.safetensors")
# The held-out episodes would depend on whether the file's bytes are those of the training.
_EVALUATED = ("--demos", world.DEMOS, "--episodes", "0-3", "--frames", "4", "--json")
_EVALUATE = ("evaluate", "run", *_EVALUATED)

SUBJECTS: tuple[Subject, ...] = (
    Subject("anchor", (world.ANCHOR,), ("inspect", world.ANCHOR, "--json"), True, 10),
    Subject("anchor, verified", (world.ANCHOR,), ("inspect", world.ANCHOR, "--verify"), True, 4),
    Subject(
        "anchor, trained with",
        (world.ANCHOR,),
        ("train", "small.yaml", *world.TRAIN, "--out", "new", "--json"),
        True,
        2,
        "new",
    ),
    Subject("demonstrations", (world.DEMOS,), ("inspect", world.DEMOS, "--verify"), True, 8),
    Subject("demonstrations, evaluated on", (world.DEMOS,), _EVALUATE, True, 4),
    Subject("backbone", ("model/model.safetensors",), ("inspect", "model", "--verify"), True, 6),
    Subject(
        "backbone, asked",
        ("model/model.safetensors",),
        ("probe", "model", "--vqa", world.ASKED, *_ASKED),
        True,
        3,
    ),
    Subject("policy", _POLICY, _EVALUATE, True, 5),
    Subject(
        "exported policy",
        ("exported/*.json", "exported/*.safetensors"),
        ("evaluate", "exported", *_EVALUATED),
        False,
        4,
    ),
    Subject("training state", (_STATE,), _RESUME, True, 8, "begun"),
    Subject("ledger", ("run/ledger.safetensors",), ("inspect", "run", "--json"), True, 8),
    Subject("ledger, resumed with", ("begun/ledger.safetensors",), _RESUME, True, 3, "begun"),
    Subject("run", ("begun/recipe.yaml", "begun/metrics.jsonl"), _RESUME, False, 3, "begun"),
    Subject(
        "run, shown",
        ("run/recipe.yaml", "run/metrics.jsonl"),
        ("inspect", "run", "--json"),
        False,
        5,
    ),
    Subject(
        "experts and routers",
        ("stream/experts.safetensors", "stream/routing.safetensors"),
        ("inspect", "stream", "--verify"),
        True,
        8,
    ),
    Subject(
        "stream in progress",
        ("stream-begun/**/*.safetensors",),
        ("train", "stream.yaml", "--out", "stream-begun", "--resume", "--json"),
        True,
        1,
        "stream-begun",
    ),
    Subject("stream.json", ("stream/*.json",), ("inspect", "stream", "--json"), False, 8),
    Subject("recipe", ("*.yaml",), ("inspect", "{file}", "--json"), False, 12),
    Subject(
        "stages.json",
        ("jobs/job/stages.json", "jobs/job/stages/*.json", "jobs/job/table.json"),
        ("run", "job.yaml", "--out", "jobs", "--json"),
        False,
        2,
    ),
    Subject(
        "results of a job",
        ("jobs/job/table.json", "jobs/job/*/results/*.json", "jobs/job/*/*.json"),
        ("report", "jobs/job", "--json"),
        False,
        6,
    ),
    Subject("table.json", ("jobs/job/table.json",), ("inspect", "jobs/job", "--json"), False, 5),
    Subject(
        "cells.json",
        ("studies/small/cells.json",),
        ("run", "study.yaml", "--out", "studies", "--json"),
        False,
        2,
    ),
    Subject(
        "dataset, shown",
        ("dataset/meta/**/*.*",),
        ("inspect", "dataset", "--json"),
        False,
        10,
    ),
    Subject(
        "dataset, trained on",
        ("dataset/meta/**/*.*", "dataset/data/**/*.parquet"),
        ("train", "small.yaml", "--method", "naive", "--demos", "dataset", "--out", "new"),
        False,
        5,
        "new",
    ),
    Subject(
        "questions in lines",
        ("questions/lines/set.jsonl", "questions/lines/images/*.png"),
        ("probe", "model", "--vqa", world.ASKED, *_ASKED),
        False,
        6,
    ),
    Subject(
        "questions, official files",
        ("questions/official/*.json", "questions/official/val2014/*.jpg"),
        (
            *("probe", "model", "--vqa"),
            "questions/official/v2_OpenEnded_mscoco_val2014_questions.json",
            *_ASKED,
        ),
        False,
        5,
    ),
    Subject(
        "questions, saved dataset",
        ("questions/saved/*",),
        ("probe", "model", "--vqa", "questions/saved", *_ASKED),
        False,
        5,
    ),
    Subject(
        "questions, parquet",
        ("questions/parquet/*",),
        ("probe", "model", "--vqa", "questions/parquet", *_ASKED),
        False,
        4,
    ),
)


@dataclass(frozen=True)
class Verdict:
    """The result of a case; `problem` is "" if all is well."""

    case: int
    subject: str
    damage: str
    file: str
    code: int
    problem: str


class Cases:
    """Numbered cases: the same number gives the same damage to the same file."""

    def __init__(
        self, root: Path, scratch: Path, seed: int = 0, subjects: Sequence[Subject] = SUBJECTS
    ) -> None:
        """Use the world in `root`; cases run in folders below `scratch`."""
        self._root, self._scratch, self._seed = root, scratch, seed
        self._subjects = subjects
        self._whole: dict[Subject, tuple[forks.Ended, dict[str, str]]] = {}

    def run(self, number: int) -> Verdict:
        """Damage a file, and run the command that reads it."""
        rng = Random(f"{self._seed} {number}")
        subject = rng.choices(self._subjects, [subject.weight for subject in self._subjects])[0]
        place = self._fresh(number)
        try:
            files = sorted(
                path
                for pattern in subject.files
                for path in self._root.glob(pattern)
                if path.is_file()
            )
            file = rng.choice(files).relative_to(self._root)
            own_copy(self._root, place, {file.parts[0], subject.writes or ""})
            done = damage(rng, place / file)
            ended = forks.run([arg.format(file=file) for arg in subject.args], place)
            sealed = subject.digest and done.sealed
            problem = self._problem(subject, file, place, ended, sealed)
        finally:
            shutil.rmtree(place)
        return Verdict(number, subject.name, done.name, str(file), ended.code, problem)

    def _problem(
        self, subject: Subject, file: Path, place: Path, ended: forks.Ended, sealed: bool
    ) -> str:
        if problem := wrong_end(ended):
            return problem
        if left := leftovers(place):
            return f"left behind: {', '.join(left)}"
        if ended.code == 0 and sealed:
            whole, tree = self._undamaged(subject, file)
            if figures(ended.out) != figures(whole.out):
                return f"other output without an error: {ended.out[-2000:]}"
            found = contents(place / subject.writes, place) if subject.writes else {}
            other = {name for name in tree | found if tree.get(name) != found.get(name)}
            # Damage to parts that are never read is still there.
            damaged = (self._root / file).resolve().relative_to(self._root.resolve())
            if other - {"/".join(damaged.parts[1:])}:
                return f"other files without an error: {', '.join(sorted(other))}"
        return ""

    def _undamaged(self, subject: Subject, file: Path) -> tuple[forks.Ended, dict[str, str]]:
        """The command's output and files without any damage."""
        if subject not in self._whole:
            place = self._fresh(-1)
            own_copy(self._root, place, {file.parts[0], subject.writes or ""})
            ended = forks.run(subject.args, place)
            if ended.code:
                raise RuntimeError(f"{subject.name}: {ended.code}\n{ended.err}")
            tree = contents(place / subject.writes, place) if subject.writes else {}
            shutil.rmtree(place)
            self._whole[subject] = ended, tree
        return self._whole[subject]

    def _fresh(self, number: int) -> Path:
        place = self._scratch / f"case-{number}"
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        return place


def own_copy(root: Path, place: Path, own: set[str]) -> None:
    """The world as links, with copies of what the case damages or writes."""
    for path in root.iterdir():
        if path.name not in own:
            (place / path.name).symlink_to(path)
        elif path.is_dir():
            shutil.copytree(path, place / path.name, symlinks=True)
        else:
            shutil.copyfile(path, place / path.name)


def wrong_end(ended: forks.Ended) -> str:
    """What is wrong with how a command ended; "" for exit 0, and for exit 2 with one clear error.

    An error is clear if it says what was found, what was expected and what to do.
    """
    tail = ended.err[-2000:]
    if ended.hung:
        return f"hung: {tail}"
    if ended.orphans:
        return "processes outlived it"
    if ended.code not in (0, 2):
        return f"exit {ended.code}: {tail}"
    if "Traceback" in ended.err or "Traceback" in ended.out:
        return f"a traceback: {tail}"
    if control := {c for c in ended.out + ended.err if c < " " and c not in "\n\r\t"}:
        return f"control characters {control}"
    lines = ended.err.splitlines()
    said = [sum(line.startswith(label) for line in lines) for label in _ERROR]
    if ended.code == 2 and said != [1, 1, 1]:
        return f"exit 2 with {said} lines of found, expected, fix: {tail}"
    return ""


def leftovers(place: Path) -> list[str]:
    """Temporary files and folders that were left behind."""
    return [
        str(path.relative_to(place))
        for path in place.rglob("*")
        if path.name.startswith(".") or path.name.endswith(".tmp")
    ]


def figures(out: str) -> Any:
    """A command's output, without the parts that differ between repetitions."""
    try:
        return _timeless(json.loads(out))
    except ValueError:
        return out


def contents(folder: Path, place: Path) -> dict[str, str]:
    """Every file below a folder with its digest, links with their targets.

    Args:
        place: the folder of the case, whose own path in a JSON file does not count.
    """
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_symlink():
            found[name] = f"-> {os.readlink(path)}"
        elif path.suffix in (".json", ".jsonl") and path.is_file():
            text = path.read_text().replace(str(place), "PLACE")
            lines = text.splitlines() if path.suffix == ".jsonl" else [text]
            found[name] = json.dumps([_timeless(json.loads(line)) for line in lines])
        elif path.is_file():
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def _timeless(document: Any) -> Any:
    if isinstance(document, dict):
        return {key: _timeless(value) for key, value in document.items() if key not in _TIMES}
    if isinstance(document, list):
        return [_timeless(value) for value in document]
    return document
