"""Float32 masters of weights used in bfloat16: exact steps, and a run of each method."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.backbones import TEXTS, images
from samples.small_run import recipe as small
from samples.training import options_of, policy_over, robot_batch
from samples.training_runs import assert_same_run, protected_shares, stop_at
from torch import Tensor, nn

from aegis_cli.anchors import measure
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.common.ranks import ALONE, Ranks
from aegis_cli.core.anchor import Anchor as CoreAnchor
from aegis_cli.data.batch import RobotBatch
from aegis_cli.methods import METHODS
from aegis_cli.methods.base import MethodContext, Pass
from aegis_cli.methods.stepper import Stepper
from aegis_cli.models import backbones
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.policy import Policy
from aegis_cli.recipes import ANCHOR_PARTS, Anchor, Cotrain, Insulate, Recipe, Train
from aegis_cli.training import checkpoint, dry_run, step, train
from aegis_cli.training.masters import BF16_MASTER, Masters, check_masters

Made, Loaded = Callable[[str], Path], Callable[[str], Backbone]  # by a family's name
FAMILY = "smolvlm"


@pytest.fixture(scope="module")
def anchor(tmp_path_factory: pytest.TempPathFactory, hf_folder: Made) -> Path:
    """An anchor with every part."""
    path = tmp_path_factory.mktemp("anchor") / "anchor.safetensors"
    settings = Anchor(samples=14, batch_size=14, energy=1.0, parts=ANCHOR_PARTS, fisher_samples=4)
    measure.run(str(hf_folder(FAMILY)), settings, path)
    return path


def recipe(folder: Path, **changes: Any) -> Recipe:
    """A short training in bfloat16 with masters."""
    settings = small(folder, **({"weights": BF16_MASTER, "precision": "bf16"} | changes))
    return dataclasses.replace(
        settings,
        cotrain=Cotrain(questions=8, batch_size=2),
        insulate=Insulate(questions=8, batch_size=2),
    )


def states(run: Path) -> Iterator[artifacts.Artifact]:
    """The training states of a run's checkpoints."""
    for folder in checkpoint.whole(run):
        yield artifacts.load(folder / checkpoint.STATE, "training-state")


# --- what a pass sees, and what a step moves ------------------------------------------------------


def two_weights() -> list[nn.Parameter]:
    generator = torch.Generator().manual_seed(0)
    return [nn.Parameter(torch.randn(4, 3, generator=generator)) for _ in range(2)]


def test_a_pass_sees_rounded_weights_and_the_masters_stay() -> None:
    weights = two_weights()
    before, masters = [p.detach().clone() for p in weights], Masters(weights)
    with masters.rounded():
        for parameter, wide in zip(weights, before, strict=True):
            assert torch.equal(parameter, wide.bfloat16())
    for parameter, wide in zip(weights, before, strict=True):
        assert parameter.dtype == torch.float32 and torch.equal(parameter, wide)


def test_gradients_of_several_passes_are_added_up_in_float32() -> None:
    """A gradient 1,000 times smaller than the first would be lost in bfloat16."""
    weight, idle = two_weights()
    masters = Masters([weight, idle])
    for scale in (1.0, 0.001):
        with masters.rounded():
            (scale * weight).sum().backward()
            assert weight.grad is not None and weight.grad.dtype == torch.bfloat16
    assert weight.grad is not None and weight.grad.dtype == torch.float32 and idle.grad is None
    wanted = 1.0 + torch.tensor(0.001).bfloat16().float()
    assert torch.equal(weight.grad, torch.full((4, 3), wanted.item()))


def test_the_masters_are_back_after_an_error() -> None:
    weights = two_weights()
    before = [p.detach().clone() for p in weights]
    with pytest.raises(ValueError, match="stop"), Masters(weights).rounded():
        raise ValueError("stop")
    assert all(torch.equal(p, wide) for p, wide in zip(weights, before, strict=True))


def test_steps_smaller_than_half_a_neighbours_distance_move_the_weights() -> None:
    """Near 1 the next bfloat16 is 2^-8 below: a hundred steps of 1e-4 are lost, or sum to 0.01."""

    def moved(weight: nn.Parameter, masters: Masters) -> float:
        optimizer = torch.optim.AdamW([weight], lr=1e-4, weight_decay=0.0)
        for _ in range(100):
            optimizer.zero_grad()
            with masters.rounded():
                weight.sum().backward()
            optimizer.step()
        with masters.rounded():
            return float(1 - weight.detach().float().mean())

    narrow, wide = nn.Parameter(torch.ones(8).bfloat16()), nn.Parameter(torch.ones(8))
    assert moved(narrow, Masters()) == 0
    assert moved(wide, Masters([wide])) == pytest.approx(0.01, abs=2**-9)


