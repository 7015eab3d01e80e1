"""An automatic guard: plain `backward()` and `step()` act like guarded ones."""

from __future__ import annotations

import contextlib
import copy
import gc
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.guard import (
    IMAGE,
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
from torch.nn.parallel import DistributedDataParallel

from aegis_cli import Guard
from aegis_cli.common.errors import AegisError, Diverged

METHODS: dict[str, dict[str, Any]] = {
    "aegis": {"layers": LAYERS},
    "aegis by token type": {"layers": LAYERS, "scope": "each"},
    "aegis at the step": {"layers": LAYERS, "projects": "both"},
    "nullspace": {"vision": "vision", "energy": 0.9, "every": 2},
    "kfac": {"protect": ("maps",)},
}
every_method = pytest.mark.parametrize("name", METHODS)


@pytest.fixture(scope="module")
def anchors(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The anchor that each method reads."""
    return anchors_by_method(tmp_path_factory.mktemp("anchors"))


def guarded(name: str, anchors: dict[str, Path]) -> tuple[Vlm, Guard]:
    model, method = make(), name.split()[0]
    return model, Guard(model, anchors[method], method=method, **METHODS[name])


def automatic(name: str, anchors: dict[str, Path], **more: Any) -> tuple[Vlm, Guard]:
    model, guard = guarded(name, anchors)
    image = (lambda given: IMAGE) if name == "aegis by token type" else None
    return model, guard.automatic(mask="mask", image=image, **more)


def plain_steps(
    model: nn.Module, steps: int = 3, change: Callable[[nn.Module], object] | None = None
) -> None:
    """The loop of `guarded_steps`, without a guard's calls."""
    optimizer = torch.optim.AdamW([p for p in model.parameters() if p.requires_grad], lr=1e-2)
    for seed in range(steps):
        loss = task_loss(model, seed)
        loss.backward()
        if change is not None:
            change(model)
        optimizer.step()
        optimizer.zero_grad()


def same_ledger(one: Guard, other: Guard) -> bool:
    rows, others = one.ledger.tensors(), other.ledger.tensors()
    return all(torch.equal(rows[name], others[name]) for name in rows)


# --- equal to the guard's own loop ----------------------------------------------------------------


@every_method
def test_a_plain_loop_takes_the_steps_of_a_guarded_one(name: str, anchors: dict[str, Path]) -> None:
    model, by_hand = guarded(name, anchors)
    guarded_steps(model, by_hand)
    by_hand.settle()
    other, guard = automatic(name, anchors)
    plain_steps(other)
    guard.settle()
    naive = make()
    plain_steps(naive)
    assert torch.equal(vector(other), vector(model)) and same_ledger(guard, by_hand)
    assert not torch.equal(vector(other), vector(naive))


@every_method
def test_passes_add_up_before_a_step(name: str, anchors: dict[str, Path]) -> None:
    found = []
    for by_itself in (False, True):
        model, guard = (automatic if by_itself else guarded)(name, anchors)
        optimizer = torch.optim.AdamW(model.parameters(), lr=1e-2)
        for step in range(2):
            for seed in range(3 * step, 3 * step + 3):
                if by_itself:
                    task_loss(model, seed).backward()
                    continue
                with guard.watch(batch(seed)[2], IMAGE):
                    loss = task_loss(model, seed)
                guard.backward(loss)
            nn.utils.clip_grad_norm_(model.parameters(), 0.01)
            optimizer.step() if by_itself else guard.step(optimizer)
            optimizer.zero_grad()
        guard.settle()
        found.append((vector(model), guard.ledger.tensors()))
    (one, rows), (other, others) = found
    # Adam divides by the root of the squared gradient, so the order of a sum becomes visible.
    torch.testing.assert_close(other, one, rtol=1e-6, atol=1e-8)
    for values, expected in zip(others.values(), rows.values(), strict=True):
        torch.testing.assert_close(values, expected, rtol=1e-6, atol=1e-12)


@every_method
def test_an_optimizer_that_calls_the_passes_itself(name: str, anchors: dict[str, Path]) -> None:
    """As Lightning's do: forward pass, `zero_grad` and backward pass happen inside the step."""
    expected, guard = automatic(name, anchors)
    plain_steps(expected)
    guard.settle()
    model, other = automatic(name, anchors)
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-2)
    for seed in range(3):

        def closure(seed: int = seed) -> Tensor:
            loss = task_loss(model, seed)
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(model.parameters(), 1e6)
            return loss

        assert optimizer.step(closure) > 0
    other.settle()
    assert torch.equal(vector(model), vector(expected)) and same_ledger(guard, other)


class Decayed(torch.optim.SGD):
    """A class that moves the weights again after its base class's step, as custom ones do."""

    @torch.no_grad()
    def step(self, closure: Any = None) -> Any:
        lost = super().step(closure)
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.mul_(0.95)
        return lost


@every_method
def test_an_optimizer_that_goes_on_after_its_base_classs_step(
    name: str, anchors: dict[str, Path]
) -> None:
    """Changes after the inner step are constrained too, even after a step that failed."""
    ends = []
    for is_automatic in (False, True):
        model, guard = (automatic if is_automatic else guarded)(name, anchors)
        optimizer = Decayed(model.parameters(), lr=1e-2)
        for seed in range(4):
            if is_automatic:
                task_loss(model, seed).backward()
                optimizer.step()
            else:
                with guard.watch(batch(seed)[2], IMAGE):
                    loss = task_loss(model, seed)
                guard.backward(loss)
                guard.step(optimizer)
            optimizer.zero_grad()
        guard.settle()
        ends.append(vector(model))
    torch.testing.assert_close(*ends, rtol=0, atol=1e-12)


def test_a_step_that_raises_is_constrained_with_the_next_one(anchors: dict[str, Path]) -> None:
    class Failing(Decayed):
        fails = False

        def step(self, closure: Any = None) -> Any:
            lost = super().step(closure)
            if self.fails:
                raise RuntimeError
            return lost

    model, start = make(), make()
    guard = Guard(model, anchors["nullspace"], method="nullspace", vision="vision", energy=1.0)
    guard.automatic(mask="mask")
    optimizer = Failing(model.parameters(), lr=1e-2)
    for seed in range(5):
        optimizer.fails = seed == 2
        task_loss(model, seed).backward()
        with pytest.raises(RuntimeError) if optimizer.fails else contextlib.nullcontext():
            optimizer.step()
        optimizer.zero_grad()
    assert not torch.equal(vector(model), vector(start))
    pixels, ids, mask = batch(100)  # one of those on which the anchor was measured
    with torch.no_grad():
        before, after = (m(pixels, ids, mask)[mask] for m in (start, model))
    torch.testing.assert_close(after, before, rtol=0, atol=1e-5)


def test_several_guards_each_see_their_own_model(anchors: dict[str, Path]) -> None:
    alone, guard = automatic("aegis", anchors)
    plain_steps(alone)
    both = [automatic("aegis", anchors) for _ in range(2)]
    for model, _ in both:
        plain_steps(model)
    for model, other in both:
        assert torch.equal(vector(model), vector(alone)) and same_ledger(guard, other)


def test_small_anchor_gradients_are_those_of_a_loop_that_calls_the_guard(tmp_path: Path) -> None:
    """The penalty is scaled before its backward pass; in half precision its gradients would vanish.

    The penalty is divided by the variances, which are those of a deep model's residual stream.
    """
    model = deep()
    path = measured(model, tmp_path / "anchor.safetensors", parts=("moments",))
    rows = []
    for is_automatic, half in ((False, False), (False, True), (True, True)):
        model = deep()
        guard = Guard(model, path, layers=LAYERS, weighting="variance")
        scaler = torch.amp.GradScaler("cpu", init_scale=2.0**14)
        if is_automatic:
            guard.automatic(mask="mask", scaler=scaler)
        pixels, ids, mask = batch(0, 2048, torch.float32)
        pass_of = contextlib.nullcontext() if is_automatic else guard.watch(mask)
        with pass_of, torch.autocast("cpu", torch.float16, enabled=half):
            out = model(pixels, ids, mask)
        loss = (out.float() / 40 - 1).square().mean(-1)[mask].mean()
        if is_automatic:
            scaler.scale(loss).backward()
        else:
            guard.backward(loss, scaler)
        rows.append(guard.ledger.tensors()["aa"][0])
        guard.remove()
    exact, manual, automatically = rows
    torch.testing.assert_close(automatically, manual, rtol=1e-3, atol=0)
    torch.testing.assert_close(automatically, exact, rtol=0.1, atol=0)


def deep() -> Vlm:
    model = make(dtype=torch.float32)
    with torch.no_grad():
        model.text.words.weight.mul_(40)
        model.vision[0].weight.mul_(150)
    return model


@pytest.mark.parametrize("is_automatic", [False, True])
def test_a_step_that_overflows_counts_once(is_automatic: bool, anchors: dict[str, Path]) -> None:
    """This holds however many micro-batches it has; it has no row, since no weight moves."""
    model, guard = guarded("aegis", anchors)
    scaler = torch.amp.GradScaler("cpu", init_scale=256.0)
    if is_automatic:
        guard.automatic(mask="mask", scaler=scaler)
    optimizer = torch.optim.SGD(model.parameters(), lr=0.1)
    for step in range(4):
        for micro in range(3):
            factor = math.inf if step in (1, 2) and micro == 1 else 1.0
            if is_automatic:
                scaler.scale(task_loss(model, step) * factor).backward()
                continue
            with guard.watch(batch(step)[2]):
                loss = task_loss(model, step) * factor
            guard.backward(loss, scaler)
        if is_automatic:
            scaler.step(optimizer)
        else:
            guard.step(optimizer, scaler)
        scaler.update()
        optimizer.zero_grad()
    assert guard.ledger.tensors()["step"].tolist() == [1, 4]


def test_an_exception_in_a_backward_pass_ends_no_training(anchors: dict[str, Path]) -> None:
    """For example an out-of-memory error, after which a loop continues with a smaller batch."""
    model, _guard = automatic("aegis", anchors)
    optimizer = torch.optim.SGD(model.parameters(), lr=0.1)
    one, _ = automatic("aegis", anchors)
    own = torch.optim.SGD(one.parameters(), lr=0.1)

    def fail(gradient: Tensor) -> None:
        raise MemoryError

    loss = task_loss(model, 0)
    handle = model.vision[0].weight.register_hook(fail)
    with pytest.raises(MemoryError):
        loss.backward()
    handle.remove()
    for each, stepping in ((model, optimizer), (one, own)):
        stepping.zero_grad()
        task_loss(each, 1).backward()
        stepping.step()
    assert torch.equal(vector(model), vector(one))


class FailsOnce(torch.autograd.Function):
    """Returns its input, and fails in its first backward pass."""

    failed = False

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return x.clone()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:  # type: ignore[override]
        if not FailsOnce.failed:
            FailsOnce.failed = True
            raise MemoryError
        return gradient


class WithLoss(nn.Module):
    """Calls the model and computes the loss from its scores, as Hugging Face models do."""

    def __init__(self, model: Vlm) -> None:
        super().__init__()
        self.model = model

    def forward(self, pixels: Tensor, ids: Tensor, mask: Tensor) -> dict[str, Tensor]:
        return {"loss": FailsOnce.apply(self.model(pixels, ids, mask)).square().mean()}


def test_a_backward_pass_may_fail_before_it_comes_to_the_first_parameter(
    anchors: dict[str, Path],
) -> None:
    FailsOnce.failed = False
    model, guard = guarded("aegis", anchors)
    policy = WithLoss(model)
    guard.automatic(mask="mask", around=policy)
    optimizer = torch.optim.SGD(model.parameters(), lr=0.1)
    with pytest.raises(MemoryError):
        policy(*batch(0))["loss"].backward()
    for seed in (1, 2):
        policy(*batch(seed))["loss"].backward()
        optimizer.step()
        optimizer.zero_grad()
    assert len(guard.ledger) == 2


def test_a_gradient_of_the_inputs_alone_takes_no_pass_away(anchors: dict[str, Path]) -> None:
    """It works, and the loss of the same pass can still go backward."""
    model, guard = automatic("aegis", anchors)
    pixels, ids, mask = batch(0)
    loss = model(pixels.requires_grad_(), ids, mask).square().mean()
    torch.autograd.grad(loss, pixels, retain_graph=True)
    refused(lambda: model(pixels, ids, mask), "a second forward pass")
    loss.backward()
    assert len(guard.ledger) == 1


def scaled_steps(model: nn.Module, scaler: torch.amp.GradScaler) -> None:
    """Three steps of AdamW, with losses that are multiplied by a scaler."""
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-2)
    for seed in range(3):
        scaler.scale(task_loss(model, seed)).backward()
        scaler.step(optimizer)
        scaler.update()
        optimizer.zero_grad()


