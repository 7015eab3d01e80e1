"""One suite that every registered method must pass."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace

import pytest
import torch
from samples.tiny import make_tiny
from samples.training import (
    LORA,
    adapt,
    double_batch,
    double_policy,
    gradients,
    make_anchor,
    make_policy,
    robot_batch,
    same_bits,
    snapshot,
    start,
)

from aegis_cli import recipes
from aegis_cli.common.errors import AegisError
from aegis_cli.methods import METHODS, get
from aegis_cli.methods.base import Method, train_all
from aegis_cli.models.backbones.base import Encoding
from aegis_cli.models.backbones.embedded import EmbeddedVLM
from aegis_cli.models.policy import Policy
from aegis_cli.training import checkpoint

EVERYTHING = {name for name, _ in make_tiny().named_parameters()}
DENSE = {
    n
    for n, module in make_tiny().named_modules()
    if isinstance(module, torch.nn.Linear | torch.nn.Conv2d)
}
# The parameters of the adapted backbone that each method trains; a new method adds its line.
TRAINABLE = {
    "naive": EVERYTHING,
    "stop-gradient": set(),
    "lora": {f"{name}.{part}" for name in make_tiny().language_maps() for part in "ab"},
    **dict.fromkeys(
        ("aegis", "nullspace", "l2sp", "maps", "ewc", "distill", "insulate", "cotrain"), EVERYTHING
    ),
    "kfac": {name for name in EVERYTHING if name.rpartition(".")[0] in DENSE},
}


@pytest.fixture(params=sorted(METHODS))
def method(request: pytest.FixtureRequest) -> Method:
    return METHODS[request.param]


def learning(policy: Policy) -> dict[str, torch.nn.Parameter]:
    return {name: p for name, p in policy.backbone.named_parameters() if p.requires_grad}


def train(
    policy: Policy,
    method: Method,
    steps: int,
    *,
    expert_lr: float = 3e-3,
    backbone_lr: float = 3e-3,
) -> list[float]:
    """Losses of `steps` updates on one batch with the same noise."""
    groups = [
        {"params": list(learning(policy).values()), "lr": backbone_lr},
        {"params": list(policy.expert.parameters()), "lr": expert_lr},
    ]
    optimizer = torch.optim.AdamW([group for group in groups if group["params"]], weight_decay=0.0)
    losses = []
    for _ in range(steps):
        losses.append(gradients(policy, method).loss.item())
        optimizer.step()
    return losses


def randomize(policy: Policy, seed: int = 7) -> None:
    """Move every trainable parameter of the backbone, LoRA's zero B included."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in learning(policy).values():
            parameter += 0.1 * torch.randn(
                parameter.shape, generator=generator, dtype=parameter.dtype
            )


def tensors_of(encoding: Encoding) -> list[torch.Tensor]:
    return [*encoding.hidden, *(t for pair in encoding.keys_values for t in pair)]


# --- the registry ---------------------------------------------------------------------------------


def test_the_registry_holds_what_recipes_offer() -> None:
    assert len(METHODS) >= 4
    assert tuple(METHODS) == recipes.METHODS
    assert all(name == method.name and method.summary for name, method in METHODS.items())
    assert TRAINABLE.keys() == METHODS.keys()


def test_an_unknown_method_is_refused_with_the_known_ones() -> None:
    with pytest.raises(AegisError) as caught:
        get("aegiss")
    assert "aegiss" in caught.value.found
    assert all(name in caught.value.expected for name in METHODS)


# --- adapting -------------------------------------------------------------------------------------


def test_adapting_changes_no_output(method: Method) -> None:
    policy, batch = double_policy(), double_batch()
    before = tensors_of(policy.backbone.encode(batch))
    adapt(method, policy)
    after = tensors_of(policy.backbone.encode(batch))
    assert all(torch.equal(x, y) for x, y in zip(before, after, strict=True))


def test_what_is_trainable_is_what_is_declared(method: Method) -> None:
    assert set(learning(adapt(method, make_policy()))) == TRAINABLE[method.name]


def test_every_parameter_is_in_exactly_one_group(method: Method) -> None:
    backbone = adapt(method, make_policy()).backbone
    grouped = [id(p) for group in backbone.parameter_groups().values() for p in group]
    assert len(grouped) == len(set(grouped))
    assert set(grouped) == {id(p) for p in backbone.parameters()}


def test_only_what_is_trainable_gets_gradients(method: Method) -> None:
    policy = adapt(method, double_policy())
    gradients(policy, method)
    frozen = {name: p.grad for name, p in policy.backbone.named_parameters() if not p.requires_grad}
    assert all(gradient is None for gradient in frozen.values())
    assert all(p.grad is not None and p.grad.isfinite().all() for p in policy.expert.parameters())
    # the first layer's outputs reach the second layer's keys, so all its trainable weights move
    first = {name: p.grad for name, p in learning(policy).items() if name.startswith("layers.0.")}
    assert all(gradient is not None for gradient in first.values())
    assert bool(first) == bool(TRAINABLE[method.name])
    assert not first or any(gradient.abs().sum() > 0 for gradient in first.values())


def test_stop_gradient_holds_the_gradient_back_even_from_a_backbone_that_learns() -> None:
    open_method = replace(METHODS["stop-gradient"], adapt=train_all)
    policy = adapt(open_method, make_policy())
    gradients(policy, open_method)
    assert all(p.grad is None for p in policy.backbone.parameters())


