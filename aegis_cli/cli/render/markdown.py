"""A report as Markdown, to be pasted into a README or a model card.

It has the same titles, tables and notes as the terminal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from aegis_cli.cli.render.layout import BEST, paragraphs, parts_of, unmarked
from aegis_cli.common.files import write_text


def save_table(report: Any, view: Callable[[Any], RenderableType]) -> None:
    """Write `table.md` into the report's folder, beside `table.json`."""
    write_text(Path(report.out) / "table.md", markdown(view(report)))


def markdown(view: RenderableType) -> str:
    """The view's parts, separated by blank lines.

    Args:
        view: a `Text`, a `Table`, or a `Group` of these.
    """
    return "\n\n".join(_blocks(view)) + "\n"


def _blocks(view: RenderableType) -> Iterator[str]:
    for part in parts_of(view):
        if isinstance(part, Table):
            if part.title:
                yield f"**{part.title}**"
            yield _table(part)
            continue
        for line in paragraphs(part):
            yield f"**{line}**" if part.style == "bold" else line


def _table(table: Table) -> str:
    header = [str(column.header) for column in table.columns]
    rules = ["---:" if column.justify == "right" else "---" for column in table.columns]
    # rich stores cells by column, but Markdown needs them by row.
    columns = [[_cell(cell) for cell in column.cells] for column in table.columns]
    rows = zip(*columns, strict=True)
    return "\n".join(map(_row, (header, rules, *rows)))


def _cell(cell: RenderableType) -> str:
    """The cell's text; the best of a column is bold, and the worst looks like the others."""
    if not isinstance(cell, Text):
        return str(cell)
    mark, text = unmarked(cell)
    return f"**{text}**" if mark == BEST else text


def _row(cells: Sequence[str]) -> str:
    escaped = [cell.replace("|", r"\|") for cell in cells]  # a | would end the cell
    return f"| {' | '.join(escaped)} |"
