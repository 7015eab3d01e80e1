"""A merge as a table, and its sweep as a plot of the trade-off between task and answers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from aegis_cli.cli.render.layout import fixed, number, percent, plain_table
from aegis_cli.cli.render.plots import figure, save_figure
from aegis_cli.cli.render.tables import pairs
from aegis_cli.common import commands

_COLOR, _CHOSEN = "#0072b2", "#d55e00"


def merge(report: Any) -> RenderableType:
    """The written merge, and the points of the sweep."""
    kept = None if report.kept is None else f"{percent(report.kept)} % of the displacement"
    facts = {
        "method": report.method,
        "target": report.target,
        "base": report.base,
        "strength": report.strength,
        "kept": kept,
        "max_drop_points": report.max_drop,
        "passed": report.passed,
        "out": report.out,
    }
    parts: list[RenderableType] = [pairs({k: v for k, v in facts.items() if v is not None})]
    if report.points:
        parts.append(_points(report))
        before = f"before fine-tuning: {percent(report.baseline_accuracy, 2)} %"
        judged = f"judged on {report.questions:,} validation questions; {before}"
        parts.append(Text(f"{judged}\n{_next(report)}"))
    return Group(*parts)


def _points(report: Any) -> Any:
    """A line per strength, without columns that have no figures."""
    shown = {
        "Strength": lambda p: number(p.strength),
        "Kept %": lambda p: percent(p.kept),
        "VQA %": lambda p: percent(p.accuracy, 2),
        "Drop (points)": lambda p: fixed(p.drop_points, 2),
        "95 % interval": lambda p: " to ".join(fixed(end, 2) for end in p.drop_interval),
    }
    first = report.points[0]
    if first.validation_loss is not None:
        shown["Validation loss"] = lambda p: fixed(p.validation_loss, 4)
    if first.task_accuracy is not None:
        shown["Task accuracy %"] = lambda p: percent(p.task_accuracy, 2)
    rows = [[show(point) for show in shown.values()] for point in report.points]
    return plain_table(list(shown), rows, left=0)


def _next(report: Any) -> str:
    """The next step: a chosen strength must be judged on other data."""
    if report.out is not None:
        asked = []  # options that differ from the defaults of `aegis probe`
        if report.vqa not in (None, "scenes"):
            asked += ["--vqa", report.vqa]
        if report.ask not in (None, "{}"):
            asked += ["--ask", report.ask]
        probe = commands.aegis("probe", report.out, "--baseline", report.base, *asked)
        return f"now ask the test questions: {probe}"
    if report.passed is False:
        return "no strength of this sweep passes: try stronger ones with --sweep"
    return "write one: --strength S --out FOLDER, or --max-drop POINTS --out FOLDER"


def merge_plot(report: Any, path: Path) -> None:
    """Draw a sweep: the drop on the questions against the performance on the task.

    Without a figure of the task, the kept share of the displacement takes its place.

    Raises:
        AegisError: `path` cannot be written.
    """
    save_figure(lambda: _frontier(report), path)


def _frontier(report: Any) -> Any:
    drawn = figure(figsize=(6.4, 4.4), layout="constrained")
    axis = drawn.subplots()
    field, unit, name = _task_axis(report.points[0])  # all points have the same figures
    across = [unit * getattr(point, field) for point in report.points]
    lost = [p.drop_points for p in report.points]
    axis.plot(across, lost, "o-", color=_COLOR, markersize=5)
    for x, point in zip(across, report.points, strict=True):
        chosen = point.strength == report.strength
        color = _CHOSEN if chosen else _COLOR
        if chosen:
            axis.plot(x, point.drop_points, "o", color=color, markersize=9, zorder=3)
        label = "as trained" if point.strength == 0 else number(point.strength)
        place = {"xytext": (6, 5), "textcoords": "offset points"}
        axis.annotate(label, (x, point.drop_points), **place, color=color, fontsize=8)
    axis.axhline(0, color="0.3", linestyle="--", linewidth=1)
    if report.max_drop is not None:
        axis.axhline(report.max_drop, color=_CHOSEN, linestyle=":", linewidth=1)
    axis.invert_yaxis()  # so that up is better
    axis.set(xlabel=name, ylabel="VQA accuracy lost (points)")
    axis.set_title(f"Merge by '{report.method}', per strength, on validation data", loc="left")
    axis.grid(alpha=0.25)
    axis.spines[["top", "right"]].set_visible(False)
    return drawn


def _task_axis(point: Any) -> tuple[str, float, str]:
    """The field for the performance on the task, its unit, and the label of the axis."""
    if point.validation_loss is not None:
        return "validation_loss", 1.0, "validation loss of the policy"
    if point.task_accuracy is not None:
        return "task_accuracy", 100.0, "task accuracy (%)"
    return "kept", 100.0, "kept share of the displacement (%)"
