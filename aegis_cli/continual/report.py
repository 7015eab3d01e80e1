"""What is said of a stream: a task's routing and parameters, the matrix of all tasks, its figures.

A matrix is what a probe measures again and what lies in a file of its own; a report is a matrix
and what the training recorded beside it.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from pydantic import TypeAdapter

from aegis_cli.core.accuracy_matrix import (
    SeenScores,
    StreamScores,
    reuse_rate,
    seen_error_scores,
    seen_scores,
)
from aegis_cli.data.streams import mtil
from aegis_cli.recipes import TEST
from aegis_cli.training import folder

Rows = tuple[tuple[float, ...], ...]
Ends = Sequence[Sequence[float] | None]  # of the intervals of a row


# --- a task ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SiteRouting:
    """What one map's router does for one task, at the task's end.

    Attributes:
        site: the map's name.
        experts: numbers of the experts it uses, none where no loss reads the map.
        owners: the tasks that brought these experts.
        mass: mean weight of each over the positions that the loss reads.
        load: share of each in the summed p ||B A x||.
        pruned: new experts that went after phase 1.
        dropped: old experts that the router forgot then.
        trained_phase1, trained: parameters here that learned in phase 1 (None without one) and in
            the last phase.
        added: numbers stored here since the task before.
    """

    site: str
    experts: tuple[int, ...]
    owners: tuple[int, ...]
    mass: tuple[float, ...]
    load: tuple[float, ...]
    pruned: tuple[int, ...]
    dropped: tuple[int, ...]
    trained_phase1: int | None
    trained: int
    added: int


@dataclass(frozen=True)
class TaskRecord:
    """One task, learned.

    Attributes:
        task: the task's name.
        phase1_steps: steps of phase 1; None for a learner with one phase.
        trained_phase1, trained: parameters that learned in phase 1, and in the last (or only)
            phase.
        trained_mean: parameters that learned, mean over all steps of the task.
        added: numbers stored since the task before, those that tell the task included.
        history_mass: routing mass on experts of earlier tasks, mean over maps that have some; None
            where none has.
        untouched: share of maps that the task added no expert to; None without experts.
        loss: loss of the last step; None where nothing learns.
        sites: the routing per map.
    """

    task: str
    phase1_steps: int | None
    trained_phase1: int | None
    trained: int
    trained_mean: float
    added: int
    history_mass: float | None
    untouched: float | None
    loss: float | None
    sites: tuple[SiteRouting, ...]


def record_from(raw: Mapping[str, Any]) -> TaskRecord:
    """A record from its JSON."""
    return TypeAdapter(TaskRecord).validate_python(raw)


def history_mass(sites: Sequence[SiteRouting], before: Sequence[TaskRecord]) -> list[float]:
    """The mass on earlier tasks' experts, per map.

    Only maps count that got experts with an earlier task and have some now.
    """
    grown = {s.site for record in before for s in record.sites if s.experts}
    task = len(before)
    masses = []
    for site in sites:
        if not site.experts or site.site not in grown:
            continue
        of_each = zip(site.mass, site.owners, strict=True)
        masses.append(sum(mass for mass, owner in of_each if owner < task))
    return masses


def untouched(sites: Sequence[SiteRouting], task: int) -> float | None:
    """Share of maps to which the task added no expert; None without maps."""
    return sum(task not in s.owners for s in sites) / len(sites) if sites else None


# --- the matrix -----------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Matrix(ABC):
    """What a run of a learner reached on each task, after each task.

    Attributes:
        kind: what `aegis inspect` calls a run of such a stream.
        model_name: what the tables call the model that learns.
        file: name of the file that holds the matrix, whose keys are `keys`.
        score: what the matrix holds.
    """

    kind: ClassVar[str]
    model_name: ClassVar[str]
    file: ClassVar[str]
    keys: ClassVar[tuple[str, ...]]
    score: ClassVar[str]

    method: str
    tasks: tuple[str, ...]

    @abstractmethod
    def figures(self) -> list[float]:
        """All measured shares and errors, in an order of their own."""

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)

    def matrix_json(self) -> dict[str, Any]:
        """What the matrix's file holds."""
        plain = self.to_json()
        return {key: plain[key] for key in self.keys}


@dataclass(frozen=True, kw_only=True)
class AccuracyMatrix(Matrix):
    """Accuracies R [T, T] of an encoder: row t after learning task t, column i on task i.

    Attributes:
        split: the tasks' parts that accuracies are of: `test`, or `validation` where settings are
            chosen.
        oracle, inferred: R with the task told, and with the task inferred from the image; for a
            learner with one state for all tasks they are the same. In the columns i > t of tasks
            that have not come, `oracle` is what the bare encoder reaches, or the current weights of
            a learner with one state.
        scores, inferred_scores: Transfer, Average, Last and forgetting of the two.
    """

    kind = "stream-run"
    model_name = "encoder"
    file = "accuracy_matrix.json"
    score = "accuracy"
    keys = ("tasks", "split", "method", "oracle", "inferred", "scores", "inferred_scores")

    split: str
    oracle: Rows
    inferred: Rows
    scores: StreamScores
    inferred_scores: StreamScores

    def figures(self) -> list[float]:
        return [share for row in (*self.oracle, *self.inferred) for share in row]


