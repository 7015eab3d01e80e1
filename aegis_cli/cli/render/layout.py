"""The common look of all tables, and figures as text."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from aegis_cli.cli.render.wide_table import WideTable

INSTRUCTIONS = 10  # rows of a table by instruction; --json has all
_SUCCESSES = {
    "Success seen %": "success_seen",
    "Success held-out %": "success_held_out",
    "Wrong target %": "wrong_target",
}
_RETURNS = {"Return % of highest": "return_share"}


def is_number(value: object) -> bool:
    """Whether a value can be drawn."""
    whole_or_not = isinstance(value, int | float) and not isinstance(value, bool)
    return whole_or_not and math.isfinite(value)


def acting(rows: Sequence[Any]) -> dict[str, str]:
    """Header -> field of the closed-loop figures of these rows.

    The rows are for coloured targets, or for a task measured by its return.
    """
    return _SUCCESSES if all(row.return_share is None for row in rows) else _RETURNS


Cell = str | Text
# Marks that also work without colours and in plain ASCII.
BEST, WORST = "*", "!"
MARKS = f"{BEST} best of its column, {WORST} worst"
_STYLES = {BEST: "bold", WORST: "dim"}


def marked(
    cells: Sequence[str], values: Sequence[float | None], more_is_better: bool | None
) -> list[Cell]:
    """The cells of a column with marks for the best and the worst.

    Values with the same text count as equal. Nothing is marked if all are equal, and no worst if
    there are only two different values.

    Args:
        values: the values of the cells; None for a cell without a figure.
        more_is_better: None for a column in which neither direction is better.
    """
    known = {value: cell for cell, value in zip(cells, values, strict=True) if value is not None}
    apart = len(set(known.values()))  # texts, so that a difference in hidden digits does not count
    if more_is_better is None or apart < 2:
        return list(cells)
    worst, best = known[min(known)], known[max(known)]
    if not more_is_better:
        worst, best = best, worst
    marks = {best: BEST}
    if apart > 2:
        marks[worst] = WORST
    shown: list[Cell] = []
    for cell in cells:
        mark = marks.get(cell)
        shown.append(cell if mark is None else Text(mark + cell, _STYLES[mark]))
    return shown


def unmarked(cell: Text) -> tuple[str, str]:
    """A cell's mark ("" if it has none), and its text without the mark."""
    mark = next((m for m, style in _STYLES.items() if cell.style == style), "")
    return mark, cell.plain.removeprefix(mark)


def plain_table(
    header: Sequence[str], rows: Iterable[Sequence[Cell]], left: int = 1, title: str | None = None
) -> Table:
    """A plain table with the first `left` columns aligned left and figures aligned right."""
    table = WideTable(left, title)
    for i, name in enumerate(header):
        table.add_column(name, justify="left" if i < left else "right", overflow="fold")
    for row in rows:
        # As a `Text`, because rich would read brackets in a string as markup.
        table.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in row))
    return table


def percent(value: float | None, digits: int = 1) -> str:
    return fixed(None if value is None else 100 * value, digits)


def fixed(value: float | None, digits: int) -> str:
    """A number with `digits` decimals; a value that rounds to 0 has no sign."""
    return "-" if value is None else f"{value:z.{digits}f}"


def number(value: float | None, significant: int = 4) -> str:
    """A number with four significant digits; large numbers are whole while still readable."""
    if value is None:
        return "-"
    # From 9999.5 on four digits round to 10000, which `g` would write as 1e+04.
    whole = 10**significant - 0.5 <= abs(value) < 1e9
    return f"{value:,.0f}" if whole else f"{value:.{significant}g}"


def parts_of(view: RenderableType) -> Iterator[Table | Text]:
    """The tables and texts of a view in their order, without the `Group`s.

    Raises:
        TypeError: the view has a part of another kind, which Markdown and pages cannot show.
    """
    match view:
        case Group():
            for part in view.renderables:
                yield from parts_of(part)
        case Table() | Text():
            yield view
        case _:
            raise TypeError(f"neither a table nor a text: a {type(view).__name__}")


def paragraphs(text: Text) -> list[str]:
    """The lines of a text that are not blank; an indented line continues the previous one."""
    lines = text.plain.replace("\n  ", " ").splitlines()
    return [line.strip() for line in lines if line.strip()]


def spread(estimate: Any, show: Callable[[float], str]) -> str:
    """`mean ±half`, with the distance to the farther end; only the mean for a single run."""
    if estimate is None:
        return "-"
    if estimate.half is None:
        return show(estimate.mean)
    half = show(estimate.half).removeprefix("+")  # `show` adds a sign to differences
    return f"{show(estimate.mean)} ±{half}"
