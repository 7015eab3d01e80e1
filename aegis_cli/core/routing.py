"""Routed low-rank experts beside a frozen linear map:

    y = W x + s_t sum_e p_{t,e}(x) B_e A_e x,    A_e [r, d_in] drawn, B_e [d_out, r] zero

Of a task t there is one router a map: the experts it may use in a fixed order, a softmax p over
these alone, and a scale s. A task computes with its own router's experts and nothing else, so what
later tasks add changes no bit of its outputs.

Why routing is a projection. With f(x) = s sum_e p_e(x) B_e A_e x and the loss's gradient g at y,

    dL/dB_e = s p_e(x) g (A_e x)^T,    dL/dp_e = s <g, B_e A_e x>

A small p_e scales the gradient that reaches B_e, and at p_e = 0 the expert is out of the descent. A
router over frozen experts moves f by s sum_e dp_e B_e A_e x, which lies in span{B_e A_e x}:
whatever the gradient g is, only its part inside the span of the experts is descended. Pushing p
towards old experts thus projects a new task's gradient on what they span, without that span ever
being computed.

Which logits: logit_e = <u_e, A_e x> + b_e reads what the expert itself reads, r + 1 numbers an
expert. Of a map with d_in inputs that is d_in / r times less than a linear router on x, which would
cost about as much as the experts it saves. The code as a router's input is a choice of this
package; `top` is the usual linear router, of one gate a sequence, or a `constant` one, which reads
nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn


class Traced(NamedTuple):
    """One pass of a map over positions [...]: p [..., E], the codes A_e x [..., E, r], and what it
    put out, y [..., d_out].
    """

    weights: Tensor
    codes: Tensor
    outputs: Tensor


class Expert(nn.Module):
    """B A, at first zero.

    Attributes:
        owner: number of the task that brought it, or made it its own.
        frozen: no later task trains it.
    """

    def __init__(self, base: nn.Linear, rank: int, owner: int) -> None:
        super().__init__()
        self.owner, self.frozen = owner, False
        self.a = nn.Parameter(base.weight.new_zeros(rank, base.in_features))
        self.b = nn.Parameter(base.weight.new_zeros(base.out_features, rank))

    @torch.no_grad()
    def draw(self, generator: torch.Generator) -> None:
        """A uniform in +-1/sqrt(d_in), as LoRA draws it (arXiv 2106.09685); drawn on the CPU."""
        bound = 1 / math.sqrt(self.a.shape[1])
        self.a.copy_(torch.empty(self.a.shape).uniform_(-bound, bound, generator=generator))


class Router(nn.Module):
    """Softmax weights over the experts of one task at one map, and the scale of their sum.

    It starts uniform, but for one of the `top` k, which is drawn: the top k of equal logits would
    always be the same. That one reads the mean of a sequence, and weights all its positions alike,
    or as a `constant` one all sequences too. A single expert has weight 1 and needs no router's
    parameters.
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
        like, count = base.weight, len(experts)
        self.scale = nn.Parameter(like.new_ones(()))
        width = rank if top is None else base.in_features
        reads, shifts = not constant, constant or top is None
        self.read = nn.Parameter(like.new_zeros(count, width)) if count > 1 and reads else None
        self.bias = nn.Parameter(like.new_zeros(count)) if count > 1 and shifts else None

    @torch.no_grad()
    def draw(self, generator: torch.Generator) -> None:
        if self.top is None or len(self.experts) == 1:
            return
        drawn, width = (self.bias, 1) if self.constant else (self.read, self.read.shape[1])
        drawn.copy_(torch.randn(drawn.shape, generator=generator) / math.sqrt(width))

    def forward(self, x: Tensor, codes: Tensor) -> Tensor:
        """Weights [..., T, E] of x [..., T, d_in] with codes [..., T, E, r]; they sum to 1."""
        if len(self.experts) == 1:
            return codes.new_ones(codes.shape[:-1])
        if self.top is None:
            return ((codes * self.read).sum(-1) + self.bias).float().softmax(-1).to(codes.dtype)
        mean = x.mean(-2, keepdim=True)
        logits = (
            self.bias.expand(*mean.shape[:-1], -1)
            if self.constant
            else nn.functional.linear(mean, self.read)
        ).float()
        chosen = logits.topk(min(self.top, logits.shape[-1]), dim=-1).indices
        outside = torch.ones_like(logits, dtype=torch.bool).scatter(-1, chosen, False)
        return (
            logits.masked_fill(outside, -math.inf)
            .softmax(-1)
            .to(codes.dtype)
            .expand(codes.shape[:-1])
        )

    def logit_parameters(self) -> list[nn.Parameter]:
        return [p for p in (self.read, self.bias) if p is not None]

    def restrict(self, kept: Sequence[int]) -> None:
        """Forget all experts but `kept` (a subset, in the router's order); the others' logits stay
        as they are.
        """
        rows = [self.experts.index(e) for e in kept]
        self.experts = tuple(kept)
        for name in ("read", "bias"):
            old = getattr(self, name)
            if old is not None:
                fresh = (
                    nn.Parameter(old.detach()[rows].clone(), old.requires_grad)
                    if len(rows) > 1
                    else None
                )
                setattr(self, name, fresh)


