"""One module of each kind that an anchor describes; the inputs span only part of its space."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from aegis_cli.core import nullspace
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.nullspace import Protection, Strength
from aegis_cli.core.pairs import Pair, minus
from aegis_cli.core.spectrum import Spectrum, channel_moment, decompose, second_moment
from aegis_cli.methods.site_weights import weights
from aegis_cli.models.backbones import Backbone

SITE = "map"
Inputs = tuple[Tensor, ...]


class Toy(nn.Module):
    """One site; a table with a second input also scores it against its rows, as tied heads do."""

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self.map = module

    def forward(self, x: Tensor, scored: Tensor | None = None) -> Tensor:
        read = self.map(x)
        return (
            read
            if scored is None
            else torch.cat([read.flatten(), (scored @ self.map.weight.T).flatten()])
        )


@dataclass(frozen=True)
class Case:
    """One site's inputs.

    `vqa` draws new inputs of the protected span at every call, and `any` draws inputs that span
    everything.
    """

    make: Callable[[], nn.Module]
    vqa: Callable[[], Inputs]
    any: Callable[[], Inputs]

    def model(self) -> Toy:
        with torch.random.fork_rng():
            torch.manual_seed(1)
            return Toy(self.make()).double()


def draw(*shape: int) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64)


def fixed(*shape: int) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2))


def half_constant(constant: Tensor) -> Tensor:
    """[64, 8]: once normalised, the first channels always read `constant` [4]; the others vary."""
    varying = draw(64, 4)
    varying = varying - varying.mean(-1, keepdim=True)
    varying = (
        varying * ((8 - constant.square().sum()) / varying.square().sum(-1, keepdim=True)).sqrt()
    )
    return torch.cat([constant.expand(64, 4), varying], -1) * (0.5 + draw(64, 1).abs()) + draw(
        64, 1
    )


def zeros_and(*constants: float) -> Tensor:
    return torch.tensor([*constants, *[-c for c in constants]], dtype=torch.float64)


CASES = {
    "linear": Case(
        lambda: nn.Linear(6, 5), lambda: (draw(4, 30, 3) @ fixed(3, 6),), lambda: (draw(4, 30, 6),)
    ),
    "linear without bias": Case(
        lambda: nn.Linear(6, 5, bias=False),
        lambda: (draw(40, 2) @ fixed(2, 6),),
        lambda: (draw(40, 6),),
    ),
    "linear, most protected": Case(
        lambda: nn.Linear(6, 5), lambda: (draw(40, 5) @ fixed(5, 6),), lambda: (draw(40, 6),)
    ),
    "conv": Case(
        lambda: nn.Conv2d(4, 5, 3, stride=2, padding=1),
        lambda: (torch.einsum("nrhw,rc->nchw", draw(6, 2, 8, 8), fixed(2, 4)),),
        lambda: (draw(6, 4, 8, 8),),
    ),
    "conv without bias or padding": Case(
        lambda: nn.Conv2d(4, 3, 4, stride=2, bias=False),
        lambda: (torch.einsum("nrhw,rc->nchw", draw(9, 1, 8, 8), fixed(1, 4)),),
        lambda: (draw(9, 4, 8, 8),),
    ),
    "norm": Case(
        lambda: nn.LayerNorm(8, eps=0),
        lambda: (half_constant(zeros_and(1.0, 0.5)),),
        lambda: (draw(64, 8),),
    ),
    "norm without shift": Case(
        lambda: nn.LayerNorm(8, eps=0, bias=False),
        lambda: (half_constant(zeros_and(0.0, 0.0)),),
        lambda: (draw(64, 8),),
    ),
    "rows": Case(
        lambda: nn.Embedding(9, 4),
        lambda: (torch.randint(4, (5, 20)),),
        lambda: (torch.randint(9, (5, 40)),),
    ),
    "tied head": Case(
        lambda: nn.Embedding(9, 6),
        lambda: (torch.randint(4, (5, 20)), draw(30, 3) @ fixed(3, 6)),
        lambda: (torch.randint(9, (5, 40)), draw(30, 6)),
    ),
}


@pytest.fixture
def fixed_draws() -> Iterator[None]:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest) -> Case:
    return CASES[request.param]


def rows_of(module: nn.Module, x: Tensor) -> Tensor:
    """The inputs that the module's parameters multiply, written out: [n, d]."""
    if isinstance(module, nn.Conv2d):
        k, s, p = module.kernel_size[0], module.stride[0], module.padding[0]
        x = F.pad(x, (p, p, p, p))
        corners = range(0, x.shape[-1] - k + 1, s)
        return torch.cat(
            [x[:, :, i : i + k, j : j + k].flatten(1) for i in corners for j in corners]
        )
    if isinstance(module, nn.LayerNorm):
        return (x - x.mean(-1, keepdim=True)) / x.std(-1, correction=0, keepdim=True)
    return x.flatten(0, -2)


