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

_BESIDE = 2  # columns of space that each column of the table takes in addition to its text


class WideTable(Table):
    """A table that continues below with its next columns if it does not fit, like a data frame.

    Words and figures are not broken unless they are wider than the terminal.

    Args:
        left: number of columns that name a line; each part starts with them.
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
            # As a plain table, because its own rendering would split it again.
            yield from Table.__rich_console__(part, console, options)

    def _parts(self, free: int) -> Iterator[list[Column]]:
        """The columns of each part: those that name a line, and as many other columns as fit."""
        names, rest = self.columns[: self.left], self.columns[self.left :]
        while True:
            fitting = len(rest)
            while fitting > 1 and _least(names + rest[:fitting]) > free:
                fitting -= 1  # down to one, which is shown even if it does not fit
            yield _folded(names + rest[:fitting], free)
            rest = rest[fitting:]
            if not rest:
                return


def _least(columns: Sequence[Column]) -> int:
    """The smallest width at which no word is broken."""
    return sum(_longest_word(c) + _BESIDE for c in columns)


def _folded(columns: Sequence[Column], free: int) -> list[Column]:
    """Each as wide as its longest word; free space goes to cells, then headers, left to right."""
    widths, spare = list(map(_longest_word, columns)), max(0, free - _least(columns))
    for wanted in (_longest_cell, _longest_line):
        for i, column in enumerate(columns):
            more = min(spare, max(0, wanted(column) - widths[i]))
            widths[i], spare = widths[i] + more, spare - more
    folded = []
    for i, (column, width) in enumerate(zip(columns, widths, strict=True)):
        # Folded here, at the same places that `_longest_word` assumes.
        header = "\n".join(textwrap.wrap(str(column.header), width or 1))
        # Copies, since the columns of names are in every part; rich numbers columns from 0.
        folded.append(replace(column, header=header, max_width=width, _index=i))
    return folded


def _longest_word(column: Column) -> int:
    """Length of the longest word; headers may break after a hyphen, as in `textwrap`."""
    words = re.split(r"\s|(?<=-)", str(column.header))
    for cell in column.cells:
        words += str(cell).split()
    return max(map(len, words), default=0)


def _longest_cell(column: Column) -> int:
    return max((len(str(cell)) for cell in column.cells), default=0)


def _longest_line(column: Column) -> int:
    return max(len(str(column.header)), _longest_cell(column))
