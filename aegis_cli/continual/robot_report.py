"""What is said of a stream of robot tasks: success of each after each, what the VLM still knows,
and what it cost.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from aegis_cli.continual.report import TaskRecord, record_from, sums
from aegis_cli.core.accuracy_matrix import SeenScores, seen_scores


@dataclass(frozen=True)
class Knowledge:
    """What the backbone knows with no task active: accuracy in [0, 1], cross-entropy in nats,
    points lost since before.
    """

    accuracy: float
    cross_entropy: float
    drop_points: float


@dataclass(frozen=True)
class RobotStreamReport:
    """A stream of robot tasks, learned.

    Attributes:
        stream: its tasks, joined.
        success: S, row t with t + 1 entries: success in closed loop on task i after learning tasks
            0 to t, the task told; of a suite task its return's share of the highest. A task that
            has not come has no scales to act with: no entry.
        scores: Average, Last and forgetting over these entries.
        vqa: before the first task, and after each. With experts nothing of a task is active then,
            so that nothing can change; `sequential` has no other weights than those that it goes on
            training.
        parameters: numbers stored beside the bare backbone at the end: action expert, scales,
            experts, routers. trained_phase1, trained, trained_mean: means over tasks of the
            records' figures.
        reuse: mean over tasks after the first, and maps that earlier tasks gave experts, of the
            routing mass on these.
        inputs: digests of the recipe, the bare backbone, the demonstrations and the questions'
            files.
        minutes: of training and evaluation; not part of the run's files.
    """

    name: str
    stream: str
    method: str
    tasks: tuple[str, ...]
    success: tuple[tuple[float, ...], ...]
    scores: SeenScores
    vqa: tuple[Knowledge, ...]
    parameters: int
    trained_phase1: float | None
    trained: float
    trained_mean: float
    reuse: float | None
    records: tuple[TaskRecord, ...]
    inputs: Mapping[str, str]
    out: str
    minutes: float

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def assemble(
    name: str,
    method: str,
    out: str,
    minutes: float,
    records: Sequence[TaskRecord],
    success: Sequence[Sequence[float]],
    vqa: Sequence[Sequence[float]],
    inputs: Mapping[str, str],
) -> RobotStreamReport:
    """The report of all tasks' records and rows; `vqa` has (accuracy, cross-entropy) before and
    after each task.
    """
    tasks = tuple(r.task for r in records)
    return RobotStreamReport(
        name=name,
        stream=", ".join(tasks),
        method=method,
        tasks=tasks,
        success=tuple(tuple(row) for row in success),
        scores=seen_scores(success),
        vqa=knowledge(vqa),
        records=tuple(records),
        inputs=inputs,
        out=out,
        minutes=minutes,
        **sums(records),
    )


def knowledge(rows: Sequence[Sequence[float]]) -> tuple[Knowledge, ...]:
    """Rows of (accuracy, cross-entropy), the first of them before any task."""
    return tuple(
        Knowledge(accuracy, loss, 100 * (rows[0][0] - accuracy)) for accuracy, loss in rows
    )


def from_json(raw: Mapping[str, Any], out: str, minutes: float) -> RobotStreamReport:
    """A report from its JSON, which has neither of the two."""
    made = {
        **raw,
        "records": tuple(record_from(r) for r in raw["records"]),
        "tasks": tuple(raw["tasks"]),
        "scores": SeenScores(**raw["scores"]),
        "vqa": tuple(Knowledge(**k) for k in raw["vqa"]),
        "success": tuple(tuple(row) for row in raw["success"]),
    }
    return RobotStreamReport(**made, out=out, minutes=minutes)
