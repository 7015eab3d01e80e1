"""What a benchmark harness recorded for each question, in one form for all harnesses."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Tally, Warned

_TOLD_BYTES = 1_000_000  # bytes read between two progress events

# Task -> its files of scores, by a name that tells them apart. A task without a file was evaluated,
# but no scores per question were recorded.
Tasks = Mapping[str, Mapping[str, Path]]


@dataclass(frozen=True)
class Evaluation:
    """One evaluation of a model on a task.

    Attributes:
        date: a text that sorts by time.
        folder: the model's folder.
        name: the evaluation's name for a user.
        files: its files of scores, by a name that tells them apart.
    """

    date: str
    folder: Path
    name: str
    files: Mapping[str, Path]


def newest(place: Path, found: Mapping[str, Sequence[Evaluation]], on_event: OnEvent) -> Tasks:
    """The files of each task's newest evaluation; a warning mentions older ones.

    Raises:
        AegisError: a task's evaluations are in several folders, so they belong to several models.
    """
    tasks: dict[str, Mapping[str, Path]] = {}
    for task, own in found.items():
        folders = sorted({str(evaluation.folder) for evaluation in own})
        if len(folders) > 1:
            raise AegisError(
                f"scores of {task} in {len(folders)} folders below '{place}'",
                "the scores of one model",
                f"give one of them, such as '{folders[0]}'",
            )
        last = max(own, key=lambda evaluation: evaluation.date)
        if len(own) > 1:
            text = f"{len(own)} evaluations of {task} in '{place}': the newest is read"
            on_event(Warned("scores", f"{text}, '{last.name}'"))
        tasks[task] = last.files
    return tasks


@dataclass
class QuestionLog:
    """One model's answers to one task.

    Attributes:
        path: the first file that they were read from.
        asked: question number -> what was asked, and the reference answer.
        values: metric and question -> the harness's value; None if it is not a number.
        lines: question number -> how many lines without a filter's name it has.
        falling: metrics for which lower is better.
        alike: question number -> what it shares with questions that depend on it, such as its
            image; questions that are not in it are independent.
        doubts: reason why scores say nothing about the model -> numbers of these questions.
    """

    path: Path
    asked: dict[str, tuple[Any, Any]] = field(default_factory=dict)
    lines: Counter[str] = field(default_factory=Counter)
    values: dict[str, dict[str, float | None]] = field(default_factory=lambda: defaultdict(dict))
    falling: frozenset[str] = frozenset()
    alike: dict[str, str] = field(default_factory=dict)
    doubts: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))


def tally_of(paths: Sequence[Path], on_event: OnEvent) -> Tally:
    """Reports how much of all files has been read; a benchmark's may have gigabytes."""
    total = sum(path.stat().st_size for path in paths)
    return Tally("scores", total, "bytes", _TOLD_BYTES, on_event)


@dataclass(frozen=True)
class Harness:
    """A reader of one harness's files.

    Attributes:
        name: the harness's name.
        holds: whether a folder has files of this harness, or a file is one.
        find: finds the files of each task's newest evaluation of one model.
        read: reads a task's files.
    """

    name: str
    holds: Callable[[Path], bool]
    find: Callable[[Path, OnEvent], Tasks]
    read: Callable[[str, Mapping[str, Path], Tally], QuestionLog]
