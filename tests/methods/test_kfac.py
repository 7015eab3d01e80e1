"""kfac on a small float64 module: what learns, what is drawn back, how far maps move."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import asdict, replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from aegis_cli.core.anchor import Anchor
from aegis_cli.core.curvature import curvatures
from aegis_cli.core.pairs import Pair, minus
from aegis_cli.core.spectrum import decompose
from aegis_cli.methods import kfac
from aegis_cli.methods.base import MethodContext, Parts, Update
from aegis_cli.methods.site_weights import weights
from aegis_cli.recipes import Kfac

MAPS = ("first", "second")
SITES = {**dict.fromkeys(MAPS, "maps"), "row": "embeddings", "table": "embeddings", "norm": "norms"}
WIDTH = 4


@pytest.fixture(autouse=True)
def fixed_draws() -> Iterator[None]:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


class Toy(nn.Module):
    """Two maps and a lone row, with a table, a normalisation and a tied head."""

    def __init__(self) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(WIDTH, WIDTH), nn.Linear(WIDTH, WIDTH, bias=False)
        self.row = nn.Parameter(torch.randn(WIDTH))
        self.table, self.norm, self.head = (
            nn.Embedding(3, WIDTH),
            nn.LayerNorm(WIDTH),
            nn.Linear(WIDTH, 3, bias=False),
        )
        self.head.weight = self.table.weight
        self.double()

    def forward(self, x: Tensor) -> Tensor:
        return self.second(self.first(x).tanh()) + self.row


def moment(size: int) -> Tensor:
    rows = torch.randn(30, size, dtype=torch.float64) * torch.logspace(
        0, 1, size, dtype=torch.float64
    )
    return rows.T @ rows


def make_anchor() -> Anchor:
    inputs = {"first": decompose(moment(WIDTH + 1)), "second": decompose(moment(WIDTH))}
    outputs = {f"{site}.outputs": decompose(moment(WIDTH)) for site in inputs}
    return Anchor(curvature={f"{site}.inputs": found for site, found in inputs.items()} | outputs)


def make_setting(**options: Any) -> MethodContext:
    toy = Toy()
    kfac.METHOD.adapt(toy, {}, {})
    chosen = asdict(Kfac(weight=0.3, damping=0.1, balance=0.0, every=1)) | options
    return MethodContext(toy, {"all": list(toy.parameters())}, SITES, chosen, make_anchor())


def values(toy: nn.Module) -> dict[str, Tensor]:
    return {name: p.detach().clone() for name, p in toy.named_parameters()}


def take_step(toy: nn.Module, optimizer: torch.optim.Optimizer) -> None:
    optimizer.zero_grad()
    toy(torch.randn(8, WIDTH, dtype=torch.float64)).square().sum().backward()
    optimizer.step()


def test_linear_maps_and_convolutions_learn() -> None:
    """A tied head is a table, and does not learn."""
    assert kfac.METHOD.needs == {"curvature"} and not kfac.METHOD.compares_layers
    toy = Toy().requires_grad_(False)
    toy.stem = nn.Conv2d(2, 2, 2)
    kfac.METHOD.adapt(toy, {}, {})
    learning = {name for name, p in toy.named_parameters() if p.requires_grad}
    assert learning == {"first.weight", "first.bias", "second.weight", "stem.weight", "stem.bias"}


@pytest.mark.parametrize("weight", [0.0, 0.3])
@pytest.mark.parametrize("balance", [0.0, 1.0])
def test_either_half_works_alone(weight: float, balance: float) -> None:
    parts = kfac.METHOD.start(make_setting(weight=weight, balance=balance))
    assert (parts.constrain is not None, parts.shares is not None) == (weight > 0, balance > 0)
    assert weight > 0 or parts == Parts(shares=parts.shares)


@pytest.mark.parametrize("steps", [1, 3])
def test_all_that_has_moved_is_drawn_back_as_far_as_its_steps_ask(steps: int) -> None:
    """The second window too starts from the pre-trained weights, not from the first's end."""
    context = make_setting()
    toy, origin = context.backbone, values(context.backbone)
    parts = kfac.METHOD.start(context)
    constrain = parts.constrain
    optimizer = torch.optim.AdamW(
        [p for p in toy.parameters() if p.requires_grad], lr=0.1, weight_decay=0.5
    )
    assert constrain is not None and not parts.compares and context.anchor is not None
    found = curvatures(context.anchor, {site: weights(toy, site)[0] for site in MAPS}, 0.1)

    def displacement(site: str) -> Pair:
        return minus(weights(toy, site), (origin[f"{site}.weight"], origin.get(f"{site}.bias")))

    for _ in range(2):
        for _ in range(steps):
            take_step(toy, optimizer)
        moved = {site: displacement(site) for site in MAPS}
        constrain(Update({}, {}, steps))
        for site, pair in moved.items():
            wanted = minus(pair, found[site].excess(*pair, 0.3 * steps))
            for x, y in zip(displacement(site), wanted, strict=True):
                assert (x is None) == (y is None)
                if x is not None:
                    torch.testing.assert_close(x, y)
        assert all(
            torch.equal(p, origin[name])
            for name, p in toy.named_parameters()
            if name.split(".")[0] not in MAPS
        )


@torch.no_grad()
def move(toy: nn.Module) -> None:
    for parameter in toy.parameters():
        if parameter.requires_grad:
            parameter += 0.3 * torch.randn_like(parameter)


