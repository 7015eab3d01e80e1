"""Training refuses, before a step moves anything, parts that its method cannot see."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from samples.training_runs import SETTINGS
from torch import Tensor, nn

from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import ignore
from aegis_cli.methods import METHODS
from aegis_cli.methods.base import Pass
from aegis_cli.recipes import Recipe
from aegis_cli.training import assemble, train


@pytest.fixture
def run(
    recipe: Recipe, demos_file: Path, anchor_file: Path, tmp_path: Path
) -> assemble.TrainingRun:
    recipe = replace(recipe, train=replace(recipe.train, method="aegis"))
    return assemble.build(recipe, METHODS["aegis"], demos_file, anchor_file, tmp_path, ignore)


def step(run: assemble.TrainingRun) -> None:
    batch = run.demos.batch(run.demos.train[:4], SETTINGS.chunk)
    train.update(run, 0, batch, train.Window())


def refused_unmoved(run: assemble.TrainingRun, message: str) -> None:
    before = {name: p.detach().clone() for name, p in run.policy.named_parameters()}
    with pytest.raises(AegisError, match=message):
        step(run)
    assert all(torch.equal(p, before[name]) for name, p in run.policy.named_parameters())


def without_anchor_gradient(run: assemble.TrainingRun) -> None:
    """Let the run's penalty be constant."""
    penalty = run.parts.penalty
    assert penalty is not None

    def zero(seen: Pass) -> tuple[Tensor, Tensor]:
        whole, w2 = penalty(seen)
        return whole * 0, w2

    run.parts = replace(run.parts, penalty=zero)


def test_an_anchor_gradient_of_zero_is_no_step(run: assemble.TrainingRun) -> None:
    without_anchor_gradient(run)
    refused_unmoved(run, "anchor gradient of zero in all")
    assert len(run.ledger) == 0


def test_another_methods_penalty_may_be_at_its_minimum(run: assemble.TrainingRun) -> None:
    """Such as the distance to the weights that the training began with, in its first step."""
    without_anchor_gradient(run)
    run.method = replace(run.method, needs=frozenset())
    step(run)
    assert len(run.ledger) == 1


def test_a_replaced_parameter_is_named(run: assemble.TrainingRun) -> None:
    layer = run.policy.backbone.get_submodule("layers.0")
    name, found = next(iter(layer.named_parameters()))
    owner, _, last = name.rpartition(".")
    setattr(layer.get_submodule(owner), last, nn.Parameter(found.detach().clone()))
    refused_unmoved(run, f"layers.0.{name}.*added to the model later")
