"""A study's tables from its finished cells alone, with the recipe that has its name."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from samples.command import ROOT, refused

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError
from aegis_cli.recipes import study_cells
from aegis_cli.studies import study

RECIPES = ROOT / "recipes"


@pytest.mark.parametrize("name", ["ablations"])
def test_inspect_shows_the_tables_of_shipped_cells_at_once(
    name: str, aegis: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shipped = RECIPES / "results" / f"{name}.cells.json"
    code, out, _ = aegis("inspect", shipped, "--json")
    report = json.loads(out)
    assert code == 0 and report["finished"] == report["cells"] == 58
    assert report["out"] == str(shipped) and not list(tmp_path.iterdir())


def test_some_cells_have_the_tables_of_what_there_is(tmp_path: Path) -> None:
    resolved = study_cells.load(RECIPES / "ablations.yaml")
    entries = files.load_json(RECIPES / "results" / "ablations.cells.json")
    some = tmp_path / "some.json"
    files.save_json(some, dict(list(entries.items())[:20]))
    report = study.told(resolved, some)
    assert 0 < report.finished <= 20 < report.cells
    files.save_json(some, {"0" * 64: {}})
    with pytest.raises(AegisError, match="none of them of the study 'ablations'"):
        study.told(resolved, some)


@pytest.mark.parametrize(("missing", "judged"), [("lora", True), ("naive", False)])
def test_no_value_is_chosen_by_another_margin_than_that_of_all_cells(
    missing: str, judged: bool, tmp_path: Path
) -> None:
    """The margin is naive's: if one of its values is missing, the best of the others sets it."""
    resolved = study_cells.load(RECIPES / "compare.yaml")
    shipped = RECIPES / "results" / "compare.cells.json"
    entries = files.load_json(shipped)
    kind = study.kind_of(resolved)
    runner = kind.make_runner(tmp_path, lambda event: None)
    del entries[runner.key(study.trials(kind)[missing][-1][1])]
    files.save_json(tmp_path / "some.json", entries)
    found = study.told(resolved, tmp_path / "some.json")
    whole = {p.variant: p.value for p in study.told(resolved, shipped).tuning if p.chosen}
    chosen = {p.variant: p.value for p in found.tuning if p.chosen}
    expected = {name: value for name, value in whole.items() if name != missing}
    assert chosen == (expected if judged else {})
    assert bool(found.tasks) is judged and found.tuning and found.finished


def test_cells_need_the_recipe_of_their_study(aegis: Any, tmp_path: Path) -> None:
    entries = (RECIPES / "results" / "ablations.cells.json").read_bytes()
    (tmp_path / "mine.cells.json").write_bytes(entries)
    assert "quickstart" in refused(aegis("inspect", tmp_path / "mine.cells.json"))
    (tmp_path / "mine.yaml").write_bytes((RECIPES / "ablations.yaml").read_bytes())
    assert aegis("inspect", tmp_path / "mine.cells.json", "--json")[0] == 0
    (tmp_path / "cells.json").write_bytes(entries)
    assert "does not name its study" in refused(aegis("inspect", tmp_path / "cells.json"))