@dataclass(frozen=True)
class VqaScore:
    """What the backbone knows with no task active.

    Attributes:
        accuracy: share of correct answers in [0, 1].
        cross_entropy: of the answers, in nats.
        drop_points: percentage points of accuracy lost since before the first task.
    """

    accuracy: float
    cross_entropy: float
    drop_points: float


@dataclass(frozen=True, kw_only=True)
class RobotMatrix(Matrix):
    """What policies reached on robot tasks, and what their backbone knows."""

    kind = "robot-stream-run"
    model_name = "backbone"

    @property
    @abstractmethod
    def measured_rows(self) -> Rows:
        """The triangle as it was measured."""

    @property
    def measured_intervals(self) -> Sequence[Ends]:
        """The 95 % interval of each entry, where it has one."""
        return ()

    @staticmethod
    @abstractmethod
    def of_measured(
        rows: Sequence[Sequence[float]], intervals: Sequence[Ends], held: Sequence[float | None]
    ) -> dict[str, Any]:
        """The triangle with its figures, by the names of a matrix.

        Args:
            intervals: of each error, where errors are measured.
            held: of each task the error of holding the position, where errors are measured.
        """


@dataclass(frozen=True, kw_only=True)
class SuccessMatrix(RobotMatrix):
    """Success of a policy in closed loop, and what its backbone knows.

    Attributes:
        success: S, row t with t + 1 entries: success on task i after learning tasks 0 to t, the
            task told; of a suite task its return's share of the highest. A task that has not come
            has no scales to act with, and so no entry.
        scores: Average, Last and forgetting over these entries.
        vqa: before the first task, and after each. With experts nothing of a task is active then,
            so that nothing can change; `sequential` has no other weights than those that it goes on
            training.
    """

    file = "success_matrix.json"
    score = "success"
    keys = ("tasks", "method", "success", "scores", "vqa")

    success: Rows
    scores: SeenScores
    vqa: tuple[VqaScore, ...]

    def figures(self) -> list[float]:
        success = [share for row in self.success for share in row]
        return success + [score.accuracy for score in self.vqa]

    @property
    def measured_rows(self) -> Rows:
        return self.success

    @staticmethod
    def of_measured(
        rows: Sequence[Sequence[float]], intervals: Sequence[Ends], held: Sequence[float | None]
    ) -> dict[str, Any]:
        return {"success": as_rows(rows), "scores": seen_scores(rows)}


@dataclass(frozen=True, kw_only=True)
class ErrorMatrix(RobotMatrix):
    """Open-loop errors of a policy in tasks that no simulator has, and what its backbone knows.

    Attributes:
        errors: row t with t + 1 entries: the error at held-out frames of task i after learning
            tasks 0 to t, the task told. It is the mean squared error over the variance of the
            training's actions, as `aegis evaluate` has it.
        error_intervals: the 95 % interval of each, by Student's t over episodes; None of one.
        hold_errors: of each task the error of repeating the current position there; None where
            actions are no positions.
        scores: Average, Last and forgetting of the errors, of which less is better.
        vqa: before the first task, and after each.
    """

    file = "error_matrix.json"
    score = "errors"
    keys = ("tasks", "method", "errors", "error_intervals", "hold_errors", "scores", "vqa")

    errors: Rows
    error_intervals: tuple[tuple[tuple[float, float] | None, ...], ...]
    hold_errors: tuple[float | None, ...]
    scores: SeenScores
    vqa: tuple[VqaScore, ...]

    def figures(self) -> list[float]:
        errors = [error for row in self.errors for error in row]
        return errors + [score.accuracy for score in self.vqa]

    @property
    def measured_rows(self) -> Rows:
        return self.errors

    @property
    def measured_intervals(self) -> Sequence[Ends]:
        return self.error_intervals

    @staticmethod
    def of_measured(
        rows: Sequence[Sequence[float]], intervals: Sequence[Ends], held: Sequence[float | None]
    ) -> dict[str, Any]:
        return {
            "errors": as_rows(rows),
            "error_intervals": tuple(
                tuple(None if ends is None else (ends[0], ends[1]) for ends in row)
                for row in intervals
            ),
            "hold_errors": tuple(held)[: len(rows)],
            "scores": seen_error_scores(rows),
        }


def vqa_scores(rows: Sequence[Sequence[float]]) -> tuple[VqaScore, ...]:
    """Scores from rows of (accuracy, cross-entropy), the first of them before any task."""
    first = rows[0][0]
    return tuple(VqaScore(accuracy, loss, 100 * (first - accuracy)) for accuracy, loss in rows)


def as_rows(rows: Sequence[Sequence[float]]) -> Rows:
    """A matrix that cannot be changed any more."""
    return tuple(tuple(row) for row in rows)


