"""Cells whose policies are merged between training and measuring."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from samples.small_run import recipe
from samples.training_runs import contents

from aegis_cli.common.events import Progress
from aegis_cli.recipes import Anchor, Merge, Recipe
from aegis_cli.studies import pipeline
from aegis_cli.studies.cells import Cell
from aegis_cli.studies.policy_cells import PolicyRunner, cell_key


@pytest.fixture(scope="module")
def small(tiny_folder: Path) -> Recipe:
    anchor = Anchor(samples=14, batch_size=14, parts=("moments", "inputs", "curvature"))
    return replace(recipe(tiny_folder, ("naive",), backbone_lr=1e-2), anchor=anchor)


def test_a_merge_is_part_of_a_cells_key_and_none_is_not(small: Recipe) -> None:
    def key(merge: Merge) -> str:
        return cell_key(Cell("a", replace(small, merge=merge)), "0" * 64)

    plain = key(Merge())
    assert key(Merge(strength=3.0)) == plain  # without a method it shapes nothing
    others = [Merge("linear", 0.5), Merge("linear", 0.6), Merge("factors"), Merge("factors", 3.0)]
    keys = {key(merge) for merge in others}
    assert len(keys) == len(others) and plain not in keys


@pytest.mark.parametrize("merge", [Merge("linear", 1.0), Merge("factors", 10.0, frames=20)])
def test_the_merged_policy_is_measured_and_a_second_run_does_nothing(
    merge: Merge, small: Recipe, tmp_path: Path
) -> None:
    merging = replace(small, merge=merge)
    table = pipeline.run(merging, tmp_path)
    folder = tmp_path / "small" / "naive"
    (row,) = table.rows
    said = json.loads((folder / "merge.json").read_text())
    assert row.validation_loss == said["validation_loss"]
    assert row.validation_loss != json.loads((folder / "train.json").read_text())["validation_loss"]
    if merge.method == "linear":  # all the way back
        assert row.accuracy == row.baseline_accuracy
    events: list[Progress] = []
    before = contents(tmp_path / "small")
    pipeline.run(merging, tmp_path, on_event=events.append)
    assert contents(tmp_path / "small") == before
    stages = {event.stage for event in events}
    assert "naive/merge (up to date)" in stages and "naive/train" not in stages


def test_another_strength_merges_anew_and_does_not_train(small: Recipe, tmp_path: Path) -> None:
    pipeline.run(replace(small, merge=Merge("linear", 0.3)), tmp_path)
    events: list[Progress] = []
    again = replace(small, merge=Merge("linear", 1.0))
    (row,) = pipeline.run(again, tmp_path, on_event=events.append).rows
    assert row.accuracy == row.baseline_accuracy
    assert "naive/train (up to date)" in {event.stage for event in events}


def test_nothing_large_is_left_of_a_measured_cell(small: Recipe, tmp_path: Path) -> None:
    runner = PolicyRunner(tmp_path, lambda _: None)
    runner.figures("a", replace(small, merge=Merge("linear", 0.5)))
    assert (tmp_path / "a" / "merged" / "checkpoints").is_dir()
    runner.clear("a")
    assert not list(tmp_path.rglob("checkpoints"))
