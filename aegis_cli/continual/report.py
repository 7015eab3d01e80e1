"""The report of a stream: each task's routing and parameters, the matrix of all tasks, its figures.

A matrix has a file of its own, and a probe measures it again. A report is a matrix together with
the figures that the training recorded.
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
Ends = Sequence[Sequence[float] | None]  # the intervals of a row


# --- a task ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SiteRouting:
    """The routing of one map for one task, at the task's end.

    Attributes:
        site: the map's name.
        experts: numbers of the experts that the router uses; empty if no loss reads the map.
        owners: the tasks that added these experts.
        mass: mean weight of each expert over the positions that the loss reads.
        load: share of each expert in the summed p ||B A x||.
        pruned: new experts that were deleted after phase 1.
        dropped: old experts that the router stopped using after phase 1.
        trained_phase1, trained: parameters here that learned in phase 1 (None without one) and in
            the last phase.
        added: numbers stored here since the previous task.
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
        added: numbers stored since the previous task, including those used to infer the task.
        history_mass: routing mass on experts of earlier tasks, mean over the maps that have such
            experts; None if no map has any.
        untouched: share of maps to which the task added no expert; None without experts.
        loss: loss of the last step; None if nothing learns.
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
    """The routing mass on earlier tasks' experts, per map.

    Only maps count that got experts in an earlier task and have experts now.
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
    """The scores that a learner reached on each task, after each task.

    Attributes:
        kind: what `aegis inspect` calls a run of such a stream.
        model_name: what the tables call the model that learns.
        file: name of the file that holds the matrix, with the keys `keys`.
        score: name of the quantity in the matrix.
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
        """All measured shares and errors, in a fixed order."""

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)

    def matrix_json(self) -> dict[str, Any]:
        """The content of the matrix's file."""
        plain = self.to_json()
        return {key: plain[key] for key in self.keys}


