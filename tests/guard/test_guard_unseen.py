"""A guard refuses by name, before a step, what it cannot see: it never holds nothing unsaid."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.guard import (
    LAYERS,
    Block,
    Vlm,
    anchors_by_method,
    batch,
    make,
    measured,
    task_loss,
    vector,
)
from samples.ranks import WORLD, shard_under_a_guard
from torch import Tensor, multiprocessing, nn

from aegis_cli import Guard
from aegis_cli.common.errors import AegisError

MASK = batch(0)[2]
METHODS: dict[str, dict[str, Any]] = {
    "aegis": {"layers": LAYERS},
    "nullspace": {"vision": "vision", "energy": 1.0},
    "kfac": {"protect": ("maps",)},
}
every_method = pytest.mark.parametrize("method", METHODS)


@pytest.fixture(scope="module")
def anchors(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The anchor that each method reads."""
    return anchors_by_method(tmp_path_factory.mktemp("anchors"))


def guarded(method: str, anchors: dict[str, Path], model: nn.Module | None = None) -> Any:
    model = make() if model is None else model
    return model, Guard(model, anchors[method], method=method, **METHODS[method])


def watched(guard: Guard, model: nn.Module, seed: int = 0) -> Tensor:
    with guard.watch(MASK):
        return task_loss(model, seed)


def refused(call: Callable[[], object], *words: str) -> None:
    with pytest.raises(AegisError) as caught:
        call()
    assert not [word for word in words if word not in str(caught.value)], caught.value


# --- parameters -----------------------------------------------------------------------------------


def test_sharded_weights_before_and_after_the_guard(
    anchors: dict[str, Path], tmp_path: Path
) -> None:
    """FSDP2 puts others in the place of the parameters; a guard would see no gradient of theirs."""
    multiprocessing.spawn(shard_under_a_guard, args=(str(tmp_path), anchors), nprocs=WORLD)


def replace(model: Vlm) -> None:
    model.text.norm.weight = nn.Parameter(model.text.norm.weight.detach().clone())


def add(model: Vlm) -> None:
    model.text.layers[1].adapter = nn.Linear(2, 2).double()


def flatten(model: Vlm) -> None:
    model.text.norm.weight.data = model.text.norm.weight.data[:3]


@every_method
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (replace, ("text.norm.weight", "put into the model later")),
        (add, ("text.layers.1.adapter.weight", "put into the model later")),
        (flatten, ("text.norm.weight", "another shape")),
    ],
)
def test_parameters_that_are_not_those_of_the_start(
    method: str, change: Callable[[Vlm], None], words: tuple[str, ...], anchors: dict[str, Path]
) -> None:
    model, guard = guarded(method, anchors)
    change(model)
    refused(lambda: watched(guard, model), *words)
    refused(lambda: guard.backward(torch.ones(1, requires_grad=True).sum()), *words)


@every_method
def test_freezing_a_part_later_is_no_other_parameter(method: str, anchors: dict[str, Path]) -> None:
    model, guard = guarded(method, anchors)
    model.text.layers[0].requires_grad_(False)
    guard.backward(watched(guard, model))


# --- passes ---------------------------------------------------------------------------------------


@every_method
def test_a_loss_that_the_model_has_no_part_in(method: str, anchors: dict[str, Path]) -> None:
    model, guard = guarded(method, anchors)
    watched(guard, model)
    elsewhere = torch.ones(3, requires_grad=True, dtype=torch.float64)
    refused(lambda: guard.backward(elsewhere.sum()), "no gradient in any parameter")


class Cut(Block):
    """A layer whose result is cut from its graph, and learns as a leaf of its own."""

    cut = False

    def forward(self, x: Tensor, hidden: Tensor) -> Tensor:
        out = super().forward(x, hidden)
        return out.detach().requires_grad_() if Cut.cut else out


def test_an_anchor_gradient_of_zero_in_every_group(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its ledger would be rows of zeros, and its training the naive one."""
    model = make(Cut)
    path = measured(model, tmp_path / "anchor.safetensors", parts=("moments",))
    guard = Guard(model, path, LAYERS)
    monkeypatch.setattr(Cut, "cut", True)
    loss = watched(guard, model)
    refused(lambda: guard.backward(loss), "anchor gradient of zero", "layers.0")
    assert len(guard.ledger) == 0


# --- steps ----------------------------------------------------------------------------------------


@every_method
def test_a_step_after_a_plain_backward_pass(method: str, anchors: dict[str, Path]) -> None:
    """As a trainer takes it that knows nothing of the guard beside it."""
    model, guard = guarded(method, anchors)
    optimizer, before = torch.optim.SGD(model.parameters(), lr=0.1), vector(model)
    task_loss(model, 0).backward()
    refused(optimizer.step, "guard")
    refused(lambda: guard.step(optimizer), "without a guard.backward", "loss.backward()")
    assert torch.equal(vector(model), before)
    optimizer.zero_grad()
    guard.backward(watched(guard, model))
    guard.step(optimizer)
    after = vector(model)
    assert not torch.equal(after, before)
    optimizer.zero_grad()
    task_loss(model, 1).backward()
    refused(lambda: guard.step(optimizer), "without a guard.backward")
    assert torch.equal(vector(model), after)
    guard.remove()
    optimizer.step()


def test_two_optimizers_may_follow_one_guarded_pass(anchors: dict[str, Path]) -> None:
    model, guard = guarded("aegis", anchors)
    parts = [*model.vision.parameters()], [*model.text.parameters()]
    optimizers = [torch.optim.SGD(part, lr=0.1) for part in parts]
    guard.backward(watched(guard, model))
    for optimizer in optimizers:
        optimizer.step()
        refused(optimizer.step, "without a guard.backward since the last one")


def test_a_step_on_zeros_is_no_training(anchors: dict[str, Path]) -> None:
    """Checkpointing libraries take one, so that the optimizer's state is there to be filled."""
    model, _guard = guarded("aegis", anchors)
    for parameter in model.parameters():
        parameter.grad = torch.zeros_like(parameter)
    torch.optim.AdamW(model.parameters(), lr=0.0).step()


def test_an_optimizer_that_calls_the_passes_itself(anchors: dict[str, Path]) -> None:
    model, guard = guarded("aegis", anchors)
    optimizer, before = torch.optim.LBFGS(model.parameters(), max_iter=1), vector(model)

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = watched(guard, model)
        guard.backward(loss)
        return loss

    optimizer.step(closure)
    assert not torch.equal(vector(model), before)


def test_a_guard_that_is_gone_refuses_nothing(anchors: dict[str, Path]) -> None:
    model, guard = guarded("aegis", anchors)
    del guard
    task_loss(model, 0).backward()
    torch.optim.SGD(model.parameters(), lr=0.1).step()
