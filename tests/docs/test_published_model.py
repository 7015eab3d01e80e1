"""The table of a published model's runs is made from the cells beside the page."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest
from samples.command_blocks import ROOT

RESULTS = ROOT / "docs/results"


def script(path: str = "docs/published_model.py") -> ModuleType:
    spec = importlib.util.spec_from_file_location("published", ROOT / path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["published"] = module  # where its dataclasses look for their types
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["published", "published-longer", "published-first"])
def test_the_pages_table_is_that_of_the_cells(name: str) -> None:
    cells = json.loads((RESULTS / f"{name}.cells.json").read_text(encoding="utf-8"))
    table = script().table(cells)
    assert len(cells) > 5 and len(table.splitlines()) > 6
    assert table in (RESULTS / "published.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("cell", [{"steps": 1200}, {}])
def test_runs_of_another_number_of_steps_are_no_runs_of_the_folder(
    cell: dict[str, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Earlier cells, which do not state it, had the usual number."""
    cells = tmp_path / "cells.json"
    cells.write_text(json.dumps({"pretrained": {}, "naive_0.0001_1": cell}))
    steps = "300" if cell else "1200"
    monkeypatch.setattr(sys, "argv", ["published", "--steps", steps, "--out", str(tmp_path)])
    with pytest.raises(SystemExit, match="another number of steps"):
        script().main()


def test_every_run_of_the_cells_is_in_the_picture(tmp_path: Path) -> None:
    pictures = script("docs/pictures/published.py")
    drawn = tmp_path / "published.png"
    pictures.draw(drawn)
    assert drawn.read_bytes().startswith(b"\x89PNG")
    shown = set(pictures.LOOKS)
    for name in pictures.PANELS.values():
        cells = json.loads((RESULTS / f"{name}.cells.json").read_text(encoding="utf-8"))
        runs = {tuple(cell.rsplit("_", 2)[:2]) for cell in cells if cell != "pretrained"}
        assert runs and runs <= shown
