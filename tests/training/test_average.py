"""The average of the weights: its value, where it is stored, and that training is unchanged."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from samples.small_run import recipe as small
from samples.training_runs import (
    SETTINGS,
    STEPS,
    Start,
    assert_resumes,
    metrics,
    protected_shares,
)
from torch import Tensor, nn

from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError, Diverged
from aegis_cli.data import demonstrations
from aegis_cli.models import backbones
from aegis_cli.recipes import Nullspace, Recipe
from aegis_cli.training import checkpoint, dry_run, step, train
from aegis_cli.training.average import Average

DECAY = 0.6


@pytest.fixture
def averaging(recipe: Recipe) -> Recipe:
    """Constraints of `nullspace` cover three steps, so that the average waits for them."""
    return replace(
        recipe, train=replace(SETTINGS, ema_decay=DECAY), nullspace=Nullspace(every=3, energy=0.9)
    )


def state(out: Path, kind: str, at: int | None = None) -> dict[str, Tensor]:
    """The weights or their average in a checkpoint's training state; None: the last checkpoint."""
    folder = checkpoint.last(out) if at is None else out / "checkpoints" / f"{at:06d}"
    saved = artifacts.load(folder / checkpoint.STATE, "training-state").tensors
    return {n.removeprefix(kind): t for n, t in saved.items() if n.startswith(kind)}


# --- the average ----------------------------------------------------------------------------------


