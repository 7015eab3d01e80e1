"""The paired differences below the table of `aegis compare`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from rich.console import RenderableType
from rich.text import Text

from aegis_cli.cli.render.layout import Cell, plain_table
from aegis_cli.cli.render.studies import shown_as
from aegis_cli.studies.metrics import Column, columns

APART = "#"  # marks a difference whose interval excludes 0
TITLE, _HOW = "Differences from", "(paired, 95 % interval)"
ONE_TRAINING = (
    "The intervals are over the questions and episodes of one training of each run. Another seed "
    "may differ by more: studies measure that."
)
NO_PAIRS = "not measured on the same questions or episodes, or not kept by an earlier version"


def paired(report: Any) -> Iterator[RenderableType]:
    """A line per run but the reference, and what the marks mean; nothing without any pair."""
    shown = columns_of(report.paired)
    if not shown:
        return
    rows: list[Sequence[Cell]] = []
    for one in report.paired:
        cells = [_cell(getattr(one, name), column) for name, column in shown.items()]
        rows.append((one.run, *cells))
    header = ("Run", *(column.header for column in shown.values()))
    yield Text()
    yield plain_table(header, rows, title=f"{TITLE} {report.against} {_HOW}")
    cells = [cell for row in rows for cell in row]
    if any(isinstance(cell, Text) for cell in cells):
        yield Text(f"{APART} the interval excludes 0")
    if "-" in cells:
        yield Text(f"-: {NO_PAIRS}")
    yield Text(ONE_TRAINING)


def columns_of(pairs: Sequence[Any]) -> dict[str, Column]:
    """The declared differences that some run has."""
    declared = columns(type(pairs[0])) if pairs else {}
    return {
        name: column
        for name, column in declared.items()
        if any(getattr(one, name) is not None for one in pairs)
    }


def excludes_zero(interval: Sequence[float] | None) -> bool:
    """Whether an interval has only values above 0, or only values below it."""
    return interval is not None and (interval[0] > 0 or interval[1] < 0)


def end_as(column: Column) -> Callable[[float | None], str]:
    """How the ends of a difference's interval are shown: like it, but without a plus sign."""
    return shown_as(replace(column, signed=False))


def _cell(difference: Any, column: Column) -> Cell:
    if difference is None:
        return "-"
    text = shown_as(column)(difference.mean)
    if difference.interval is not None:
        text += f" ({' to '.join(map(end_as(column), difference.interval))})"
    if excludes_zero(difference.interval):
        return Text(APART + text, "bold")
    return text
