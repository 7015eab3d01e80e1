"""`kfac` in a plain loop: how a model that is not ours is measured for it, and its effect."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from samples.guard import (
    IMAGE,
    LAYERS,
    PATCHES,
    WIDTH,
    Vlm,
    batch,
    compiling,
    make,
    task_loss,
    vector,
)
from samples.tiny import make_tiny
from samples.training import make_questions
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils._python_dispatch import TorchDispatchMode

from aegis_cli import Guard, inspection
from aegis_cli.anchors import curvature
from aegis_cli.anchors.anchor_file import from_artifact
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.curvature import curvatures
from aegis_cli.core.pairs import minus
from aegis_cli.core.spectrum import DENSE
from aegis_cli.guard import stepper
from aegis_cli.guard.stepper import SlowedStep
from aegis_cli.methods import kfac
from aegis_cli.methods.base import Parts
from aegis_cli.methods.site_weights import weights

MAPS = (
    "vision.0",
    *(f"text.layers.{i}.{name}" for i in (0, 1) for name in ("qkv", "out", "up", "down")),
)


def only_maps(model: nn.Module) -> nn.Module:
    """Freezes all but linear maps and convolutions, the tied head with its table."""
    kfac.adapt(model, {}, {})
    return model


def asked(
    model: nn.Module, found: Any, change: Callable[[Tensor], Tensor] = lambda ids: ids
) -> None:
    """Three passes; the answer is the last word of each text that is not padding."""
    for seed in range(100, 103):
        pixels, ids, mask = batch(seed, dtype=next(model.parameters()).dtype)
        with found.watch(mask, IMAGE):
            scores = model(pixels, change(ids), mask)
        last = mask.sum(1) - 2  # predicts the last word
        found.answer(scores[torch.arange(len(ids)), last])


def measured(model: nn.Module, path: Path, **options: Any) -> Path:
    with Guard.measure(model, **({"parts": ("curvature",), "energy": 1.0} | options)) as found:
        asked(model, found)
    found.save(path)
    return path


def read(path: Path) -> Anchor:
    return from_artifact(artifacts.load(path, "anchor"))


# --- measuring ------------------------------------------------------------------------------------


def test_the_embedded_vlms_curvature_is_that_of_the_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """This holds if both draw the same words: the command draws each question's by its number."""
    monkeypatch.setattr(
        curvature, "_uniform", lambda _, question: torch.full((len(question),), 0.5)
    )
    monkeypatch.setattr(torch, "rand", lambda count, **_: torch.full((count,), 0.5))
    model, questions = make_tiny(), make_questions()
    wanted = curvature.measure(model, questions, 1.0, seed=7)
    with Guard.measure(model, parts=("curvature",), energy=1.0, seed=7) as found:
        image_of, texts = (
            torch.from_numpy(np.asarray(questions.image_of)),
            [q.text for q in questions.questions],
        )
        with found.watch(None):
            answers = [q.answer for q in questions.questions]
            parts = list(
                model.read_vqa(torch.from_numpy(questions.images), image_of, texts, answers)
            )
        for part in parts:
            found.answer(part.scores)
    ours = found.anchor().curvature
    assert ours.keys() == wanted.keys() and len(wanted) > 10
    for name, spectrum in wanted.items():
        torch.testing.assert_close(ours[name].values, spectrum.values, rtol=1e-5, atol=1e-12)


def test_what_no_answer_reads_does_not_count(tmp_path: Path) -> None:
    """Padding is not declared, and other words there change nothing."""
    spectra = []
    for word in (0, 5):
        model = make()
        with Guard.measure(model, parts=("curvature",), energy=1.0) as found:
            asked(model, found, lambda ids, word=word: ids.masked_fill(ids == 0, word))
        spectra.append(found.anchor().curvature)
    assert {name.rpartition(".")[0] for name in spectra[0]} == set(MAPS)
    for name, spectrum in spectra[0].items():
        torch.testing.assert_close(spectrum.values, spectra[1][name].values, rtol=1e-6, atol=1e-15)


def test_probabilities_in_place_of_scores_are_refused() -> None:
    """Logarithms of probabilities are scores too."""
    for dtype in (torch.float64, torch.bfloat16):
        model, (pixels, ids, mask) = make(), batch(0)
        with Guard.measure(model, parts=("curvature",)) as found:
            with found.watch(mask):
                scores = model(pixels, ids, mask)[:, -3].to(dtype)
            with pytest.raises(AegisError, match="that are probabilities") as caught:
                found.answer(scores.softmax(-1))
            assert "logits" in caught.value.expected
            found.answer(scores.log_softmax(-1))


