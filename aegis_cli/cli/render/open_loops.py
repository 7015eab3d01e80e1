"""Open-loop errors as tables, and a plot of predicted against recorded actions."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from aegis_cli.cli.render.layout import INSTRUCTIONS, fixed, number, plain_table
from aegis_cli.cli.render.plots import figure, literal, save_figure
from aegis_cli.cli.render.tables import pairs

_RECORDED, _PREDICTED = "0.25", "#0072b2"
_TITLE_CHARACTERS = 44  # per line of the title, for each of the episodes side by side
_ROWS = 16  # of the table by steps ahead
_WIDEST = 100  # characters of an instruction
_SPLITS = {
    "validation": "the run's validation episodes",
    "other data": "all of data that the run was not trained on",
    "chosen": "as chosen",
    "unknown": "all, since the folder does not say what it was trained on",
}


def open_loop(report: Any) -> RenderableType:
    """The error over everything, by dimension, by steps ahead and by instruction."""
    error = fixed(report.relative_error, 3)
    if report.relative_interval is not None:
        low, high = (fixed(end, 3) for end in report.relative_interval)
        error += f" ({low} to {high})"
    if report.hold_error is not None:
        error += f"; hold's {fixed(report.hold_error, 3)}"
    facts = {"task": report.task} if hasattr(report, "task") else {}
    facts |= {
        "data": report.data,
        # "episodes" with a single number would read as a count.
        "episodes" if len(report.episodes) > 1 else "episode": report.episodes,
        "chosen": _SPLITS[report.split],
        "frames": report.frames,
        "chunk": report.chunk,
        "relative_error": error,
    }
    if report.fps is not None:
        facts["fps"] = number(report.fps)
    if report.trained_on:
        facts["trained_on"] = report.trained_on
    scale = "relative error: squared error over that of the training's mean action, which has 1"
    if report.hold_error is not None:
        scale += "\nhold: the current position, repeated"
    parts = [pairs(facts), _by_dimension(report), _by_step(report), *_by_instruction(report)]
    return Group(*parts, Text(scale))


def _by_dimension(report: Any) -> Table:
    shown = {
        "MAE": lambda d: number(d.mae),
        "RMSE": lambda d: number(d.rmse),
        "Std in training": lambda d: number(d.training_std),
        "Relative error": lambda d: fixed(d.relative_error, 3),
    }
    if report.hold_error is not None:
        shown["Hold's RMSE"] = lambda d: number(d.hold_rmse)
    units = any(d.unit for d in report.dimensions)
    names = ("Action", "Unit") if units else ("Action",)
    rows = []
    for dimension in report.dimensions:
        row = [dimension.name]
        if units:
            row.append(dimension.unit or "-")
        rows.append(row + [show(dimension) for show in shown.values()])
    return plain_table((*names, *shown), rows, left=len(names))


def _by_step(report: Any) -> Table:
    """At most `_ROWS` evenly spread steps, including the first and the last."""
    count = len(report.horizon)
    rows = min(count, _ROWS)
    # From 0 to the last step; `max` avoids a division by 0 for a horizon of one step.
    picked = sorted({round(i * (count - 1) / max(1, rows - 1)) for i in range(rows)})
    shown = {"Steps ahead": lambda step: str(step.step)}
    if report.fps is not None:
        shown["Seconds"] = lambda step: fixed(step.step / report.fps, 3)
    shown["Frames"] = lambda step: f"{step.frames:,}"
    shown["Relative error"] = lambda step: fixed(step.relative_error, 3)
    if report.hold_error is not None:
        shown["Hold's"] = lambda step: fixed(step.hold_error, 3)
    lines = [[show(report.horizon[at]) for show in shown.values()] for at in picked]
    title = None if rows == count else f"{rows} of {count} steps ahead; --json has all"
    return plain_table(tuple(shown), lines, left=0, title=title)


def _by_instruction(report: Any) -> Iterator[RenderableType]:
    """The worst instructions, if there are several."""
    every = report.instructions
    if len(every) < 2:
        return
    header = ("Instruction", "Episodes", "Frames", "Relative error", "95 % interval")
    if report.hold_error is not None:
        header = (*header, "Hold's")
    lines = []
    for one in every[:INSTRUCTIONS]:  # the worst come first
        ends = "-"
        if one.relative_interval is not None:
            ends = " to ".join(fixed(end, 3) for end in one.relative_interval)
        error = fixed(one.relative_error, 3)
        line = (_short(one.instruction), f"{one.episodes:,}", f"{one.frames:,}", error, ends)
        lines.append(line if report.hold_error is None else (*line, fixed(one.hold_error, 3)))
    yield plain_table(header, lines)
    if len(every) > INSTRUCTIONS:
        yield Text(f"the worst {INSTRUCTIONS} of {len(every):,} instructions; --json has all")


def _short(instruction: str) -> str:
    """An instruction shortened for a table, so that it does not push the errors out of sight."""
    said = " ".join(instruction.split())  # on one line
    if len(said) > _WIDEST:
        said = f"{said[: _WIDEST - 1]}…"
    return said or "(none)"


def open_loop_plot(report: Any, path: Path) -> None:
    """Draw predicted against recorded actions along some episodes, a row per dimension.

    Raises:
        AegisError: matplotlib is missing, or `path` cannot be written.
    """
    save_figure(lambda: _drawn(report), path)


def _drawn(report: Any) -> Any:
    from matplotlib.ticker import MaxNLocator

    rows, columns = len(report.dimensions), len(report.traces)
    drawn = figure(figsize=(1.2 + 3.6 * columns, 1.5 + 1.4 * rows), layout="constrained")
    panels = drawn.subplots(rows, columns, sharex="col", sharey="row", squeeze=False)
    for column, trace in enumerate(report.traces):
        for row, dimension in enumerate(report.dimensions):
            axis = panels[row][column]
            _draw_trace(axis, trace, row)
            if column == 0:
                unit = f"\n({dimension.unit})" if dimension.unit else ""
                axis.set_ylabel(f"{literal(dimension.name)}{literal(unit)}", fontsize=8)
        panels[0][column].set_title(_titled(report, trace), fontsize=9)
        panels[-1][column].set_xlabel("frame", fontsize=8)
        panels[-1][column].xaxis.set_major_locator(MaxNLocator(integer=True))
    finding = textwrap.fill(_finding(report), _TITLE_CHARACTERS * columns)
    drawn.suptitle(finding, x=0.01, ha="left", fontsize=11, fontweight="bold")
    _explain(drawn, report.traces[0].replan)
    return drawn


def _draw_trace(axis: Any, trace: Any, dimension: int) -> None:
    """One dimension along one episode; each chunk is a separate line that starts with a dot."""
    axis.plot(trace.recorded[:, dimension], color=_RECORDED, linewidth=1.2)
    predicted = trace.predicted[:, dimension]  # [T], like `recorded`, one chunk after the other
    for first in range(0, len(predicted), trace.replan):
        frames = range(first, min(first + trace.replan, len(predicted)))
        axis.plot(frames, predicted[frames.start : frames.stop], color=_PREDICTED, linewidth=1.2)
        axis.plot(first, predicted[first], "o", color=_PREDICTED, markersize=2.5)
    axis.grid(alpha=0.25)
    axis.tick_params(labelsize=7)
    axis.spines[["top", "right"]].set_visible(False)


def _titled(report: Any, trace: Any) -> str:
    trained = " (trained on)" if trace.episode in report.trained_on else ""
    return f"episode {trace.episode}{trained}"


def _finding(report: Any) -> str:
    if report.relative_error is None:
        return "Predicted and recorded actions, which did not vary in training"
    return f"Open-loop error: {report.relative_error:.2f} of that of the training's mean action"


def _explain(drawn: Any, replan: int) -> None:
    from matplotlib.lines import Line2D

    predicted = f"predicted, anew every {replan} frames" if replan > 1 else "predicted"
    marks = [
        Line2D([], [], color=_RECORDED, label="recorded"),
        Line2D([], [], color=_PREDICTED, marker="o", markersize=3, label=predicted),
    ]
    drawn.legend(handles=marks, loc="outside lower center", ncols=2, fontsize=8, frameon=False)