def test_a_scaler_leaves_the_steps_as_they_are(anchors: dict[str, Path]) -> None:
    model, guard = automatic("aegis", anchors)
    plain_steps(model)
    scaler = torch.amp.GradScaler("cpu", init_scale=1024.0, growth_interval=1000)
    other, scaled = automatic("aegis", anchors, scaler=scaler)
    scaled_steps(other, scaler)
    torch.testing.assert_close(vector(other), vector(model))
    rows, others = guard.ledger.tensors(), scaled.ledger.tensors()
    for name, values in rows.items():
        torch.testing.assert_close(others[name], values)


def test_a_scaler_that_was_not_given_shows_in_the_ledger_alone(anchors: dict[str, Path]) -> None:
    """As docs/guard.md says: the projection does not depend on the scale of the task's gradient."""
    scale, found = 256.0, []
    for told in (True, False):
        scaler = torch.amp.GradScaler("cpu", init_scale=scale)
        model, guard = automatic("aegis", anchors, **({"scaler": scaler} if told else {}))
        scaled_steps(model, scaler)
        found.append((vector(model), guard.ledger.tensors()))
    (model, rows), (other, scaled) = found
    torch.testing.assert_close(other, model)
    for name, times in (("tt", scale**2), ("ta", scale), ("aa", 1.0)):
        torch.testing.assert_close(scaled[name], rows[name] * times)