# --- the report -----------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class StreamReport(Matrix):
    """A stream, learned.

    Attributes:
        name: the recipe's name.
        stream: the stream's name; of robot tasks, the tasks joined.
        parameters: numbers stored beside the bare model at the end.
        trained_phase1, trained, trained_mean: means over tasks of the records' figures.
        reuse: mean over tasks after the first, and maps that earlier tasks gave experts, of the
            routing mass on these.
        records: what was learned, per task.
        inputs: digests of what the run was made from and measured with.
        out: the run folder.
        minutes: time of training and evaluation. `out` and `minutes` are not part of the run's
            files, which are the same in every repetition.
    """

    name: str
    stream: str
    parameters: int
    trained_phase1: float | None
    trained: float
    trained_mean: float
    reuse: float | None
    records: tuple[TaskRecord, ...]
    inputs: Mapping[str, str]
    out: str
    minutes: float

    @property
    def source(self) -> str:
        """What was learned, for a title."""
        return self.stream


@dataclass(frozen=True, kw_only=True)
class ImageStreamReport(StreamReport, AccuracyMatrix):
    """A stream of classification tasks, learned.

    Attributes:
        inference_parameters: how many of `parameters` tell the task.
        path: the folder of the images, where they are the user's own; JSON has it only there.
    """

    inference_parameters: int
    path: str | None = None

    @property
    def source(self) -> str:
        """What was learned, for a title."""
        return self.stream if self.path is None else f"the folder {self.path}"

    def to_json(self) -> dict[str, Any]:
        plain = super().to_json()
        return {key: value for key, value in plain.items() if key != "path" or value is not None}

    @property
    def published(self) -> Mapping[str, tuple[float, float, float]]:
        """What papers print for this stream: Transfer, Average and Last in percent, by method.

        There is nothing unless the stream was learned whole and in its order.
        """
        whole = self.split == TEST and self.tasks == mtil.STREAMS.get(self.stream)
        return mtil.PUBLISHED.get(self.stream, {}) if whole else {}


@dataclass(frozen=True, kw_only=True)
class RobotStreamReport(StreamReport, SuccessMatrix):
    """A stream of simulated robot tasks, learned.

    `parameters` counts the action expert, scales, experts and routers.
    """


@dataclass(frozen=True, kw_only=True)
class RecordedStreamReport(StreamReport, ErrorMatrix):
    """A stream of robot tasks that no simulator has, learned; `parameters` counts as there."""


def report_from(kind: type[StreamReport], raw: Mapping[str, Any], out: Path) -> StreamReport:
    """A report from its JSON, which lies in the run folder `out`.

    Raises:
        ValueError: the JSON is not that of such a report.
        AegisError: the run's log is missing or damaged.
    """
    whole = {**raw, "out": str(out), "minutes": minutes(out)}
    return TypeAdapter(kind).validate_python(whole)


def sums(records: Sequence[TaskRecord]) -> dict[str, Any]:
    """What all records together say of parameters and reuse, by a report's names."""
    first = [r.trained_phase1 for r in records if r.trained_phase1 is not None]
    masses = []
    for task, record in enumerate(records):
        masses.append(history_mass(record.sites, before=records[:task]))
    return {
        "parameters": sum(r.added for r in records),
        "trained_phase1": sum(first) / len(first) if first else None,
        "trained": sum(r.trained for r in records) / len(records),
        "trained_mean": sum(r.trained_mean for r in records) / len(records),
        "reuse": reuse_rate(masses),
    }


def minutes(path: Path) -> float:
    """Time of training and evaluation, as the run's log has it."""
    return sum(line["seconds"] for line in folder.read_metrics(path, "seconds")) / 60


# --- the probe ------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class StreamProbe(Matrix):
    """A matrix, measured again from the run's files.

    Attributes:
        measured: how many rows were measured, which are the last ones: all rows where what serves a
            learned task never changes, else the one of the end, since the weights of the other rows
            are gone. Those are as the training measured them.
        largest_difference: largest difference between the measured figures and the training's.
        out: the run folder.
    """

    measured: int
    largest_difference: float
    out: str


@dataclass(frozen=True, kw_only=True)
class ImageStreamProbe(StreamProbe, AccuracyMatrix):
    """The accuracies of a stream of classification tasks, measured again."""


@dataclass(frozen=True, kw_only=True)
class RobotStreamProbe(StreamProbe, SuccessMatrix):
    """The success on a stream of robot tasks and the backbone's knowledge, measured again."""


@dataclass(frozen=True, kw_only=True)
class RecordedStreamProbe(StreamProbe, ErrorMatrix):
    """The errors in a stream of robot tasks and the backbone's knowledge, measured again."""


def probe_from(before: StreamReport, found: StreamReport, measured: int) -> StreamProbe:
    """The figures that were measured again, beside those of the training."""
    kinds: dict[str, type[StreamProbe]] = {
        SuccessMatrix.score: RobotStreamProbe,
        ErrorMatrix.score: RecordedStreamProbe,
        AccuracyMatrix.score: ImageStreamProbe,
    }
    pairs = zip(before.figures(), found.figures(), strict=True)
    return kinds[found.score](
        **{key: getattr(found, key) for key in found.keys},
        measured=measured,
        largest_difference=max(abs(old - new) for old, new in pairs),
        out=found.out,
    )