def test_what_does_not_learn_is_rounded_for_good() -> None:
    learns, frozen = two_weights()
    masters = Masters.of([learns, frozen.requires_grad_(False)])
    assert learns.dtype == torch.float32 and frozen.dtype == torch.bfloat16
    assert masters.rounded_bytes == 2 * learns.numel()


def test_a_copy_that_teaches_is_rounded_like_its_student(hf_backbone: Loaded) -> None:
    """The distance to it starts at 0; otherwise it would start at the rounding error."""
    backbone, method = hf_backbone(FAMILY), METHODS["distill"]
    own = list(backbone.parameters())
    method.adapt(backbone, backbone.language_maps(), options_of(method))
    masters = Masters.of(own)
    groups = backbone.parameter_groups()
    parts = method.start(MethodContext(backbone, groups, {}, options_of(method)))
    assert parts.auxiliary is not None
    with masters.rounded():
        inputs = backbone.prepare(images(2), TEXTS[:2])
        seen = backbone.encode(inputs)
        found = parts.auxiliary(Pass(0, inputs, seen.hidden, seen.mask, seen.image))
    assert found.item() == 0


# --- runs -----------------------------------------------------------------------------------------


# Methods that keep weights beside the masters, constrain the masters, or train others.
RESUMED = ("naive", "distill", "ewc", "kfac", "lora", "nullspace")


@pytest.mark.parametrize("method", sorted(METHODS))
def test_every_method_trains_and_a_resumed_run_ends_in_the_same_bytes(
    method: str, hf_folder: Made, anchor: Path, demos_file: Path, tmp_path: Path
) -> None:
    """For float32 weights, resuming is tested for each method in `test_train_resume`."""
    settings, given = recipe(hf_folder(FAMILY)), (method, demos_file, anchor)
    train.run(settings, *given, tmp_path / "run")
    if method in RESUMED:
        cut = tmp_path / "cut"
        with pytest.raises(KeyboardInterrupt):
            train.run(settings, *given, cut, on_event=stop_at(3, KeyboardInterrupt()))
        train.run(settings, *given, cut, resume=True)
        assert_same_run(tmp_path / "run", cut)
    # Trainable weights are float32 in the training state, and move.
    first, *_, last = states(tmp_path / "run")
    moved = {n for n, t in first.tensors.items() if not torch.equal(t, last.tensors[n])}
    weights = {n for n in moved if n.startswith("weight.backbone.")}
    assert bool(weights) is (method != "stop-gradient")
    assert {last.tensors[n].dtype for n in weights} <= {torch.float32}


def test_what_nullspace_applies_to_the_masters_is_orthogonal_to_the_protected_span(
    hf_folder: Made, anchor: Path, demos_file: Path, tmp_path: Path
) -> None:
    settings = recipe(hf_folder(FAMILY))
    exact = dataclasses.replace(settings.nullspace, energy=1.0, every=1)
    settings = dataclasses.replace(settings, nullspace=exact)
    train.run(settings, "nullspace", demos_file, anchor, tmp_path / "run")
    assert max(protected_shares(tmp_path / "run", anchor, 1.0)) < 1e-5


def by_hand(policy: Policy, batch: RobotBatch, steps: int) -> dict[str, Tensor]:
    """AdamW on float32 copies of the weights, of which the passes read the rounded values."""
    learning = {name: p for name, p in policy.named_parameters() if p.requires_grad}
    wide = {name: p.detach().clone() for name, p in learning.items()}
    optimizer = torch.optim.AdamW(wide.values(), lr=1e-3, fused=True)
    policy.backbone.round_weights(torch.bfloat16)
    for index in range(steps):
        with torch.no_grad():
            for name, parameter in learning.items():
                parameter.copy_(wide[name])
        policy.zero_grad()
        noise = torch.Generator().manual_seed(index)
        policy.flow_loss(
            batch, policy.encode(batch.images, batch.instructions), 2, noise
        ).backward()
        for name, parameter in learning.items():
            wide[name].grad = None if parameter.grad is None else parameter.grad.float()
        optimizer.step()
    return wide


