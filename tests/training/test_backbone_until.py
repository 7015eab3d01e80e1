"""A last phase of training in which the backbone is frozen and only the expert learns."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from samples.training_runs import (
    EVERY,
    SETTINGS,
    STEPS,
    Start,
    assert_same_run,
    metrics,
    stop_at,
)

from aegis_cli.common import artifacts
from aegis_cli.recipes import Kfac, Recipe, Train
from aegis_cli.training import checkpoint, schedule

UNTIL = 4  # the last step that moves the backbone; a checkpoint follows it


@pytest.fixture
def halted(recipe: Recipe) -> Recipe:
    """Constraints of `kfac` and `nullspace` cover three steps, so that one is cut short."""
    train = replace(SETTINGS, backbone_until=UNTIL / STEPS, weight_decay=0.5)
    kfac = Kfac(every=3, growth=1.0)
    return replace(recipe, train=train, kfac=kfac, nullspace=replace(recipe.nullspace, every=3))


def backbone_of(out: Path, step: int) -> bytes:
    return (out / "checkpoints" / f"{step:06d}" / "backbone" / "model.safetensors").read_bytes()


def expert_of(out: Path, step: int) -> dict[str, torch.Tensor]:
    path = out / "checkpoints" / f"{step:06d}" / checkpoint.EXPERT
    return artifacts.load(path, "expert").tensors


@pytest.mark.parametrize("method", ["naive", "aegis", "kfac", "ewc", "insulate"])
def test_the_backbones_bytes_stand_still_and_the_expert_goes_on(
    method: str, start: Start, halted: Recipe, tmp_path: Path
) -> None:
    start(method, tmp_path, recipe=halted)
    assert backbone_of(tmp_path, EVERY) != backbone_of(tmp_path, UNTIL)
    assert backbone_of(tmp_path, UNTIL) == backbone_of(tmp_path, STEPS)
    before, after = expert_of(tmp_path, UNTIL), expert_of(tmp_path, STEPS)
    assert any(not torch.equal(tensor, after[name]) for name, tensor in before.items())
    rates = [line["lr_backbone"] for line in metrics(tmp_path)]
    assert [rate > 0 for rate in rates] == [n <= UNTIL for n in range(1, STEPS + 1)]


def test_up_to_there_the_run_is_the_same(
    start: Start, halted: Recipe, recipe: Recipe, tmp_path: Path
) -> None:
    whole = replace(halted, train=replace(halted.train, backbone_until=1.0))
    for name, own in (("halted", halted), ("whole", whole)):
        start("naive", tmp_path / name, recipe=own)
    assert backbone_of(tmp_path / "halted", UNTIL) == backbone_of(tmp_path / "whole", UNTIL)
    assert backbone_of(tmp_path / "halted", STEPS) != backbone_of(tmp_path / "whole", STEPS)


@pytest.mark.parametrize("method", ["aegis", "kfac"])
@pytest.mark.parametrize("interrupted_at", [3, 5])
def test_a_resumed_run_ends_in_the_same_bytes(
    method: str, interrupted_at: int, start: Start, halted: Recipe, tmp_path: Path
) -> None:
    start(method, tmp_path / "whole", recipe=halted)
    with pytest.raises(KeyboardInterrupt):
        stop = stop_at(interrupted_at, KeyboardInterrupt())
        start(method, tmp_path / "cut", recipe=halted, on_event=stop)
    start(method, tmp_path / "cut", recipe=halted, resume=True)
    assert_same_run(tmp_path / "cut", tmp_path / "whole")


def test_the_ledger_has_a_row_for_each_step_that_moves_the_backbone(
    start: Start, halted: Recipe, tmp_path: Path
) -> None:
    start("aegis", tmp_path, recipe=halted)
    ledger = artifacts.load(tmp_path / "ledger.safetensors", "ledger")
    assert ledger.tensors["step"].tolist() == list(range(1, UNTIL + 1))


@pytest.mark.parametrize(
    ("steps", "share", "wanted"), [(600, 1.0, 600), (600, 0.7, 420), (3, 0.1, 1)]
)
def test_at_least_one_step_moves_the_backbone(steps: int, share: float, wanted: int) -> None:
    assert schedule.moving_steps(steps, share) == wanted


def test_nothing_is_lost_of_the_rate_before_its_peak() -> None:
    settings = Train(steps=100, warmup=10, final_lr_share=0.1)
    warming = [schedule.rate_left(step, settings) for step in range(10)]
    falling = [schedule.rate_left(step, settings) for step in range(10, 100)]
    assert warming == [1.0] * 10 and falling[0] == 1.0
    assert falling == sorted(falling, reverse=True) and falling[-1] > 0.1


def test_a_run_whose_backbone_stands_still_needs_no_anchor_gradient_to_go_on(
    start: Start, halted: Recipe, tmp_path: Path
) -> None:
    shared = replace(halted, aegis=replace(halted.aegis, refresh=3))
    start("aegis", tmp_path / "whole", recipe=shared)
    with pytest.raises(KeyboardInterrupt):
        stop = stop_at(5, KeyboardInterrupt())
        start("aegis", tmp_path / "cut", recipe=shared, on_event=stop)
    start("aegis", tmp_path / "cut", recipe=shared, resume=True)
    assert_same_run(tmp_path / "cut", tmp_path / "whole")


def test_metrics_of_a_backbone_that_stands_still_have_no_figures_of_a_projection(
    start: Start, halted: Recipe, tmp_path: Path
) -> None:
    start("aegis", tmp_path, recipe=halted)
    told = ["energy_shed" in line and "conflict" in line for line in metrics(tmp_path)]
    assert told == [number <= UNTIL for number in range(1, STEPS + 1)]
