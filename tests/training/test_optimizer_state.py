"""An optimizer's state as named tensors: read out, put back, and continued."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from aegis_cli.common.errors import AegisError
from aegis_cli.training import optimizer_state


def parameters(seed: int = 0) -> dict[str, nn.Parameter]:
    generator = torch.Generator().manual_seed(seed)
    return {
        name: nn.Parameter(torch.randn(3, 2, generator=generator))
        for name in ("a.weight", "b", "never.used")
    }


def optimizers(named: dict[str, nn.Parameter]) -> list[torch.optim.Optimizer]:
    """Two optimizers of different kinds, as in pre-training."""
    return [
        torch.optim.AdamW([named["a.weight"], named["never.used"]], lr=0.1, fused=True),
        torch.optim.SGD([named["b"]], lr=0.1, momentum=0.9),
    ]


def train(
    named: dict[str, nn.Parameter], makers: list[torch.optim.Optimizer], steps: range
) -> None:
    for i in steps:
        for name in ("a.weight", "b"):
            named[name].grad = torch.full((3, 2), 1.0 + i)
        for optimizer in makers:
            optimizer.step()


def test_training_goes_on_as_if_nothing_had_happened() -> None:
    whole, first, second = parameters(), parameters(), parameters(seed=1)
    train(whole, optimizers(whole), range(5))
    before = optimizers(first)
    train(first, before, range(3))
    saved = {name: t.clone() for name, t in optimizer_state.to_tensors(first, before).items()}
    after = optimizers(second)
    optimizer_state.from_tensors(saved, second, after)
    train(second, after, range(3, 5))
    assert all(torch.equal(whole[name], second[name]) for name in whole)
    assert not any("optimizer" in name and "never.used" in name for name in saved)


def test_what_is_put_back_is_a_copy() -> None:
    """Files are memory-mapped: an optimizer must not write into one."""
    named = parameters()
    train(named, made := optimizers(named), range(2))
    saved = {name: t.clone() for name, t in optimizer_state.to_tensors(named, made).items()}
    kept = {name: t.clone() for name, t in saved.items()}
    optimizer_state.from_tensors(saved, named, made)
    train(named, made, range(2, 4))
    assert all(torch.equal(saved[name], kept[name]) for name in saved)


Saved = dict[str, Tensor]


def drop(name: str) -> Callable[[Saved], object]:
    return lambda saved: saved.pop(name)


def put(name: str, value: Tensor) -> Callable[[Saved], object]:
    return lambda saved: saved.update({name: value})


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (drop("weight.b"), "'weight.b' missing"),
        (put("weight.c", torch.zeros(3, 2)), "'weight.c' not part of it"),
        (
            put("weight.b", torch.ones(1)),
            r"'weight.b' is float32 \[1\] instead of float32 \[3, 2\]",
        ),
        (put("weight.b", torch.zeros(3, 2, dtype=torch.int64)), "'weight.b' is int64"),
        (put("optimizer.exp_avg/a.weight", torch.zeros(2)), "exp_avg/a.weight' is float32"),
        (put("optimizer.exp_avg/a.weight", torch.full((3, 2), torch.inf)), "NaN or infinite"),
        (put("optimizer.exp_avg_sq/a.weight", -torch.ones(3, 2)), "is negative"),
        (put("optimizer.step/a.weight", torch.tensor([3.0])), "step/a.weight' is float32"),
        (put("optimizer.step/c", torch.tensor(3.0)), "step/c' not part of it"),
        (put("optimizer.exp_avg/b", torch.zeros(3, 2)), "exp_avg/b' not part of it"),
        (put("other", torch.zeros(1)), "'other' not part of it"),
        (drop("optimizer.exp_avg_sq/a.weight"), "exp_avg_sq/a.weight' missing"),
        (drop("optimizer.momentum_buffer/b"), "momentum_buffer/b' missing"),
    ],
)
def test_a_tensor_that_does_not_fit_is_refused_before_any_is_put_back(
    change: Callable[[Saved], object], found: str
) -> None:
    """A fused optimizer writes to its parameter's full size, whatever the size of its state."""
    named = parameters()
    train(named, made := optimizers(named), range(2))
    saved = {name: t.clone() for name, t in optimizer_state.to_tensors(named, made).items()}
    bare = optimizer_state.stateless(named, made)
    assert bare == ["never.used"]
    change(saved)
    fresh = parameters(seed=1)
    before = {name: p.detach().clone() for name, p in fresh.items()}
    after = optimizers(fresh)
    with pytest.raises(AegisError, match=found):
        optimizer_state.from_tensors(saved, fresh, after, "'x'", bare)
    assert all(torch.equal(p, before[name]) for name, p in fresh.items())
    assert not any(optimizer.state for optimizer in after)


def test_a_file_that_does_not_say_what_has_no_state_has_one_at_least() -> None:
    named = parameters()
    train(named, made := optimizers(named), range(2))
    saved = {name: t.clone() for name, t in optimizer_state.to_tensors(named, made).items()}
    optimizer_state.from_tensors(saved, named, made)
    weights = {name: t for name, t in saved.items() if name.startswith("weight.")}
    with pytest.raises(AegisError, match="without an optimizer's state"):
        optimizer_state.from_tensors(weights, named, made)


@pytest.mark.parametrize(("fused", "place"), [(True, "meta"), (False, "cpu")])
def test_step_counts_lie_where_their_optimizer_reads_them(fused: bool, place: str) -> None:
    """They are where PyTorch's own `load_state_dict` puts them; 'meta' stands for a GPU."""
    parameter = nn.Parameter(torch.zeros(2, device="meta"))
    optimizer = torch.optim.AdamW([parameter])
    optimizer.param_groups[0]["fused"] = fused
    saved: dict[str, Tensor] = {
        "weight.p": torch.zeros(2),
        "optimizer.step/p": torch.tensor(3.0),
        "optimizer.exp_avg/p": torch.zeros(2),
        "optimizer.exp_avg_sq/p": torch.zeros(2),
    }
    optimizer_state.from_tensors(saved, {"p": parameter}, [optimizer])
    assert optimizer.state[parameter]["step"].device.type == place
    assert optimizer.state[parameter]["exp_avg"].device.type == "meta"