class FamilyNorm(nn.Module):
    """The RMS norm of a model family: a class of its own, recognised by its behaviour."""

    def __init__(self) -> None:
        super().__init__()
        self.weight, self.eps = nn.Parameter(torch.full((WIDTH,), 1.5, dtype=torch.float64)), 1e-6

    def forward(self, x: Tensor) -> Tensor:
        return self.weight * (x * torch.rsqrt(x.square().mean(-1, keepdim=True) + self.eps))


def test_a_familys_norms_are_measured_beside_the_curvature() -> None:
    """The curvature calls a norm to recognise it, which does not count as a use of its weight."""
    found = {}
    for parts in (("inputs",), ("inputs", "curvature")):
        model = make()
        model.text.norm = FamilyNorm()
        with Guard.measure(model, parts=parts, vision="vision", energy=1.0) as measuring:
            if "curvature" in parts:
                asked(model, measuring)
            else:
                pixels, ids, mask = batch(100)
                with measuring.watch(mask):
                    model(pixels, ids, mask)
        found[len(parts)] = measuring.anchor().inputs
    assert found[1].keys() == found[2].keys() and "text.norm" in found[2]


def test_all_parts_in_one_measurement_are_what_each_is_alone(tmp_path: Path) -> None:
    model, options = make(), {"layers": LAYERS, "vision": "vision"}
    together = read(
        measured(
            model, tmp_path / "all.safetensors", parts=("moments", "inputs", "curvature"), **options
        )
    )
    alone = {
        part: read(measured_part(model, tmp_path / f"{part}.safetensors", part, **options))
        for part in ("moments", "inputs")
    }
    minded = read(measured(model, tmp_path / "curvature.safetensors"))
    for ours, theirs in zip(
        (*together.image, *together.text),
        (*alone["moments"].image, *alone["moments"].text),
        strict=True,
    ):
        assert torch.equal(ours.mean, theirs.mean) and torch.equal(ours.var, theirs.var)
    for mine, other in (
        (together.inputs, alone["inputs"].inputs),
        (together.curvature, minded.curvature),
    ):
        assert mine.keys() == other.keys() and all(
            torch.equal(mine[site].values, other[site].values) for site in mine
        )
    report = inspection.run(tmp_path / "all.safetensors")
    assert len(report.curvature) == 2 * len(MAPS) and report.facts["parts"] == [
        "moments",
        "inputs",
        "curvature",
    ]


def measured_part(model: nn.Module, path: Path, part: str, **options: Any) -> Path:
    with Guard.measure(model, parts=(part,), energy=1.0, **options) as found:
        for seed in range(100, 103):
            pixels, ids, mask = batch(seed)
            with found.watch(mask, IMAGE):
                model(pixels, ids, mask)
    found.save(path)
    return path


def test_a_frozen_tower_is_not_measured_and_not_needed(tmp_path: Path) -> None:
    model = only_maps(make())
    model.vision.requires_grad_(False)
    path = measured(model, tmp_path / "anchor.safetensors")
    assert {name.rpartition(".")[0] for name in read(path).curvature} == set(MAPS[1:])
    Guard(model, path, method="kfac").remove()
    model.vision.requires_grad_(True)
    with pytest.raises(AegisError, match="curvature of vision.0"):
        Guard(model, path, method="kfac")


class Loose(Vlm):
    """Uses a map's weight outside of its module's call."""

    def forward(self, pixels: Tensor, ids: Tensor, mask: Tensor) -> Tensor:
        scores = super().forward(pixels, ids, mask)
        return scores + F.linear(scores[..., :16], self.text.layers[0].out.weight).mean()


def test_a_map_used_outside_its_module_is_not_taken_as_measured(tmp_path: Path) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = Loose().double().eval()
    path = measured(only_maps(model), tmp_path / "anchor.safetensors")
    with pytest.raises(AegisError, match="text.layers.0.out; linear reads its parameters outside"):
        Guard(model, path, method="kfac")


def test_every_pass_has_its_answers() -> None:
    model, (pixels, ids, mask) = make(), batch(0)
    found = Guard.measure(model, parts=("curvature",))

    def forward() -> Tensor:
        with found.watch(mask):
            return model(pixels, ids, mask)

    scores = forward()
    for call in (forward, found.anchor):
        with pytest.raises(AegisError, match="without its answers"):
            call()
    with pytest.raises(AegisError, match="without a graph"):
        found.answer(scores.detach())
    with pytest.raises(AegisError, match=r"scores \[0, 8, 23\]"):
        found.answer(scores[:0])
    found.answer(scores[:, PATCHES:])
    overflowed = forward() * torch.inf
    with pytest.raises(AegisError, match=r"not finite[\s\S]*float32"):
        found.answer(overflowed)
    found.remove()
    with pytest.raises(AegisError, match="without the curvature"):
        Guard.measure(model, LAYERS).answer(scores)


