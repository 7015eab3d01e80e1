"""Measurements of a policy on robot frames, and how a merge handles parameters outside maps."""

from __future__ import annotations

import copy
from pathlib import Path

import pytest
import torch
from samples.tiny import make_tiny
from samples.training_runs import small_policy

from aegis_cli.core.pairs import Pair
from aegis_cli.data import demonstrations
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.merging import task_factors
from aegis_cli.merging.displacement import Displacement
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.policy import Policy

FRAMES = 50


@pytest.fixture
def demos(demos_file: Path) -> Demonstrations:
    return demonstrations.load(demos_file, 0.2, 0)


@pytest.fixture
def policy(demos: Demonstrations) -> Policy:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return small_policy(make_tiny(), demos).eval()


def half(_: str, moved: Pair, strength: float) -> Pair:
    weight, bias = moved
    return weight / 2, None if bias is None else bias / 2


def moved_from(base: Backbone) -> Backbone:
    """A copy in which every parameter has changed."""
    tuned = copy.deepcopy(base)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in tuned.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))
    return tuned


# --- robot frames ---------------------------------------------------------------------------------


def test_passes_are_of_one_instruction_and_of_training_frames_alone(demos: Demonstrations) -> None:
    passes = list(task_factors._passes(demos, FRAMES, "x", lambda _: None))
    rows = torch.cat(passes)
    assert len(rows) == FRAMES == len(rows.unique())
    assert set(rows.tolist()) <= set(demos.train.tolist())
    assert all(len(demos.instruction_of[part].unique()) == 1 for part in passes)
    assert all(len(part) <= task_factors.FRAMES for part in passes)


def test_inputs_are_the_mean_second_moment_of_what_a_map_reads(
    policy: Policy, demos: Demonstrations
) -> None:
    spectra = task_factors.inputs(policy, demos, FRAMES)
    assert spectra.keys() == set(task_factors.dense_sites(policy.backbone))
    rows: list[torch.Tensor] = []
    layer = policy.backbone.get_submodule("layers.0.up")
    hook = layer.register_forward_pre_hook(lambda _, given: rows.append(given[0].flatten(0, -2)))
    with torch.no_grad():
        for frames in task_factors._passes(demos, FRAMES, "x", lambda _: None):
            batch = demos.batch(frames, 4)
            encoding = policy.encode(batch.images, batch.instructions)
            assert encoding.mask.all()  # nothing is padded
    hook.remove()
    x = torch.cat(rows).double()
    x = torch.cat([x, torch.ones(len(x), 1, dtype=torch.float64)], 1)
    values = torch.linalg.eigvalsh(x.T @ x / len(x)).flip(0)
    torch.testing.assert_close(spectra["layers.0.up"].values, values, rtol=1e-5, atol=1e-6)


def test_curvature_leaves_out_what_the_task_does_not_depend_on(
    policy: Policy, demos: Demonstrations
) -> None:
    """The expert reads keys and values, so nothing after those of the last layer counts."""
    found = task_factors.curvature(policy, demos, FRAMES, flow_samples=2)
    last = f"layers.{policy.backbone.depth - 1}"
    unused = {f"{last}.{part}" for part in ("out", "up", "down")}
    measured = {name.rpartition(".")[0] for name in found}
    assert measured == set(task_factors.dense_sites(policy.backbone)) - unused
    assert all(float(spectrum.values.sum()) > 0 for spectrum in found.values())


def test_curvature_does_not_depend_on_the_gradients_state(
    policy: Policy, demos: Demonstrations
) -> None:
    first = task_factors.curvature(policy, demos, 20, flow_samples=2)
    again = task_factors.curvature(policy, demos, 20, flow_samples=2)
    assert all(torch.equal(first[name].values, again[name].values) for name in first)
    assert all(parameter.grad is None for parameter in policy.backbone.parameters())


# --- weights --------------------------------------------------------------------------------------


def test_what_is_no_map_keeps_the_maps_mean_share() -> None:
    base = make_tiny()
    tuned = moved_from(base)
    origin, before = (dict(model.named_parameters()) for model in (base, copy.deepcopy(tuned)))
    share = Displacement(tuned, base, half).keep(1.0)
    assert share == pytest.approx(0.5, abs=1e-6)
    for name, now in tuned.named_parameters():
        wanted = (origin[name] + before[name]) / 2
        torch.testing.assert_close(now, wanted, rtol=0, atol=1e-6, msg=name)


def test_every_strength_begins_at_the_fine_tuned_weights() -> None:
    base = make_tiny()
    tuned = moved_from(base)
    before = copy.deepcopy(tuned.state_dict())
    displacement = Displacement(tuned, base, half)
    displacement.keep(1.0)
    once = copy.deepcopy(tuned.state_dict())
    displacement.keep(1.0)
    assert all(torch.equal(once[name], now) for name, now in tuned.state_dict().items())
    assert displacement.keep(0) == 1
    assert all(torch.equal(before[name], now) for name, now in tuned.state_dict().items())
