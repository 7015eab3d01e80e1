"""What a benchmark harness noted of each question: what its readers give, whatever it is called."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress, Warned

_TOLD_BYTES = 1_000_000  # between two tellings of how much is read

# By task, the files that hold its scores, by what tells them apart. A task without a file was
# asked, and what each question got was not noted.
Tasks = Mapping[str, Mapping[str, Path]]


@dataclass(frozen=True)
class Evaluation:
    """One time that a model was asked a task.

    Attributes:
        date: a text, of which the newest is the last one.
        folder: the model's.
        name: what a user knows this evaluation by.
        files: those with its scores, by what tells them apart.
    """

    date: str
    folder: Path
    name: str
    files: Mapping[str, Path]


def newest(place: Path, found: Mapping[str, Sequence[Evaluation]], on_event: OnEvent) -> Tasks:
    """The files of each task's newest evaluation; a warning tells of older ones.

    Raises:
        AegisError: a task's evaluations are in several folders, and so of several models.
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
        asked: by the question's number, what was asked, and the reference answer.
        values: by metric and question, the number that the harness gave; None where it is none.
        lines: by the question's number, how many lines without a filter's name it has.
        falling: metrics of which less is better.
        alike: by the question's number, what others share with it that are not independent of it,
            such as its image; questions that are not in it are independent.
        doubts: by why their scores tell nothing of the model, the numbers of questions.
    """

    path: Path
    asked: dict[str, tuple[Any, Any]] = field(default_factory=dict)
    lines: Counter[str] = field(default_factory=Counter)
    values: dict[str, dict[str, float | None]] = field(default_factory=lambda: defaultdict(dict))
    falling: frozenset[str] = frozenset()
    alike: dict[str, str] = field(default_factory=dict)
    doubts: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))


class Reading:
    """Tells how much of all files is read; those of a benchmark may have gigabytes."""

    def __init__(self, paths: Sequence[Path], on_event: OnEvent) -> None:
        self._total = sum(path.stat().st_size for path in paths)
        self._done, self._told, self._on_event = 0, 0, on_event

    def read(self, size: int) -> None:
        """So many bytes more."""
        self._done += size
        if self._done - self._told >= _TOLD_BYTES or self._done == self._total:
            self._told = self._done
            self._on_event(Progress("scores", self._done, self._total, "bytes"))


@dataclass(frozen=True)
class Harness:
    """What reads one harness's files.

    Attributes:
        name: the harness's.
        holds: whether a folder has files of this harness, or a file is one.
        find: the files of each task, of one model, of the newest evaluation.
        read: a task's files.
    """

    name: str
    holds: Callable[[Path], bool]
    find: Callable[[Path, OnEvent], Tasks]
    read: Callable[[str, Mapping[str, Path], Reading], QuestionLog]
