"""`aegis.refresh`: several steps share one anchor gradient, also across an interruption."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.training_runs import (
    EVERY,
    STEPS,
    Start,
    assert_same_run,
    metrics,
    recipe,
    start,
    stop_at,
)
from torch import Tensor

from aegis_cli.common import artifacts
from aegis_cli.core.ledger import energy_shed_mean
from aegis_cli.recipes import Aegis, Recipe
from aegis_cli.training import checkpoint, dry_run, step

__all__ = ["recipe", "start"]  # fixtures

SHARED = 4  # steps; more than between two checkpoints, so one checkpoint falls inside


def refreshed(recipe: Recipe, every: int, **options: Any) -> Recipe:
    return replace(recipe, aegis=Aegis(refresh=every, **options))


def ledger(run: Path) -> dict[str, Tensor]:
    return artifacts.load(run / "ledger.safetensors", "ledger").tensors


@pytest.mark.parametrize(
    ("cut", "optimizer", "options"),
    [
        (3, "adamw", {}),
        (4, "adamw", {}),
        (5, "sgd", {}),
        (3, "sgd", {"idle": "kept"}),
        (5, "adamw", {"idle": "kept", "projects": "both"}),
        (3, "adamw", {"fraction": 0.5}),
    ],
)
def test_a_run_cut_inside_an_interval_goes_on_to_the_same_bytes(
    start: Start,
    recipe: Recipe,
    tmp_path: Path,
    cut: int,
    optimizer: str,
    options: dict[str, Any],
) -> None:
    chosen = refreshed(recipe, SHARED, **options)
    chosen = replace(chosen, train=replace(recipe.train, optimizer=optimizer))
    start("aegis", tmp_path / "whole", recipe=chosen)
    with pytest.raises(KeyboardInterrupt):
        start("aegis", tmp_path / "cut", recipe=chosen, on_event=stop_at(cut, KeyboardInterrupt()))
    start("aegis", tmp_path / "cut", recipe=chosen, resume=True)
    assert_same_run(tmp_path / "cut", tmp_path / "whole")


def test_a_second_backward_pass_is_taken_in_the_first_step_of_each_interval(
    start: Start, recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken, pass_back = [], step.second_backward

    def counted(*arguments: Any) -> dict[int, Tensor | None]:
        taken.append(len(taken))
        return pass_back(*arguments)

    monkeypatch.setattr(step, "second_backward", counted)
    start("aegis", tmp_path / "each", recipe=refreshed(recipe, 1))
    assert len(taken) == STEPS
    start("aegis", tmp_path / "shared", recipe=refreshed(recipe, SHARED))
    assert len(taken) == STEPS + 2  # before steps 1 and 5


def test_the_ledger_has_the_inner_products_with_the_gradient_that_was_used(
    start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    report = start("aegis", tmp_path / "shared", recipe=refreshed(recipe, SHARED))
    start("aegis", tmp_path / "each", recipe=refreshed(recipe, 1))
    shared, each = ledger(tmp_path / "shared"), ledger(tmp_path / "each")
    assert shared["step"].tolist() == list(range(1, STEPS + 1))
    assert torch.equal(shared["aa"][0].expand(SHARED, -1), shared["aa"][:SHARED])
    assert not torch.equal(shared["aa"][0], shared["aa"][SHARED])
    for name in ("tt", "ta", "aa", "w2"):
        assert torch.equal(shared[name][0], each[name][0])
    assert not torch.equal(shared["ta"][1], shared["ta"][0])
    assert len(shared["w2"].unique(dim=0)) == STEPS  # W2 is each step's own
    assert report.energy_shed_mean == energy_shed_mean(shared)
    assert [line["step"] for line in metrics(tmp_path / "shared") if "energy_shed" in line]


def test_a_checkpoint_holds_the_gradient_where_the_next_step_reuses_it(
    start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    start("aegis", tmp_path, recipe=refreshed(recipe, SHARED))
    found = {}
    for n in range(EVERY, STEPS + 1, EVERY):
        state = artifacts.load(tmp_path / "checkpoints" / f"{n:06d}" / checkpoint.STATE)
        found[n] = any(name.startswith("anchor_gradient.") for name in state.tensors)
    assert found == {2: True, 4: False, 6: True}


def test_a_dry_run_counts_the_gradient_in_the_checkpoints(
    recipe: Recipe, demos_file: Path, anchor_file: Path, tmp_path: Path
) -> None:
    each, shared = (
        dry_run.run(refreshed(recipe, every), "aegis", demos_file, anchor_file, tmp_path / "run")
        for every in (1, SHARED)
    )
    assert shared.memory_mb["anchor gradient"] == each.memory_mb["anchor gradient"] > 0
    more = (shared.disk_mb - each.disk_mb) / each.checkpoints
    assert more == pytest.approx(each.memory_mb["anchor gradient"])
