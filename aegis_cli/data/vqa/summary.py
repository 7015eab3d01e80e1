"""A summary of a set of questions, and a contact sheet."""

from __future__ import annotations

import dataclasses
import statistics
from array import array
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aegis_cli.common import files, hub, media
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Item, OnEvent, Progress, Tally, ignore
from aegis_cli.data.vqa import easy, sets
from aegis_cli.data.vqa.answers import normalise
from aegis_cli.data.vqa.entries import Entry
from aegis_cli.data.vqa.images import decode
from aegis_cli.data.vqa.packed import Entries

ANSWERS = 10  # the most common ones listed
PROBLEMS = 5  # the bad questions listed, with their places
SHOWN = 6  # images on a sheet
_PARTS = ("anchor", "validation", "probe")  # co-training uses the anchors' images
_TILE, _TEXT = 384, 13  # pixels
_EVERY = 20_000  # questions or images between two reports of progress


@dataclass(frozen=True)
class Part:
    """The questions of one part, which are those about its images."""

    name: str
    questions: int
    images: int


@dataclass(frozen=True)
class Family:
    """Questions of one kind, such as an annotation's `answer_type`."""

    name: str
    questions: int


@dataclass(frozen=True)
class CommonAnswer:
    """A normalised answer, and the number of questions whose reference it is."""

    answer: str
    questions: int
    share: float


@dataclass(frozen=True)
class QuestionsReport:
    """The report on a set of questions.

    Attributes:
        questions, images: usable ones, judged by the files, or by the images too if they were
            decoded.
        bad: how many questions are unusable; `problems` are the first `PROBLEMS` errors.
        repeated: how many questions repeat an earlier one about the same image.
        words, answer_words: median and maximum per question and per answer.
        answers_a_question: the fewest and the most answers per question.
        parts: the shares for anchors, tuning studies and probes.
        answers: the `ANSWERS` most common of `distinct_answers`.
    """

    kind: str
    path: str
    questions: int
    images: int
    bad: int
    problems: tuple[str, ...]
    repeated: int
    words: dict[str, float]
    answer_words: dict[str, float]
    answers_a_question: dict[str, int]
    parts: tuple[Part, ...]
    families: tuple[Family, ...]
    distinct_answers: int
    answers: tuple[CommonAnswer, ...]

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def is_set(name: str) -> bool:
    """Whether a name stands for easy-VQA, or for a file or folder of questions.

    A split may follow after a #; with one, any name in the form of a hub id counts too. The hub
    itself is not queried.
    """
    if name == easy.NAME:
        return True
    path = Path(name)
    if not path.exists() and "#" in name:
        own = name.rpartition("#")[0]
        path = Path(own)
        if not path.exists() and not hub.is_local(own):
            return True
    return sets.is_file(path) or (path.is_dir() and sets.is_folder(path))


def of_set(name: str, images: bool = False, on_event: OnEvent = ignore) -> QuestionsReport:
    """Read every question of a set.

    Args:
        images: whether to decode every image too; questions about undecodable images are bad.

    Raises:
        AegisError: a file cannot be read, or no question is usable.
    """
    found = _read(name, on_event)
    if images:
        found = _with_whole_images(found, on_event)
    entries = found.entries
    words, answer_words = array("I"), array("I")
    given, families, said = set[int](), Counter[str](), Counter[str]()
    for entry in _counted(entries, "count", "questions", on_event):
        question = entry.question
        words.append(len(question.text.split()))
        answer_words.append(len(question.answer.split()))
        given.add(max(len(question.answers), 1))
        families[question.family] += 1
        said[question.answer] += 1
    answers = Counter[str]()
    for answer, count in said.items():  # a few answers are given a million times
        answers[normalise(answer)] += count
    return QuestionsReport(
        kind="questions",
        path=name,
        questions=len(entries),
        images=len(entries.images),
        bad=found.skipped,
        problems=_first(found.problems),
        repeated=sum(
            _repeated(entries, key)
            for key in _counted(entries.images, "compare questions", "images", on_event)
        ),
        words=_words(words),
        answer_words=_words(answer_words),
        answers_a_question={"least": min(given), "most": max(given)},
        parts=tuple(_part(found, part) for part in _PARTS),
        families=tuple(Family(*each) for each in families.most_common()),
        distinct_answers=len(answers),
        answers=tuple(
            CommonAnswer(answer, count, count / len(entries))
            for answer, count in answers.most_common(ANSWERS)
        ),
    )


