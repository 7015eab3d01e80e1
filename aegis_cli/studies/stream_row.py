"""What became of one cell of a study of streams."""

from __future__ import annotations

from dataclasses import dataclass

from aegis_cli.continual.report import StreamReport


@dataclass(frozen=True)
class StreamRow:
    """One stream, learned once.

    Shares in [0, 1]. Transfer, Average, Last and forgetting are with the task told, and inferred.
    `parameters` are the numbers stored beside the bare encoder at the end, `inference_parameters`
    of them tell the task; `trained_` figures are means over tasks of the parameters that learned:
    in phase 1, in the last phase, and over all steps.

    Attributes:
        own: accuracy on each task, told, right after it was learned.
        added: numbers stored since the task before, of each task.
        new_experts: experts in all maps that belong to the task, of each task.
        first_change: of the first task's accuracy, told, from its own learning to the end.
        minutes: of training and evaluation.
    """

    method: str
    transfer: float | None
    average: float
    last: float
    forgetting: float | None
    inferred_transfer: float | None
    inferred_average: float
    inferred_last: float
    inferred_forgetting: float | None
    reuse: float | None
    parameters: int
    inference_parameters: int
    trained_phase1: float | None
    trained: float
    trained_mean: float
    own: tuple[float, ...]
    added: tuple[int, ...]
    new_experts: tuple[int, ...]
    first_change: float
    minutes: float


def row(report: StreamReport) -> StreamRow:
    """The figures of a learned stream that studies compare."""
    told, inferred = report.scores, report.inferred_scores
    owned = [
        sum(s.owners.count(task) for s in record.sites)
        for task, record in enumerate(report.records)
    ]
    return StreamRow(
        method=report.method,
        transfer=told.transfer,
        average=told.average,
        last=told.last,
        forgetting=told.forgetting,
        inferred_transfer=inferred.transfer,
        inferred_average=inferred.average,
        inferred_last=inferred.last,
        inferred_forgetting=inferred.forgetting,
        parameters=report.parameters,
        inference_parameters=report.inference_parameters,
        trained_phase1=report.trained_phase1,
        trained=report.trained,
        trained_mean=report.trained_mean,
        reuse=report.reuse,
        own=tuple(row[task] for task, row in enumerate(report.oracle)),
        added=tuple(r.added for r in report.records),
        new_experts=tuple(owned),
        first_change=report.oracle[-1][0] - report.oracle[0][0],
        minutes=report.minutes,
    )
