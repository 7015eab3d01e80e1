"""`kfac` and `nullspace` batch maps of one shape if launching a product takes longest.

The device decides this; here the CPU is treated as such a device.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import pytest
import torch
from samples.nullspace import with_one
from torch import Tensor, nn

from aegis_cli.common import devices
from aegis_cli.core import stacking
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.spectrum import channel_moment, decompose, lone_row, second_moment
from aegis_cli.methods import METHODS
from aegis_cli.methods.base import MethodContext, Update
from aegis_cli.recipes import Kfac, Nullspace

pytestmark = pytest.mark.usefixtures("fixed_draws")

WIDTH, STEPS = 6, 3
LAYERS = ("a", "b", "c")


class Toy(nn.Module):
    """Three maps, one of them without bias, two normalisations, a convolution and a lone row."""

    def __init__(self) -> None:
        super().__init__()
        for name in LAYERS:
            self.add_module(name, nn.Linear(WIDTH, WIDTH, bias=name != "c"))
        self.first, self.second = nn.LayerNorm(WIDTH), nn.LayerNorm(WIDTH)
        self.stem = nn.Conv2d(2, WIDTH, 3)
        self.row = nn.Parameter(torch.randn(WIDTH))
        self.double()

    def forward(self, x: Tensor) -> Tensor:
        x = self.stem(x).flatten(2).mT + self.row
        x = self.b(self.first(self.a(x)).tanh())
        return self.c(self.second(x))


def rows(width: int) -> Tensor:
    return torch.randn(4, width, dtype=torch.float64)


def make_anchor() -> Anchor:
    """An anchor of maps with different numbers of directions."""
    inputs = {name: decompose(second_moment(with_one(rows(WIDTH)))) for name in LAYERS}
    inputs["b"] = decompose(second_moment(with_one(rows(WIDTH)[:2])))
    inputs["c"] = decompose(second_moment(rows(WIDTH)))  # has no bias
    inputs["stem"] = decompose(second_moment(with_one(rows(2 * 9))))
    outputs = {f"{name}.outputs": decompose(second_moment(rows(WIDTH))) for name in inputs}
    curved = {f"{name}.inputs": found for name, found in inputs.items()} | outputs
    norms = {name: decompose(channel_moment(rows(WIDTH), True)) for name in ("first", "second")}
    return Anchor(inputs=inputs | norms | {"row": lone_row()}, curvature=curved)


def trained(method: str, options: dict[str, Any], together: bool) -> tuple[Toy, list[int]]:
    """A toy after some constrained steps, and the number of maps in each group."""
    found = METHODS[method]
    counts: list[int] = []
    stack = stacking.stacked

    def counted(pairs: Any) -> Any:
        counts.append(len(pairs))
        return stack(pairs)

    with pytest.MonkeyPatch.context() as patch, torch.random.fork_rng():
        torch.manual_seed(1)
        patch.setattr(devices, "reading_stalls", lambda _: together)
        patch.setattr(stacking, "stacked", counted)
        toy = Toy()
        found.adapt(toy, {}, options)
        sites = dict.fromkeys((*LAYERS, "stem"), "maps")
        sites |= dict.fromkeys(("first", "second"), "norms") | {"row": "embeddings"}
        context = MethodContext(toy, {"all": list(toy.parameters())}, sites, options, make_anchor())
        parts = found.start(context)
        assert parts.constrain is not None
        learning = {name: p for name, p in toy.named_parameters() if p.requires_grad}
        optimizer = torch.optim.SGD(learning.values(), lr=0.1)
        for _ in range(STEPS):
            before = {name: p.detach().clone() for name, p in learning.items()}
            if parts.begin is not None:
                parts.begin()
            optimizer.zero_grad()
            toy(torch.randn(5, 2, 4, 4, dtype=torch.float64)).square().sum().backward()
            if parts.pull is not None:
                parts.pull()
            optimizer.step()
            parts.constrain(Update(before, {}))
        return toy, counts


CASES = [
    ("kfac", asdict(Kfac(weight=0.3, damping=0.1, balance=0.0, every=1))),
    ("nullspace", asdict(Nullspace(energy=0.9, every=1))),
    ("nullspace", asdict(Nullspace(soft=0.1, every=1))),
    ("nullspace", asdict(Nullspace(energy=0.9, every=1, keeps="coordinates"))),
]


@pytest.mark.parametrize(("method", "options"), CASES)
def test_maps_end_where_each_would_by_itself(method: str, options: dict[str, Any]) -> None:
    alone, apart = trained(method, options, together=False)
    both, counts = trained(method, options, together=True)
    assert not any(count > 1 for count in apart) and 2 in counts
    for (name, x), y in zip(alone.named_parameters(), both.parameters(), strict=True):
        torch.testing.assert_close(x, y, rtol=1e-9, atol=1e-12, msg=name)
