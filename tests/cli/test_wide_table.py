"""Tables on terminals of any width: nothing is lost, broken or too wide."""

from __future__ import annotations

import io
import random

import pytest
from rich.console import Console

from aegis_cli.cli.render.layout import plain_table
from aegis_cli.cli.render.markdown import markdown

WORDS = [
    "naive",
    "stop-gradient",
    "24.62",
    "±3.09",
    "(nats)",
    "Cross-entropy",
    "%",
    "-",
    "x",
    "layers.0.qkv",
    "1,603",
]


def lines_of(
    header: list[str], rows: list[list[str]], left: int, width: int, title: str | None = None
) -> list[str]:
    console = Console(file=io.StringIO(), width=width, color_system=None)
    console.print(plain_table(header, rows, left, title))
    return console.file.getvalue().splitlines()


def generated(seed: int) -> tuple[list[str], list[list[str]], int]:
    """Header, rows, and how many columns identify a line; the first of them is a single word."""
    draw = random.Random(seed)
    count, left = draw.randint(2, 14), draw.randint(1, 2)
    text = lambda: " ".join(draw.choices(WORDS, k=draw.randint(1, 3)))  # noqa: E731
    rows = [[f"line{i}", *(text() for _ in range(count))] for i in range(draw.randint(1, 5))]
    return ["Name", *(text() for _ in range(count))], rows, left


@pytest.mark.parametrize("seed", range(40))
@pytest.mark.parametrize("width", [40, 80, 120, 1000])
def test_no_word_of_a_table_is_lost_broken_or_out_of_sight(seed: int, width: int) -> None:
    header, rows, left = generated(seed)
    lines = lines_of(header, rows, left, width)
    assert max(map(len, lines)) <= width
    parts = sum(line.split()[:1] == ["line0"] for line in lines)
    shown = sorted(word for line in lines for word in line.split())
    cells = [word for row in rows for cell in row for word in cell.split()]
    for word in set(cells):
        assert shown.count(word) >= cells.count(word)
    assert all(shown.count(row[0]) == parts for row in rows)  # each part identifies its lines
    letters = "".join(word for line in lines for word in line.split() if set(word) != {"─"})
    once = [cell for line in (header, *rows) for cell in line[left:]]
    in_each_part = [cell for line in (header, *rows) for cell in line[:left]]
    assert sorted(letters) == sorted("".join(once + parts * in_each_part).replace(" ", ""))


def test_a_table_goes_on_below_with_its_next_columns_and_one_title() -> None:
    header = ["Method", *(f"Column {i}" for i in range(8))]
    rows = [[name, *8 * ["1234.56 ±7.89"]] for name in ("naive", "stop-gradient")]
    lines = lines_of(header, rows, 1, 60, "Kept")
    assert (
        sum(line.startswith("Kept") for line in lines) == 1
        and sum(line.startswith(" Method") for line in lines) == 2
    )
    assert sum("stop-gradient" in line for line in lines) == 2
    wide = lines_of(header, rows, 1, 200, "Kept")
    assert sum("stop-gradient" in line for line in wide) == 1 and max(map(len, wide)) < 160


def test_figures_get_room_before_headers_and_headers_break_at_hyphens() -> None:
    lines = lines_of(
        ["Method", "Cross-entropy (nats)", "Knob"],
        [["naive", "1.035 ±0.156", "soft 0.0003"]],
        1,
        36,
    )
    assert "1.035 ±0.156" in lines[-2]
    assert [line.split() for line in lines[1:4]] == [
        ["Cross-"],
        ["entropy"],
        ["Method", "(nats)", "Knob"],
    ]


def test_a_word_wider_than_the_terminal_is_folded_not_cut() -> None:
    name = "model.language_model.layers.0.self_attn.q_proj.weight"
    lines = lines_of(["Tensor", "Shape"], [[name, "3 x 4"]], 2, 30)
    assert max(map(len, lines)) <= 30 and name in "".join(
        word for line in lines for word in line.split() if word not in "3x4"
    )


def test_markdown_has_the_whole_table() -> None:
    header = ["Method", *(f"Column {i}" for i in range(30))]
    assert markdown(plain_table(header, [["naive", *30 * ["1"]]])).count("\n") == 3
