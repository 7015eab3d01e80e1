"""A guard on a model with adapters, and on wrapped models: plain names everywhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.guard import (
    LAYERS,
    Vlm,
    anchors_by_method,
    batch,
    compiling,
    guarded_steps,
    make,
    measured,
    task_loss,
    vector,
)
from torch import Tensor, nn
from torch import distributed as dist
from torch.distributed.algorithms._checkpoint.checkpoint_wrapper import checkpoint_wrapper
from torch.nn.parallel import DistributedDataParallel

from aegis_cli import Guard
from aegis_cli.common.errors import AegisError
from aegis_cli.models import structure
from aegis_cli.models.wrappers import plain_names

TARGETS = ["qkv", "out", "up", "down"]


@pytest.fixture(scope="module")
def anchors(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The anchor that each method reads, measured on the model alone."""
    return anchors_by_method(tmp_path_factory.mktemp("anchors"))


def with_lora(model: nn.Module, targets: list[str] = TARGETS, **settings: Any) -> nn.Module:
    """PEFT's LoRA around a model, in the model's dtype."""
    peft = pytest.importorskip("peft")
    config = peft.LoraConfig(r=2, lora_alpha=4, target_modules=targets, **settings)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return peft.get_peft_model(model, config).double()


def adapters(model: nn.Module) -> Tensor:
    return torch.cat([p.detach().flatten() for p in model.parameters() if p.requires_grad])


# --- PEFT -----------------------------------------------------------------------------------------


def test_a_lora_put_on_before_the_guard_learns_under_it(anchors: dict[str, Path]) -> None:
    """The anchor is the model's own: a fresh LoRA does not change what was measured."""
    model = with_lora(make())
    frozen, before = vector(make()), adapters(model)
    guard = Guard(model, anchors["aegis"], LAYERS)
    assert guard.ledger.groups[:2] == ("layers.0", "layers.1")
    assert not [name for name in guard.ledger.groups if "base_model" in name]
    guarded_steps(model, guard)
    rows = guard.ledger.tensors()
    assert (rows["ta"][:, :2] < 0).any() and (rows["aa"][:, :2].sum(1) > 0).all()
    assert not torch.equal(adapters(model), before)
    guard.remove()
    assert torch.equal(vector(model.unload()), frozen)


def test_a_lora_with_the_guard_is_what_it_is_without_its_wrapper(anchors: dict[str, Path]) -> None:
    """PEFT changes the model in place, so the guard accepts either."""
    found = []
    for inside in (False, True):
        wrapped = with_lora(make())
        given = wrapped.get_base_model() if inside else wrapped
        guard = Guard(given, anchors["aegis"], LAYERS)
        guarded_steps(wrapped, guard)
        found.append((adapters(wrapped), guard.ledger.tensors()))
    (one, rows), (other, others) = found
    assert torch.equal(one, other)
    assert all(torch.equal(rows[name], others[name]) for name in rows)


@pytest.mark.parametrize("method", ["aegis", "nullspace", "kfac"])
def test_a_lora_put_on_after_the_guard_is_refused(method: str, anchors: dict[str, Path]) -> None:
    options: dict[str, dict[str, Any]] = {
        "aegis": {"layers": LAYERS},
        "nullspace": {"vision": "vision"},
        "kfac": {"protect": "maps"},
    }
    model = make()
    guard = Guard(model, anchors[method], method=method, **options[method])
    wrapped = with_lora(model)
    with pytest.raises(AegisError, match="lora_A.*added to the model later") as caught:
        guarded_steps(wrapped, guard, steps=1)
    assert "get_peft_model" in caught.value.fix


def test_a_model_that_is_frozen_after_the_guard_is_refused(anchors: dict[str, Path]) -> None:
    """Something below it, such as an adapter outside, may still give its hidden states a graph."""
    model = make()
    guard = Guard(model, anchors["aegis"], LAYERS)
    model.requires_grad_(False)
    pixels, ids, mask = batch(0)
    with guard.watch(mask):
        loss = model(pixels.requires_grad_(), ids, mask).square().mean()
    with pytest.raises(AegisError, match="nothing learns any more"):
        guard.backward(loss)


def test_a_lora_that_has_learned_is_no_longer_what_was_measured(
    anchors: dict[str, Path],
) -> None:
    model = with_lora(make())
    nn.init.ones_(model.get_submodule("base_model.model.text.layers.0.up.lora_B.default").weight)
    with pytest.raises(AegisError, match="weights and adapters are not those") as caught:
        Guard(model, anchors["aegis"], LAYERS)
    assert "before trained adapters are loaded" in caught.value.fix


def test_a_module_that_is_saved_with_the_adapters(anchors: dict[str, Path]) -> None:
    """PEFT trains a copy of it; an equal copy makes no difference."""
    model = with_lora(make(), modules_to_save=["norm"])
    guarded_steps(model, Guard(model, anchors["aegis"], LAYERS), steps=1)
    with pytest.raises(AegisError, match="weights and adapters"):
        Guard(model, anchors["aegis"], LAYERS)


