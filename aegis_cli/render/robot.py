"""A stream of robot tasks as tables: the success matrix with its figures, what the backbone knows, parameters and routing."""

from __future__ import annotations

from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from aegis_cli.render.layout import fixed, percent, plain_table
from aegis_cli.render.stream import parameters, routing


def robot_stream(report: Any) -> RenderableType:
    """What `aegis train` shows of a stream of robot tasks."""
    last = f"{report.minutes:.1f} minutes; files: {report.out}"
    title = Text(f"{report.name}: {report.method} on {report.stream}", "bold")
    return Group(title, *_success(report), parameters(report), Text(f"{_sums(report)}\n{last}"))


def robot_probe(report: Any) -> RenderableType:
    """What `aegis probe` shows of it."""
    said = f"measured again: {report.measured} of {len(report.tasks)} rows, largest difference {report.largest_difference:g}"
    return Group(*_success(report), Text(f"{said}\nfiles: {report.out}"))


def robot_inspect(inspection: Any) -> RenderableType:
    """What `aegis inspect` shows of it."""
    report = inspection.report
    parts = [Text(f"{inspection.path}: {report.method} on {report.stream}", "bold"), *_success(report), parameters(report)]
    if any(record.sites for record in report.records):
        parts.append(routing(report))
    return Group(*parts, Text(_sums(report)))


def _success(report: Any) -> list[RenderableType]:
    """The matrix beside what the backbone knows; tasks that have not come are '-'."""
    header = ("Success %", *report.tasks, "VQA %", "Drop (points)", "Cross-entropy (nats)")
    rows = [
        (f"after {after}" if after else "before", *(percent(v) for v in found), *["-"] * (len(report.tasks) - len(found)),
         percent(known.accuracy), fixed(known.drop_points, 2), fixed(known.cross_entropy, 3))
        for after, found, known in zip(("", *report.tasks), ((), *report.success), report.vqa, strict=True)
    ]  # fmt: skip
    s = report.scores
    figures = [(percent(s.average), percent(s.last), percent(s.forgetting, 2))]
    return [plain_table(header, rows), plain_table(("Average %", "Last %", "Forgetting (points)"), figures, left=0)]


def _sums(report: Any) -> str:
    first, after, mean = report.trained_phase1, report.trained, report.trained_mean
    phases = "" if first is None else f"{first:,.0f} in phase 1, {after:,.0f} after it, "
    return (
        f"{report.parameters:,} numbers stored beside the bare backbone; trained, mean of tasks: {phases}{mean:,.0f} mean of "
        f"steps; mass on history {percent(report.reuse)} %"
    )
