"""What all tables have in common: their look, and figures as text."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from rich.table import Table
from rich.text import Text

from aegis_cli.cli.render.wide_table import WideTable

_SUCCESSES = {
    "Success seen %": "success_seen",
    "Success held-out %": "success_held_out",
    "Wrong target %": "wrong_target",
}
_RETURNS = {"Return % of highest": "return_share"}


def acting(rows: Sequence[Any]) -> dict[str, str]:
    """Header -> field of what rows say of closed loops.

    Rows are of coloured targets, or of a task measured by its return.
    """
    return _SUCCESSES if all(row.return_share is None for row in rows) else _RETURNS


Cell = str | Text
# Marks that an output without colours and in plain ASCII shows, too.
BEST, WORST = "*", "!"
MARKS = f"{BEST} best of its column, {WORST} worst"
_STYLES = {BEST: "bold", WORST: "dim"}


def marked(
    cells: Sequence[str], values: Sequence[float | None], more_is_better: bool | None
) -> list[Cell]:
    """The cells of a column, the best ones and the worst ones marked.

    Values that look alike are alike. Nothing is marked where all are, and no worst of two.

    Args:
        values: of the cells; None of one without a figure.
        more_is_better: None for a column with no good end.
    """
    known = {value: cell for cell, value in zip(cells, values, strict=True) if value is not None}
    if more_is_better is None or len(set(known.values())) < 2:
        return list(cells)
    ends = known[min(known)], known[max(known)]
    worst, best = ends if more_is_better else ends[::-1]
    marks = {best: BEST} if len(set(known.values())) == 2 else {best: BEST, worst: WORST}
    return [
        Text(marks[cell] + cell, _STYLES[marks[cell]]) if cell in marks else cell for cell in cells
    ]


def unmarked(cell: Text) -> tuple[str, str]:
    """A cell's mark, which may be none, and its text without it."""
    mark = next((m for m, style in _STYLES.items() if cell.style == style), "")
    return mark, cell.plain.removeprefix(mark)


def plain_table(
    header: Sequence[str], rows: Iterable[Sequence[Cell]], left: int = 1, title: str | None = None
) -> Table:
    """Plain and aligned: the first `left` columns to the left, figures to the right."""
    table = WideTable(left, title)
    for i, name in enumerate(header):
        table.add_column(name, justify="left" if i < left else "right", overflow="fold")
    for row in rows:
        table.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in row))
    return table


def percent(value: float | None, digits: int = 1) -> str:
    return fixed(None if value is None else 100 * value, digits)


def fixed(value: float | None, digits: int) -> str:
    """A number with that many digits after its point; what rounds to 0 has no sign."""
    return "-" if value is None else f"{value:z.{digits}f}"


def number(value: float | None, significant: int = 4) -> str:
    """Four significant digits; a large number whole, as long as it can be read."""
    if value is None:
        return "-"
    whole = 10**significant - 0.5 <= abs(value) < 1e9
    return f"{value:,.0f}" if whole else f"{value:.{significant}g}"


def paragraphs(text: Text) -> list[str]:
    """The lines of a text that are not blank; an indented line goes on with the one before."""
    lines = text.plain.replace("\n  ", " ").splitlines()
    return [line.strip() for line in lines if line.strip()]


def spread(estimate: Any, show: Callable[[float], str]) -> str:
    """`mean ±half`: the distance of the farther end; the mean alone of a single run."""
    if estimate is None or estimate.half is None:
        return "-" if estimate is None else show(estimate.mean)
    # of differences `show` writes the sign
    return f"{show(estimate.mean)} ±{show(estimate.half).removeprefix('+')}"
