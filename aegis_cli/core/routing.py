"""Routed low-rank experts beside a frozen linear map:

    y = W x + s_t sum_e p_{t,e}(x) B_e A_e x,    with A_e [r, d_in] random, B_e [d_out, r] zero

Each task t has one router per map: the experts that it may use, in a fixed order, a softmax p over
only these, and a scale s. A task computes only with the experts of its own router, so later
additions change no bit of its outputs.

Why routing is a projection. With f(x) = s sum_e p_e(x) B_e A_e x and the loss's gradient g at y,

    dL/dB_e = s p_e(x) g (A_e x)^T,    dL/dp_e = s <g, B_e A_e x>

A small p_e scales down the gradient that reaches B_e, and at p_e = 0 the expert does not learn. A
router over frozen experts moves f by s sum_e dp_e B_e A_e x, which lies in span{B_e A_e x}:
whatever the gradient g is, the descent follows only its part inside the span of the experts.
Pushing p towards old experts thus projects a new task's gradient onto their span, which is never
computed.

The logits: logit_e = <u_e, A_e x> + b_e reads what the expert itself reads, with r + 1 numbers per
expert. At a map with d_in inputs that is d_in / r times less than a linear router on x, which would
cost about as much as the experts that it saves. Using the codes A_e x as the router's input is our
choice. `top` selects the usual linear router instead, with one gate per sequence, or a `constant`
one, which reads nothing.
"""

from __future__ import annotations

import math
from collections.abc import Generator, ItemsView, Mapping, Sequence, ValuesView
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from aegis_cli.core.numerics import wide_type

M = TypeVar("M", bound=nn.Module)


class Traced(NamedTuple):
    """One forward pass of a map over positions [...].

    Attributes:
        weights: p [..., E].
        codes: A_e x [..., E, r].
        outputs: y [..., d_out].
    """

    weights: Tensor
    codes: Tensor
    outputs: Tensor


class Expert(nn.Module):
    """A low-rank map B A, initially zero.

    Attributes:
        owner: number of the task that added it, or took it over.
        frozen: True if no later task trains it.
    """

    def __init__(self, base: nn.Linear, rank: int, owner: int) -> None:
        super().__init__()
        self.owner, self.frozen = owner, False
        # In half precision, small steps would be lost.
        wide = wide_type(base.weight.dtype)
        self.a = nn.Parameter(base.weight.new_zeros(rank, base.in_features, dtype=wide))
        self.b = nn.Parameter(base.weight.new_zeros(base.out_features, rank, dtype=wide))

    @torch.no_grad()
    def draw(self, generator: torch.Generator) -> None:
        """Draw A uniformly in +-1/sqrt(d_in), as LoRA does (arXiv 2106.09685).

        The numbers are drawn on the CPU, so that they are the same on every device.
        """
        bound = 1 / math.sqrt(self.a.shape[1])
        self.a.copy_(torch.empty(self.a.shape).uniform_(-bound, bound, generator=generator))


class Router(nn.Module):
    """Softmax weights over the experts of one task at one map, and the scale of their sum.

    Its weights start equal, unless `top` is set: the top k of equal logits would always be the same
    experts, so these logits are drawn at random. A router with `top` reads the mean of a sequence
    and gives all its positions the same weights; a `constant` one gives all sequences the same
    weights too. A single expert has weight 1, and its router has no parameters but the scale.
    """

    def __init__(
        self,
        base: nn.Linear,
        experts: Sequence[int],
        rank: int,
        top: int | None = None,
        constant: bool = False,
    ) -> None:
        super().__init__()
        self.experts, self.top, self.constant = tuple(experts), top, constant
        like, count, wide = base.weight, len(experts), wide_type(base.weight.dtype)
        self.scale = nn.Parameter(like.new_ones((), dtype=wide))
        self.read: nn.Parameter | None = None
        self.bias: nn.Parameter | None = None
        if count == 1:
            return
        if not constant:
            width = rank if top is None else base.in_features  # of a code, or of the map's input
            self.read = nn.Parameter(like.new_zeros(count, width, dtype=wide))
        if constant or top is None:
            self.bias = nn.Parameter(like.new_zeros(count, dtype=wide))

    @torch.no_grad()
    def draw(self, generator: torch.Generator) -> None:
        """Draw the parameters behind the logits at random, if `top` is set."""
        if self.top is None or len(self.experts) == 1:
            return
        drawn = self.bias if self.constant else self.read
        assert drawn is not None
        width = 1 if self.constant else drawn.shape[1]
        # Scaled so that a sum over `width` inputs has standard deviation 1, whatever the width.
        drawn.copy_(torch.randn(drawn.shape, generator=generator) / math.sqrt(width))

    def forward(self, x: Tensor, codes: Tensor) -> Tensor:
        """Weights of the experts at each position [..., T, E]; they sum to 1.

        Args:
            x: the map's inputs, [..., T, d_in].
            codes: A_e x, [..., T, E, r].
        """
        if len(self.experts) == 1:
            return codes.new_ones(codes.shape[:-1])
        if self.top is None:
            assert self.read is not None and self.bias is not None
            logits = (codes * self.read).sum(-1) + self.bias  # [..., T, E]
            return logits.float().softmax(-1).to(codes.dtype)
        mean = x.mean(-2, keepdim=True)  # [..., 1, d_in]
        if self.constant:
            assert self.bias is not None
            logits = self.bias.expand(*mean.shape[:-1], -1).float()
        else:
            assert self.read is not None
            logits = nn.functional.linear(mean, self.read).float()  # [..., 1, E]
        chosen = logits.topk(min(self.top, logits.shape[-1]), dim=-1).indices
        outside = torch.ones_like(logits, dtype=torch.bool).scatter(-1, chosen, False)
        # Minus infinity gives a weight of exactly 0, so the expert does not learn.
        weights = logits.masked_fill(outside, -math.inf).softmax(-1).to(codes.dtype)
        return weights.expand(codes.shape[:-1])  # [..., T, E], the same at each position

    def logit_parameters(self) -> list[nn.Parameter]:
        """The parameters behind the logits; a single expert has none."""
        return [p for p in (self.read, self.bias) if p is not None]

    def restrict(self, kept: Sequence[int]) -> None:
        """Forget all experts but `kept`, a subset in the router's order.

        The logits of the remaining ones do not change.
        """
        rows = [self.experts.index(e) for e in kept]
        self.experts = tuple(kept)
        for name in ("read", "bias"):
            old = getattr(self, name)
            if old is None:
                continue
            fresh = None  # a single expert needs no logits
            if len(rows) > 1:
                fresh = nn.Parameter(old.detach()[rows].clone(), old.requires_grad)
            setattr(self, name, fresh)