# --- training -------------------------------------------------------------------------------------


def test_the_loss_falls(method: Method) -> None:
    losses = train(adapt(method, make_policy()), method, steps=15)
    assert losses[-1] < 0.9 * losses[0]


@pytest.mark.parametrize(
    "name", [n for n in sorted(METHODS) if TRAINABLE[n] and not METHODS[n].stop_gradient]
)
def test_the_backbone_alone_lowers_the_loss(name: str) -> None:
    policy = adapt(METHODS[name], make_policy())
    expert = snapshot(policy.expert.named_parameters())
    losses = train(policy, METHODS[name], steps=15, expert_lr=0.0, backbone_lr=1e-2)
    assert all(same_bits(p.detach(), expert[n]) for n, p in policy.expert.named_parameters())
    assert losses[-1] < 0.99 * losses[0]


def test_what_is_frozen_stays_bit_for_bit(method: Method) -> None:
    policy = adapt(method, make_policy())
    before = snapshot(policy.backbone.named_parameters())
    train(policy, method, steps=3)
    frozen = before.keys() - TRAINABLE[method.name]
    moved = {
        name
        for name, p in policy.backbone.named_parameters()
        if not same_bits(p.detach(), before[name])
    }
    assert not moved & frozen
    assert bool(moved) == bool(TRAINABLE[method.name])


def test_the_anchor_is_let_go(method: Method) -> None:
    """A method keeps what it needs of it; the rest would stay in memory for the whole run."""
    anchor, policy = (
        replace(make_anchor()),
        make_policy(),
    )  # a copy: the sample is kept for other tests
    whole = weakref.ref(anchor)
    parts = start(method, policy, anchor)
    del anchor
    gc.collect()
    assert whole() is None and parts is not None


# --- exporting ------------------------------------------------------------------------------------


def export(method: Method, policy: Policy) -> EmbeddedVLM:
    return checkpoint.plain_backbone(policy.backbone, method)


def test_export_gives_a_plain_model_with_the_same_outputs(method: Method) -> None:
    policy, batch = adapt(method, double_policy()), double_batch()
    start = tensors_of(policy.backbone.encode(batch))
    randomize(policy)
    plain, original = export(method, policy), make_tiny()
    assert (plain is policy.backbone) == (method.name != "lora")  # no copy if nothing was added
    assert [(n, t.shape) for n, t in plain.state_dict().items()] == [
        (n, t.shape) for n, t in original.state_dict().items()
    ]
    assert [(n, type(m)) for n, m in plain.named_modules()] == [
        (n, type(m)) for n, m in original.named_modules()
    ]
    adapted, exported = tensors_of(policy.backbone.encode(batch)), tensors_of(plain.encode(batch))
    for x, y in zip(adapted, exported, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-10, atol=1e-10)
    moved = any(not torch.equal(x, y) for x, y in zip(start, adapted, strict=True))
    assert moved == bool(
        TRAINABLE[method.name]
    )  # otherwise the comparison above would have shown nothing


def test_export_leaves_the_adapted_model_as_it_is(method: Method) -> None:
    policy = adapt(method, make_policy())
    randomize(policy)
    before = snapshot(policy.backbone.named_parameters())
    export(method, policy)
    after = snapshot(policy.backbone.named_parameters())
    assert before.keys() == after.keys()
    assert all(same_bits(before[name], after[name]) for name in before)


def test_a_method_that_trains_nothing_exports_the_backbone_it_got() -> None:
    names = [name for name in METHODS if not TRAINABLE[name]]
    assert names
    for name in names:
        policy = adapt(METHODS[name], make_policy())
        train(policy, METHODS[name], steps=2)
        assert export(METHODS[name], policy).fingerprint() == make_tiny().fingerprint()


# --- LoRA -----------------------------------------------------------------------------------------


@pytest.fixture
def lora_changes() -> dict[str, torch.Tensor]:
    """Exported minus original weights, after a few steps in float64."""
    policy = adapt(METHODS["lora"], double_policy())
    train(policy, METHODS["lora"], steps=4)
    original = make_tiny().double().state_dict()
    return {
        name: t - original[name] for name, t in export(METHODS["lora"], policy).state_dict().items()
    }


def test_lora_changes_the_language_maps_alone(lora_changes: dict[str, torch.Tensor]) -> None:
    maps = {f"{name}.weight" for name in make_tiny().language_maps()}
    changed = {name for name, change in lora_changes.items() if change.abs().max() > 0}
    assert changed <= maps
    assert "layers.0.qkv.weight" in changed


def test_lora_changes_have_the_rank_asked_for(lora_changes: dict[str, torch.Tensor]) -> None:
    singular = torch.linalg.svdvals(lora_changes["layers.0.qkv.weight"])
    assert (singular[int(LORA["rank"]) :] < 1e-12 * singular[0]).all()
    assert singular[int(LORA["rank"]) - 1] > 1e-6 * singular[0]  # and the full rank is used


def test_lora_is_scaled_by_alpha_over_rank() -> None:
    policy = adapt(METHODS["lora"], double_policy())
    randomize(policy)
    module = policy.backbone.get_submodule("layers.1.up")
    change = (
        export(METHODS["lora"], policy).get_submodule("layers.1.up").weight - module.base.weight
    )
    torch.testing.assert_close(change, LORA["alpha"] / LORA["rank"] * module.b @ module.a)


def test_the_batch_of_these_tests_holds_padding() -> None:
    assert robot_batch().is_pad.any()