class RoutedLinear(nn.Module):
    """A frozen map, the experts beside it, and a router for each task that has some.

    Attributes:
        active: number of the task whose router is used; None, or a task without a router here: the
            bare map.
        trace: where passes are noted while `traced` is on.
    """

    def __init__(self, base: nn.Linear) -> None:
        super().__init__()
        self.base = base.requires_grad_(False)
        self.experts, self.routers = nn.ModuleDict(), nn.ModuleDict()
        self.active: int | None = None
        self.born = 0
        self.trace: list[Traced] | None = None

    def forward(self, x: Tensor) -> Tensor:
        y = self.base(x)
        router = self.router(self.active)
        if router is None:
            return y
        experts = self.of(router.experts)
        codes = nn.functional.linear(x, torch.cat([e.a for e in experts])).unflatten(
            -1, (len(experts), -1)
        )
        weights = router(x, codes)
        # the scale meets the codes, which are smaller than y, and the sum is part of the product
        mixed = ((router.scale * weights).unsqueeze(-1) * codes).flatten(-2)
        columns = torch.cat([e.b for e in experts], dim=1)
        y = torch.addmm(y.flatten(0, -2), mixed.flatten(0, -2), columns.T).view_as(y)
        if self.trace is not None:
            self.trace.append(Traced(weights, codes, y))
        return y

    def router(self, task: int | None) -> Router | None:
        name = str(task)
        if name not in self.routers:  # a ModuleDict has no `get`
            return None
        return self.routers[name]

    def of(self, numbers: Sequence[int]) -> list[Expert]:
        return [self.experts[str(n)] for n in numbers]

    @property
    def numbers(self) -> tuple[int, ...]:
        """Of all experts there are, in the order they came in; a number is never given twice."""
        return tuple(int(n) for n in self.experts)

    def add_expert(self, rank: int, owner: int, generator: torch.Generator) -> int:
        """A new expert's number."""
        number, expert = self.born, Expert(self.base, rank, owner)
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
        """A router of `task` over `experts`; none, and the task has the bare map here."""
        router = Router(self.base, experts, self.experts[str(experts[0])].a.shape[0], top, constant)
        router.draw(generator)
        self.routers[str(task)] = router
        return router

    def restrict(self, task: int, kept: Sequence[int]) -> None:
        """Let the task's router forget all experts but `kept`; an expert in no router is gone."""
        router = self.routers[str(task)]
        router.restrict(kept)
        if not kept:
            del self.routers[str(task)]
        used = {e for r in self.routers.values() for e in r.experts}
        for number in set(self.numbers) - used:
            del self.experts[str(number)]

    def count(self) -> int:
        """Numbers that it holds beside the map: experts, routers, scales."""
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
        """Become what `structure` says, with tensors that are still to be loaded;
        nothing learns.
        """
        self.experts, self.routers, self.born = nn.ModuleDict(), nn.ModuleDict(), structure["born"]
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
    """Put a `RoutedLinear` in the place of each of `sites` (by dotted name in `root`); nothing
    changes yet.
    """
    routed = {}
    for name, linear in sites.items():
        parent, _, leaf = name.rpartition(".")
        routed[name] = RoutedLinear(linear)
        setattr(root.get_submodule(parent), leaf, routed[name])
    return routed


def activate(sites: Routed, task: int | None) -> None:
    """Let every map compute for `task`; None: the bare maps."""
    for site in sites.values():
        site.active = task


@contextmanager
def traced(sites: Routed) -> Iterator[dict[str, list[Traced]]]:
    """Inside, the passes of each map are noted, with their graphs."""
    found: dict[str, list[Traced]] = {name: [] for name in sites}
    for name, site in sites.items():
        site.trace = found[name]
    try:
        yield found
    finally:
        for site in sites.values():
            site.trace = None


def named_parameters(sites: Routed) -> dict[str, nn.Parameter]:
    """Experts', routers' and scales' parameters by `{site}.{name}`; the maps' own weights are not
    among them.
    """
    return {
        f"{site}.{name}": parameter
        for site, routed in sites.items()
        for name, parameter in routed.named_parameters()
        if not name.startswith("base.")
    }
