"""A table for terminals of any width."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import replace

from rich import box
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Column, Table
from rich.text import TextType

_BESIDE = 2  # columns of space that each column of the table takes beside its text


class WideTable(Table):
    """Where it does not fit, it goes on below with its next columns, as data frames do.

    No word and no figure is broken but one wider than the terminal.

    Args:
        left: columns that name a line, with which each part begins.
    """

    def __init__(self, left: int, title: TextType | None = None) -> None:
        super().__init__(
            title=title,
            title_justify="left",
            box=box.SIMPLE_HEAD,
            pad_edge=False,
            collapse_padding=True,
            header_style="bold",
        )
        self.left = left

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        free = options.max_width - 1
        if sum(_longest_line(c) + _BESIDE for c in self.columns) <= free:
            yield from super().__rich_console__(console, options)
            return
        for i, columns in enumerate(self._parts(free)):
            part = WideTable(self.left, None if i else self.title)
            part.rows, part.columns = self.rows, columns
            yield from Table.__rich_console__(part, console, options)

    def _parts(self, free: int) -> Iterator[list[Column]]:
        names, rest = self.columns[: self.left], self.columns[self.left :]
        while names or rest:
            fitting = len(rest)
            while fitting > 1 and _least(names + rest[:fitting]) > free:
                fitting -= 1
            yield _folded(names + rest[:fitting], free)
            names, rest = (names, rest[fitting:]) if rest[fitting:] else ([], [])


def _least(columns: Sequence[Column]) -> int:
    return sum(_longest_word(c) + _BESIDE for c in columns)


def _folded(columns: Sequence[Column], free: int) -> list[Column]:
    """Each as wide as its longest word; what is left goes to cells, then headers, left to right."""
    widths, spare = list(map(_longest_word, columns)), max(0, free - _least(columns))
    for wanted in (_longest_cell, _longest_line):
        for i, column in enumerate(columns):
            more = min(spare, max(0, wanted(column) - widths[i]))
            widths[i], spare = widths[i] + more, spare - more
    headers = [
        "\n".join(textwrap.wrap(str(c.header), width or 1))
        for c, width in zip(columns, widths, strict=True)
    ]
    made = zip(columns, headers, widths, strict=True)
    return [
        replace(c, header=header, max_width=width, _index=i)
        for i, (c, header, width) in enumerate(made)
    ]


def _longest_word(column: Column) -> int:
    """Headers may break after a hyphen."""
    words = [
        *re.split(r"\s|(?<=-)", str(column.header)),
        *(word for cell in column.cells for word in str(cell).split()),
    ]
    return max(map(len, words), default=0)


def _longest_cell(column: Column) -> int:
    return max((len(str(cell)) for cell in column.cells), default=0)


def _longest_line(column: Column) -> int:
    return max(len(str(column.header)), _longest_cell(column))