@settings(max_examples=50)
@given(
    decay=st.floats(0.01, 0.999),
    waits=st.lists(st.integers(1, 4), min_size=1, max_size=12),
    seed=st.integers(0, 99),
)
def test_it_is_the_sum_that_its_definition_says(decay: float, waits: list[int], seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    weight = nn.Parameter(torch.randn(3, 2, generator=generator))
    average, wanted, done = Average({"w": weight}, decay), weight.detach().double(), 0
    for waited in waits:
        done += waited
        weight.data.copy_(torch.randn(3, 2, generator=generator))
        average.follow(done)
        average.follow(done)  # the second call changes nothing
        kept = min(decay, (1 + done) / (10 + done))
        for _ in range(waited):
            wanted = kept * wanted + (1 - kept) * weight.detach().double()
    torch.testing.assert_close(average.weights["w"].double(), wanted, rtol=1e-5, atol=1e-6)


def test_a_count_that_nobody_reads_leads_to_the_same_average() -> None:
    counts, found = (1, 2, 5, 5, 5), []
    for unread in (False, True):
        weight = nn.Parameter(torch.zeros(4))
        average = Average({"w": weight}, DECAY)
        for number, done in enumerate(counts, 1):
            weight.data.copy_(number * torch.arange(4.0))
            average.follow(torch.tensor(float(done), dtype=torch.float64) if unread else done)
        average.follow(7)  # as for a checkpoint
        found.append(average.weights["w"])
    torch.testing.assert_close(found[1], found[0])


def test_inside_its_block_the_parameters_are_the_average_and_after_it_themselves() -> None:
    weight = nn.Parameter(torch.zeros(4))
    average = Average({"w": weight}, 0.5)
    weight.data.copy_(torch.arange(4.0))
    average.follow(1)
    place, mean = weight.data_ptr(), average.weights["w"].clone()
    with pytest.raises(RuntimeError), average.in_place():
        assert torch.equal(weight, mean) and weight.data_ptr() == place
        raise RuntimeError
    assert torch.equal(weight, torch.arange(4.0)) and weight.data_ptr() == place
    assert torch.equal(average.weights["w"], mean)


# --- in training ----------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["naive", "stop-gradient", "nullspace", "lora"])
def test_a_checkpoint_is_the_average_and_training_does_not_notice(
    method: str, start: Start, averaging: Recipe, tmp_path: Path, demos_file: Path
) -> None:
    plain = replace(averaging, train=replace(averaging.train, ema_decay=None))
    start(method, tmp_path / "average", recipe=averaging)
    start(method, tmp_path / "plain", recipe=plain)
    weights, its = (state(tmp_path / name, "weight.") for name in ("average", "plain"))
    assert weights.keys() == its.keys() and all(torch.equal(its[n], weights[n]) for n in its)
    means = state(tmp_path / "average", "average.")
    assert means.keys() <= weights.keys() and state(tmp_path / "plain", "average.") == {}
    policy, _ = checkpoint.load_policy(tmp_path / "average")
    found = dict(policy.named_parameters())
    for name in means.keys() & found.keys():  # adapters are merged into the maps that they adapt
        assert torch.equal(found[name], means[name])
    moved = {name for name, mean in means.items() if not torch.equal(mean, weights[name])}
    assert any(name.startswith("expert.") for name in moved)
    assert any(name.startswith("backbone.") for name in moved) == (method != "stop-gradient")
    # What was measured was written.
    demos = demonstrations.load(demos_file, SETTINGS.validation_share, averaging.seed)
    noise = train.validation_noise(averaging.seed)
    loss = train.validation_loss(policy, demos, averaging.train, noise)
    told = metrics(tmp_path / "average")[-1]["validation_loss"]
    assert told == pytest.approx(loss, rel=1e-5)
    assert told != pytest.approx(metrics(tmp_path / "plain")[-1]["validation_loss"], rel=1e-5)


def test_it_holds_constrained_weights_alone(
    start: Start, averaging: Recipe, tmp_path: Path, anchor_file: Path
) -> None:
    start("nullspace", tmp_path, recipe=averaging)
    assert max(protected_shares(tmp_path, anchor_file, 0.9)) < 1e-8


def test_it_follows_the_last_good_step_of_a_run_that_diverges(
    start: Start, averaging: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This holds though the method had not constrained that step when it became the last."""
    compute, good = step.compute_gradients, STEPS - 1

    def spoiled(*args: Any, index: int, **options: Any) -> step.StepGradients:
        found = compute(*args, index=index, **options)
        return replace(found, loss=found.loss * math.nan) if index == good else found

    monkeypatch.setattr(step, "compute_gradients", spoiled)
    with pytest.raises(Diverged):
        start("nullspace", tmp_path, recipe=averaging)
    assert checkpoint.last(tmp_path).resolve().name == f"{good:06d}"
    (earlier, _), (mean, weights) = (
        [state(tmp_path, kind, at) for kind in ("average.", "weight.")] for at in (good - 1, good)
    )
    kept = min(DECAY, (1 + good) / (10 + good))
    for name, tensor in mean.items():
        torch.testing.assert_close(tensor, kept * earlier[name] + (1 - kept) * weights[name])


def test_what_does_not_learn_has_none(start: Start, averaging: Recipe, tmp_path: Path) -> None:
    start("stop-gradient", tmp_path / "run", recipe=averaging)
    plain = backbones.load(averaging.backbone)
    found, _ = checkpoint.load_policy(tmp_path / "run")
    assert found.backbone.fingerprint() == plain.fingerprint()


@pytest.mark.parametrize("method", ["naive", "nullspace", "aegis"])
def test_a_resumed_run_ends_in_the_same_bytes(
    method: str, start: Start, averaging: Recipe, tmp_path: Path
) -> None:
    assert_resumes(start, method, averaging, tmp_path)


def test_it_follows_masters_of_rounded_weights_and_no_rounded_ones(
    hf_folder: Callable[[str], Path], demos_file: Path, tmp_path: Path
) -> None:
    folder = hf_folder("smolvlm")
    narrow = small(folder, weights="bf16-master", precision="bf16", ema_decay=DECAY)
    train.run(narrow, "naive", demos_file, None, tmp_path / "run")
    assert all(t.dtype == torch.float32 for t in state(tmp_path / "run", "average.").values())
    with pytest.raises(AegisError, match=r"train.ema_decay: 0.6 with weights in half precision"):
        rounded = small(folder, weights="bf16", precision="bf16", ema_decay=DECAY)
        train.run(rounded, "naive", demos_file, None, tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_a_damaged_average_is_refused(start: Start, averaging: Recipe, tmp_path: Path) -> None:
    longer = replace(averaging, train=replace(averaging.train, steps=STEPS + 2))
    start("naive", tmp_path / "run", recipe=averaging)
    path = checkpoint.last(tmp_path / "run") / checkpoint.STATE
    saved = artifacts.load(path, "training-state")
    kept = {n: t.clone() for n, t in saved.tensors.items()}
    kept.pop(next(name for name in kept if name.startswith("average.")))
    header = saved.header
    artifacts.save(
        path, "training-state", kept, seed=header.seed, inputs=header.inputs, meta=header.meta
    )
    with pytest.raises(AegisError, match=r"the average in .* does not fit the model: .* missing"):
        start("naive", tmp_path / "run", recipe=longer, resume=True)


def test_a_dry_run_counts_it(averaging: Recipe, demos_file: Path, tmp_path: Path) -> None:
    found = []
    for decay in (None, DECAY):
        settings = replace(averaging, train=replace(averaging.train, ema_decay=decay))
        plan = dry_run.run(settings, "naive", demos_file, None, tmp_path / "out")
        found.append((plan.memory_mb, plan.disk_mb))
    (without, disk), (counted, more) = found
    assert without["average"] == 0 < counted["average"] == counted["gradients"]
    assert counted["method"] == without["method"]
    assert more - disk == pytest.approx(3 * counted["average"])  # checkpoints
