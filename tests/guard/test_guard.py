"""The guard's backward pass in a plain loop, against separate gradients and `aegis train`."""

from __future__ import annotations

import copy
import dataclasses
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.graphs import outputs_kept
from samples.guard import (
    IMAGE,
    LAYERS,
    PATCHES,
    TEXT,
    TupleBlock,
    batch,
    compiling,
    guarded_steps,
    make,
    measured,
    task_loss,
    through_checkpoint,
    vector,
)
from samples.training_runs import STEPS
from torch import Tensor, nn

from aegis_cli import Guard, inspection, methods
from aegis_cli.anchors.anchor_file import from_artifact
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError, Diverged
from aegis_cli.common.events import ignore
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.moments import merge
from aegis_cli.models import backbones
from aegis_cli.recipes import Aegis as Options
from aegis_cli.recipes import Kfac, Nullspace, Recipe
from aegis_cli.training import assemble, loading, schedule, train


@pytest.fixture(scope="module")
def anchor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return measured(make(), tmp_path_factory.mktemp("anchor") / "anchor.safetensors")


# --- equal to training ----------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:the weight of kfac")  # one is strong on purpose
@pytest.mark.parametrize(
    ("method", "options"),
    [
        ("aegis", {}),
        (
            "aegis",
            {
                "projects": "both",
                "scope": "each",
                "weighting": "variance",
                "restoration": 0.1,
                "groups": "language",
            },
        ),
        ("nullspace", {"energy": 0.99, "every": 1}),
        ("nullspace", {"energy": 0.99, "every": 4}),
        ("kfac", {"every": 1}),
        ("kfac", {"weight": 3.0, "balance": 0.5, "every": 4}),
        ("kfac", {"weight": 0.0, "every": 1}),
        ("kfac", {"balance": 0.0, "every": 1}),
    ],
)
def test_equal_to_training_step_for_step(
    method: str,
    options: dict[str, Any],
    recipe: Recipe,
    demos_file: Path,
    anchor_file: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A plain loop with the guard beside `aegis train`'s own steps, in float64.

    Both start alike and are settled at the end.
    """
    section = {"aegis": Options, "nullspace": Nullspace, "kfac": Kfac}[method](**options)
    settings = dataclasses.replace(recipe.train, method=method)
    changed = dataclasses.replace(recipe, **{method: section}, train=settings)
    monkeypatch.setattr(loading.backbones, "load", lambda name: in_double(LOAD(name)))
    theirs, ours = (
        assemble.build(
            changed, methods.get(method), demos_file, anchor_file, Path("unused"), ignore
        )
        for _ in range(2)
    )
    guard = Guard(
        ours.policy.double().backbone,
        anchor_file,
        "layers",
        method=method,
        vision="stem",
        **options,
    )
    theirs.policy.double().train()
    for index, frames in enumerate(frames_of(theirs)):
        train.update(theirs, index, frames, train.Window(), settle=index + 1 == STEPS)
    plain_loop(ours, guard)
    guard.settle()
    start = in_double(LOAD(recipe.backbone))
    for x, y in zip(ours.policy.parameters(), theirs.policy.parameters(), strict=True):
        torch.testing.assert_close(x, y, rtol=0, atol=1e-9)
    assert (vector(ours.policy.backbone) - vector(start)).norm() > 1e-2
    assert (
        guard.ledger.groups == theirs.ledger.groups and guard.ledger.layers == theirs.ledger.layers
    )
    rows, expected = guard.ledger.tensors(), theirs.ledger.tensors()
    for name in rows:
        torch.testing.assert_close(rows[name], expected[name], rtol=1e-6, atol=1e-12)
    assert len(guard.ledger) == (STEPS if method == "aegis" else 0)


LOAD = backbones.load


def in_double(backbone: Any) -> Any:
    backbone.pixels = lambda frames: type(backbone).pixels(backbone, frames).double()
    return backbone.double()


def frames_of(run: assemble.TrainingRun) -> Iterator[Any]:
    settings = run.recipe.train
    order = schedule.BatchOrder(len(run.demos.train), settings.batch_size, run.recipe.seed)
    for index in range(settings.steps):
        yield run.demos.batch(run.demos.train[order.rows(index)], settings.chunk)


def plain_loop(run: assemble.TrainingRun, guard: Guard) -> None:
    """The loop that a user would write with our parts: `aegis train`'s, except for the guard."""
    policy, settings = run.policy.train(), run.recipe.train
    (optimizer,) = run.optimizers
    for index, frames in enumerate(frames_of(run)):
        factor = schedule.warmup_then_decay(
            index, settings.steps, settings.warmup, settings.final_lr_share
        )
        for group in run.rates:
            group["lr"] = group["peak"] * factor
        inputs = policy.backbone.prepare(frames.images, frames.instructions)
        patches = policy.backbone.shape.image_tokens
        mask = torch.cat([torch.ones(len(inputs.mask), patches, dtype=torch.bool), inputs.mask], 1)
        with guard.watch(mask, torch.arange(mask.shape[1]) < patches):
            encoding = policy.backbone.encode(inputs)
        loss = policy.flow_loss(
            frames, encoding, settings.flow_samples, train._generator(run, index, train._NOISE)
        )
        guard.backward(loss)
        nn.utils.clip_grad_norm_(run.learning, settings.clip_norm)
        guard.step(optimizer)
        optimizer.zero_grad()


def read_anchor(path: Path) -> Anchor:
    return from_artifact(artifacts.load(path, "anchor"))


# --- the dual backward, written out ---------------------------------------------------------------


def separate(
    model: nn.Module, anchor: Anchor, seeds: list[int]
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Summed task gradients and mean anchor gradients of some batches, with a graph for each."""
    named = dict(model.named_parameters())
    wanted = [merge(i, t) for i, t in zip(anchor.image, anchor.text, strict=True)]
    task, pull = ({name: torch.zeros_like(p) for name, p in named.items()} for _ in range(2))
    for seed in seeds:
        seen: list[Tensor] = []
        handles = [
            layer.register_forward_hook(
                lambda m, i, o: seen.append(o[0] if isinstance(o, tuple) else o)
            )
            for layer in model.text.layers
        ]
        loss = task_loss(model, seed)
        for handle in handles:
            handle.remove()
        costs = []
        for hidden, moments in zip(seen, wanted, strict=True):
            rows = hidden[batch(seed)[2]]
            mean, std = rows.mean(0), rows.std(0, correction=0)
            costs.append(
                (mean - moments.mean).square().sum() + (std - moments.var.sqrt()).square().sum()
            )
        for total, value, share in (
            (task, loss, 1.0),
            (pull, torch.stack(costs).mean(), 1 / len(seeds)),
        ):
            found = torch.autograd.grad(
                value, list(named.values()), retain_graph=True, allow_unused=True
            )
            for name, gradient in zip(named, found, strict=True):
                if gradient is not None:
                    total[name] += share * gradient
    return task, pull


def groups_of(model: nn.Module) -> list[list[str]]:
    """Names in the order of the guard's groups."""
    names = [n for n, _ in model.named_parameters()]
    parts = ("text.layers.0.", "text.layers.1.", "vision.", "text.words.", "text.norm.")
    return [[n for n in names if n.startswith(part)] for part in parts]


def flat(named: dict[str, Tensor], names: list[str]) -> Tensor:
    return torch.cat([named[name].flatten() for name in names])


@pytest.mark.parametrize("seeds", [[0], [1, 2], [0, 3, 4]])
@pytest.mark.parametrize("block", ["tensors", "tuples"])
def test_the_sum_of_gradients_is_projected(seeds: list[int], block: str, anchor: Path) -> None:
    """After every micro-batch `.grad` is the projected sum.

    It is orthogonal to the mean anchor gradient where they conflict.
    """
    model = make() if block == "tensors" else make(TupleBlock)
    guard = Guard(model, anchor, LAYERS)
    read, conflicts, costs = read_anchor(anchor), [], []
    for done, seed in enumerate(seeds, 1):
        with guard.watch(batch(seed)[2]):
            loss = task_loss(model, seed)
        guard.backward(loss)
        task, pull = separate(model, read, seeds[:done])
        got = {
            name: torch.zeros_like(p) if p.grad is None else p.grad
            for name, p in model.named_parameters()
        }
        rows = {name: value[-1] for name, value in guard.ledger.tensors().items()}
        for i, names in enumerate(groups_of(model)):
            g, a = flat(task, names), flat(pull, names)
            d = g @ a
            conflicts.append(bool(d < 0))
            expected = g - d / (a @ a) * a if d < 0 else g
            torch.testing.assert_close(flat(got, names), expected, rtol=1e-8, atol=1e-10)
            products = torch.stack([rows[name][i] for name in ("tt", "ta", "aa")])
            torch.testing.assert_close(
                products, torch.stack([g @ g, d, a @ a]), rtol=1e-6, atol=1e-8
            )
        costs.append(torch.stack(alone(model, anchor, seed)))
        torch.testing.assert_close(rows["w2"], torch.stack(costs).mean(0), rtol=1e-9, atol=0)
        assert len(guard.ledger) == 1
    assert any(conflicts) and not all(conflicts)


def alone(model: nn.Module, anchor: Path, seed: int) -> tuple[Tensor, ...]:
    """W2^2 of each layer for one batch."""
    other = copy.deepcopy(model)
    other.zero_grad()
    guard = Guard(other, anchor, LAYERS)
    with guard.watch(batch(seed)[2]):
        loss = task_loss(other, seed)
    guard.backward(loss)
    return tuple(guard.ledger.tensors()["w2"][0])


def test_restoration_does_not_grow_with_the_number_of_micro_batches(anchor: Path) -> None:
    model = make()
    guard = Guard(model, anchor, LAYERS, projects="update", restoration=0.3)
    for seed in (1, 2, 5):
        with guard.watch(batch(seed)[2]):
            loss = task_loss(model, seed)
        guard.backward(loss)
    task, pull = separate(model, read_anchor(anchor), [1, 2, 5])
    for name, parameter in model.named_parameters():
        torch.testing.assert_close(
            parameter.grad, task[name] + 0.3 * pull[name], rtol=1e-8, atol=1e-10
        )


def test_what_the_task_never_reaches_has_no_gradient_where_the_sum_has_no_conflict(
    anchor: Path,
) -> None:
    """This holds though the sum of an earlier pass had one, which the projection changed."""
    grads = []
    for scales in ((1.0,), (-1.0, 2.0)):
        model = make()
        guard = Guard(model, anchor, LAYERS)
        for scale in scales:
            pixels, ids, mask = batch(3)
            with guard.watch(mask):
                model(pixels, ids, mask)
            read = torch.cat([model.vision(pixels).mT, model.text.words(ids)], 1)
            first, last = model.text.layers
            # Like an expert that reads only the last layer's keys and values.
            loss = scale * last.qkv(last.norm1(first(read, ~mask))).square().mean()
            guard.backward(loss)
        grads.append([p.grad for p in model.parameters()])
    for alone, summed in zip(*grads, strict=True):
        assert (alone is None) == (summed is None)
    assert any(gradient is None for gradient in grads[0])


def clear_past_the_count(model: nn.Module) -> None:
    """Write zeros in a way that PyTorch's version counter does not see."""
    for parameter in model.parameters():
        if parameter.grad is not None:
            parameter.grad.data.zero_()


@pytest.mark.parametrize(
    "clear",
    [
        lambda model: model.zero_grad(set_to_none=True),
        lambda model: model.zero_grad(set_to_none=False),
        clear_past_the_count,
    ],
)
def test_zero_grad_begins_a_new_row(clear: Callable[[nn.Module], None], anchor: Path) -> None:
    models = make(), make()
    for model, steps in zip(models, ([3], [0, 3]), strict=True):
        guard = Guard(model, anchor, LAYERS)
        for seed in steps:
            clear(model)
            with guard.watch(batch(seed)[2]):
                loss = task_loss(model, seed)
            guard.backward(loss)
        assert guard.ledger.tensors()["step"].tolist() == list(range(1, len(steps) + 1))
    for ours, theirs in zip(*(m.parameters() for m in models), strict=True):
        assert (ours.grad is None) == (theirs.grad is None) or not (
            ours.grad if theirs.grad is None else theirs.grad
        ).any()
        if ours.grad is not None and theirs.grad is not None:
            assert torch.equal(ours.grad, theirs.grad)


@pytest.mark.parametrize("method", ["aegis", "nullspace"])
def test_no_graph_outlives_its_step(method: str, anchor: Path) -> None:
    model = make()
    guard = Guard(model, anchor, LAYERS, method=method, vision="vision")
    made, kept = outputs_kept(lambda: guarded_steps(model, guard))
    assert made > 0 and kept == 0


def test_cleared_gradients_are_not_kept_through_the_next_forward_pass(anchor: Path) -> None:
    model = make()
    guard = Guard(model, anchor, LAYERS)
    with guard.watch(batch(0)[2]):
        loss = task_loss(model, 0)
    guard.backward(loss)
    kept = weakref.ref(model.text.words.weight.grad)
    model.zero_grad()
    assert kept() is not None  # the sum might have continued
    with guard.watch(batch(0)[2]):
        assert kept() is None
        task_loss(model, 0)


def test_a_gradient_that_lay_there_before_is_part_of_the_sum(anchor: Path) -> None:
    """Another loss goes backward first: the result is the guard's backward of both losses."""
    first, both = make(), make()
    for model in (first, both):
        guard, other = (
            Guard(model, anchor, LAYERS),
            sum(p.square().sum() for p in model.parameters()),
        )
        if model is first:
            other.backward()
        with guard.watch(batch(1)[2]):
            loss = task_loss(model, 1)
        guard.backward(loss if model is first else loss + other)
    for ours, theirs in zip(first.parameters(), both.parameters(), strict=True):
        torch.testing.assert_close(ours.grad, theirs.grad, rtol=1e-10, atol=1e-12)


# --- precision, checkpointing, compiled parts -----------------------------------------------------


def trained(
    anchor: Path, change: Callable[[nn.Module], object] = lambda model: None
) -> tuple[Tensor, dict[str, Tensor]]:
    model = make()
    change(model)
    guard = Guard(model, anchor, LAYERS)
    guarded_steps(model, guard)
    return vector(model), guard.ledger.tensors()


def test_checkpointed_layers_change_nothing(anchor: Path) -> None:
    plain, rows = trained(anchor)
    saved, saved_rows = trained(
        anchor, lambda model: setattr(model, "around", through_checkpoint(reentrant=False))
    )
    assert torch.equal(plain, saved) and all(
        torch.equal(rows[name], saved_rows[name]) for name in rows
    )


@pytest.mark.parametrize("inside", [True, False])
def test_reentrant_checkpoints_are_refused_before_anything_is_written(
    inside: bool, anchor: Path
) -> None:
    model = make()
    if inside:
        model.around = through_checkpoint(reentrant=True)
    else:  # only part of each layer
        for layer in model.text.layers:
            layer.up.forward = through_reentrant(layer.up.forward)  # type: ignore[method-assign]
    guard = Guard(model, anchor, LAYERS)
    with pytest.raises(AegisError, match="use_reentrant=True"):
        with guard.watch(batch(0)[2]):
            loss = task_loss(model, 0)
        guard.backward(loss)
    assert all(p.grad is None for p in model.parameters())


def test_layers_that_run_without_a_graph_are_refused(anchor: Path) -> None:
    model = make()
    upper = model.text.layers[1]
    model.around = lambda layer, *inputs: (
        torch.no_grad()(layer)(*inputs) if layer is upper else layer(*inputs)
    )
    with (
        pytest.raises(AegisError, match="'text.layers.1' runs without a graph") as caught,
        Guard(model, anchor, LAYERS).watch(None),
    ):
        task_loss(model, 0)
    assert "layer.requires_grad_(False)" in caught.value.fix  # frozen layers are fine


def through_reentrant(forward: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    return lambda x: torch.utils.checkpoint.checkpoint(forward, x, use_reentrant=True)


@compiling
@pytest.mark.parametrize("how", ["wrapped", "in place"])
def test_compiled_layers_change_nothing(how: str, anchor: Path) -> None:
    def compile_layers(model: nn.Module) -> None:
        for i, layer in enumerate(model.text.layers):
            if how == "wrapped":
                model.text.layers[i] = torch.compile(layer, backend="aot_eager")
            else:
                layer.compile(backend="aot_eager")

    torch._dynamo.reset()
    try:
        found, rows = trained(anchor, compile_layers)
    finally:
        torch._dynamo.reset()
    plain, plain_rows = trained(anchor)
    torch.testing.assert_close(found, plain, rtol=1e-9, atol=1e-10)
    torch.testing.assert_close(rows["ta"], plain_rows["ta"], rtol=1e-6, atol=1e-9)


@compiling
def test_layers_compiled_and_used_before_walk_their_graph_twice(anchor: Path) -> None:
    """A plain backward pass has compiled a graph that frees its memory."""
    import torch._functorch.config as config

    def compile_and_use(model: nn.Module) -> None:
        model.text.layers[0] = torch.compile(model.text.layers[0], backend="aot_eager")
        task_loss(model, 0).backward()
        model.zero_grad()

    torch._dynamo.reset()
    try:
        with config.patch(donated_buffer=True):
            found, rows = trained(anchor, compile_and_use)
            assert not config.donated_buffer
    finally:
        torch._dynamo.reset()
    plain, _ = trained(anchor)
    torch.testing.assert_close(found, plain, rtol=1e-9, atol=1e-10)
    assert len(rows["step"]) == 3


@compiling
def test_a_model_that_was_compiled_and_used_before_is_seen_by_a_later_guard(anchor: Path) -> None:
    """Compiled code knows only the hooks that existed when it was compiled."""
    import torch._functorch.config as config

    def compile_and_use(model: nn.Module) -> None:
        model.compile(backend="aot_eager")
        task_loss(model, 0).backward()
        model.zero_grad()

    torch._dynamo.reset()
    try:
        with config.patch(donated_buffer=False):  # as an earlier guard leaves it
            found, rows = trained(anchor, compile_and_use)
    finally:
        torch._dynamo.reset()
    plain, _ = trained(anchor)
    torch.testing.assert_close(found, plain, rtol=1e-9, atol=1e-10)
    assert len(rows["step"]) == 3


@pytest.mark.parametrize("scale", [2.0**8, 2.0**-3])
def test_a_scaler_changes_nothing_but_the_scale(scale: float, anchor: Path) -> None:
    """There are two micro-batches per step, which is unscaled and clipped."""
    found = []
    for scaler in (None, torch.amp.GradScaler("cpu", init_scale=scale)):
        model = make()
        guard, optimizer = Guard(model, anchor, LAYERS, projects="both", restoration=0.1), None
        optimizer = torch.optim.AdamW(model.parameters(), lr=1e-2)
        for seed in range(6):
            with guard.watch(batch(seed)[2]):
                loss = task_loss(model, seed)
            guard.backward(loss, scaler)
            if seed % 2:
                if scaler is not None:
                    scaler.unscale_(optimizer)
                nn.utils.clip_grad_norm_(model.parameters(), 0.5)
                guard.step(optimizer, scaler)
                if scaler is not None:
                    scaler.update()
                optimizer.zero_grad()
        found.append((vector(model), guard.ledger.tensors()))
    (plain, rows), (scaled, scaled_rows) = found
    torch.testing.assert_close(scaled, plain, rtol=1e-10, atol=1e-12)
    assert all(
        torch.allclose(rows[name], scaled_rows[name], rtol=1e-9, atol=1e-14) for name in rows
    )
    assert len(rows["step"]) == 3


@pytest.mark.parametrize("at", ["task", "anchor"])
def test_a_scaler_skips_the_step_of_an_overflow(at: str, anchor: Path) -> None:
    """This holds even if only the anchor gradient overflows, in a group that is not projected."""
    model = make()
    guard, scaler = Guard(model, anchor, LAYERS), torch.amp.GradScaler("cpu", init_scale=4.0)
    optimizer, before = torch.optim.AdamW(model.parameters(), lr=1e-2), vector(model)
    with guard.watch(batch(0)[2]):
        loss = task_loss(model, 0)
    if at == "task":
        loss = loss * torch.inf
    else:
        model.text.layers[0].up.bias.register_hook(overflow_in_agreement())
    guard.backward(loss, scaler)
    guard.step(optimizer, scaler)
    scaler.update()
    assert (
        torch.equal(vector(model), before) and scaler.get_scale() == 2.0 and len(guard.ledger) == 0
    )
    optimizer.zero_grad()
    with guard.watch(batch(0)[2]):
        loss = task_loss(model, 0)
    guard.backward(loss, scaler)
    guard.step(optimizer, scaler)
    assert not torch.equal(vector(model), before) and len(guard.ledger) == 1


@pytest.mark.parametrize("is_automatic", [False, True])
def test_after_an_overflow_an_optimizer_that_clears_less_than_what_learns_is_refused(
    is_automatic: bool, anchor: Path
) -> None:
    """The infinities that it leaves would cause every later step to be skipped."""
    model = make()
    guard, scaler = Guard(model, anchor, LAYERS), torch.amp.GradScaler("cpu", init_scale=4.0)
    if is_automatic:
        guard.automatic(mask="mask", scaler=scaler)
    optimizer = torch.optim.AdamW(model.text.parameters(), lr=1e-2)
    before = vector(model)
    scaled_step(model, guard, optimizer, scaler, torch.inf)
    with pytest.raises(AegisError, match=r"(?s)of which 27 were cleared.*model\.zero_grad"):
        scaled_step(model, guard, optimizer, scaler)
    assert torch.equal(vector(model), before)
    guard.discard()
    model.zero_grad()
    scaled_step(model, guard, optimizer, scaler)
    assert not torch.equal(vector(model), before) and len(guard.ledger) == 1


def step_with_an_overflow_outside(
    guard: Guard, optimizer: torch.optim.Optimizer, outside: nn.Parameter, by_guard: bool, bad: bool
) -> None:
    """One step with a new scaler, which skips it if a gradient outside overflows."""
    scaler = torch.amp.GradScaler("cpu", init_scale=4.0)
    with guard.watch(batch(0)[2]):
        loss = task_loss(guard._model, 0)
    guard.backward(loss, scaler)
    outside.grad = torch.full_like(outside, torch.inf if bad else 0.0)
    if by_guard:
        guard.step(optimizer, scaler)
    else:
        scaler.step(optimizer)
    scaler.update()
    optimizer.zero_grad()


@pytest.mark.parametrize("by_guard", [True, False])
@pytest.mark.parametrize("kind", [{}, {"foreach": True}, {"fused": True}])
def test_a_step_that_is_skipped_for_others_gradients_has_no_row(
    kind: dict[str, bool], by_guard: bool, tmp_path: Path
) -> None:
    """An action expert's overflow skips the VLM's step too, though its gradients were finite."""
    model, outside = make(dtype=torch.float32), nn.Parameter(torch.zeros(2))
    path = measured(make(dtype=torch.float32), tmp_path / "anchor.safetensors")
    guard = Guard(model, path, LAYERS)
    optimizer = torch.optim.AdamW([*model.parameters(), outside], **kind)
    for bad in (True, False, True, False, True):
        step_with_an_overflow_outside(guard, optimizer, outside, by_guard, bad)
    guard.remove()
    assert guard.ledger.tensors()["step"].tolist() == [2, 4]


def test_a_batch_that_is_left_out_after_its_backward_pass_has_no_row(anchor: Path) -> None:
    model = make()
    guard = Guard(model, anchor, LAYERS)
    optimizer = torch.optim.SGD(model.parameters(), lr=0.01)
    for number in range(4):
        with guard.watch(batch(number)[2]):
            loss = task_loss(model, number)
        guard.backward(loss)
        if number != 2:
            optimizer.step()
        optimizer.zero_grad()
    assert guard.ledger.tensors()["step"].tolist() == [1, 2, 4]


class NotTorchs:
    """An optimizer that is not PyTorch's, and writes without changing PyTorch's version counter."""

    def __init__(self, model: nn.Module) -> None:
        self._model = model

    def step(self) -> None:
        for parameter in self._model.parameters():
            parameter.data.sub_(0.01 * parameter.grad)


def test_steps_of_an_optimizer_that_tells_nothing_have_their_rows(anchor: Path) -> None:
    model = make()
    guard, optimizer = Guard(model, anchor, LAYERS), NotTorchs(model)
    for number in range(3):
        with guard.watch(batch(number)[2]):
            loss = task_loss(model, number)
        guard.backward(loss)
        guard.step(optimizer)
        model.zero_grad()
    guard.remove()
    assert len(guard.ledger) == 3


def test_only_the_projected_gradient_overflows(tmp_path: Path) -> None:
    """In float16, a combination of two finite gradients may not be finite."""
    model = make(dtype=torch.float16)
    guard = Guard(model, measured(model, tmp_path / "anchor.safetensors"), LAYERS)
    combine = guard._parts.combine

    def large(*gram: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        of_task, of_anchor = combine(*gram)
        return of_task * 1e9, of_anchor

    guard._dual._parts = dataclasses.replace(guard._parts, combine=large)
    optimizer = torch.optim.AdamW(model.parameters(), fused=True)
    before, scaler = vector(model), torch.amp.GradScaler("cpu", init_scale=4.0)
    for given in (scaler, None):
        with guard.watch(batch(0)[2]):
            loss = task_loss(model, 0)
        if given is None:
            with pytest.raises(Diverged):
                guard.backward(loss)
        else:
            guard.backward(loss, scaler)
            guard.step(optimizer, scaler)
            scaler.update()
            optimizer.zero_grad()
    assert len(guard.ledger) == 0 and torch.equal(vector(model), before)
    assert scaler.get_scale() == 2.0


class AsksItsScaler(torch.optim.AdamW):
    """An optimizer with the older interface: its step receives the scaler and asks it."""

    def __init__(self, parameters: Any, **settings: Any) -> None:
        super().__init__(parameters, **settings)
        self._step_supports_amp_scaling = True

    def step(self, closure: Any = None, *, grad_scaler: Any = None) -> Any:
        grad_scaler.unscale_(self)
        if any(map(bool, grad_scaler._found_inf_per_device(self).values())):
            return None
        return super().step(closure)


@pytest.mark.filterwarnings("ignore:GradScaler is going to stop passing itself:FutureWarning")
@pytest.mark.parametrize("automatic", [True, False])
def test_an_optimizer_that_asks_its_scaler_skips_the_step_too(
    automatic: bool, anchor: Path
) -> None:
    """Its step is neither constrained nor counted."""
    model = make()
    guard = Guard(model, anchor, method="nullspace", vision="vision", every=2)
    optimizer = AsksItsScaler(model.parameters(), lr=0.01)
    scaler = torch.amp.GradScaler("cpu", init_scale=4.0)
    if automatic:
        guard.automatic(scaler=scaler)
    pending = []
    for factor in (1.0, torch.inf, 1.0, torch.inf, 1.0):
        before = vector(model)
        scaled_step(model, guard, optimizer, scaler, factor)
        optimizer.zero_grad()
        pending.append(guard.pending)
        assert torch.equal(before, vector(model)) == (factor == torch.inf)
    assert pending == [1, 1, 0, 0, 1]


def scaled_step(
    model: nn.Module,
    guard: Guard,
    optimizer: torch.optim.Optimizer,
    scaler: torch.amp.GradScaler,
    factor: float = 1.0,
) -> None:
    """One step of a loop with a scaler, which calls the guard unless that is automatic."""
    if guard.is_automatic:
        scaler.scale(task_loss(model, 0) * factor).backward()
        scaler.step(optimizer)
    else:
        with guard.watch(batch(0)[2]):
            loss = task_loss(model, 0) * factor
        guard.backward(loss, scaler)
        guard.step(optimizer, scaler)
    scaler.update()
    optimizer.zero_grad()


def test_after_an_overflow_what_the_task_does_not_reach_has_no_gradient(tmp_path: Path) -> None:
    """So if the optimizer does not have it, training continues as if nothing had overflowed."""
    model = make()
    model.spare = nn.Linear(3, 3).double()
    used = [p for name, p in model.named_parameters() if not name.startswith("spare")]
    path = measured(model, tmp_path / "anchor.safetensors", parts=("moments",))
    guard, scaler = Guard(model, path, LAYERS), torch.amp.GradScaler("cpu", init_scale=4.0)
    optimizer, before = torch.optim.AdamW(used, lr=1e-2), vector(model)
    scaled_step(model, guard, optimizer, scaler, torch.inf)
    assert model.spare.weight.grad is None and torch.equal(vector(model), before)
    scaled_step(model, guard, optimizer, scaler)
    assert not torch.equal(vector(model), before) and scaler.get_scale() == 2.0


def overflow_in_agreement() -> Callable[[Tensor], Tensor | None]:
    """Makes the first anchor gradient infinite in the task gradient's direction.

    Without a conflict nothing is projected.
    """
    task: list[Tensor] = []

    def hook(gradient: Tensor) -> Tensor | None:
        task.append(gradient)
        return task[0].sign() * torch.inf if len(task) == 2 else None

    return hook


@pytest.mark.parametrize("at", ["loss", "gradient"])
@pytest.mark.parametrize("method", ["aegis", "nullspace"])
def test_without_a_scaler_what_is_not_finite_is_refused(method: str, at: str, anchor: Path) -> None:
    model = make()
    with Guard(model, anchor, LAYERS, method=method, vision="vision") as guard:
        guarded_steps(model, guard, steps=2)
        with guard.watch(batch(0)[2]):
            loss = task_loss(model, 0) * (torch.nan if at == "loss" else 1)
        if at == "gradient":
            model.text.layers[0].up.bias.register_hook(lambda gradient: gradient * torch.nan)
        with pytest.raises(Diverged, match="not finite"):
            guard.backward(loss)


def test_autocast_reaches_the_forward_pass_alone(anchor: Path) -> None:
    """Products are in bf16 and the penalty in float32, whether the backward is inside or outside.

    The inner products are close to those in float32.
    """
    float32 = measured(make(dtype=torch.float32), anchor.with_name("float32.safetensors"))
    rows = []
    for precision, inside in (("float32", False), ("bf16", False), ("bf16", True)):
        model = make(dtype=torch.float32)
        guard, half = Guard(model, float32, LAYERS), precision == "bf16"
        with torch.autocast("cpu", torch.bfloat16, enabled=half), guard.watch(batch(0)[2]):
            loss = task_loss(model, 0)
        with torch.autocast("cpu", torch.bfloat16, enabled=half and inside):
            guard.backward(loss)
        assert all(p.grad is None or p.grad.dtype == torch.float32 for p in model.parameters())
        rows.append(guard.ledger.tensors())
    assert torch.allclose(rows[0]["tt"], rows[1]["tt"], rtol=0.1) and torch.allclose(
        rows[0]["w2"], rows[1]["w2"], rtol=0.1
    )
    assert not torch.equal(rows[0]["tt"], rows[1]["tt"])
    assert torch.equal(rows[1]["ta"], rows[2]["ta"]) and torch.equal(rows[1]["w2"], rows[2]["w2"])


def test_half_precision_weights_meet_the_anchor_in_float32(tmp_path: Path) -> None:
    model = make(dtype=torch.bfloat16)
    path = measured(model, tmp_path / "anchor.safetensors", parts=("moments",))
    guard, seen = Guard(model, path, LAYERS), []
    model.text.layers[0].register_forward_hook(
        lambda m, i, o: seen.append(o.detach()[batch(0)[2]].double())
    )
    with guard.watch(batch(0)[2]):
        loss = task_loss(model, 0)
    guard.backward(loss)
    read = read_anchor(path)
    moments, rows = merge(read.image[0], read.text[0]), seen[0]
    wanted = (rows.mean(0) - moments.mean).square().sum() + (
        rows.std(0, correction=0) - moments.var.sqrt()
    ).square().sum()
    torch.testing.assert_close(guard.ledger.tensors()["w2"][0, 0], wanted, rtol=1e-5, atol=0)
    assert all(p.grad is None or p.grad.dtype == torch.bfloat16 for p in model.parameters())


# --- what learns, and what is watched -------------------------------------------------------------


def test_frozen_parts_stay_frozen(anchor: Path) -> None:
    model = make()
    model.vision.requires_grad_(False)
    model.text.layers[0].requires_grad_(False)
    guard = Guard(model, anchor, LAYERS, projects="both")
    frozen, free = vector(model.vision), vector(model.text.layers[1])
    guarded_steps(model, guard, weight_decay=0.3)
    assert torch.equal(vector(model.vision), frozen) and not torch.equal(
        vector(model.text.layers[1]), free
    )


def test_the_ledger_lists_what_learns_and_inspect_says_what_does_not(
    anchor: Path, tmp_path: Path
) -> None:
    model = make()
    model.vision.requires_grad_(False)
    model.text.layers[0].requires_grad_(False)
    guard = Guard(model, anchor, LAYERS)
    guarded_steps(model, guard)
    rows = guard.ledger.tensors()
    assert guard.ledger.groups == ("layers.1", "embeddings", "text.norm")
    assert guard.ledger.layers == ("layers.0", "layers.1")
    assert rows["tt"].all() and rows["aa"][:, 0].all() and rows["w2"].all()
    guard.ledger.save(tmp_path / "ledger.safetensors")
    report = inspection.run(tmp_path / "ledger.safetensors")
    assert [layer.name for layer in report.layers] == list(guard.ledger.groups)
    assert report.frozen == ("layers.0",)


class Averaged(nn.Linear):
    """Divides by a mean that it maintains itself, as BatchNorm does."""

    def __init__(self, width: int) -> None:
        super().__init__(width, width)
        self.register_buffer("seen", torch.ones(()))
        self.register_buffer("last", torch.ones(()), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        if self.training:
            self.seen = 0.9 * self.seen + 0.1 * x.detach().abs().mean()
        self.last = x.detach().mean()
        return super().forward(x / self.seen)


@pytest.mark.parametrize("training", [False, True])
def test_buffers_that_training_passes_change_are_told_once(training: bool, tmp_path: Path) -> None:
    """Only the buffers that a checkpoint has, and only if they change."""
    model = make()
    model.text.norm = nn.Sequential(model.text.norm, Averaged(16).double())
    guard = Guard(model, measured(model, tmp_path / "anchor.safetensors"), LAYERS)
    model.train(training)
    if training:
        with pytest.warns(UserWarning, match=r"buffers of 'text\.norm\.1', as BatchNorm"):
            guarded_steps(model, guard)
    guarded_steps(model, guard)


def test_what_lies_outside_the_model_is_left_to_the_task(anchor: Path) -> None:
    """The anchor gradient never reaches an action head, whatever the guard is told."""
    model, head = make(), nn.Linear(WIDTH := 23, 2).double()
    guard = Guard(model, anchor, LAYERS)
    with guard.watch(batch(0)[2]):
        said = model(*batch(0))
        loss = head(said).square().mean()
    wanted = torch.autograd.grad(loss, list(head.parameters()), retain_graph=True)
    guard.backward(loss)
    assert said.shape[-1] == WIDTH and all(
        torch.equal(p.grad, g) for p, g in zip(head.parameters(), wanted, strict=True)
    )


def test_only_watched_passes_count(anchor: Path) -> None:
    plain, rows = trained(anchor)
    model = make()
    guard = Guard(model, anchor, LAYERS)
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-2)
    for seed in range(3):
        with guard.watch(batch(seed)[2]):
            loss = task_loss(model, seed)
        task_loss(model, seed + 50)  # a training pass without a watch
        guard.backward(loss)
        optimizer.step()  # nothing constrains the update, so the guard's step would be the same
        optimizer.zero_grad()
        with torch.no_grad():
            task_loss(model, seed + 70)
        with guard.watch(batch(seed)[2]):
            task_loss(model, seed + 90)
        guard.discard()
    assert torch.equal(vector(model), plain) and torch.equal(
        guard.ledger.tensors()["ta"], rows["ta"]
    )


def test_padding_never_counts_and_no_mask_is_every_token(anchor: Path) -> None:
    """Values at a padded token change nothing; without a mask they do."""
    found = []
    for masked, noise in ((True, 0.0), (True, 5.0), (False, 0.0), (False, 5.0)):
        model = make()
        guard = Guard(model, anchor, LAYERS)
        pixels, ids, mask = batch(0)
        disturb = model.text.words.register_forward_hook(
            lambda m, i, o, n=noise: o + n * (i[0] == 0)[..., None]
        )
        with guard.watch(mask if masked else None):
            loss = model(pixels, ids, mask)[mask].square().mean()
        disturb.remove()
        guard.backward(loss)
        found.append(guard.ledger.tensors()["w2"])
    torch.testing.assert_close(found[0], found[1], rtol=1e-10, atol=0)
    assert not torch.allclose(found[2], found[3], rtol=1e-3) and not torch.allclose(
        found[0], found[2], rtol=1e-3
    )


def test_masks_of_any_dtype_and_order_of_calls(anchor: Path) -> None:
    """Image and text that go through the layers in turn are tokens in the order of the calls."""
    w2 = []
    for mask in (batch(0)[2], batch(0)[2].long(), batch(0)[2].float()):
        model = make()
        guard = Guard(model, anchor, LAYERS)
        with guard.watch(mask):
            loss = task_loss(model, 0)
        guard.backward(loss)
        w2.append(guard.ledger.tensors()["w2"])
    assert torch.equal(w2[0], w2[1]) and torch.equal(w2[0], w2[2])
    model, seen = make(), []
    guard = Guard(model, anchor, LAYERS)
    pixels, ids, mask = batch(0)
    with guard.watch(mask):
        for x, hidden in (
            (model.vision(pixels).mT, ~mask[:, :PATCHES]),
            (model.text.words(ids), ~mask[:, PATCHES:]),
        ):
            for layer in model.text.layers:
                x = layer(x, hidden)
            seen.append(x)
    guard.backward(seen[1].square().mean())
    last = read_anchor(anchor)
    moments, rows = merge(last.image[1], last.text[1]), torch.cat(seen, 1)[mask].detach()
    wanted = (rows.mean(0) - moments.mean).square().sum() + (
        rows.std(0, correction=0) - moments.var.sqrt()
    ).square().sum()
    torch.testing.assert_close(guard.ledger.tensors()["w2"][0, 1], wanted)
    assert mask.shape[1] == PATCHES + TEXT == len(IMAGE)


def test_hooks_go_and_copies_stand_alone(anchor: Path) -> None:
    model = make()
    with Guard(model, anchor, LAYERS, projects="update") as guard:
        guarded_steps(model, guard, steps=1)
        other = copy.deepcopy(model)
        assert torch.equal(task_loss(other, 0), task_loss(model, 0))
        assert sum(len(m._forward_hooks) for m in model.modules()) == 2
    assert sum(len(m._forward_hooks) + len(m._forward_pre_hooks) for m in model.modules()) == 0
    optimizer = torch.optim.SGD(model.parameters(), lr=0.1)
    optimizer.step()  # nothing is guarded any longer
    with pytest.raises(AegisError, match="removed"):
        guard.backward(task_loss(model, 0))


def test_the_ledger_is_a_file_that_inspect_reads(anchor: Path, tmp_path: Path) -> None:
    model = make()
    guard = Guard(model, anchor, LAYERS)
    guarded_steps(model, guard)
    guard.ledger.save(tmp_path / "ledger.safetensors")
    report = inspection.run(tmp_path / "ledger.safetensors")
    assert report.kind == "ledger" and report.facts["method"] == "aegis"
    assert [layer.name for layer in report.layers] == [
        "layers.0",
        "layers.1",
        "vision",
        "embeddings",
        "text.norm",
    ]
    assert report.energy_shed_mean is not None and 0 < report.energy_shed_mean < 1
