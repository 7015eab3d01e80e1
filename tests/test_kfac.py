"""The kfac method on a small module in float64: what is drawn back, how far maps move, and windows of several steps."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from aegis_cli.core.anchor import Anchor
from aegis_cli.core.curvature import curvatures, drawn_back
from aegis_cli.core.nullspace import minus
from aegis_cli.core.spectrum import decompose, lone_row
from aegis_cli.methods import kfac
from aegis_cli.methods.base import Parts, Setting, Update, weights

SITES = {"first": "maps", "second": "maps", "row": "embeddings"}
WIDTH = 4


@pytest.fixture(autouse=True)
def fixed_draws() -> Iterator[None]:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


class Toy(nn.Module):
    """Two maps and a lone row."""

    def __init__(self) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(WIDTH, WIDTH), nn.Linear(WIDTH, WIDTH, bias=False)
        self.row = nn.Parameter(torch.randn(WIDTH))
        self.double()

    def forward(self, x: Tensor) -> Tensor:
        return self.second(self.first(x).tanh()) + self.row


def moment(size: int) -> Tensor:
    rows = torch.randn(30, size, dtype=torch.float64) * torch.logspace(0, 1, size, dtype=torch.float64)
    return rows.T @ rows


def make_anchor() -> Anchor:
    inputs = {"first": decompose(moment(WIDTH + 1)), "second": decompose(moment(WIDTH))}
    return Anchor(inputs=inputs | {"row": lone_row()}, outputs={site: decompose(moment(WIDTH)) for site in inputs})


def make_setting(**options: Any) -> Setting:
    toy = Toy()
    chosen = {"weight": 0.3, "balance": 0.0, "every": 1} | options
    return Setting(toy, {"all": list(toy.parameters())}, SITES, chosen, make_anchor())


def values(toy: nn.Module) -> dict[str, Tensor]:
    return {name: p.detach().clone() for name, p in toy.named_parameters()}


def take_step(toy: nn.Module, optimizer: torch.optim.Optimizer) -> None:
    optimizer.zero_grad()
    toy(torch.randn(8, WIDTH, dtype=torch.float64)).square().sum().backward()
    optimizer.step()


def test_without_weight_it_is_naive() -> None:
    assert kfac.METHOD.start(make_setting(weight=0.0)) == Parts()


def test_it_needs_both_sides_and_trains_everything() -> None:
    assert kfac.METHOD.needs == {"inputs", "outputs"} and not kfac.METHOD.dual and not kfac.METHOD.ceiling
    toy = Toy().requires_grad_(False)
    kfac.METHOD.adapt(toy, {}, {})
    assert all(p.requires_grad for p in toy.parameters())


@pytest.mark.parametrize("steps", [1, 3])
def test_all_that_has_moved_is_drawn_back_as_far_as_its_steps_ask(steps: int) -> None:
    """The second window too starts from the pre-trained weights, not from the first's end."""
    setting = make_setting()
    toy, origin = setting.backbone, values(setting.backbone)
    constrain = kfac.METHOD.start(setting).constrain
    optimizer = torch.optim.AdamW(toy.parameters(), lr=0.1, weight_decay=0.5)
    assert constrain is not None and setting.anchor is not None
    found = curvatures(setting.anchor, {site: weights(toy, site)[0] for site in SITES})
    for _ in range(2):
        before = values(toy)
        for _ in range(steps):
            take_step(toy, optimizer)
        moved = {name: p.detach() - origin[name] for name, p in toy.named_parameters()}
        wanted = {
            "first": drawn_back(found["first"], (moved["first.weight"], moved["first.bias"]), 0.3 * steps),
            "second": drawn_back(found["second"], (moved["second.weight"], None), 0.3 * steps),
        }
        constrain(Update(before, {}, steps))
        for site, pair in wanted.items():
            got = minus(weights(toy, site), (origin[f"{site}.weight"], origin.get(f"{site}.bias")))
            for x, y in zip(got, pair, strict=True):
                assert (x is None) == (y is None)
                if x is not None:
                    torch.testing.assert_close(x, y)
        assert torch.equal(toy.row, origin["row"])


def test_a_map_moves_the_less_the_smaller_its_gradient() -> None:
    pairs = {name: (nn.Parameter(torch.zeros(3, 2)), nn.Parameter(torch.zeros(3))) for name in ("large", "small", "none")}
    for pair, size in zip(pairs.values(), (2.0, 0.5, 0.0), strict=True):
        for parameter in pair:
            parameter.grad = torch.full_like(parameter, size)
    rms = ((4 + 0.25) / 3) ** 0.5  # of all maps' entries together
    for balance in (0.5, 1.0):
        shares = {name: share.item() for name, share in kfac.shares(pairs, balance).items()}
        assert shares == pytest.approx({"large": 2 / (2 + balance * rms), "small": 0.5 / (0.5 + balance * rms), "none": 0.0})
    assert {share.item() for name, share in kfac.shares(pairs, 0.0).items() if name != "none"} == {1.0}
    for parameter in (p for pair in pairs.values() for p in pair):
        parameter.grad = None  # as after a step that was refused
    assert {share.item() for share in kfac.shares(pairs, 1.0).values()} == {1.0}


def test_shares_do_not_depend_on_the_losss_scale() -> None:
    pairs = {name: (nn.Parameter(torch.zeros(3, 2)), None) for name in "ab"}
    found = []
    for scale in (1.0, 1e-6):
        torch.manual_seed(1)
        for (weight, _), size in zip(pairs.values(), (1.0, 5.0), strict=True):
            weight.grad = scale * size * torch.randn_like(weight)
        found.append(torch.stack(list(kfac.shares(pairs, 1.0).values())))
    torch.testing.assert_close(*found)


def test_only_the_latest_update_is_balanced() -> None:
    """What was there before a window keeps its length but for the proximal step."""
    setting = make_setting(weight=1e-12, balance=1.0)
    toy = setting.backbone
    constrain = kfac.METHOD.start(setting).constrain
    assert constrain is not None
    with torch.no_grad():
        toy.first.weight += 1
        before = values(toy)
        toy.first.weight += 0.1
    toy.first.weight.grad = torch.ones(WIDTH, WIDTH, dtype=torch.float64)
    share = kfac.shares({site: weights(toy, site) for site in SITES}, 1.0)["first"].item()
    constrain(Update(before, {}))
    torch.testing.assert_close(toy.first.weight.detach(), before["first.weight"] + 0.1 * share)
    assert 0.3 < share < 0.7
