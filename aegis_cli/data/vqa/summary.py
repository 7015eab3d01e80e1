"""What a set of questions holds, and a contact sheet of it."""

from __future__ import annotations

import dataclasses
import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aegis_cli.common import files, hub, media
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.data.vqa import easy, sets
from aegis_cli.data.vqa.answers import normalise
from aegis_cli.data.vqa.entries import Entry
from aegis_cli.data.vqa.images import decode

ANSWERS = 10  # of the commonest
PROBLEMS = 5  # of bad questions, by their places
SHOWN = 6  # images on a sheet
_PARTS = ("anchor", "validation", "probe")  # co-training has the images of anchors
_TILE, _TEXT = 384, 13  # pixels


@dataclass(frozen=True)
class Part:
    """The questions that one purpose gets, which are those of its images."""

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
    """An answer, as answers are compared, and of how many questions it is the reference."""

    answer: str
    questions: int
    share: float


@dataclass(frozen=True)
class QuestionsReport:
    """What is known of a set of questions.

    Attributes:
        questions, images: that can be used, as far as their files tell, or the images too.
        bad: how many questions cannot; `problems` are the first `PROBLEMS` that they have.
        repeated: how many are asked of their image a second time.
        words, answer_words: of a question and of an answer, in the median and at most.
        answers_a_question: the fewest and the most that people gave to one.
        parts: what anchors, tuning studies and probes get of them.
        answers: the `ANSWERS` commonest of `distinct_answers`.
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
    """Whether a name is that of easy-VQA, or of a file or folder of questions.

    A split may follow it after a #, and so it may a name that has the form of one on the hub.
    Others on the hub are not looked for.
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
        images: whether to decode every image, too; questions about one that cannot be are bad.

    Raises:
        AegisError: a file that cannot be read, or no question that can be used.
    """
    found = _read(name)
    if images:
        found = _with_whole_images(found, on_event)
    entries = found.entries
    asked = [entry.question for entry in entries]
    distinct = {(entry.picture.key, entry.question.text) for entry in entries}
    given = [max(len(question.answers), 1) for question in asked]
    answers = Counter(normalise(question.answer) for question in asked)
    families = Counter(question.family for question in asked)
    return QuestionsReport(
        kind="questions",
        path=name,
        questions=len(entries),
        images=len({entry.picture.key for entry in entries}),
        bad=found.skipped,
        problems=_first(found.problems),
        repeated=len(entries) - len(distinct),
        words=_words([question.text for question in asked]),
        answer_words=_words([question.answer for question in asked]),
        answers_a_question={"least": min(given), "most": max(given)},
        parts=tuple(_part(found, part) for part in _PARTS),
        families=tuple(Family(*each) for each in families.most_common()),
        distinct_answers=len(answers),
        answers=tuple(
            CommonAnswer(answer, count, count / len(entries))
            for answer, count in answers.most_common(ANSWERS)
        ),
    )


def save_sheet(name: str, out: Path) -> None:
    """Write a PNG with some images of a set, each with a question and its answer.

    Raises:
        AegisError: a set or an image that cannot be read, or a path that cannot be written.
    """
    media.check_sheet(out)
    first: dict[str, Entry] = {}
    for entry in _read(name).entries:
        first.setdefault(entry.picture.key, entry)
    spread = np.linspace(0, len(first) - 1, SHOWN).round().astype(int)
    # Of fewer images than there is room for, each is found several times.
    shown = [list(first.values())[number] for number in np.unique(spread)]
    cells = [(_caption(entry), [decode(entry.picture, None)]) for entry in shown]
    sheet = media.tiled(cells, columns=3, tile=_TILE, text=_TEXT)
    files.write_atomically(out, lambda file: sheet.save(file, format="PNG"))


def _caption(entry: Entry) -> str:
    return f"{entry.question.text}  {entry.question.answer}"


def _words(texts: Sequence[str]) -> dict[str, float]:
    """How many words texts have."""
    counts = [len(text.split()) for text in texts]
    return {"median": statistics.median(counts), "most": max(counts)}


def _first(problems: Sequence[AegisError]) -> tuple[str, ...]:
    """What is wrong with the first; several questions may be about one image that is."""
    return tuple(dict.fromkeys(problem.found for problem in problems))[:PROBLEMS]


def _with_whole_images(found: sets.Listed, on_event: OnEvent) -> sets.Listed:
    """The set without the questions about images that cannot be decoded, which are problems."""
    pictures = {entry.picture.key: entry.picture for entry in found.entries}
    broken: dict[str, AegisError] = {}
    for number, (key, picture) in enumerate(pictures.items(), start=1):
        try:
            decode(picture, None)
        except AegisError as error:  # told with the other problems
            broken[key] = error
        on_event(Progress("images", number, len(pictures), "images"))
    sound = tuple(entry for entry in found.entries if entry.picture.key not in broken)
    lost = [broken[e.picture.key] for e in found.entries if e.picture.key in broken]
    if not sound:
        raise AegisError(
            f"no image of '{found.name}' can be decoded, the first: {lost[0].found}",
            "images of a common format",
            lost[0].fix,
        )
    return dataclasses.replace(found, entries=sound, problems=(*found.problems, *lost))


def _read(name: str) -> sets.Listed:
    try:
        found = sets.read(name, skip_bad=True)
    except AegisError as error:
        known = "aegis inspect takes .jsonl and .parquet files, and lists in .json, for questions"
        if not Path(name).exists() and hub.is_id(name):
            known += ", and a repository with meta/info.json at its top for a LeRobot dataset"
        raise AegisError(error.found, error.expected, f"{error.fix}; {known}") from error
    if not isinstance(found, sets.Listed):
        raise AegisError(f"'{name}', which is rendered", "questions in files", "aegis probe MODEL")
    return found


def _part(found: sets.Listed, name: str) -> Part:
    mine = [entry for entry in found.entries if found.holds(name, entry.picture.key)]
    return Part(name, len(mine), len({entry.picture.key for entry in mine}))