def _counted(items: Sequence[Item], stage: str, unit: str, on_event: OnEvent) -> Iterator[Item]:
    return Tally(stage, len(items), unit, _EVERY, on_event).each(items)


def _repeated(entries: Entries, key: str) -> int:
    """How many questions about an image repeat an earlier one about it."""
    texts = [entry.question.text for entry in entries.about(key)]
    return len(texts) - len(set(texts))


def save_sheet(name: str, out: Path, on_event: OnEvent = ignore) -> None:
    """Write a PNG with some images of a set, each with a question and its answer.

    Raises:
        AegisError: a set or an image cannot be read, or the path cannot be written.
    """
    media.check_sheet(out)
    entries = _read(name, on_event).entries
    spread = np.linspace(0, len(entries.images) - 1, SHOWN).round().astype(int)
    # If there are fewer images than places, some are found several times.
    shown = [entries.about(entries.images[number], 1)[0] for number in np.unique(spread)]
    cells = [(_caption(entry), [decode(entry.picture, None)]) for entry in shown]
    sheet = media.tiled(cells, columns=3, tile=_TILE, text=_TEXT)
    files.write_atomically(out, lambda file: sheet.save(file, format="PNG"))


def _caption(entry: Entry) -> str:
    return f"{entry.question.text}  {entry.question.answer}"


def _words(counts: Sequence[int]) -> dict[str, float]:
    """Median and maximum of the numbers of words of texts."""
    return {"median": statistics.median(counts), "most": max(counts)}


def _first(problems: Sequence[AegisError]) -> tuple[str, ...]:
    """The first distinct problems; several questions may share a broken image."""
    return tuple(dict.fromkeys(problem.found for problem in problems))[:PROBLEMS]


def _with_whole_images(found: sets.Listed, on_event: OnEvent) -> sets.Listed:
    """The set without questions about undecodable images, which become problems."""
    entries = found.entries
    pictures = {key: entries.picture(key) for key in entries.images}
    broken: dict[str, AegisError] = {}
    for number, (key, picture) in enumerate(pictures.items(), start=1):
        try:
            decode(picture, None)
        except AegisError as error:  # reported with the other problems
            broken[key] = error
        on_event(Progress("images", number, len(pictures), "images"))
    if not broken:
        return found
    sound = Entries(entry for entry in entries if entry.picture.key not in broken)
    lost = [broken[e.picture.key] for e in entries if e.picture.key in broken]
    if not sound:
        raise AegisError(
            f"no image of '{found.name}' can be decoded, the first: {lost[0].found}",
            "images of a common format",
            lost[0].fix,
        )
    return dataclasses.replace(found, entries=sound, problems=(*found.problems, *lost))


def _read(name: str, on_event: OnEvent) -> sets.Listed:
    try:
        found = sets.read(name, skip_bad=True, on_event=on_event)
    except AegisError as error:
        known = "aegis inspect takes .jsonl and .parquet files, and lists in .json, for questions"
        if not Path(name).exists() and hub.is_id(name):
            known += ", and a repository with meta/info.json at its top for a LeRobot dataset"
        raise AegisError(error.found, error.expected, f"{error.fix}; {known}") from error
    if not isinstance(found, sets.Listed):
        raise AegisError(f"'{name}', which is rendered", "questions in files", "aegis probe MODEL")
    return found


def _part(found: sets.Listed, name: str) -> Part:
    mine = [key for key in found.entries.images if found.holds(name, key)]
    return Part(name, sum(map(found.entries.count, mine)), len(mine))