# --- in a loop ------------------------------------------------------------------------------------


class Reads(TorchDispatchMode):
    """Counts reads of numbers, for each of which a GPU would wait."""

    count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += func is torch.ops.aten._local_scalar_dense.default
        return func(*args, **(kwargs or {}))


def test_the_shares_of_a_device_are_read_together() -> None:
    model = make()
    shares = {p: torch.tensor(0.25) for p in model.parameters()}
    first, second, *_ = shares
    shares[first], shares[second] = torch.tensor(torch.nan), torch.tensor(1.0)
    before = [p.detach().clone() for p in shares]
    with Reads() as reads, torch.no_grad():
        slowed = SlowedStep(Parts(shares=lambda: shares))
        for parameter in shares:
            parameter += 1
        slowed.go_back()
    assert len(before) > 10 and reads.count == 0
    for number, (now, then) in enumerate(zip(shares, before, strict=True)):
        torch.testing.assert_close(now, then + (1 if number < 2 else 0.25))


def steps(model: nn.Module, guard: Guard, count: int = 4, **adam: Any) -> None:
    optimizer = torch.optim.AdamW(
        [p for p in model.parameters() if p.requires_grad], **({"lr": 1e-2} | adam)
    )
    for seed in range(count):
        guard.backward(task_loss(model, seed))
        guard.step(optimizer)
        optimizer.zero_grad()


@pytest.mark.filterwarnings("ignore:the weight of kfac")  # strong on purpose
@compiling
@pytest.mark.parametrize("build", ["plain", "compiled"])
def test_under_a_strong_pull_nothing_is_left_of_what_answers_mind(
    build: str, tmp_path: Path
) -> None:
    """Directions that do not matter to answers continue to learn."""
    model = only_maps(make())
    path = measured(model, tmp_path / "anchor.safetensors")
    origin = {site: tuple(t.detach().clone() for t in weights(model, site)) for site in MAPS}
    found = curvatures(read(path), {site: pair[0] for site, pair in origin.items()}, damping=0.0)
    if build == "compiled":
        torch._dynamo.reset()
        model.text.layers[0] = torch.compile(model.text.layers[0], backend="eager")
    guard = Guard(model, path, method="kfac", weight=1e12, damping=0)
    steps(model, guard, weight_decay=0.3)
    names = {
        site.replace("layers.0.", "layers.0._orig_mod.") if build == "compiled" else site: site
        for site in MAPS
    }
    for name, site in names.items():
        moved = minus(weights(model, name), origin[site])
        kept = found[site].excess(*moved, 1e3)  # which a weaker pull would remove
        assert (
            max(part.abs().max().item() for part in kept)
            < 1e-6
            < max(part.abs().max().item() for part in moved)
        )
    torch._dynamo.reset()


@pytest.mark.filterwarnings("ignore:the weight of kfac")  # strong on purpose
def test_what_else_learns_is_refused_or_left_by_name(tmp_path: Path) -> None:
    path, model = measured(make(), tmp_path / "anchor.safetensors"), make()
    with pytest.raises(
        AegisError, match=r"a Embedding \(text.words\); a LayerNorm \(.*5 in all"
    ) as caught:
        Guard(model, path, method="kfac")
    assert (
        "linear maps and convolutions" in caught.value.expected and "protect=" in caught.value.fix
    )
    with Guard(model, path, method="kfac", vision="vision", protect="maps", weight=1e12) as guard:
        assert {"vision.0", "text.norm", "text.words"} < set(guard.unprotected) and not set(
            MAPS[1:]
        ) & set(guard.unprotected)
        before = {name: p.detach().clone() for name, p in model.named_parameters()}
        steps(model, guard)
    moved = {name for name, p in model.named_parameters() if not torch.equal(p, before[name])}
    assert {"vision.0.weight", "text.norm.weight", "text.words.weight"} <= moved
    assert only_maps(model) is model and all(
        isinstance(model.get_submodule(site), DENSE) for site in MAPS
    )


@pytest.mark.parametrize("options", [{}, {"weight": 0.0}, {"balance": 0.0}])
def test_a_step_past_the_guard_is_refused(options: dict[str, float], tmp_path: Path) -> None:
    model = only_maps(make())
    guard = Guard(model, measured(model, tmp_path / "anchor.safetensors"), method="kfac", **options)
    optimizer, before = torch.optim.AdamW(model.parameters(), lr=0.1), vector(model)
    guard.backward(task_loss(model, 0))
    with pytest.raises(AegisError, match="guarded parameters"):
        optimizer.step()
    assert torch.equal(vector(model), before)
    guard.step(optimizer)
    assert not torch.equal(vector(model), before)