# --- what else a loop does ------------------------------------------------------------------------


def test_evaluation_is_no_pass(anchors: dict[str, Path]) -> None:
    model, guard = automatic("aegis", anchors)
    for seed in range(2):
        with torch.no_grad():
            task_loss(model, seed)
    assert len(guard.ledger) == 0
    plain_steps(model, 1)
    assert len(guard.ledger) == 1


def test_a_copy_of_the_model_is_not_watched(anchors: dict[str, Path]) -> None:
    model, guard = automatic("aegis", anchors)
    task_loss(copy.deepcopy(model), 0).backward()
    plain_steps(model, 1)
    assert len(guard.ledger) == 1


def test_gradients_that_are_asked_for_alone_are_no_backward_pass(
    anchors: dict[str, Path],
) -> None:
    expected, guard = automatic("aegis", anchors)
    plain_steps(expected, 1)
    model, other = automatic("aegis", anchors)
    loss = task_loss(model, 0)
    torch.autograd.grad(loss, [*model.parameters()][:3], retain_graph=True)
    loss.backward()
    torch.optim.AdamW(model.parameters(), lr=1e-2).step()
    assert torch.equal(vector(model), vector(expected)) and same_ledger(guard, other)


def test_gradients_that_are_asked_for_alone_leave_the_sum_of_a_step_as_it_was(
    anchors: dict[str, Path],
) -> None:
    expected, guard = automatic("aegis", anchors)
    model, other = automatic("aegis", anchors)
    for asks, trained in ((False, expected), (True, model)):
        task_loss(trained, 0).backward()
        loss = task_loss(trained, 1)
        if asks:
            kept = [p.grad.clone() for p in trained.parameters()]
            torch.autograd.grad(loss, [*trained.parameters()][:3], retain_graph=True)
            for parameter, gradient in zip(trained.parameters(), kept, strict=True):
                torch.testing.assert_close(parameter.grad, gradient, rtol=1e-12, atol=1e-12)
        loss.backward()
        torch.optim.SGD(trained.parameters(), lr=1e-2).step()
    torch.testing.assert_close(vector(model), vector(expected), rtol=1e-12, atol=1e-12)
    assert (guard.ledger.tensors()["ta"] < 0).any() and len(other.ledger) == 1


