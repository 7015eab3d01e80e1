"""The table of a published model's runs is made from the cells that lie beside the page."""

from __future__ import annotations

import importlib.util
import json
import sys
from types import ModuleType

import pytest
from samples.command_blocks import ROOT

RESULTS = ROOT / "docs/results"


def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("published", ROOT / "docs/published_model.py")
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