@dataclass(frozen=True, kw_only=True)
class AccuracyMatrix(Matrix):
    """Accuracies R [T, T] of an encoder: row t after learning task t, column i on task i.

    Attributes:
        split: the part of each task on which accuracies are measured: `test`, or `validation` when
            settings are chosen.
        oracle, inferred: R with the task told, and with the task inferred from the image; both are
            the same for a learner with one state for all tasks. In the columns i > t of tasks
            that have not come yet, `oracle` is the accuracy of the bare encoder, or of the current
            weights of a learner with one state.
        scores, inferred_scores: Transfer, Average, Last and forgetting of each.
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
    """The backbone's answers to questions with no task active.

    Attributes:
        accuracy: share of correct answers in [0, 1].
        cross_entropy: cross-entropy of the answers, in nats.
        drop_points: percentage points of accuracy lost since before the first task.
    """

    accuracy: float
    cross_entropy: float
    drop_points: float


@dataclass(frozen=True, kw_only=True)
class RobotMatrix(Matrix):
    """The scores of policies on robot tasks, and of their backbone on questions."""

    kind = "robot-stream-run"
    model_name = "backbone"

    @property
    @abstractmethod
    def measured_rows(self) -> Rows:
        """The triangular matrix as measured."""

    @property
    def measured_intervals(self) -> Sequence[Ends]:
        """The 95 % interval of each entry, if it has one."""
        return ()

    @staticmethod
    @abstractmethod
    def of_measured(
        rows: Sequence[Sequence[float]], intervals: Sequence[Ends], held: Sequence[float | None]
    ) -> dict[str, Any]:
        """The triangular matrix with its figures, by the attribute names of a matrix.

        Args:
            intervals: the interval of each error, if errors are measured.
            held: each task's error of holding the position, if errors are measured.
        """


@dataclass(frozen=True, kw_only=True)
class SuccessMatrix(RobotMatrix):
    """Success of a policy in closed loop, and its backbone's answers to questions.

    Attributes:
        success: S, row t with t + 1 entries: success on task i after learning tasks 0 to t, with
            the task told; for a suite task, its return as a share of the highest return. A task
            that has not come yet has no scales to act with, and therefore no entry.
        scores: Average, Last and forgetting over these entries.
        vqa: before the first task, and after each. With experts, no expert is active here, so
            nothing can change; `sequential` has only the weights that it goes on training.
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
    """Open-loop errors of a policy in tasks without a simulator, and its backbone's answers.

    Attributes:
        errors: row t with t + 1 entries: the error at held-out frames of task i after learning
            tasks 0 to t, with the task told. It is the mean squared error divided by the variance
            of the training actions, as in `aegis evaluate`.
        error_intervals: the 95 % interval of each error, by Student's t over episodes; None for a
            single episode.
        hold_errors: each task's error of repeating the current position; None if actions are not
            positions.
        scores: Average, Last and forgetting of the errors (lower is better).
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
    """Scores from rows of (accuracy, cross-entropy); the first row is before any task."""
    first = rows[0][0]
    return tuple(VqaScore(accuracy, loss, 100 * (first - accuracy)) for accuracy, loss in rows)


def as_rows(rows: Sequence[Sequence[float]]) -> Rows:
    """The rows as an immutable matrix."""
    return tuple(tuple(row) for row in rows)


# --- the report -----------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class StreamReport(Matrix):
    """The report of a learned stream.

    Attributes:
        name: the recipe's name.
        stream: the stream's name; for robot tasks, the task names joined.
        parameters: numbers stored beside the bare model at the end.
        trained_phase1, trained, trained_mean: means over tasks of the records' figures.
        reuse: routing mass on experts of earlier tasks, mean over all tasks after the first and
            over the maps that earlier tasks gave experts.
        records: one record per task.
        inputs: digests of what the run was made from and measured with.
        out: the run folder.
        minutes: time of training and evaluation. `out` and `minutes` are not part of the run's
            files, which are the same in every equal run.
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
    """The report of a learned stream of classification tasks.

    Attributes:
        inference_parameters: how many of `parameters` are used to infer the task.
        path: the folder of the user's own images; in the JSON only if there is one.
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
        """Published Transfer, Average and Last for this stream in percent, by method.

        It is empty unless all tasks were learned in the stream's order and the test parts measured.
        """
        whole = self.split == TEST and self.tasks == mtil.STREAMS.get(self.stream)
        return mtil.PUBLISHED.get(self.stream, {}) if whole else {}


@dataclass(frozen=True, kw_only=True)
class RobotStreamReport(StreamReport, SuccessMatrix):
    """The report of a learned stream of simulated robot tasks.

    `parameters` counts the action expert, scales, experts and routers.
    """


@dataclass(frozen=True, kw_only=True)
class RecordedStreamReport(StreamReport, ErrorMatrix):
    """The report of a learned stream of robot tasks without a simulator.

    `parameters` counts as in `RobotStreamReport`.
    """


def report_from(kind: type[StreamReport], raw: Mapping[str, Any], out: Path) -> StreamReport:
    """A report from its JSON in the run folder `out`.

    Raises:
        ValueError: the JSON does not describe such a report.
        AegisError: the run's log is missing or damaged.
    """
    whole = {**raw, "out": str(out), "minutes": minutes(out)}
    return TypeAdapter(kind).validate_python(whole)


def sums(records: Sequence[TaskRecord]) -> dict[str, Any]:
    """The parameters and reuse over all records, by a report's attribute names."""
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
    """Time of training and evaluation in minutes, from the run's log."""
    return sum(line["seconds"] for line in folder.read_metrics(path, "seconds")) / 60


# --- the probe ------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class StreamProbe(Matrix):
    """A matrix, measured again from the run's files.

    Attributes:
        measured: how many of the last rows were measured again: all rows if the weights of a
            learned task never change, otherwise only the last row, since the weights of the others
            are gone. The remaining rows are as the training measured them.
        largest_difference: largest difference between these figures and those of the training.
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
    """The success on a stream of robot tasks and the backbone's answers, measured again."""


@dataclass(frozen=True, kw_only=True)
class RecordedStreamProbe(StreamProbe, ErrorMatrix):
    """The errors in a stream of robot tasks and the backbone's answers, measured again."""


def probe_from(before: StreamReport, found: StreamReport, measured: int) -> StreamProbe:
    """A probe from the figures measured again and the report of the training."""
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