def test_a_forward_pass_that_fails_leaves_no_trace(anchors: dict[str, Path]) -> None:
    expected, guard = automatic("aegis", anchors)
    plain_steps(expected)
    model, other = automatic("aegis", anchors)
    pixels, ids, mask = batch(0)
    with pytest.raises(RuntimeError, match="size"):
        model(pixels[:2], ids, mask)
    plain_steps(model)
    assert torch.equal(vector(model), vector(expected)) and same_ledger(guard, other)


def test_a_batch_that_is_skipped(anchors: dict[str, Path]) -> None:
    model, guard = automatic("aegis", anchors)
    task_loss(model, 0)
    with pytest.raises(AegisError, match="second forward pass") as caught:
        task_loss(model, 1)
    assert "torch.no_grad()" in caught.value.fix
    guard.discard()
    plain_steps(model, 1)
    assert len(guard.ledger) == 1


@pytest.mark.parametrize("backward", [False, True])
def test_after_a_loss_that_fails_the_next_pass_says_how_to_go_on(
    backward: bool, anchors: dict[str, Path]
) -> None:
    """Outside the model's call: while the loss is computed, or before its backward pass arrives."""
    expected, guard = automatic("aegis", anchors)
    plain_steps(expected)
    model, other = automatic("aegis", anchors)
    FailsOnce.failed = not backward
    scores = FailsOnce.apply(model(*batch(0)))
    with pytest.raises(MemoryError if backward else RuntimeError):
        (scores if backward else scores.view(-1, 7919)).square().mean().backward()
    with pytest.raises(AegisError) as caught:
        plain_steps(model)
    assert "guard.discard()" in caught.value.fix
    other.discard()
    plain_steps(model)
    assert torch.equal(vector(model), vector(expected)) and same_ledger(guard, other)


