"""A training state holds what learns; frozen weights are read from the model again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from samples.training_runs import SETTINGS, Start, assert_resumes, assert_same_run, stop_at

from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.methods import METHODS
from aegis_cli.models import backbones
from aegis_cli.recipes import Recipe
from aegis_cli.training import assemble, checkpoint

WEIGHT = "weight."


def state_of(out: Path) -> artifacts.Artifact:
    return artifacts.load(checkpoint.last(out) / checkpoint.STATE, "training-state")


def weights(out: Path) -> set[str]:
    return {n.removeprefix(WEIGHT) for n in state_of(out).tensors if n.startswith(WEIGHT)}


def with_frozen(out: Path, recipe: Recipe, without: str = "") -> None:
    """Rewrite the last state as an earlier version wrote it, with the frozen weights.

    Args:
        without: the name of a weight that is left out.
    """
    saved, path = state_of(out), checkpoint.last(out) / checkpoint.STATE
    backbone = backbones.load(recipe.backbone)
    frozen = {f"weight.backbone.{n}": p.detach() for n, p in backbone.named_parameters()}
    tensors = frozen | saved.tensors
    tensors.pop(without, None)
    header = saved.header
    artifacts.save(
        path, "training-state", tensors, seed=header.seed, inputs=header.inputs, meta=header.meta
    )


@pytest.mark.parametrize("method", sorted(METHODS))
def test_no_frozen_weight_is_written_twice(
    method: str,
    whole_run: Callable[[str], Path],
    recipe: Recipe,
    demos_file: Path,
    anchor_file: Path,
    tmp_path: Path,
) -> None:
    ours = replace(recipe, train=replace(SETTINGS, method=method))
    given = METHODS[method], demos_file, anchor_file, tmp_path, lambda _: None
    begun = assemble.build(ours, *given)
    parameters = dict(begun.policy.named_parameters())
    assert weights(whole_run(method)) == {n for n, p in parameters.items() if p.requires_grad}
    if method == "stop-gradient":
        assert {name.partition(".")[0] for name in weights(whole_run(method))} == {"expert"}


def test_a_run_with_frozen_parts_resumes_to_the_same_bytes(
    start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    frozen = replace(recipe, train=replace(SETTINGS, freeze="layers.0"))
    assert_resumes(start, "naive", frozen, tmp_path)
    found = weights(tmp_path / "whole")
    assert any(name.startswith("backbone.layers.1.") for name in found)
    assert not any(name.startswith("backbone.layers.0.") for name in found)


def test_a_state_of_an_earlier_version_resumes_to_the_same_bytes(
    whole_run: Callable[[str], Path], start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    with pytest.raises(KeyboardInterrupt):
        start("stop-gradient", tmp_path, on_event=stop_at(3, KeyboardInterrupt()))
    with_frozen(tmp_path, recipe)
    assert len(weights(tmp_path)) > len(weights(whole_run("stop-gradient")))
    torch.manual_seed(99)
    start("stop-gradient", tmp_path, resume=True)
    kept = checkpoint.whole(tmp_path)[0] / checkpoint.STATE
    kept.write_bytes((whole_run("stop-gradient") / kept.relative_to(tmp_path)).read_bytes())
    assert_same_run(tmp_path, whole_run("stop-gradient"))


def test_a_lost_weight_of_an_earlier_version_is_missed(
    start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    with pytest.raises(KeyboardInterrupt):
        start("stop-gradient", tmp_path, on_event=stop_at(3, KeyboardInterrupt()))
    lost = "weight.backbone.layers.0.qkv.weight"
    with_frozen(tmp_path, recipe, without=lost)
    with pytest.raises(AegisError, match=f"'{lost}' missing"):
        start("stop-gradient", tmp_path, resume=True)
