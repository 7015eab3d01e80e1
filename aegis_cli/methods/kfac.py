"""A proximal penalty with the Kronecker-factored curvature of the answers to VQA, map by map.

It takes the proximal step of (w / 2) sum_ij h_ij (W - W0)_ij^2 in the eigenbases of the two factors
of K-FAC (arXiv 1503.05671; see core/curvature.py). Within one map this is elastic weight
consolidation with a Kronecker-factored Fisher information instead of a diagonal one (structured
Laplace, Ritter et al. 2018, arXiv 1805.07810). Across maps it is not: each map's curvature is
divided by its own mean, so every map is pulled equally hard. The step acts on the weights and not
on a gradient that Adam would rescale. It differs from `nullspace` in two ways: directions that VQA
reads but that do not change its answers are freer, and it acts on the whole displacement since the
start, so that changes which the loss does not keep demanding are undone.

Unlike AdamW's decay, the weight is not multiplied by the learning rate. If each step moves a
direction by the rate, the pull and the steps balance at a displacement of rate / (w h).

Between two proximal steps the steepest directions drift, and the loss is computed at drifted
weights: a lower `every` lets them drift less and costs more. Normalisations, tables and lone rows
do not learn.

Two options measure what that choice is worth. `step: gradient` adds the penalty's gradient to the
task gradient instead, as elastic weight consolidation does. `growth` lets the weight grow as the
learning rate falls from its peak, weight (peak / rate)^growth. Even with a constant weight, the
proximal step gains on the optimizer's steps as these get shorter; `growth` sets how much more it
does, and with -1 it does not: the weight falls with the rate.

`balance` undoes one effect of Adam. Its updates have the same size in every tensor, however small
the tensor's gradient, so a map with little to learn moves as far as the others, driven by noise,
and VQA suffers. So the learning rate of a map is multiplied by r / (r + balance R), where r is the
root mean square of its gradient and R that of the gradients of all maps together.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor, nn

from aegis_cli.common import devices
from aegis_cli.common.ranks import ALONE, Ranks, rows_here
from aegis_cli.core import curvature, stacking
from aegis_cli.core.curvature import Curvature
from aegis_cli.core.numerics import ratio
from aegis_cli.core.pairs import Pair, copied_small, minus
from aegis_cli.core.spectrum import DENSE
from aegis_cli.methods.base import Method, MethodContext, Options, Parts, Update
from aegis_cli.methods.site_weights import pair_here, stackable, weights

_LEAST_RATE = 1e-6  # fraction of the peak learning rate
# The weight over the learning rate: in most of our studies, and where little is left to learn.
_STUDIED, _STRONG = 15, 500


def adapt(backbone: nn.Module, _: Mapping[str, nn.Linear], __: Options) -> None:
    """Train linear maps and convolutions; freeze normalisations, tables and lone rows."""
    backbone.requires_grad_(True)
    for module in backbone.modules():
        if not isinstance(module, DENSE):
            for parameter in module.parameters(recurse=False):
                parameter.requires_grad_(False)


def start(context: MethodContext) -> Parts:
    """Pull every map back towards its current weights, and slow down maps with small gradients.

    With weight 0 nothing is pulled back.
    """
    options, owners = context.options, context.owners
    weight, balance = options["weight"], options["balance"]
    pairs = {site: weights(context.backbone, site) for site in context.sites}
    # `adapt` has frozen the other sites: normalisations, tables and lone rows.
    maps = {site: pair for site, pair in pairs.items() if pair[0].requires_grad}
    slowed = (lambda: shares(maps, balance, owners)) if balance > 0 else None
    if weight == 0:
        return Parts(shares=slowed)
    groups = _grouped(maps, _curvatures(context, maps), owners)
    if options["step"] == "gradient":
        return Parts(shares=slowed, pull=_pull(groups, weight))
    return Parts(
        shares=slowed,
        constrain=_constrain(groups, weight, options["growth"]),
        compares=False,  # the start is the reference, so no weights are copied per step
        every=options["every"],
    )


def why_strong(weight: float, rate: float, option: str) -> str | None:
    """Why the backbone may learn little with a weight at a learning rate; None if it is usual.

    Args:
        option: how a user sets the weight, such as `--set kfac.weight`.
    """
    # At a rate of 0 nothing is meant to learn.
    if rate == 0 or weight <= _STRONG * rate:
        return None
    times = f"{weight / rate:,.0f} times the backbone's learning rate {rate:g}"
    return (
        f"the weight of kfac, {weight:g}, is {times}, so the backbone may learn little, however "
        f"long it trains: a direction of mean curvature moves at most about rate / weight, "
        f"{rate / weight:.2g}. Most of our studies have {_STUDIED} times the rate: "
        f"{option}={_STUDIED * rate:.2g}"
    )


def _curvatures(context: MethodContext, maps: Mapping[str, Pair]) -> dict[str, Curvature]:
    """The curvature of each map, for the rows that this process has."""
    owners = context.owners
    likes = {site: rows_here(weight) for site, (weight, _) in maps.items()}
    assert context.anchor is not None
    found = curvature.curvatures(context.anchor, likes, context.options["damping"])
    if owners.several:
        # One map at a time, so that only one map's rows are in memory twice.
        for site, (weight, _) in maps.items():
            found[site] = found[site].of_rows(owners.rows(len(weight)), owners.total)
    return found


def _constrain(groups: Sequence[_Group], weight: float, growth: float) -> Callable[[Update], None]:
    """The proximal step."""

    @torch.no_grad()
    def constrain(update: Update) -> None:
        # One proximal step stands for n of them, one after each of the n steps. Where the curvature
        # is small it is as strong as all of them: 1 + n w h instead of (1 + w h)^n.
        strength = weight * update.steps
        if growth:
            # weight (peak / rate)^growth, where `rate_left` is rate / peak.
            strength = strength / _shrunk(update.rate_left, growth)
        for group in groups:
            excess = group.curvature.excess(*group.moved(), strength)
            stacking.subtract(group.here(), excess)

    return constrain


def _pull(groups: Sequence[_Group], weight: float) -> Callable[[], None]:
    """The penalty's gradient, added to the task's."""

    @torch.no_grad()
    def pull() -> None:
        for group in groups:
            added = group.curvature.gradient(*group.moved(), weight)
            of_each = stacking.apart(added, group.here())
            for now, parts in zip(group.maps, of_each, strict=True):
                for tensor, by in zip(now, parts, strict=True):
                    # A tensor without a gradient has not moved.
                    if tensor is not None and tensor.grad is not None and by is not None:
                        rows_here(tensor.grad).add_(by)

    return pull


def _shrunk(rate: float | Tensor, growth: float) -> float | Tensor:
    """A fraction of the peak learning rate to the power `growth`, kept above 0 to divide by."""
    # A schedule may end at 0, and a high power of a small fraction underflows to 0 too.
    return _at_least(_at_least(rate, _LEAST_RATE) ** growth, sys.float_info.min)


def _at_least(x: float | Tensor, least: float) -> float | Tensor:
    return x.clamp(min=least) if isinstance(x, Tensor) else max(x, least)


@dataclass(frozen=True)
class _Group:
    """Maps that are drawn back in one computation: one map, or on a GPU several of one shape.

    Attributes:
        origin: the initial weights and biases, stacked like `curvature`.
    """

    maps: Sequence[Pair]
    origin: Pair
    curvature: Curvature

    def here(self) -> list[Pair]:
        """The rows of each map that this process has."""
        return [pair_here(pair) for pair in self.maps]

    def moved(self) -> Pair:
        """Displacement of the maps from their initial values, stacked."""
        return minus(stacking.stacked(self.here()), self.origin)


def _grouped(
    maps: Mapping[str, Pair], found: Mapping[str, Curvature], owners: Ranks
) -> list[_Group]:
    """The maps in groups, each with its initial values and its curvature."""

    def directions(site: str) -> int:
        return found[site].inputs.shape[-1]

    groups = []
    for names in stackable(maps, owners, directions):
        own = [maps[name] for name in names]
        now = stacking.stacked([pair_here(pair) for pair in own])
        curved = curvature.stacked([found[name] for name in names])
        # Copied, because `stacked` returns a single map's own tensors, which training changes.
        groups.append(_Group(own, copied_small(now), curved))
    return groups


def shares(
    maps: Mapping[str, Pair], balance: float, owners: Ranks = ALONE
) -> dict[Tensor, float | Tensor]:
    """The fraction r / (r + balance R) of the learning rate for each map's weight and bias.

    r is the root mean square of the map's gradient, R that of all maps together; without a gradient
    the fraction is 0. `owners` are the processes that each have some rows of every map. On a GPU
    the fractions are tensors [], which are never read.
    """
    learning = [[t for t in pair if t is not None] for pair in maps.values()]
    found_squares = owners.total(_squares(learning))
    entries = [sum(t.numel() for t in tensors) for tensors in learning]
    if devices.reading_stalls(found_squares.device):
        return _unread_shares(learning, found_squares, entries, balance)
    # One transfer for all maps.
    squares = found_squares.tolist()
    whole = math.sqrt(sum(squares) / sum(entries))  # R: a mean over entries, not over maps
    found: dict[Tensor, float | Tensor] = {}
    for tensors, square, count in zip(learning, squares, entries, strict=True):
        rms = math.sqrt(square / count)  # r
        # If no map has a gradient, R is 0 too: avoid 0 / 0.
        share = rms / (rms + balance * whole) if rms else 0.0
        found |= dict.fromkeys(tensors, share)
    return found


def _unread_shares(
    learning: Sequence[Sequence[Tensor]], squares: Tensor, entries: Sequence[int], balance: float
) -> dict[Tensor, float | Tensor]:
    """The result of `shares` as tensors []; reading them would force a GPU sync."""
    counts = torch.tensor(entries, dtype=torch.float64, device="cpu")
    counts = devices.send(counts, squares.device)
    rms = (squares / counts).sqrt()
    whole = (squares.sum() / sum(entries)).sqrt()
    # If no map has a gradient, every share is 0.
    found = ratio(rms, rms + balance * whole).float()
    unread: dict[Tensor, float | Tensor] = {}
    for tensors, share in zip(learning, found, strict=True):
        unread |= dict.fromkeys(tensors, share)
    return unread


def _squares(maps: Sequence[Sequence[Tensor]]) -> Tensor:
    """Sum of the squared gradients of each map's tensors (at most two), [maps] float64."""
    like = maps[0][0]
    # Map i has the entries 2 i for its weight and 2 i + 1 for its bias; they are 0 without a
    # gradient.
    places, gradients = [], []
    for number, tensors in enumerate(maps):
        for part, tensor in enumerate(tensors):
            if tensor.grad is not None:
                places.append(2 * number + part)
                gradients.append(rows_here(tensor.grad))
    norms = [torch.zeros((), device=like.device)] * (2 * len(maps))
    # A few kernels instead of thousands.
    found = torch._foreach_norm(gradients) if gradients else ()
    for place, norm in zip(places, found, strict=True):
        # In a user's own loop, the layers may be spread over several GPUs.
        norms[place] = norm.to(like.device)
    # `to` launches nothing if a norm already has the dtype, as nearly always; `double` would.
    widest = reduce(torch.promote_types, (norm.dtype for norm in norms))
    both = torch.stack([norm.to(widest) for norm in norms]).double()
    return both.view(-1, 2).square().sum(1)  # [maps, 2] -> [maps]


METHOD = Method(
    "kfac",
    "what has moved is drawn back along the curvature of VQA's answers",
    adapt,
    start=start,
    needs=frozenset({"curvature"}),
)
