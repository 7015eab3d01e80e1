"""The drawn pictures of docs/pictures: their script runs, and its output is what is committed."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

FOLDER = Path(__file__).parents[2] / "docs" / "pictures"
NAMES = ("pipeline", "projection", "routing", "accuracy-matrix")


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("draw", FOLDER / "draw.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", NAMES)
def test_every_word_stands_on_the_card(name: str, script: ModuleType) -> None:
    assert tuple(script.PICTURES) == NAMES
    figure = script.PICTURES[name]()
    figure.draw_without_rendering()
    width, height = figure.bbox.size
    for text in figure.axes[0].texts:
        extent = text.get_window_extent()
        inside = extent.x0 > 10 and extent.y0 > 10 and extent.x1 < width - 10
        assert inside and extent.y1 < height - 10, text.get_text()


@pytest.mark.parametrize("name", NAMES)
def test_letters_are_paths_so_that_no_font_is_needed(name: str) -> None:
    drawn = (FOLDER / f"{name}.svg").read_text()
    assert drawn.startswith("<?xml") and "<text" not in drawn and len(drawn) > 10_000


def test_the_page_s_pictures_are_there_and_small() -> None:
    sizes = {path.name: path.stat().st_size for path in FOLDER.iterdir() if path.is_file()}
    assert {"compare.png", "rollout.gif"} <= set(sizes)
    assert sizes["rollout.gif"] < 1_500_000 and max(sizes.values()) < 1_500_000
