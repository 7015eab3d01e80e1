"""A stream as tables: the accuracy matrix with its figures, parameters, and each map's routing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from aegis_cli.cli.render.layout import number, percent, plain_table


def stream(report: Any) -> RenderableType:
    """What `aegis train` shows of a stream."""
    return learned(report, [*_accuracy(report), *_published(report)], _stored(report))


def stream_probe(report: Any) -> RenderableType:
    """What `aegis probe` shows of a stream."""
    return probed(report, _accuracy(report))


def stream_inspect(inspection: Any) -> RenderableType:
    """What `aegis inspect` shows of a stream."""
    return inspected(inspection, _accuracy(inspection.report), _stored(inspection.report))


# --- what both kinds of stream show ---------------------------------------------------------------


def learned(report: Any, tables: Sequence[RenderableType], stored: str) -> RenderableType:
    """A stream's end: its own tables, then the parameters."""
    title = Text(f"{report.name}: {report.method} on {report.stream}", "bold")
    last = f"{_sums(report, stored)}\n{report.minutes:.1f} minutes; files: {report.out}"
    return Group(title, *tables, parameters(report), Text(last))


def probed(report: Any, tables: Sequence[RenderableType]) -> RenderableType:
    """Its tables, measured again."""
    said = (
        f"measured again: {report.measured} of {len(report.tasks)} rows, largest difference "
        f"{report.largest_difference:g}"
    )
    return Group(*tables, Text(f"{said}\nfiles: {report.out}"))


def inspected(inspection: Any, tables: Sequence[RenderableType], stored: str) -> RenderableType:
    """Its tables, the parameters, and the routing of a learner that has some."""
    report = inspection.report
    parts = [
        Text(f"{inspection.path}: {report.method} on {report.stream}", "bold"),
        *tables,
        parameters(report),
    ]
    if any(record.sites for record in report.records):
        parts.append(routing(report))
    return Group(*parts, Text(_sums(report, stored)))


def _accuracy(report: Any) -> list[RenderableType]:
    parts: list[RenderableType] = [_matrix("Accuracy %, task told", report.oracle, report.tasks)]
    if report.inferred != report.oracle:
        parts.append(_matrix("Accuracy %, task inferred", report.inferred, report.tasks))
    rows = [
        (name, percent(s.transfer), percent(s.average), percent(s.last), percent(s.forgetting, 2))
        for name, s in (("task told", report.scores), ("task inferred", report.inferred_scores))
    ]
    return [
        *parts,
        plain_table(
            (
                f"On {report.split} parts",
                "Transfer %",
                "Average %",
                "Last %",
                "Forgetting (points)",
            ),
            rows,
        ),
    ]


def _published(report: Any) -> list[RenderableType]:
    """What papers print for the same stream, beside this run's own line above."""
    if not report.published:
        return []
    rows = [
        (method, *(f"{value:.1f}" for value in figures))
        for method, figures in report.published.items()
    ]
    title = "As their papers print them, on the whole data sets; not run here"
    return [plain_table(("Published", "Transfer %", "Average %", "Last %"), rows, title=title)]


def _matrix(title: str, rows: Sequence[Sequence[float]], tasks: Sequence[str]) -> Table:
    lines = [
        (f"after {task}", *(percent(v) for v in row)) for task, row in zip(tasks, rows, strict=True)
    ]
    return plain_table(("", *tasks), lines, title=title)


def parameters(report: Any) -> Table:
    """A line a task."""
    header = (
        "Task",
        "Phase 1 (steps)",
        "Trained in phase 1",
        "Trained after",
        "Trained, mean of steps",
        "Added",
        "Mass on history %",
        "Maps without a new expert %",
        "Pruned",
        "Dropped",
        "Loss",
    )
    rows = [
        (
            r.task,
            _count(r.phase1_steps),
            _count(r.trained_phase1),
            _count(r.trained),
            _count(round(r.trained_mean)),
            _count(r.added),
            percent(r.history_mass),
            percent(r.untouched),
            str(sum(len(s.pruned) for s in r.sites)),
            str(sum(len(s.dropped) for s in r.sites)),
            number(r.loss),
        )
        for r in report.records
    ]
    return plain_table(header, rows)


def routing(report: Any) -> Table:
    """A line a task and map."""
    header = (
        "Task",
        "Map",
        "Old experts",
        "Mass %",
        "New experts",
        "Mass %",
        "Pruned",
        "Dropped",
        "Trained in phase 1",
        "Trained after",
        "Added",
    )
    rows = []
    for task, record in enumerate(report.records):
        for s in record.sites:
            old = [i for i, owner in enumerate(s.owners) if owner < task]
            new = [i for i in range(len(s.owners)) if i not in old]
            used = [
                (_numbers(s.experts[i] for i in part), percent(sum(s.mass[i] for i in part)))
                for part in (old, new)
            ]
            counts = map(_count, (s.trained_phase1, s.trained, s.added))
            rows.append(
                (
                    record.task,
                    s.site,
                    *used[0],
                    *used[1],
                    _numbers(s.pruned),
                    _numbers(s.dropped),
                    *counts,
                )
            )
    return plain_table(header, rows, left=2)


def _stored(report: Any) -> str:
    return f"{stored(report, 'encoder')}, {report.inference_parameters:,} of them to tell tasks"


def stored(report: Any, model: str) -> str:
    """How many numbers a run keeps; a learner that trains the model itself keeps one of its own,
    and nothing beside it.
    """
    whose = (
        f", the {model} that it has changed among them"
        if report.method == "sequential"
        else f" beside the bare {model}"
    )
    return f"{report.parameters:,} numbers stored{whose}"


def _sums(report: Any, stored: str) -> str:
    first, after, mean = report.trained_phase1, report.trained, report.trained_mean
    phases = "" if first is None else f"{first:,.0f} in phase 1, {after:,.0f} after it, "
    return (
        f"{stored}; trained, mean of tasks: {phases}{mean:,.0f} mean of steps; mass on "
        f"history {percent(report.reuse)} %"
    )


def _numbers(values: Any) -> str:
    return " ".join(map(str, values)) or "-"


def _count(value: int | None) -> str:
    return "-" if value is None else f"{value:,}"