def test_a_scaler_skips_the_step_of_an_overflow_and_changes_no_other(tmp_path: Path) -> None:
    """Not even the pull of the skipped step remains."""
    ends = []
    for scaled in (False, True):
        model = only_maps(make())
        guard = Guard(
            model, measured(model, tmp_path / "anchor.safetensors"), method="kfac", weight=1.0
        )
        optimizer = torch.optim.AdamW(model.parameters(), lr=1e-2)
        scaler = torch.amp.GradScaler("cpu", init_scale=8.0, enabled=scaled)
        for seed in range(2):
            guard.backward(task_loss(model, seed), scaler)
            guard.step(optimizer, scaler)
            scaler.update()
            optimizer.zero_grad()
        ends.append(vector(model))
    torch.testing.assert_close(*ends, rtol=0, atol=1e-12)
    guard.backward(task_loss(model, 2) * math.inf, scaler)
    guard.step(optimizer, scaler)
    assert torch.equal(vector(model), ends[1])
    assert optimizer.state[model.vision[0].weight]["step"] == 2


@pytest.mark.parametrize("is_automatic", [False, True])
@pytest.mark.parametrize("fused", [False, True])
def test_an_overflow_in_one_map_moves_nothing(
    fused: bool, is_automatic: bool, tmp_path: Path
) -> None:
    """A fused optimizer is called for such a step too, and skips it inside its kernel."""
    model, plain = only_maps(make()), only_maps(make())
    path = measured(model, tmp_path / "anchor.safetensors")
    ends = []
    for each, overflows in ((model, True), (plain, False)):
        guard = Guard(each, path, method="kfac", weight=1.0)
        learning = [p for p in each.parameters() if p.requires_grad]
        optimizer = torch.optim.AdamW(learning, lr=1e-2, fused=fused)
        scaler = torch.amp.GradScaler("cpu", init_scale=8.0)
        if is_automatic:
            guard.automatic(scaler=scaler)
        for seed, lost in ((0, False), (1, False), (2, True), (2, False)):
            if lost and not overflows:
                continue
            before = vector(each)
            up = each.text.layers[0].up.weight
            hook = up.register_hook(lambda gradient: gradient * math.inf) if lost else None
            if is_automatic:
                scaler.scale(task_loss(each, seed)).backward()
                scaler.step(optimizer)
            else:
                guard.backward(task_loss(each, seed), scaler)
                guard.step(optimizer, scaler)
            scaler.update()
            optimizer.zero_grad()
            if hook is not None:
                hook.remove()
                assert torch.equal(vector(each), before)
        ends.append(vector(each))
    torch.testing.assert_close(*ends, rtol=0, atol=1e-12)


def warned(model: nn.Module, guard: Guard, rates: list[float], is_automatic: bool) -> list[int]:
    """The steps, from 0, at which a guard warns of its weight; the other half learns faster."""
    learning = [p for p in model.parameters() if p.requires_grad]
    expert = nn.Parameter(torch.ones(1))
    groups = [{"params": learning}, {"params": [expert], "lr": 1.0}]
    optimizer = torch.optim.SGD(groups, lr=0.0)
    if is_automatic:
        guard.automatic()
    found = []
    for step, rate in enumerate(rates):
        optimizer.param_groups[0]["lr"] = rate
        loss = task_loss(model, step)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            if is_automatic:
                loss.backward()
                optimizer.step()
            else:
                guard.backward(loss)
                guard.step(optimizer)
        optimizer.zero_grad()
        if said:
            (text,) = (str(warning.message) for warning in said)
            assert ": weight=" in text and "may learn little" in text
            found.append(step)
    return found


@pytest.mark.parametrize("is_automatic", [False, True])
def test_a_guard_warns_once_of_a_weight_too_strong_for_the_learning_rate(
    is_automatic: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the end of a warm-up, and by the rate of what it guards."""
    monkeypatch.setattr(stepper, "HELD", 2)
    path = measured(make(), tmp_path / "anchor.safetensors")
    for rates, expected in (
        ([1e-5] * 4, [2]),  # the default weight is 3,000 times the rate
        ([0.0, 1e-6, 2e-6, 1e-6], [3]),
        ([1e-6, 1e-6, 1e-4, 2e-3, 2e-3, 1e-6], []),  # 15 times the peak
        ([0.0] * 3, []),
    ):
        model = only_maps(make())
        guard = Guard(model, path, method="kfac")
        assert warned(model, guard, rates, is_automatic) == expected
        guard.remove()


def test_a_weight_of_15_times_the_rate_is_not_too_strong(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stepper, "HELD", 2)
    path = measured(make(), tmp_path / "anchor.safetensors")
    model = only_maps(make())
    guard = Guard(model, path, method="kfac", weight=15 * 1e-5)
    assert warned(model, guard, [1e-5] * 3, is_automatic=False) == []