def test_nullspace_protects_adapters_that_were_measured(
    anchors: dict[str, Path], tmp_path: Path
) -> None:
    """An adapter is two maps of its own, and the second one's inputs depend on the first."""
    options: dict[str, Any] = {"method": "nullspace", "vision": "vision", "energy": 1.0}
    with pytest.raises(AegisError, match="measured without these adapters.*lora_A"):
        Guard(with_lora(make()), anchors["nullspace"], **options)
    path = measured(with_lora(make()).eval(), tmp_path / "anchor.safetensors")
    other = with_lora(make())
    nn.init.ones_(other.get_submodule("base_model.model.text.layers.0.up.lora_A.default").weight)
    with pytest.raises(AegisError, match="measured with adapters of other values") as caught:
        Guard(other, path, **options)
    assert "save_pretrained" in caught.value.fix
    model = with_lora(make())
    before = adapters(model)
    guard = Guard(model, path, **options)
    guarded_steps(model, guard, steps=1)
    assert not torch.equal(adapters(model), before)


def test_adapters_that_were_saved_are_those_that_were_measured(tmp_path: Path) -> None:
    """So one process may measure and another one train."""
    peft = pytest.importorskip("peft")
    model = with_lora(make()).eval()
    model.save_pretrained(tmp_path / "adapters")
    path = measured(model, tmp_path / "anchor.safetensors")
    other = peft.PeftModel.from_pretrained(make(), tmp_path / "adapters", is_trainable=True)
    Guard(other, path, method="nullspace", vision="vision", energy=1.0)


# --- other wrappers -------------------------------------------------------------------------------


@pytest.fixture
def group(tmp_path: Path) -> Iterator[None]:
    """A process group with only this process."""
    dist.init_process_group("gloo", f"file://{tmp_path}/store", rank=0, world_size=1)
    yield
    dist.destroy_process_group()


def compiled(model: Vlm) -> nn.Module:
    return torch.compile(model, backend="eager")  # type: ignore[return-value]


def compiled_parts(model: Vlm) -> nn.Module:
    model.text = torch.compile(model.text, backend="eager")  # type: ignore[assignment]
    model.text.layers[0] = torch.compile(model.text.layers[0], backend="eager")
    return model


def checkpointed(model: Vlm) -> nn.Module:
    for i, layer in enumerate(model.text.layers):
        model.text.layers[i] = checkpoint_wrapper(layer)
    return model


class Policy(nn.Module):
    """A model that calls part of itself like some wrappers call theirs."""

    def __init__(self, vlm: nn.Module) -> None:
        super().__init__()
        self.module = nn.Module()
        self.module.base_model = vlm


WRAPPED: dict[str, Callable[[Vlm], nn.Module]] = {
    "DistributedDataParallel": DistributedDataParallel,
    "peft": with_lora,
    "both": lambda model: DistributedDataParallel(with_lora(model)),
    "compile": compiled,
    "compiled parts": compiled_parts,
    "checkpoint": checkpointed,
}


@compiling
@pytest.mark.usefixtures("group")
@pytest.mark.parametrize("how", WRAPPED)
def test_layers_groups_and_weights_have_their_plain_names(
    how: str, anchors: dict[str, Path]
) -> None:
    model = WRAPPED[how](make())
    plain = plain_names(model)
    found = structure.find_layers(model, LAYERS)
    assert [plain(name) for name in found] == ["text.layers.0", "text.layers.1"]
    assert structure.find_layers(model, None).keys() == found.keys()
    if how in ("DistributedDataParallel", "compile"):
        full = next(iter(found)).removesuffix(".0")
        assert full != LAYERS and structure.find_layers(model, full) == found
    assert structure.fingerprint(model) == structure.fingerprint(make())
    assert "stem" in structure.find_maps(model, ("vision",)).kinds.values()
    guard = Guard(model, anchors["aegis"], LAYERS)
    alone = Guard(make(), anchors["aegis"], LAYERS)
    assert tuple(structure.parameter_groups(model, found)) == alone.ledger.groups
    if how == "peft" or how == "both":  # only the adapters learn
        assert guard.ledger.groups == ("layers.0", "layers.1")
    else:
        assert guard.ledger.groups == alone.ledger.groups
        Guard(model, anchors["nullspace"], method="nullspace", vision="vision", energy=1.0)


@pytest.mark.usefixtures("group")
def test_a_guard_given_the_wrapper_does_what_it_does_with_the_model(
    anchors: dict[str, Path],
) -> None:
    found = []
    for wrap in (lambda model: model, DistributedDataParallel):
        model = wrap(make())
        guard = Guard(model, anchors["aegis"], LAYERS, process_group=dist.group.WORLD)
        guarded_steps(model, guard)
        found.append(vector(model))
    assert torch.equal(*found)


def test_a_part_that_is_called_as_wrappers_call_theirs_keeps_its_name() -> None:
    policy = Policy(make())
    plain = plain_names(policy)
    assert plain("module.base_model.text.layers.0.up.weight") == (
        "module.base_model.text.layers.0.up.weight"
    )
    with pytest.raises(AegisError, match="no module 'text.layers'"):
        structure.find_layers(policy, LAYERS)


def test_plain_batches_still_train_what_is_checkpointed(anchors: dict[str, Path]) -> None:
    """The wrapper's own checkpointing is not reentrant, so the second pass is possible."""
    found = []
    for wrap in (lambda model: model, checkpointed):
        model = wrap(make())
        guard = Guard(model, anchors["aegis"], LAYERS)
        with guard.watch(batch(0)[2]):
            loss = task_loss(model, 0)
        guard.backward(loss)
        found.append(torch.cat([p.grad.flatten() for p in model.parameters()]))
    torch.testing.assert_close(*found)
