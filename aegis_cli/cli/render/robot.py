"""A stream of robot tasks as tables: the success matrix with its figures, what the backbone knows,
parameters and routing.
"""

from __future__ import annotations

from typing import Any

from rich.console import RenderableType

from aegis_cli.cli.render.layout import fixed, percent, plain_table
from aegis_cli.cli.render.streams import inspected, learned, probed, stored


def robot_stream(report: Any) -> RenderableType:
    """What `aegis train` shows of a stream of robot tasks."""
    return learned(report, _success(report), _stored(report))


def robot_probe(report: Any) -> RenderableType:
    """What `aegis probe` shows of it."""
    return probed(report, _success(report))


def robot_inspect(inspection: Any) -> RenderableType:
    """What `aegis inspect` shows of it."""
    return inspected(inspection, _success(inspection.report), _stored(inspection.report))


def _success(report: Any) -> list[RenderableType]:
    """The matrix beside what the backbone knows; tasks that have not come are '-'."""
    header = ("Success %", *report.tasks, "VQA %", "Drop (points)", "Cross-entropy (nats)")
    rows = [
        (
            f"after {after}" if after else "before",
            *(percent(v) for v in found),
            *["-"] * (len(report.tasks) - len(found)),
            percent(known.accuracy),
            fixed(known.drop_points, 2),
            fixed(known.cross_entropy, 3),
        )
        for after, found, known in zip(
            ("", *report.tasks), ((), *report.success), report.vqa, strict=True
        )
    ]
    s = report.scores
    figures = [(percent(s.average), percent(s.last), percent(s.forgetting, 2))]
    return [
        plain_table(header, rows),
        plain_table(("Average %", "Last %", "Forgetting (points)"), figures, left=0),
    ]


def _stored(report: Any) -> str:
    return stored(report, "backbone")
