"""The drawings of `aegis report`: their ticks and names are readable."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence

import pytest
import torch

from aegis_cli.cli.page import charts, runs
from aegis_cli.cli.page.charts import Series, Spot
from aegis_cli.cli.page.cursor import At

CASES = range(20)
DIGIT = 6.7  # the width of a digit of 12 px, in the units of a drawing


def drawn(markup: str) -> ElementTree.Element:
    return ElementTree.fromstring(markup)


def texts(chart: ElementTree.Element, kind: str) -> list[ElementTree.Element]:
    return [text for text in chart.iter("text") if kind in text.get("class", "").split()]


def draw(seed: int, *size: int) -> list[float]:
    return torch.rand(*size, generator=torch.Generator().manual_seed(seed)).tolist()


def learning(seed: int) -> list[tuple[float, float]]:
    """A figure of any size over some steps, of which there may be only one."""
    count, power = 1 + seed % 7, -6 + seed % 11
    return [(10 + 3 * k, (0.1 + y) * 10.0**power) for k, y in enumerate(draw(seed, count))]


@pytest.mark.parametrize("seed", CASES)
@pytest.mark.parametrize("log", [False, True])
def test_steps_have_whole_ticks_and_each_axis_has_two(seed: int, log: bool) -> None:
    chart = drawn(charts.lines([Series("x", learning(seed))], "step", "loss", "loss", log))
    ticks = texts(chart, "tick")
    below = [float(tick.text or "") for tick in ticks if tick.get("text-anchor") == "middle"]
    assert len(below) >= 2 and all(value.is_integer() for value in below)
    assert len(ticks) - len(below) >= 2


@pytest.mark.parametrize("seed", CASES)
def test_the_axis_says_its_name_beside_its_ticks(seed: int) -> None:
    chart = drawn(charts.lines([Series("x", learning(seed))], "step", "Time of a step", "time"))
    ends = [tick for tick in texts(chart, "tick") if tick.get("text-anchor") == "end"]
    lefts = [float(tick.get("x", "")) - DIGIT * len(tick.text or "") for tick in ends]
    assert min(lefts) >= 15  # the name is rotated around x = 12


@pytest.mark.parametrize("highest", [2e-4, 2e-5, 1.7e-3, 200_000, 3e7, 40, 0.3])
@pytest.mark.parametrize("log", [False, True])
def test_ticks_say_the_values_that_they_stand_at(highest: float, log: bool) -> None:
    scale = charts.spanning([highest / 30, highest], 0, 1, log)
    for tick in scale.ticks():
        assert float(charts.label(tick)) == pytest.approx(tick, rel=1e-6, abs=1e-12)


def spots(seed: int) -> list[Spot]:
    """Three means with intervals that extend past 100 %."""
    values = draw(seed, 3, 4)
    return [
        Spot(f"method{k}", x, y, (x - 9 * a, x + 9 * a), (y - b, y + b), k)
        for k, (x, y, a, b) in enumerate((90 + 10 * p, 20 * q, a, b) for p, q, a, b in values)
    ]


@pytest.mark.parametrize("seed", CASES)
def test_success_ends_at_100_percent(seed: int) -> None:
    chart = drawn(charts.frontier(spots(seed), [], "success", "lost", "frontier"))
    below = [t for t in texts(chart, "tick") if t.get("text-anchor") == "middle"]
    ticks = {float(tick.text or ""): float(tick.get("x", "")) for tick in below}
    assert max(ticks) <= 100
    (low, left), *_, (high, right) = sorted(ticks.items())
    end = left + (100 - low) / (high - low) * (right - left)
    across = [bar for bar in bars(chart) if bar.get("y1") == bar.get("y2")]
    assert len(across) == 3 and all(float(bar.get("x2", "")) <= end + 0.2 for bar in across)


def bars(chart: ElementTree.Element) -> list[ElementTree.Element]:
    return [line for line in chart.iter("line") if "bar" in line.get("class", "").split()]


def test_a_return_may_surpass_the_expert() -> None:
    above = Spot("x", 120, 1.0, (110, 130), (0.5, 1.5))
    chart = drawn(charts.frontier([above], [], "return", "lost", "frontier"))
    below = [t for t in texts(chart, "tick") if t.get("text-anchor") == "middle"]
    assert max(float(tick.text or "") for tick in below) >= 120


@pytest.mark.parametrize("seed", CASES)
def test_a_name_covers_no_interval(seed: int) -> None:
    chart = drawn(charts.frontier(spots(seed), [], "success", "lost", "frontier"))
    boxes = [name_box(text) for text in texts(chart, "name")]
    lines = [[float(bar.get(end, "")) for end in ("x1", "y1", "x2", "y2")] for bar in bars(chart)]
    assert len(boxes) == 3 and not any(crosses(box, line) for box in boxes for line in lines)


def name_box(text: ElementTree.Element) -> tuple[float, float, float, float]:
    left, base = float(text.get("x", "")), float(text.get("y", ""))
    return left, base - 9, left + DIGIT * len(text.text or ""), base


def crosses(box: Sequence[float], line: Sequence[float]) -> bool:
    left, right = sorted((line[0], line[2]))
    top, bottom = sorted((line[1], line[3]))
    return left < box[2] and right > box[0] and top < box[3] and bottom > box[1]


def test_drawings_have_no_colours_of_their_own() -> None:
    """The style sheet has them, for light and dark."""
    chart = charts.frontier(spots(0), [], "success", "lost", "frontier")
    assert not re.search(r"#[0-9a-f]{3}|rgb|fill=|stroke=", str(chart))


def watched(sets: str | list[str]) -> At:
    """A run that was asked questions of these sets during training."""
    names = [sets] if isinstance(sets, str) else sets
    fields = ["vqa_drop_points", *(f"vqa_drop_points_{k}" for k in range(2, len(names) + 1))]
    line = {"step": 3, "loss": 1.0} | dict.fromkeys(fields, 0.5)
    return At({"label": "x", "metrics": [line], "recipe": {"probe": {"vqa": sets}}})


@pytest.mark.parametrize(
    ("sets", "titles"),
    [
        ("scenes", ["VQA drop, validation (points)"]),
        (["scenes"], ["VQA drop, validation (points)"]),
        (
            ["scenes", "data/own.jsonl"],
            [
                "VQA drop on scenes, validation (points)",
                "VQA drop on own.jsonl, validation (points)",
            ],
        ),
    ],
)
def test_what_is_lost_of_each_question_set_is_drawn(
    sets: str | list[str], titles: list[str]
) -> None:
    for others in ([], [watched("scenes")]):
        page = runs.curves([*others, watched(sets)])
        found = re.findall(r'aria-label="(VQA [^"]*)"', str(page))
        assert found == titles, page