def dense_rows(module: nn.Module, x: Tensor) -> Tensor:
    """The inputs that a linear map or convolution multiplies, with a 1 if it has a bias."""
    rows = rows_of(module, x)
    return rows if module.bias is None else with_one(rows)


def with_one(rows: Tensor) -> Tensor:
    """Rows [n, d] with a 1 appended, [n, d + 1]."""
    return torch.cat([rows, rows.new_ones(len(rows), 1)], 1)


def measure(module: nn.Module, inputs: Inputs, energy: float = 1.0) -> dict[str, Spectrum]:
    """The spectra that an anchor would hold of these inputs."""
    if isinstance(module, nn.Embedding):
        own = Spectrum(
            (torch.bincount(inputs[0].flatten(), minlength=module.num_embeddings) > 0).double(),
            None,
        )
        scores = [decompose(second_moment(h), energy) for h in inputs[1:]]
        return {SITE: own} | {f"{SITE}.scores": s for s in scores}
    if isinstance(module, nn.LayerNorm):
        moment = channel_moment(rows_of(module, inputs[0]), module.bias is not None)
    else:
        moment = second_moment(dense_rows(module, inputs[0]))
    return {SITE: decompose(moment, energy)}


def protection_of(case: Case, inputs: Inputs, energy: float, soft: float = 0.0) -> Protection:
    module = case.model().map
    return nullspace.protections(
        Anchor(inputs=measure(module, inputs)), {SITE: module.weight}, Strength(energy, soft)
    )[SITE]


def random_update(case: Case) -> Pair:
    module = case.make().double()
    bias = getattr(module, "bias", None)
    return draw(*module.weight.shape), None if bias is None else draw(*bias.shape)


def assert_same(x: Pair, y: Pair, tolerance: float = 1e-10) -> None:
    for a, b in zip(x, y, strict=True):
        assert (a is None) == (b is None)
        if a is not None and b is not None:
            torch.testing.assert_close(a, b, rtol=0, atol=tolerance)


def size(update: Pair) -> float:
    """|weight|^2 + |bias|^2."""
    return sum(float(tensor.double().square().sum()) for tensor in update if tensor is not None)


def protected_share(
    protections: Mapping[str, Protection], updates: Iterable[tuple[str, Pair]]
) -> float:
    """Share of the updates' energy along protected directions; 0 if nothing moved."""
    inside, total = 0.0, 0.0
    for site, update in updates:
        inside += size(protections[site].removed(*update))
        total += size(update)
    return inside / total if total else 0.0


@torch.no_grad()
def share_of_displacement(now: nn.Module, then: Backbone, anchor: Anchor, energy: float) -> float:
    """Share of the movement between two models along directions with `energy` of the VQA inputs."""
    start = {site: weights(then, site) for site in then.sites()}
    protections = nullspace.protections(
        anchor, {site: pair[0] for site, pair in start.items()}, Strength(energy)
    )
    moved = {site: minus(weights(now, site), pair) for site, pair in start.items()}
    return protected_share(protections, moved.items())
