"""Tables as HTML, of figures and of the views that the terminal shows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich.console import RenderableType
from rich.table import Table

from aegis_cli.cli.page.html import Child, Markup, element
from aegis_cli.cli.render.layout import paragraphs, parts_of


def table(
    header: Sequence[Child],
    rows: Sequence[Sequence[Child]],
    left: int = 1,
    caption: Child = None,
) -> Markup:
    """A table that scrolls sideways if the page is narrow; the first `left` columns are text."""
    names = [
        element("th", name, scope="col", class_="text" if i < left else None)
        for i, name in enumerate(header)
    ]
    body = [element("tr", *_cells(row, left)) for row in rows]
    parts = [
        None if caption is None else element("caption", caption),
        element("thead", element("tr", *names)),
        element("tbody", *body),
    ]
    return element("div", element("table", *parts), class_="scroll")


def _cells(row: Sequence[Child], left: int) -> Iterator[Markup]:
    for i, cell in enumerate(row):
        if isinstance(cell, Markup) and cell.startswith("<td"):  # made by `shaded`
            yield cell
        elif i == 0:
            yield element("th", cell, scope="row")
        else:
            yield element("td", cell, class_="text" if i < left else None)


def shaded(cell: Child, depth: float) -> Markup:
    """A cell with a background that is deeper the closer `depth` is to 1."""
    inside = min(max(depth, 0), 1)
    return element("td", cell, class_="shade", style=f"--depth:{inside:.3f}")


def verdict(passed: bool | None, yes: str = "yes", no: str = "no") -> Child:
    """Whether something is passed; a dash for None."""
    if passed is None:
        return "–"
    return element("span", yes if passed else no, class_="yes" if passed else "no")


def pairs(values: Sequence[tuple[str, Child]], big: bool = False) -> Markup:
    """Names with their values, side by side."""
    items = [element("div", element("dt", name), element("dd", value)) for name, value in values]
    return element("dl", *items, class_="facts big" if big else "facts")


def view(shown: RenderableType) -> Iterator[Markup]:
    """The parts of a view of the terminal: a `Text`, a `Table`, or a `Group` of these."""
    for part in parts_of(shown):
        if isinstance(part, Table):
            yield _terminal_table(part)
            continue
        for line in paragraphs(part):
            yield element("h3" if part.style == "bold" else "p", line)


def _terminal_table(shown: Table) -> Markup:
    header = [str(column.header) for column in shown.columns]
    left = sum(column.justify != "right" for column in shown.columns)  # texts come first
    # rich stores cells by column, but HTML needs them by row.
    columns = [[str(cell) for cell in column.cells] for column in shown.columns]
    rows = [list(row) for row in zip(*columns, strict=True)]
    title = str(shown.title) if shown.title else None
    return table(header, rows, left, title)