def test_a_guard_that_is_removed_leaves_the_loop_alone(anchors: dict[str, Path]) -> None:
    model, guard = automatic("aegis", anchors)
    guard.remove()
    plain_steps(model)
    naive = make()
    plain_steps(naive)
    assert torch.equal(vector(model), vector(naive))
    assert not model._forward_hooks and not model._forward_pre_hooks


def test_it_stays_at_work_though_nobody_keeps_it(anchors: dict[str, Path]) -> None:
    expected, _ = automatic("aegis", anchors)
    plain_steps(expected)
    model, guard = automatic("aegis", anchors)
    del guard
    gc.collect()
    plain_steps(model)
    assert torch.equal(vector(model), vector(expected))


@pytest.fixture
def group(tmp_path: Path) -> Iterator[None]:
    """A process group with only this process."""
    dist.init_process_group("gloo", f"file://{tmp_path}/store", rank=0, world_size=1)
    yield
    dist.destroy_process_group()


@pytest.mark.usefixtures("group")
def test_distributed_data_parallel_has_gathered_the_gradients_before(
    anchors: dict[str, Path],
) -> None:
    expected, guard = automatic("aegis", anchors)
    plain_steps(expected)
    model = make()
    together = DistributedDataParallel(model)
    shared = Guard(model, anchors["aegis"], LAYERS, process_group=dist.group.WORLD)
    shared.automatic(mask="mask")
    plain_steps(together)
    torch.testing.assert_close(vector(model), vector(expected))
    assert len(shared.ledger) == len(guard.ledger) == 3