def test_kfac_without_a_penalty_is_adamw_on_the_masters_bit_for_bit(hf_backbone: Loaded) -> None:
    backbone, method = hf_backbone(FAMILY), METHODS["kfac"]
    own, options = list(backbone.parameters()), options_of(method, weight=0.0, balance=0.0)
    method.adapt(backbone, backbone.language_maps(), options)
    policy, batch = policy_over(backbone), robot_batch(3)
    wanted = by_hand(copy.deepcopy(policy), batch, steps=3)

    masters = Masters.of(own)
    context = MethodContext(backbone, backbone.parameter_groups(), {}, options, CoreAnchor())
    parts = method.start(context)
    learning = {name: p for name, p in policy.named_parameters() if p.requires_grad}
    optimizer = torch.optim.AdamW(learning.values(), lr=1e-3, fused=True)
    stepper = Stepper(backbone, parts)
    for index in range(3):
        optimizer.zero_grad()
        step.compute_gradients(
            policy,
            method,
            parts,
            batch,
            torch.Generator().manual_seed(index),
            index=index,
            flow_samples=2,
            precision="float32",
            masters=masters,
        )
        stepper.step(index + 1, optimizer.step, {})
    assert wanted.keys() == learning.keys()
    assert all(torch.equal(p, wanted[name]) for name, p in learning.items())


def test_a_checkpoint_has_the_masters_and_resuming_refuses_rounded_ones(
    hf_folder: Made, demos_file: Path, tmp_path: Path
) -> None:
    settings, run = recipe(hf_folder(FAMILY), steps=2), tmp_path / "run"
    train.run(settings, "naive", demos_file, None, run)
    saved = backbones.load(str(run))
    (state,) = states(run)
    for name, parameter in saved.named_parameters():
        assert torch.equal(parameter, state.tensors[f"weight.backbone.{name}"])
    assert not all(torch.equal(p, p.bfloat16().float()) for p in saved.parameters())

    path = checkpoint.last(run) / checkpoint.STATE
    name = next(n for n in state.tensors if n.startswith("weight.backbone."))
    spoiled = {**state.tensors, name: state.tensors[name].bfloat16()}
    header = state.header
    artifacts.save(
        path, "training-state", spoiled, seed=header.seed, inputs=header.inputs, meta=header.meta
    )
    with pytest.raises(AegisError, match=f"'{name}' is bfloat16"):
        train.run(settings, "naive", demos_file, None, run, resume=True)


def test_low_rank_terms_are_merged_into_wide_weights(
    hf_folder: Made, demos_file: Path, tmp_path: Path
) -> None:
    """What they add is not rounded, although the weights to which it is added have been."""
    train.run(recipe(hf_folder(FAMILY), steps=2), "lora", demos_file, None, tmp_path / "run")
    merged = backbones.load(str(tmp_path / "run")).language_maps()
    before = backbones.load(str(hf_folder(FAMILY))).language_maps()
    (state,) = states(tmp_path / "run")
    wide = set()
    for name, linear in merged.items():
        base = before[name].weight.bfloat16()  # frozen, and so rounded for good
        low, high = (state.tensors[f"weight.backbone.{name}.{part}"] for part in ("a", "b"))
        torch.testing.assert_close(linear.weight, base.float() + 2 * high @ low)  # alpha / rank
        if not torch.equal(linear.weight, linear.weight.bfloat16().float()):
            wide.add(name)
        assert (name in wide) is bool(high.any())  # some get no gradient
    assert wide


def test_a_dry_run_counts_masters_rounded_weights_and_narrow_gradients(
    hf_folder: Made, demos_file: Path, tmp_path: Path
) -> None:
    folder, out = hf_folder(FAMILY), tmp_path / "out"
    count = sum(p.numel() for p in backbones.load(str(folder)).parameters())
    masters, float32 = (
        dry_run.run(recipe(folder, weights=weights), "naive", demos_file, None, out).memory_mb
        for weights in (BF16_MASTER, "float32")
    )
    assert masters["weights"] == pytest.approx(float32["weights"] + 2e-6 * count)
    assert masters["gradients"] == pytest.approx(float32["gradients"] - 2e-6 * count)
    assert masters["optimizer"] == float32["optimizer"]
    assert masters["activations"] < float32["activations"]


# --- refused --------------------------------------------------------------------------------------


def test_the_embedded_backbone_has_no_rounded_weights(
    tiny_folder: Path, demos_file: Path, tmp_path: Path
) -> None:
    settings = small(tiny_folder, weights=BF16_MASTER)
    with pytest.raises(AegisError, match="bf16-master with the embedded backbone"):
        train.run(settings, "naive", demos_file, None, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_sharded_weights_have_no_masters() -> None:
    sharded = Train(weights=BF16_MASTER, parallel="fsdp")
    with pytest.raises(AegisError, match="fsdp with train.weights: bf16-master"):
        check_masters(sharded, Ranks(0, 2))
    check_masters(sharded, ALONE)
    check_masters(Train(weights=BF16_MASTER), Ranks(0, 2))
