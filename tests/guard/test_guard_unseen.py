"""A guard refuses by name, before a step, what it cannot see: it never fails silently."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from samples import processes
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
from torch import Tensor, nn

from aegis_cli import Guard
from aegis_cli.common import devices
from aegis_cli.common.errors import AegisError
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.moments import Moments
from aegis_cli.guard import process_groups
from aegis_cli.methods.aegis import _penalty
from aegis_cli.methods.base import Pass

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
    """FSDP2 replaces the parameters; a guard would never see the gradients of the new ones."""
    processes.start(shard_under_a_guard, (str(tmp_path), anchors), WORLD)


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
        (replace, ("text.norm.weight", "added to the model later")),
        (add, ("text.layers.1.adapter.weight", "added to the model later")),
        (flatten, ("text.norm.weight", "a different shape")),
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


@every_method
def test_what_learns_only_later_is_refused(method: str, anchors: dict[str, Path]) -> None:
    """Its first steps would be taken without protection."""
    model = make()
    model.vision.requires_grad_(False)
    own = {"kfac": {"protect": ("maps",)}, "nullspace": {"vision": "vision"}}
    path = anchors[method]
    guard = Guard(model, path, method=method, **{**METHODS[method], **own.get(method, {})})
    model.vision.requires_grad_(True)
    refused(lambda: watched(guard, model), "different trainable parameters")
    guard.remove()
    automatic = Guard(make(), path, method=method, **METHODS[method]).automatic(mask="mask")
    other = automatic._model
    other.text.layers[0].requires_grad_(False)
    task_loss(other, 0).backward()  # a part that is frozen later is not one


@pytest.mark.parametrize("method", ["nullspace", "kfac"])
def test_a_model_that_has_moved_since_the_guard_was_made(
    method: str, anchors: dict[str, Path]
) -> None:
    """The directions from which its updates are kept away are on the other device."""
    model, guard = guarded(method, anchors)
    optimizer = torch.optim.SGD(model.parameters(), lr=0.1)
    guard.backward(watched(guard, model))
    there = torch.device("cuda", 0)  # as if it had been there
    learning = guard._stepper._learning
    learning._devices = [there for _ in learning._devices]
    before = vector(model)
    refused(lambda: guard.step(optimizer), "cuda:0", "before Guard(...)")
    refused(lambda: watched(guard, model), "cuda:0", "before Guard(...)")
    assert torch.equal(vector(model), before)


def test_an_anchor_follows_a_model_to_its_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """The meta device computes nothing, and refuses tensors of any other device."""
    monkeypatch.setattr(devices, "reading_stalls", lambda _: True)  # no rows are selected there
    layers = [Moments(4, torch.zeros(3), torch.ones(3)) for _ in range(2)]
    penalty = _penalty(Anchor(layers, layers), "all", "variance", torch.empty(0))
    hidden = tuple(torch.zeros(2, 5, 3, device="meta") for _ in layers)
    tokens = torch.ones(2, 5, dtype=torch.bool, device="meta")
    seen = Pass(0, None, hidden, tokens, tokens)
    cost, distances = penalty(seen)
    assert cost.device.type == distances.device.type == "meta"


@pytest.mark.parametrize("is_automatic", [False, True])
def test_processes_that_are_connected_after_the_guard_was_made(
    is_automatic: bool, anchors: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As trainers do it; without a group each process would project with its own gradient."""
    model, guard = guarded("aegis", anchors)
    named = Guard(make(), anchors["aegis"], layers=LAYERS, process_group="world")
    if is_automatic:
        guard.automatic(mask="mask")
    monkeypatch.setattr(process_groups, "count", lambda: 2)
    begin = (lambda: task_loss(model, 0)) if is_automatic else (lambda: watched(guard, model))
    refused(begin, "one of 2 processes", "process_group='world'")
    known = {"world": "all of them", None: None}
    monkeypatch.setattr(process_groups, "resolved", lambda group: known[group])
    asked: list[object] = []
    monkeypatch.setattr(
        process_groups, "mean_gradients", lambda taken, _, group: (asked.append(group), taken)[1]
    )
    monkeypatch.setattr(process_groups, "mean_over", lambda numbers, group: list(numbers))
    with named.watch(MASK):
        loss = task_loss(named._model, 0)
    named.backward(loss)
    assert asked == ["all of them"]


@every_method
def test_a_table_with_sparse_gradients(method: str, anchors: dict[str, Path]) -> None:
    model = make()
    model.text.words.sparse = True
    refused(lambda: guarded(method, anchors, model), "text.words", "sparse=False")


def test_another_word_than_world(anchors: dict[str, Path]) -> None:
    refused(
        lambda: Guard(make(), anchors["aegis"], layers=LAYERS, process_group="gloo"),
        "process_group='gloo'",
        "'world'",
    )


# --- passes ---------------------------------------------------------------------------------------


@every_method
def test_a_loss_that_the_model_has_no_part_in(method: str, anchors: dict[str, Path]) -> None:
    model, guard = guarded(method, anchors)
    watched(guard, model)
    elsewhere = torch.ones(3, requires_grad=True, dtype=torch.float64)
    refused(lambda: guard.backward(elsewhere.sum()), "no gradient in any parameter")


class Cut(Block):
    """A layer whose output is detached from its graph, and learns as a leaf of its own."""

    cut = False

    def forward(self, x: Tensor, hidden: Tensor) -> Tensor:
        out = super().forward(x, hidden)
        return out.detach().requires_grad_() if Cut.cut else out


def test_an_anchor_gradient_of_zero_in_every_group(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its ledger would be rows of zeros, and its training the same as naive."""
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
    """As in a trainer that does not know of the guard."""
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


@pytest.mark.parametrize("is_automatic", [False, True])
def test_two_optimizers_do_not_constrain_twice(
    is_automatic: bool, anchors: dict[str, Path]
) -> None:
    """A proximal step taken twice would draw back twice as far."""
    model, guard = guarded("kfac", anchors)
    if is_automatic:
        guard.automatic(mask="mask")
    parts = [*model.vision.parameters()], [*model.text.parameters()]
    one, other = (torch.optim.SGD(part, lr=0.1) for part in parts)
    for seed in range(2):  # each step may have one of them
        if is_automatic:
            task_loss(model, seed).backward()
        else:
            guard.backward(task_loss(model, seed))
        take = (lambda o: o.step()) if is_automatic else guard.step
        take(one)
        before = vector(model)
        refused(lambda: take(other), "two optimizers")
        assert torch.equal(vector(model), before)
        one.zero_grad()
        other.zero_grad()


def test_an_optimizer_of_other_parameters_constrains_nothing(anchors: dict[str, Path]) -> None:
    model, guard = guarded("kfac", anchors)
    expert = nn.Linear(2, 1)
    optimizer = torch.optim.SGD(expert.parameters(), lr=0.1)
    guard.backward(task_loss(model, 0))
    guard.step(torch.optim.SGD(model.parameters(), lr=0.1))
    held, before = vector(model), vector(expert)
    expert(torch.ones(1, 2)).sum().backward()
    guard.step(optimizer)
    assert torch.equal(vector(model), held) and not torch.equal(vector(expert), before)


def test_a_step_on_zeros_is_no_training(anchors: dict[str, Path]) -> None:
    """Checkpointing libraries take one to create the optimizer's state before filling it."""
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