@compiling
@pytest.mark.parametrize("how", ["before", "after", "in place"])
def test_a_compiled_model(how: str, anchors: dict[str, Path]) -> None:
    expected, guard = automatic("aegis", anchors)
    plain_steps(expected)
    model = make()
    called: nn.Module = model
    try:
        if how == "before":
            called = torch.compile(model, backend="aot_eager")  # type: ignore[assignment]
        other = Guard(called, anchors["aegis"], LAYERS).automatic(mask="mask")
        if how == "after":
            called = torch.compile(model, backend="aot_eager")  # type: ignore[assignment]
        if how == "in place":
            model.compile(backend="aot_eager")
        plain_steps(called)
    finally:
        torch.compiler.reset()
    torch.testing.assert_close(vector(model), vector(expected))
    for name, values in guard.ledger.tensors().items():
        torch.testing.assert_close(other.ledger.tensors()[name], values)


# --- refused --------------------------------------------------------------------------------------


def refused(call: Callable[[], object], *words: str) -> None:
    with pytest.raises(AegisError) as caught:
        call()
    assert not [word for word in words if word not in str(caught.value)], caught.value


def test_a_backward_pass_without_a_call_of_the_model(anchors: dict[str, Path]) -> None:
    model, _ = automatic("aegis", anchors)
    pixels, ids, mask = batch(0)
    loss = model.forward(pixels, ids, mask).square().mean()
    refused(loss.backward, "without a forward pass that the guard saw", "around=policy")
    optimizer, before = torch.optim.SGD(model.parameters(), lr=0.1), vector(model)
    refused(optimizer.step, "without a guard.backward")
    assert torch.equal(vector(model), before)


def test_calls_of_the_guard_in_an_automatic_loop(anchors: dict[str, Path]) -> None:
    model, guard = automatic("kfac", anchors)
    loss = task_loss(model, 0)
    refused(lambda: guard.backward(loss), "automatic guard", "loss.backward()")
    refused(lambda: guard.step(torch.optim.SGD(model.parameters(), lr=0.1)), "automatic guard")
    refused(guard.automatic, "automatic guard")
    refused(lambda: guard.watch(None).__enter__(), "guard.watch of an automatic guard")


def test_a_name_in_place_of_the_module_whose_call_is_a_pass(anchors: dict[str, Path]) -> None:
    _, guard = guarded("aegis", anchors)
    refused(lambda: guard.automatic(around="policy"), "around='policy'")


def test_a_mask_that_is_not_among_the_arguments(anchors: dict[str, Path]) -> None:
    model, guard = guarded("aegis", anchors)
    guard.automatic()
    refused(lambda: task_loss(model, 0), "'attention_mask'", "pixels, ids, mask", "mask=")
    model, guard = guarded("aegis by token type", anchors)
    refused(lambda: guard.automatic(mask="mask"), "no image mask", "guard.automatic(image=")


@every_method
def test_a_loss_that_is_not_finite(name: str, anchors: dict[str, Path]) -> None:
    model, _ = automatic(name, anchors)
    before = vector(model)
    with pytest.raises(Diverged, match="not finite"):
        (task_loss(model, 0) * torch.inf).backward()
    assert torch.equal(vector(model), before)


@every_method
def test_a_trainer_with_closures_beside_a_guard_is_refused(
    name: str, anchors: dict[str, Path]
) -> None:
    """Such a step computes its gradients itself, and would silently train unguarded."""
    model, _guard = guarded(name, anchors)
    optimizer, before = torch.optim.AdamW(model.parameters(), lr=0.1), vector(model)

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = task_loss(model, 0)
        loss.backward()
        return loss

    refused(lambda: optimizer.step(closure), "guard")
    refused(lambda: optimizer.step(closure=closure), "guard")
    assert torch.equal(vector(model), before)


# --- a step that raises an exception --------------------------------------------------------------


class Interrupted(Exception):
    """Raised inside a step."""


class BreakingSGD(torch.optim.SGD):
    """Raises in its step, before it has moved the weights or after it."""

    breaks: str | None = None

    def step(self, closure: Any = None) -> Any:
        if self.breaks == "before":
            raise Interrupted
        super().step(closure)
        if self.breaks == "after":
            raise Interrupted