class _Modules(nn.ModuleDict, Generic[M]):
    """Modules of one class, by name."""

    if TYPE_CHECKING:

        def __getitem__(self, key: str) -> M: ...
        def items(self) -> ItemsView[str, M]: ...
        def values(self) -> ValuesView[M]: ...


class RoutedLinear(nn.Module):
    """A frozen map, the experts beside it, and a router for each task that uses some of them.

    Attributes:
        experts: by number.
        routers: by task.
        active: number of the task whose router is used. With None, or a task without a router here,
            the map is bare.
        born: how many experts were ever created, which is the number of the next one.
        trace: where passes are recorded inside `traced`.
    """

    experts: _Modules[Expert]
    routers: _Modules[Router]

    def __init__(self, base: nn.Linear) -> None:
        super().__init__()
        self.base = base.requires_grad_(False)
        self.experts, self.routers = _Modules(), _Modules()
        self.active: int | None = None
        self.born = 0
        self.trace: list[Traced] | None = None

    def forward(self, x: Tensor) -> Tensor:
        y = self.base(x)
        router = self.router(self.active)
        if router is None:
            return y
        experts = self.of(router.experts)
        # Beside a map in half precision, the products are computed in its dtype.
        dtype = self.base.weight.dtype
        rows = torch.cat([e.a for e in experts]).to(dtype)  # [E*r, d_in]
        # All experts of a router have the same rank, so one product gives all their codes.
        joined = nn.functional.linear(x, rows)  # [..., E*r]
        codes = joined.unflatten(-1, (len(experts), -1))  # [..., E, r]
        weights = router(x, codes)  # [..., E]
        # The scale multiplies the codes, which are smaller than y, and one product over the columns
        # of all experts also computes the sum.
        strengths = (router.scale * weights).unsqueeze(-1)  # s p_e, [..., E, 1]
        mixed = (strengths * codes).flatten(-2)  # [..., E*r]
        columns = torch.cat([e.b for e in experts], dim=1).to(dtype)  # [d_out, E*r]
        added_up = torch.addmm(y.flatten(0, -2), mixed.flatten(0, -2), columns.T)
        y = added_up.view_as(y)
        if self.trace is not None:
            self.trace.append(Traced(weights, codes, y))
        return y

    def router(self, task: int | None) -> Router | None:
        """The task's router at this map, if it has one."""
        name = str(task)
        if name not in self.routers:  # a ModuleDict has no `get`
            return None
        return self.routers[name]

    def of(self, numbers: Sequence[int]) -> list[Expert]:
        """The experts with these numbers."""
        return [self.experts[str(n)] for n in numbers]

    @property
    def numbers(self) -> tuple[int, ...]:
        """Numbers of all experts, in order of creation; no number is used twice."""
        return tuple(int(n) for n in self.experts)

    def add_expert(self, rank: int, owner: int, generator: torch.Generator) -> int:
        """Create a new expert with a random A and return its number."""
        # Numbers of deleted experts are not reused: routers and files name experts by them.
        number = self.born
        expert = Expert(self.base, rank, owner)
        expert.draw(generator)
        self.experts[str(number)] = expert
        self.born += 1
        return number

    def add_router(
        self,
        task: int,
        experts: Sequence[int],
        generator: torch.Generator,
        top: int | None = None,
        constant: bool = False,
    ) -> Router:
        """Create a router of `task` over `experts` (at least one) and return it."""
        rank = self.experts[str(experts[0])].a.shape[0]
        router = Router(self.base, experts, rank, top, constant)
        router.draw(generator)
        self.routers[str(task)] = router
        return router

    def restrict(self, task: int, kept: Sequence[int]) -> None:
        """Let the task's router forget all experts but `kept`; delete experts without a router."""
        router = self.routers[str(task)]
        router.restrict(kept)
        if not kept:
            del self.routers[str(task)]
        used = set[int]()
        for other in self.routers.values():
            used.update(other.experts)
        for number in set(self.numbers) - used:
            del self.experts[str(number)]

    @torch.no_grad()
    def merged(self, task: int) -> nn.Linear:
        """The map with the task's only expert merged; bare if the task has no router.

        Raises:
            ValueError: the router has several experts, whose weights depend on the input.
        """
        router = self.router(task)
        if router is None:
            return self.base
        if len(router.experts) > 1:
            raise ValueError(f"a router over {len(router.experts)} experts")
        (expert,) = self.of(router.experts)  # its routing weight is 1
        self.base.weight.addmm_(expert.b, expert.a, alpha=float(router.scale))
        return self.base

    def count(self) -> int:
        """How many numbers it stores beside the map: experts, routers and scales."""
        return sum(p.numel() for part in (self.experts, self.routers) for p in part.parameters())

    # --- structure, apart from the tensors --------------------------------------------------------

    def structure(self) -> dict[str, Any]:
        """Everything but the tensors, as plain JSON."""
        experts = {
            n: {"owner": e.owner, "frozen": e.frozen, "rank": e.a.shape[0]}
            for n, e in self.experts.items()
        }
        routers = {
            t: {"experts": list(r.experts), "top": r.top, "constant": r.constant}
            for t, r in self.routers.items()
        }
        return {"born": self.born, "experts": experts, "routers": routers}

    def rebuild(self, structure: Mapping[str, Any]) -> None:
        """Recreate the modules of `structure`, frozen; their tensors are still to be loaded."""
        self.experts, self.routers, self.born = _Modules(), _Modules(), structure["born"]
        # JSON keys are sorted as text, 10 before 2; `numbers` promises the order of creation.
        for number in sorted(structure["experts"], key=int):
            said = structure["experts"][number]
            expert = Expert(self.base, said["rank"], said["owner"])
            expert.frozen = said["frozen"]
            self.experts[number] = expert
        for task in sorted(structure["routers"], key=int):
            said = structure["routers"][task]
            rank = structure["experts"][str(said["experts"][0])]["rank"]
            self.routers[task] = Router(
                self.base, said["experts"], rank, said["top"], said["constant"]
            )
        self.requires_grad_(False)


