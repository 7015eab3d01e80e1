"""`aegis compare` of streams: what each learner reached, kept and stored, in one table."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Warned, ignore
from aegis_cli.continual import files
from aegis_cli.continual.report import (
    ErrorMatrix,
    ImageStreamReport,
    StreamReport,
    SuccessMatrix,
)
from aegis_cli.continual.state import changed_inputs


@dataclass(frozen=True)
class StreamRow:
    """One finished stream.

    Attributes:
        transfer, average, last, forgetting: figures of the matrix, with the task told: shares in
            [0, 1], or open-loop errors. Only streams of images have a transfer, and a single task
            has no forgetting.
        drop_points: percentage points of VQA accuracy lost over the stream; None for images.
        parameters: numbers stored beside the bare model at the end.
        minutes: time of training and evaluation.
    """

    run: str
    method: str
    transfer: float | None
    average: float
    last: float
    forgetting: float | None
    drop_points: float | None
    parameters: int
    minutes: float


@dataclass(frozen=True)
class StreamComparison:
    """Several streams of the same tasks.

    Attributes:
        score: the quantity in their matrices: `accuracy`, `success` or `errors`.
        differs: names of the inputs that not all runs share, such as the backbone.
    """

    score: str
    tasks: tuple[str, ...]
    rows: list[StreamRow]
    differs: list[str]

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def run(paths: Sequence[Path], on_event: OnEvent = ignore) -> StreamComparison:
    """Compare finished streams.

    Raises:
        AegisError: a stream is not finished, or they learned other tasks or other kinds of tasks.
    """
    reports = [files.read(Path(path)) for path in paths]
    first = reports[0]
    for path, report in zip(paths[1:], reports[1:], strict=True):
        if (report.score, report.tasks) != (first.score, first.tasks):
            raise AegisError(
                f"the tasks {', '.join(report.tasks)} in '{path}' ({report.score})",
                f"{', '.join(first.tasks)} ({first.score}), as in '{paths[0]}'",
                "compare streams of the same tasks in the same order",
            )
    differs = sorted({name for report in reports for name in _changed(first, report)})
    if differs:
        listed = ", ".join(differs)
        text = f"the streams differ in {listed}, which may also explain different figures"
        on_event(Warned("compare", text))
    rows = [_row(str(path), report) for path, report in zip(paths, reports, strict=True)]
    return StreamComparison(first.score, first.tasks, rows, differs)


def _changed(first: StreamReport, other: StreamReport) -> list[str]:
    """The inputs in which two streams differ, beside their recipes: learners have their own."""
    names = changed_inputs(first.inputs, other.inputs)
    return [name for name in names if name != "recipe"]


def _row(path: str, report: StreamReport) -> StreamRow:
    assert isinstance(report, ImageStreamReport | SuccessMatrix | ErrorMatrix)
    scores = report.scores
    of_images = isinstance(report, ImageStreamReport)
    return StreamRow(
        run=path,
        method=report.method,
        transfer=getattr(scores, "transfer", None),
        average=scores.average,
        last=scores.last,
        forgetting=scores.forgetting,
        drop_points=None if of_images else report.vqa[-1].drop_points,
        parameters=report.parameters,
        minutes=report.minutes,
    )