@pytest.mark.parametrize("when", ["before", "after"])
@pytest.mark.parametrize("by_itself", [True, False])
@pytest.mark.parametrize("name", ["nullspace", "kfac"])
def test_what_a_broken_step_has_moved_is_constrained_and_nothing_else(
    name: str, by_itself: bool, when: str, anchors: dict[str, Path]
) -> None:
    """The next steps equal those of a loop in which it succeeded, or was left out."""
    found = []
    for breaks in (True, False):
        model, guard = automatic(name, anchors) if by_itself else guarded(name, anchors)
        optimizer = BreakingSGD([p for p in model.parameters() if p.requires_grad], lr=0.05)
        for seed in range(4):
            optimizer.breaks = when if breaks and seed == 1 else None
            if not breaks and seed == 1 and when == "before":
                continue
            with contextlib.suppress(Interrupted):
                loss = task_loss(model, seed)
                if by_itself:
                    loss.backward()
                    optimizer.step()
                else:
                    guard.backward(loss)
                    guard.step(optimizer)
            optimizer.zero_grad()
        guard.settle()
        found.append(vector(model))
    assert torch.equal(*found)


# --- two guards -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["aegis", "nullspace", "kfac"])
def test_two_guards_on_a_shared_parameter_are_refused(name: str, anchors: dict[str, Path]) -> None:
    """The second guard's result has parts again in the directions that the first one protects."""
    one, first = automatic(name, anchors)
    task_loss(one, 0).backward()
    one.zero_grad()
    other = make()
    other.text.layers[0].up = one.text.layers[0].up  # of the same values, as pre-trained
    second = Guard(other, anchors[name], method=name, **METHODS[name]).automatic(mask="mask")
    with pytest.raises(AegisError, match="two guards at work on 2 parameters.*up.weight"):
        task_loss(other, 0).backward()
    first.remove()
    other.zero_grad()
    second.discard()
    task_loss(other, 0).backward()


@pytest.mark.parametrize("by_hand", ["neither", "aegis", "nullspace"])
def test_one_guard_of_the_gradient_and_one_of_the_update_go_together(
    by_hand: str, anchors: dict[str, Path]
) -> None:
    """Whichever of them is called in the loop, if any, the steps are the same."""
    ends = []
    for called in ("neither", by_hand):
        model, second = guarded("nullspace", anchors)
        first = Guard(model, anchors["aegis"], LAYERS)
        for name, guard in (("aegis", first), ("nullspace", second)):
            if name != called:
                guard.automatic(mask="mask")
        if called == "neither":
            plain_steps(model)
        else:
            guarded_steps(model, first if called == "aegis" else second)
        second.settle()
        assert len(first.ledger) == 3
        ends.append(vector(model))
    assert torch.equal(*ends)
    for name in ("aegis", "nullspace"):
        alone, _ = automatic(name, anchors)
        plain_steps(alone)
        assert not torch.equal(ends[0], vector(alone))


@pytest.mark.parametrize("called", ["aegis", "nullspace"])
def test_two_guards_that_are_both_called_in_a_loop_are_named(
    called: str, anchors: dict[str, Path]
) -> None:
    model, second = guarded("nullspace", anchors)
    first = Guard(model, anchors["aegis"], LAYERS)
    optimizer = torch.optim.SGD(model.parameters(), lr=0.1)
    with first.watch(batch(0)[2]):
        loss = task_loss(model, 0)
    (first if called == "aegis" else second).backward(loss)
    refused(lambda: second.step(optimizer), "of one of two guards on", "guard.automatic()")


@pytest.mark.parametrize("by_itself", [True, False])
@pytest.mark.parametrize("name", ["nullspace", "kfac"])
def test_a_model_that_is_cast_later_is_refused_before_anything_moves(
    name: str, by_itself: bool, anchors: dict[str, Path]
) -> None:
    """As Lightning does with precision='bf16-true'."""
    model, guard = automatic(name, anchors) if by_itself else guarded(name, anchors)
    model.bfloat16()
    before = vector(model)
    with pytest.raises(AegisError, match="was in torch.float64 .* and is in torch.bfloat16"):
        if by_itself:
            task_loss(model, 0)
        else:
            guard.backward(task_loss(model, 0))
    assert torch.equal(before, vector(model))
