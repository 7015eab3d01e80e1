"""AdamW's moments in 8 bits: close to AdamW, resumed to the same bytes, counted and refused."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from samples.small_run import recipe as small
from samples.training_runs import SETTINGS, Start, assert_resumes, recipe, start
from torch import Tensor, nn

from aegis_cli.common.errors import AegisError
from aegis_cli.common.ranks import Ranks
from aegis_cli.recipes import Recipe, Train
from aegis_cli.training import dry_run, eight_bit, optimizer_state, train

__all__ = ["recipe", "start"]  # fixtures

TRAIN = Train(weight_decay=0.1)
EIGHT_BIT = replace(SETTINGS, states=eight_bit.STATES)
Saved = dict[str, Tensor]
installed = pytest.mark.skipif(
    importlib.util.find_spec("bitsandbytes") is None, reason="needs the extra low-memory"
)


def parameters(seed: int = 0) -> dict[str, nn.Parameter]:
    """A parameter large enough for codes, with an incomplete last block, and a small one."""
    generator = torch.Generator().manual_seed(seed)
    shapes = {"large": (90, 50), "small": (7,), "idle": (3,)}
    return {n: nn.Parameter(torch.randn(shape, generator=generator)) for n, shape in shapes.items()}


def adamw(named: dict[str, nn.Parameter], settings: Train = TRAIN) -> torch.optim.Optimizer:
    return eight_bit.adamw([{"params": list(named.values()), "lr": 1e-2}], settings)


def steps(named: dict[str, nn.Parameter], optimizer: torch.optim.Optimizer, which: range) -> None:
    for index in which:
        generator = torch.Generator().manual_seed(index)
        for name in ("large", "small"):
            named[name].grad = torch.randn(named[name].shape, generator=generator)
        optimizer.step()


def saved_after(count: int) -> tuple[dict[str, nn.Parameter], Saved]:
    named = parameters()
    steps(named, made := adamw(named), range(count))
    return named, {n: t.clone() for n, t in optimizer_state.to_tensors(named, [made]).items()}


# --- the optimizer --------------------------------------------------------------------------------


@installed
def test_its_steps_are_near_adamws() -> None:
    near, exact = parameters(), parameters()
    steps(near, adamw(near), range(20))
    steps(exact, torch.optim.AdamW(exact.values(), lr=1e-2, weight_decay=0.1), range(20))
    torch.testing.assert_close(near["small"], exact["small"], rtol=1e-5, atol=1e-6)
    moved = (exact["large"] - parameters()["large"]).norm()
    assert 0 < (near["large"] - exact["large"]).norm() < 0.1 * moved


@installed
def test_its_betas_and_eps_are_the_recipes() -> None:
    other = replace(TRAIN, betas=(0.5, 0.8), eps=1e-2)
    near, exact = parameters(), parameters()
    steps(near, adamw(near, other), range(20))
    as_torch = {"betas": (0.5, 0.8), "eps": 1e-2, "weight_decay": 0.1}
    steps(exact, torch.optim.AdamW(exact.values(), lr=1e-2, **as_torch), range(20))
    torch.testing.assert_close(near["small"], exact["small"], rtol=1e-5, atol=1e-6)
    moved = (exact["large"] - parameters()["large"]).norm()
    assert 0 < (near["large"] - exact["large"]).norm() < 0.1 * moved


@installed
def test_a_state_is_put_back_to_the_same_bytes_and_goes_on() -> None:
    whole, saved = parameters(), saved_after(3)[1]
    steps(whole, adamw(whole), range(6))
    named = parameters(seed=1)
    optimizer_state.from_tensors(saved, named, [made := adamw(named)], without=["idle"])
    again = optimizer_state.to_tensors(named, [made])
    assert again.keys() == saved.keys()
    assert all(torch.equal(again[name], saved[name]) for name in saved)
    steps(named, made, range(3, 6))
    assert all(torch.equal(whole[name], named[name]) for name in whole)


@installed
def test_what_is_kept_is_what_is_counted_and_expected() -> None:
    named, saved = saved_after(1)
    assert saved["optimizer.state1/large"].dtype == torch.uint8
    assert saved["optimizer.state1/small"].dtype == torch.float32
    for name in ("large", "small"):
        wanted = eight_bit.kept(named[name])
        found = {k: saved[f"optimizer.{k}/{name}"] for k in wanted}
        assert {k: (t.shape, t.dtype) for k, t in found.items()} == {
            k: (t.shape, t.dtype) for k, t in wanted.items()
        }
        size = sum(t.nbytes for k, t in found.items() if k != "step")
        assert size == eight_bit.state_bytes(named[name])
    assert not any("qmap" in name or "idle" in name for name in saved if "optimizer." in name)


@installed
@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda s: s.pop("optimizer.absmax1/large"), "absmax1/large' missing"),
        (lambda s: s.update({"optimizer.state1/large": torch.zeros(90, 50)}), "state1/large' is"),
        (lambda s: s["optimizer.absmax1/large"].fill_(torch.nan), "NaN or infinite"),
        (lambda s: s["optimizer.absmax2/large"].fill_(-1), "is negative"),
        (lambda s: s["optimizer.state2/small"].fill_(-1), "is negative"),
        (lambda s: s.update({"optimizer.absmax1/large": torch.zeros(17)}), "absmax1/large' is"),
    ],
)
def test_a_damaged_state_is_refused_before_any_is_put_back(
    change: Callable[[Saved], object], problem: str
) -> None:
    saved = saved_after(2)[1]
    change(saved)
    named = parameters(seed=1)
    before = {name: p.detach().clone() for name, p in named.items()}
    with pytest.raises(AegisError, match=problem):
        optimizer_state.from_tensors(saved, named, [made := adamw(named)], "'x'", ["idle"])
    assert all(torch.equal(p, before[name]) for name, p in named.items()) and not made.state


# --- runs -----------------------------------------------------------------------------------------


@installed
@pytest.mark.parametrize("method", ["naive", "kfac", "nullspace", "lora"])
def test_a_resumed_run_ends_in_the_same_bytes(
    method: str, start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    assert_resumes(start, method, replace(recipe, train=EIGHT_BIT), tmp_path)


@installed
def test_it_steps_masters_of_rounded_weights(
    hf_folder: Callable[[str], Path], demos_file: Path, tmp_path: Path
) -> None:
    narrow = {"weights": "bf16-master", "precision": "bf16", "states": eight_bit.STATES}
    settings = small(hf_folder("smolvlm"), **narrow)
    report = train.run(settings, "naive", demos_file, None, tmp_path / "run")
    assert report.steps == 4


@installed
def test_a_dry_run_counts_a_quarter(recipe: Recipe, demos_file: Path, tmp_path: Path) -> None:
    found = []
    for settings in (SETTINGS, EIGHT_BIT):
        plan = dry_run.run(
            replace(recipe, train=settings), "naive", demos_file, None, tmp_path / "out"
        )
        found.append((plan.memory_mb["optimizer"], plan.disk_mb))
    (whole, disk), (coded, smaller) = found
    assert 0.25 * whole < coded < whole and smaller < disk


# --- refused --------------------------------------------------------------------------------------


def test_other_optimizers_and_sharded_weights_have_none() -> None:
    with pytest.raises(AegisError, match="8bit with train.optimizer: sgd"):
        eight_bit.check(Train(states="8bit", optimizer="sgd"), Ranks())
    with pytest.raises(AegisError, match="8bit with train.parallel: fsdp"):
        eight_bit.check(Train(states="8bit", parallel="fsdp"), Ranks(0, 2))
    eight_bit.check(Train(), Ranks(0, 2))


def test_without_the_library_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(AegisError, match=r"aegis-vla\[low-memory\]"):
        eight_bit.check(Train(states="8bit"), Ranks())
