"""SGD for the backbone under every method; test_train.py shows that naive's is PyTorch's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from samples.training_runs import (
    SETTINGS,
    STEPS,
    Start,
    assert_resumes,
    protected_shares,
    recipe,
    start,
)

from aegis_cli.methods import METHODS
from aegis_cli.recipes import Recipe
from aegis_cli.training import assemble, dry_run

__all__ = ["recipe", "start"]  # fixtures

SGD = replace(SETTINGS, optimizer="sgd", backbone_lr=0.05, betas=(0.8, 0.95))


# One of each way in which a method uses the optimizer: plain, a second backward pass, adapters,
# an auxiliary loss, and updates that are projected or preconditioned over several steps. Resuming
# each method from a checkpoint is tested with AdamW in `test_train_resume`.
@pytest.mark.parametrize("method", ["naive", "aegis", "lora", "ewc", "kfac", "nullspace"])
def test_a_resumed_run_with_sgd_ends_in_the_same_bytes(
    start: Start, recipe: Recipe, tmp_path: Path, method: str
) -> None:
    assert_resumes(start, method, replace(recipe, train=SGD), tmp_path)


def test_the_applied_update_is_constrained_as_adamws_is(
    start: Start, recipe: Recipe, anchor_file: Path, tmp_path: Path
) -> None:
    """`nullspace` projects SGD's applied update, including its momentum and weight decay."""
    shared = replace(SGD, weight_decay=0.5)
    guarded = replace(recipe.nullspace, energy=0.9, every=1)
    slow = replace(recipe, train=shared, nullspace=guarded)
    start("nullspace", tmp_path / "kept", recipe=slow)
    start("naive", tmp_path / "lost", recipe=slow)
    assert max(protected_shares(tmp_path / "kept", anchor_file, 0.9)) < 1e-8
    assert min(protected_shares(tmp_path / "lost", anchor_file, 0.9)) > 0.01


def test_a_dry_run_counts_one_moment_instead_of_two(
    recipe: Recipe, demos_file: Path, tmp_path: Path
) -> None:
    found = {
        (optimizer, momentum): dry_run.run(
            replace(recipe, train=replace(SETTINGS, optimizer=optimizer, momentum=momentum)),
            "naive",
            demos_file,
            None,
            tmp_path / "run",
        )
        for optimizer, momentum in (("adamw", 0.9), ("sgd", 0.9), ("sgd", 0.0))
    }
    adam, sgd, none = (report.memory_mb["optimizer"] for report in found.values())
    assert adam - sgd == pytest.approx(sgd - none) and sgd > none > 0  # the expert keeps AdamW's
    disk = [report.disk_mb for report in found.values()]
    assert disk[0] - disk[1] == pytest.approx(disk[1] - disk[2]) and disk[1] > disk[2]


def test_a_rate_per_parameter_gives_sgd_a_group_for_each(
    recipe: Recipe, demos_file: Path, anchor_file: Path, tmp_path: Path
) -> None:
    """This lets kfac's `balance` scale SGD's steps too."""
    chosen = replace(recipe, train=replace(SGD, method="kfac"))
    made = assemble.build(chosen, METHODS["kfac"], demos_file, anchor_file, tmp_path, print)
    backbone, expert = made.optimizers
    assert isinstance(backbone, torch.optim.SGD) and isinstance(expert, torch.optim.AdamW)
    assert len(backbone.param_groups) > STEPS and len(expert.param_groups) == 1