Routed = Mapping[str, RoutedLinear]


def route(root: nn.Module, sites: Mapping[str, nn.Linear]) -> dict[str, RoutedLinear]:
    """Replace each linear map by a `RoutedLinear`; the outputs do not change yet.

    Args:
        sites: the maps, by their dotted names in `root`.
    """
    routed = {}
    for name, linear in sites.items():
        parent, _, leaf = name.rpartition(".")
        routed[name] = RoutedLinear(linear)
        setattr(root.get_submodule(parent), leaf, routed[name])
    return routed


def merge(root: nn.Module, sites: Routed, task: int) -> None:
    """Replace each routed map by a plain one that computes the same for the task.

    The routed maps must not be used afterwards.

    Args:
        sites: by their dotted names in `root`, as `route` returned them.

    Raises:
        ValueError: as in `RoutedLinear.merged`; the weights of other maps may have changed by then.
    """
    plain = {name: site.merged(task) for name, site in sites.items()}
    for name, linear in plain.items():
        parent, _, leaf = name.rpartition(".")
        setattr(root.get_submodule(parent), leaf, linear)


def activate(sites: Routed, task: int | None) -> None:
    """Let every map compute for `task`; with None, the maps are bare."""
    for site in sites.values():
        site.active = task


@contextmanager
def traced(sites: Routed) -> Generator[dict[str, list[Traced]]]:
    """Record the passes of each map inside the block, with their graphs."""
    found: dict[str, list[Traced]] = {name: [] for name in sites}
    for name, site in sites.items():
        site.trace = found[name]
    try:
        yield found
    finally:
        for site in sites.values():
            site.trace = None


def named_parameters(sites: Routed) -> dict[str, nn.Parameter]:
    """Parameters of experts, routers and scales by `{site}.{name}`, without those of the maps."""
    found = {}
    for site, routed in sites.items():
        for name, parameter in routed.named_parameters():
            if not name.startswith("base."):
                found[f"{site}.{name}"] = parameter
    return found
