"""A step reads no number from its device; its figures are read once for many steps.

There is no GPU here, so these tests treat the CPU as a device for which one must wait.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.training_runs import SETTINGS, Start, metrics, stop_at
from torch import Tensor

from aegis_cli.common import artifacts, devices, prefetch
from aegis_cli.common.errors import Diverged
from aegis_cli.core import projection, stacking
from aegis_cli.core.moments import (
    batch_moments,
    joint_moments,
    padded_moments,
    shared_moments,
)
from aegis_cli.methods import METHODS, distill, kfac
from aegis_cli.recipes import Aegis, Recipe
from aegis_cli.recipes.policy import Ewc, Kfac
from aegis_cli.training import assemble, step, train
from aegis_cli.training.step_figures import UnreadFigures

LATER = replace(SETTINGS, log_every=3, validate_every=6, checkpoint_every=6)
READS = ("item", "tolist", "cpu", "numpy", "nonzero", "__bool__", "__int__", "__float__")


@pytest.fixture
def waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "reading_stalls", lambda _: True)


@contextmanager
def counted() -> Iterator[Counter[str]]:
    """How often a number of a tensor is read in the block."""
    found: Counter[str] = Counter()
    with pytest.MonkeyPatch.context() as patch:
        for name in READS:
            real = getattr(Tensor, name)

            def read(self: Tensor, *rest: object, name: str = name, real: object = real) -> object:
                found[name] += 1
                return real(self, *rest)  # type: ignore[operator]

            patch.setattr(Tensor, name, read)
        yield found


def begun(
    recipe: Recipe,
    method: str,
    demos: Path,
    anchor: Path,
    out: Path,
    decay: float | None = None,
) -> assemble.TrainingRun:
    chosen = replace(recipe, train=replace(LATER, method=method, ema_decay=decay))
    return assemble.build(chosen, METHODS[method], demos, anchor, out, lambda _: None)


def prepared_batch(run: assemble.TrainingRun) -> step.RobotBatch:
    """What the prefetching thread passes to a step."""
    batch = run.demos.batch(run.demos.train[:4], run.recipe.train.chunk)
    size = len(batch), int((~batch.is_pad).sum())
    prepare = run.parts.prepare
    return step.with_prepared(batch, size, run.policy.backbone, run.ranks, 1, by_method=prepare)


@pytest.mark.parametrize("method", sorted(METHODS))
def test_steps_between_two_lines_read_no_number(
    method: str, recipe: Recipe, demos_file: Path, anchor_file: Path, tmp_path: Path, waits: None
) -> None:
    if method == "aegis":
        recipe = replace(recipe, aegis=Aegis(idle="kept"))
    run = begun(recipe, method, demos_file, anchor_file, tmp_path, decay=0.6)
    run.policy.train()
    batch, window = prepared_batch(run), train.Window()
    with counted() as found:
        for index in range(5):
            train.update(run, index, batch, window)
    assert not found and len(run.unread) == 5
    train.read_figures(run, window)
    assert len(run.unread) == 0 and window.loss > 0
    assert len(run.ledger) == (5 if METHODS[method].compares_layers else 0)


@pytest.mark.parametrize("refresh", [1, 2])
def test_no_frame_is_prepared_within_a_step(
    refresh: int,
    recipe: Recipe,
    demos_file: Path,
    anchor_file: Path,
    tmp_path: Path,
    waits: None,
) -> None:
    """Neither is the share of frames for the anchor gradient."""
    chosen = replace(recipe, aegis=Aegis(fraction=0.5, refresh=refresh))
    run = begun(chosen, "aegis", demos_file, anchor_file, tmp_path)
    run.policy.train()
    fetch = train._fetching(run)
    batches = [fetch(index) for index in range(2)]
    parts = [batch.prepared[0].anchor_inputs for batch in batches]
    assert [part is not None for part in parts] == [True, refresh == 1]
    assert len(parts[0].ids) == -(-len(batches[0]) // 2)
    found = []
    for ahead in (True, False):
        run, window = begun(chosen, "aegis", demos_file, anchor_file, tmp_path), train.Window()
        run.policy.train()
        with pytest.MonkeyPatch.context() as patch:
            if ahead:
                patch.setattr(type(run.policy.backbone), "process", None)
            for index, batch in enumerate(batches):
                bare = replace(batch, prepared=())
                train.update(run, index, batch if ahead else bare, window)
        train.read_figures(run, window)
        found.append((window.loss, run.ledger.tensors()["w2"].tolist()))
    assert found[0] == found[1]


def test_what_the_task_leaves_alone_is_moved_by_a_weight_that_is_read(
    recipe: Recipe, demos_file: Path, anchor_file: Path, tmp_path: Path, waits: None
) -> None:
    run = begun(recipe, "aegis", demos_file, anchor_file, tmp_path)
    run.policy.train()
    batch, window = prepared_batch(run), train.Window()
    with counted() as found:
        train.update(run, 0, batch, window)
    assert found == {"tolist": 1}


def test_the_same_reads_are_seen_where_nobody_waits(
    recipe: Recipe, demos_file: Path, anchor_file: Path, tmp_path: Path
) -> None:
    run = begun(recipe, "aegis", demos_file, anchor_file, tmp_path)
    run.policy.train()
    with counted() as found:
        train.update(run, 0, prepared_batch(run), train.Window())
    assert found["nonzero"] and found["tolist"] and found["__float__"]


def treat_each_map_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Products of stacked maps round differently, and this test compares bytes."""
    monkeypatch.setattr(stacking, "groups", lambda sites, *_: [[site] for site in sites])