def drawn_back(toy: nn.Module, anchor: Anchor, update: Update, **options: Any) -> dict[str, Tensor]:
    """The weights of a copy of the toy, always moved alike, after one constraint."""
    context = replace(make_setting(**options), backbone=copy.deepcopy(toy), anchor=anchor)
    constrain = kfac.METHOD.start(context).constrain
    assert constrain is not None
    with torch.random.fork_rng():
        torch.manual_seed(1)
        move(context.backbone)
    constrain(update)
    return values(context.backbone)


@pytest.mark.parametrize("growth", [-1.0, 0.0, 0.5, 2.0])
def test_the_weight_grows_as_the_learning_rate_falls(growth: float) -> None:
    context = make_setting()
    toy, anchor = context.backbone, context.anchor
    assert anchor is not None
    late = drawn_back(toy, anchor, Update({}, {}, 2, rate_left=0.25), growth=growth)
    heavy = drawn_back(toy, anchor, Update({}, {}, 2), weight=0.3 * 4**growth)
    early = drawn_back(toy, anchor, Update({}, {}, 2), growth=growth)
    plain = drawn_back(toy, anchor, Update({}, {}, 2))
    for name, tensor in late.items():
        torch.testing.assert_close(tensor, heavy[name])
        assert torch.equal(early[name], plain[name])
    moved = not torch.allclose(late["first.weight"], plain["first.weight"])
    assert moved == (growth != 0)


@pytest.mark.parametrize("weight", [0.1, 0.5])
def test_steps_of_one_size_settle_at_the_rate_over_weight_and_curvature(weight: float) -> None:
    rate, context = 0.01, make_setting(weight=weight)
    toy, origin = context.backbone, values(context.backbone)
    parts, shape = kfac.METHOD.start(context), toy.second.weight
    assert parts.constrain is not None and context.anchor is not None
    found = curvatures(context.anchor, {"second": shape}, 0.1)["second"]
    # One step moves each direction of the eigenbases by the rate.
    step = rate * found.outputs.sum(1, keepdim=True) @ found.inputs.sum(1, keepdim=True).T
    for _ in range(4000):
        with torch.no_grad():
            shape += step
        parts.constrain(Update({}, {}, 1))
    along = found.outputs.T @ (shape.detach() - origin["second.weight"]) @ found.inputs
    curved = (found.g[:, None] + 0.1) * found.c[None, :]
    stiff = curved > 0.05
    assert stiff.any()
    torch.testing.assert_close(along[stiff], (rate / (weight * curved))[stiff], rtol=0.01, atol=0)


@pytest.mark.parametrize("growth", [-1.0, 1.0, 8.0, 80.0])
@pytest.mark.parametrize("read", [True, False])
def test_a_rate_of_zero_still_has_a_weight(growth: float, read: bool) -> None:
    context = make_setting()
    assert context.anchor is not None
    rate = 0.0 if read else torch.zeros((), dtype=torch.float64)
    last = Update({}, {}, 1, rate_left=rate)
    found = drawn_back(context.backbone, context.anchor, last, growth=growth)
    assert all(tensor.isfinite().all() for tensor in found.values())


def test_by_its_gradient_the_penalty_is_added_to_the_tasks() -> None:
    """sum_ij w h_ij D_ij^2 / 2 has the gradient to which an excess of small weight tends."""
    context = make_setting(step="gradient")
    toy, origin = context.backbone, values(context.backbone)
    parts = kfac.METHOD.start(context)
    assert parts.pull is not None and parts.constrain is None and context.anchor is not None
    move(toy)
    for parameter in toy.parameters():
        parameter.grad = torch.ones_like(parameter) if parameter.requires_grad else None
    toy.second.weight.grad = None
    parts.pull()
    assert toy.second.weight.grad is None
    found = curvatures(context.anchor, {"first": weights(toy, "first")[0]}, 0.1)["first"]
    moved = minus(weights(toy, "first"), (origin["first.weight"], origin["first.bias"]))
    for tensor, small in zip(weights(toy, "first"), found.excess(*moved, 1e-9), strict=True):
        torch.testing.assert_close(tensor.grad - 1, 0.3 * small / 1e-9, rtol=1e-5, atol=1e-7)


def make_pairs(*sizes: float) -> list[tuple[nn.Parameter, nn.Parameter]]:
    """Maps whose gradients have these sizes everywhere."""
    pairs = [(nn.Parameter(torch.zeros(3, 2)), nn.Parameter(torch.zeros(3))) for _ in sizes]
    for pair, size in zip(pairs, sizes, strict=True):
        for parameter in pair:
            parameter.grad = torch.full_like(parameter, size)
    return pairs


@pytest.mark.parametrize("scale", [1.0, 1e-12])
@pytest.mark.parametrize("balance", [0.5, 1.0])
def test_a_map_learns_the_slower_the_smaller_its_gradient(balance: float, scale: float) -> None:
    """Weight and bias alike, at any scale of the loss."""
    large, small, none = pairs = make_pairs(2.0 * scale, 0.5 * scale, 0.0)
    rms = ((4 + 0.25) / 3) ** 0.5  # of all maps' entries together
    found = kfac.shares(dict(zip("abc", pairs, strict=True)), balance)
    for pair, share in (
        (large, 2 / (2 + balance * rms)),
        (small, 0.5 / (0.5 + balance * rms)),
        (none, 0.0),
    ):
        assert [found[t] for t in pair] == pytest.approx([share] * 2)


def test_a_map_that_the_loss_does_not_reach_does_not_move() -> None:
    reached, other = make_pairs(1.0, 1.0)
    for parameter in other:
        parameter.grad = None
    found = kfac.shares({"a": reached, "b": other}, 1.0)
    assert {found[t] for t in other} == {0.0} and min(found[t] for t in reached) > 0.3
