"""An optimizer's state as named tensors: taken, put back, and continued."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from aegis_cli.training import optimizer_state


def parameters(seed: int = 0) -> dict[str, nn.Parameter]:
    generator = torch.Generator().manual_seed(seed)
    return {
        name: nn.Parameter(torch.randn(3, 2, generator=generator))
        for name in ("a.weight", "b", "never.used")
    }


def optimizers(named: dict[str, nn.Parameter]) -> list[torch.optim.Optimizer]:
    """Two of different kinds, as pre-training has them."""
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


@pytest.mark.parametrize(("fused", "place"), [(True, "meta"), (False, "cpu")])
def test_step_counts_lie_where_their_optimizer_reads_them(fused: bool, place: str) -> None:
    """As PyTorch's own `load_state_dict` places them; 'meta' stands for a GPU."""
    parameter = nn.Parameter(torch.zeros(2, device="meta"))
    optimizer = torch.optim.AdamW([parameter])
    optimizer.param_groups[0]["fused"] = fused
    saved: dict[str, Tensor] = {
        "weight.p": torch.zeros(2),
        "optimizer.step/p": torch.tensor(3.0),
        "optimizer.exp_avg/p": torch.zeros(2),
    }
    optimizer_state.from_tensors(saved, {"p": parameter}, [optimizer])
    assert optimizer.state[parameter]["step"].device.type == place
    assert optimizer.state[parameter]["exp_avg"].device.type == "meta"