@pytest.mark.parametrize("method", ["naive", "aegis", "nullspace", "kfac", "maps", "distill"])
def test_a_run_that_reads_late_ends_as_one_that_reads_at_once(
    method: str, recipe: Recipe, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = replace(recipe, train=LATER)
    start(method, tmp_path / "at-once", recipe=chosen)
    monkeypatch.setattr(devices, "reading_stalls", lambda _: True)
    if method == "nullspace":
        treat_each_map_alone(monkeypatch)
    start(method, tmp_path / "late", recipe=chosen)
    one, other = (metrics(tmp_path / name) for name in ("at-once", "late"))
    assert [line["step"] for line in one] == [line["step"] for line in other] == [3, 6]
    for before, after in zip(one, other, strict=True):
        for name in ("loss", *({"energy_shed", "validation_loss"} & before.keys())):
            assert after[name] == pytest.approx(before[name], rel=2e-4), name
    rows = [
        artifacts.load(tmp_path / name / train.LEDGER, "ledger").tensors
        for name in ("at-once", "late")
    ]
    assert rows[0]["step"].tolist() == rows[1]["step"].tolist()
    torch.testing.assert_close(rows[1]["w2"], rows[0]["w2"], rtol=1e-4, atol=1e-6)
    if method in ("naive", "nullspace"):
        weights = [
            artifacts.load(tmp_path / name / "checkpoints/last/training_state/state.safetensors")
            for name in ("at-once", "late")
        ]
        for name, tensor in weights[0].tensors.items():
            assert torch.equal(tensor, weights[1].tensors[name]), name


def test_batches_that_several_threads_prepare_are_those_of_one(
    recipe: Recipe,
    demos_file: Path,
    anchor_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    waits: None,
) -> None:
    run, found = begun(recipe, "naive", demos_file, anchor_file, tmp_path), {}
    for workers in (1, 3):
        monkeypatch.setattr(prefetch, "workers", lambda workers=workers: workers)
        with train.batches_of(run, range(1, 12)) as batches:
            found[workers] = list(batches)
    assert len(found[1]) == len(found[3]) == 11
    for one, other in zip(found[1], found[3], strict=True):
        assert one.instructions == other.instructions and one.of_step == other.of_step
        ((one_part,), (other_part,)) = one.prepared, other.prepared
        assert torch.equal(one.actions, other.actions)
        assert torch.equal(one_part.inputs.pixels, other_part.inputs.pixels)
        assert torch.equal(one_part.inputs.ids, other_part.inputs.ids)


def test_a_run_goes_on_with_another_number_of_threads_to_the_same_weights(
    recipe: Recipe, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, waits: None
) -> None:
    started: list[int] = []

    class Counted(ThreadPoolExecutor):
        def __init__(self, workers: int, *rest: object, **named: Any) -> None:
            super().__init__(workers, *rest, **named)
            started.append(workers)

    monkeypatch.setattr(prefetch, "ThreadPoolExecutor", Counted)

    def of(workers: int) -> Recipe:
        return replace(recipe, train=replace(LATER, checkpoint_every=2, workers=workers))

    start("naive", tmp_path / "whole", recipe=of(5))
    assert max(started) == 5
    started.clear()
    with pytest.raises(KeyboardInterrupt):
        stop = stop_at(3, KeyboardInterrupt())
        start("naive", tmp_path / "resumed", recipe=of(1), on_event=stop)
    assert max(started) == 1
    start("naive", tmp_path / "resumed", recipe=of(7), resume=True)
    assert max(started) == 7
    whole, resumed = (
        artifacts.load(
            tmp_path / name / "checkpoints/last/training_state/state.safetensors"
        ).tensors
        for name in ("whole", "resumed")
    )
    for name, tensor in whole.items():
        assert torch.equal(tensor, resumed[name]), name


@pytest.mark.parametrize("decay", [None, 0.6])
@pytest.mark.parametrize(
    ("method", "options"),
    [
        ("naive", {}),
        ("nullspace", {}),
        ("kfac", {"kfac": Kfac(every=2, growth=1.0)}),
        ("kfac", {"kfac": Kfac(every=3)}),
        ("ewc", {"ewc": Ewc(step="proximal")}),
    ],
    ids=["naive", "nullspace", "kfac-begun", "kfac-whole", "ewc"],
)
def test_a_step_that_is_not_finite_moves_nothing_however_late_it_is_read(
    method: str,
    options: dict[str, Any],
    decay: float | None,
    recipe: Recipe,
    start: Start,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Neither weights nor average move, though a constraint may cover that step and others."""
    real = step.compute_gradients

    def broken(*rest: object, index: int, **named: object) -> step.StepGradients:
        found = real(*rest, index=index, **named)  # type: ignore[arg-type]
        return replace(found, loss=found.loss * math.nan) if index == 3 else found

    monkeypatch.setattr(step, "compute_gradients", broken)
    treat_each_map_alone(monkeypatch)
    chosen = replace(recipe, train=replace(LATER, log_every=6, ema_decay=decay), **options)
    ends = {}
    for name in ("at-once", "late"):
        if name == "late":
            monkeypatch.setattr(devices, "reading_stalls", lambda _: True)
        with pytest.raises(Diverged, match="at step 4") as caught:
            start(method, tmp_path / name, recipe=chosen)
        assert caught.value.good_steps == 3
        last = tmp_path / name / "checkpoints/last"
        assert last.resolve().name == "000003"
        ends[name] = artifacts.load(last / "training_state/state.safetensors").tensors
    assert ends["at-once"].keys() == ends["late"].keys()
    for name, tensor in ends["at-once"].items():
        if method == "kfac":  # its shares of the learning rates round differently
            torch.testing.assert_close(ends["late"][name], tensor, rtol=1e-4, atol=1e-6)
        else:
            assert torch.equal(tensor, ends["late"][name]), name


def test_only_adamw_can_be_told_to_stand_still(waits: None) -> None:
    weight = torch.nn.Parameter(torch.zeros(2))
    adamw, sgd = torch.optim.AdamW([weight], fused=True), torch.optim.SGD([weight])
    plain, cpu = METHODS["naive"].start(None), torch.device("cpu")  # type: ignore[arg-type]
    assert UnreadFigures.of(cpu, [adamw], plain, sharded=False).deferred
    assert not UnreadFigures.of(cpu, [sgd, adamw], plain, sharded=False).deferred
    assert not UnreadFigures.of(cpu, [adamw], plain, sharded=True).deferred
    by_the_anchor = replace(plain, penalty=lambda _: None, constrain=lambda _: None)  # type: ignore
    assert not UnreadFigures.of(cpu, [adamw], by_the_anchor, sharded=False).deferred
    reuses = replace(plain, penalty=lambda _: None, refresh=2)  # type: ignore
    assert not UnreadFigures.of(cpu, [adamw], reuses, sharded=False).deferred


# --- the same figures without a number ------------------------------------------------------------


def some_states() -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    hidden, taught = torch.randn(2, 3, 7, 5, generator=generator, dtype=torch.float64)
    mask = torch.arange(7) < torch.tensor([[7], [3], [5]])
    hidden[~mask] = math.nan  # padding never counts
    return hidden.requires_grad_(), taught, mask


def test_moments_without_selecting_rows_are_the_same() -> None:
    hidden, _, mask = some_states()
    gradients = []
    for moments in (batch_moments, padded_moments):
        mean, var = moments(hidden, mask)
        (gradient,) = torch.autograd.grad((mean.square() + var).sum(), hidden)
        gradients.append((mean, var, gradient))
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-14)


def graded(found: Sequence[tuple[Tensor, Tensor]], hidden: Sequence[Tensor]) -> list[Tensor]:
    """Means, variances and a gradient of each layer."""
    total = torch.stack([(mean.square() + var).sum() for mean, var in found]).sum()
    gradients = torch.autograd.grad(total, hidden)
    return [tensor for pair in found for tensor in pair] + list(gradients)


def test_moments_of_several_layers_at_once_are_those_of_each(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first, *_, mask = some_states()
    of_another_width = torch.ones(3, 7, 2, dtype=torch.float64, requires_grad=True)
    layers = [first, (2 * first).detach().requires_grad_(), of_another_width]
    layers += [(i + first).detach().requires_grad_() for i in range(5)]
    expected = graded([padded_moments(h, mask) for h in layers], layers)
    # As many numbers as two layers have: the last five layers form three groups.
    for most in (stacking.MOST, 2 * first.numel(), 1):
        monkeypatch.setattr(stacking, "MOST", most)
        found = graded(joint_moments(layers, mask), layers)
        for one, other in zip(expected, found, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-14)


def test_moments_that_processes_share_are_the_same_without_selecting_rows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first, _, mask = some_states()
    layers = [(i + first).detach().requires_grad_() for i in range(3)]

    def total(here: Tensor) -> Tensor:
        """The sum over two processes, where the other process has other tokens."""
        return here + torch.ones_like(here)

    expected = graded(shared_moments(layers, mask, total), layers)
    for most in (stacking.MOST, 2 * first.numel()):
        monkeypatch.setattr(stacking, "MOST", most)
        found = graded(shared_moments(layers, mask, total, reads=False), layers)
        for one, other in zip(expected, found, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("shared", [False, True])
def test_distances_without_selecting_rows_are_the_same(
    shared: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    hidden, taught, mask = some_states()
    total = (lambda x: x) if shared else None
    one = distill.relative_distance([hidden], [taught], mask, total)
    monkeypatch.setattr(devices, "reading_stalls", lambda _: True)
    other = distill.relative_distance([hidden], [taught], mask, total)
    torch.testing.assert_close(one, other, rtol=1e-12, atol=0)


def test_shares_without_numbers_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    maps = {}
    for i, size in enumerate((1.0, 1e-3, 0.0)):
        weight, bias = torch.nn.Parameter(torch.zeros(3, 4)), torch.nn.Parameter(torch.zeros(3))
        weight.grad = size * torch.randn(3, 4, generator=torch.Generator().manual_seed(i))
        maps[f"map{i}"] = weight, bias
    one = kfac.shares(maps, balance=1.0)
    monkeypatch.setattr(devices, "reading_stalls", lambda _: True)
    other = kfac.shares(maps, balance=1.0)
    for tensor, share in one.items():
        assert float(other[tensor]) == pytest.approx(share, rel=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_weight_that_is_a_tensor_rounds_once_more_at_most(dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    task, anchor = torch.randn(2, 4099, generator=generator, dtype=dtype)
    for weight in (0.37, 1e-5, 12345.678):
        (one,) = projection.apply([task.clone()], [anchor], 1.0, weight)
        wa = torch.tensor(weight, dtype=torch.float64)
        (other,) = projection.apply([task.clone()], [anchor], torch.tensor(1.0), wa)
        rounding = torch.finfo(dtype).eps * ((weight * anchor).abs() + one.abs())
        assert ((one - other).abs() <= rounding).all()
