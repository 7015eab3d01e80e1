"""Keep the applied update out of the span of VQA inputs, map by map.

For each map, D <- D - D U U^T, where D is the update that was just applied and U holds the leading
eigenvectors of the uncentred second moment of the map's inputs on VQA. In continual learning this
is Adam-NSCL (arXiv 2103.07113) and GPM (arXiv 2103.09762), which use the inputs of previous tasks'
classifiers and project only the gradient or its Adam direction. Here weight decay is part of D.
Nothing is frozen by hand: biases read a constant 1, normalisations (x^, 1) in each channel, tables
one-hot rows, and a tied head protects the other side of the embedding. A lone row (a separator of
image rows, say) is a table's row that every question reads, and stays as it is. `soft` and `every`
are ours: the projection is linear, so projecting a sum of updates is the same as summing their
projections, and projecting once in a few steps costs a few times less.

What an update has changed along U is the change of the coordinates W U. `keeps: coordinates`
remembers these [o, k] instead of the weights [o, d] before the steps that a projection covers. It
leaves the unstored directions free, along which `soft` otherwise removes a small share.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import nn

from aegis_cli.common.ranks import Ranks, rows_here
from aegis_cli.core import nullspace, stacking
from aegis_cli.core.nullspace import Dense, Elementwise, Protection, Remembered, Strength, TableRows
from aegis_cli.core.pairs import Pair, minus
from aegis_cli.methods.base import Method, MethodContext, Parts, Update, train_all
from aegis_cli.methods.site_weights import pair_here, stackable, weights


def start(context: MethodContext) -> Parts:
    """Project every site of the kinds in `protect`; energy 0 protects nothing."""
    options = context.options
    hard = options["energy"]
    if hard == 0:
        return Parts()
    # Either a fraction of the energy is protected completely, or every direction softly.
    strength = Strength(soft=options["soft"]) if hard is None else Strength(hard)
    assert context.anchor is not None
    # The others learn unprotected, as under `naive`.
    chosen = [site for site, kind in context.sites.items() if kind in options["protect"]]
    likes = {site: weights(context.backbone, site)[0] for site in chosen}
    here = {site: rows_here(like) for site, like in likes.items()}
    protections = nullspace.protections(context.anchor, here, strength)
    if context.owners.several:
        # Every row is projected independently, so sharded weights need no communication.
        for site, like in likes.items():
            protections[site] = protections[site].of_rows(context.owners.rows(len(like)))
    groups = _grouped(context.backbone, protections, context.owners)
    if options["keeps"] == "coordinates":
        return _by_coordinates(groups, options["every"])

    @torch.no_grad()
    def constrain(update: Update) -> None:
        for group in groups:
            group.project(update)

    return Parts(constrain=constrain, every=options["every"])


def _by_coordinates(groups: Sequence[_Group], every: int) -> Parts:
    """The method with coordinates of the earlier weights instead of copies."""
    before: dict[str, Remembered] = {}  # by each group's first site

    @torch.no_grad()
    def begin() -> None:
        for group in groups:
            now = stacking.stacked(group.here())
            before[group.sites[0]] = group.protection.remember(*now)

    @torch.no_grad()
    def constrain(_: Update) -> None:
        for group in groups:
            group.hold(before.pop(group.sites[0]))

    return Parts(constrain=constrain, begin=begin, compares=False, every=every)


@dataclass(frozen=True)
class _Group:
    """Sites that are projected in one computation: one site, or on a GPU several of one shape.

    Attributes:
        backbone: not the context, which would keep the whole anchor in memory.
        protection: that of all sites, stacked.
    """

    backbone: nn.Module
    sites: Sequence[str]
    protection: Protection

    def pairs(self) -> list[Pair]:
        """Weight and bias of each site, as DTensors if they are sharded."""
        return [weights(self.backbone, site) for site in self.sites]

    def here(self) -> list[Pair]:
        """The rows of each site that this process has."""
        return [pair_here(pair) for pair in self.pairs()]

    def project(self, update: Update) -> None:
        """Remove the protected part of an update from the weights."""
        before = []
        for site, pair in zip(self.sites, self.pairs(), strict=True):
            before.append(pair_here(_before(site, pair, update)))
        if len(self.sites) == 1:
            _project(self.here()[0], before[0], self.protection)
            return
        moved = minus(stacking.stacked(self.here()), stacking.stacked(before))
        stacking.subtract(self.here(), self.protection.removed(*moved))

    def hold(self, before: Remembered) -> None:
        """Remove the change along the protected directions from the weights."""
        here = self.here()
        if len(here) == 1:
            weight, bias = here[0]
            self.protection.hold(weight.data, None if bias is None else bias.data, before)
            return
        assert isinstance(self.protection, Dense | Elementwise)
        stacking.subtract(here, self.protection.changed(*stacking.stacked(here), before))


def _grouped(
    backbone: nn.Module, protections: Mapping[str, Protection], owners: Ranks
) -> list[_Group]:
    """The sites in groups, each with the protection of all its sites."""

    def directions(site: str) -> int:
        protection = protections[site]
        return len(protection.factor) if isinstance(protection, Dense) else 0

    def alone(site: str) -> bool:
        # Each table has its own set of rows that are read.
        return isinstance(protections[site], TableRows)

    pairs = {site: weights(backbone, site) for site in protections}
    groups = []
    for names in stackable(pairs, owners, directions, alone):
        protection = nullspace.stacked([protections[name] for name in names])
        groups.append(_Group(backbone, names, protection))
    return groups


def _before(site: str, now: Pair, update: Update) -> Pair:
    """Weight and bias from before the update.

    A lone row is listed under the site's own name.
    """
    if site in update.before:
        return update.before[site], None
    _, bias = now
    before_bias = None if bias is None else update.before[f"{site}.bias"]
    return update.before[f"{site}.weight"], before_bias


def _project(now: Pair, before: Pair, protection: Protection) -> None:
    (weight, bias), (old_weight, old_bias) = now, before
    # The allowed part is added to the old values, so that a row that may not change keeps its bits:
    # subtracting the protected part from the new values would round.
    moved, shifted = nullspace.allowed(protection, minus(now, before))
    torch.add(old_weight, moved, out=weight.data)
    if bias is not None:
        assert old_bias is not None and shifted is not None
        torch.add(old_bias, shifted, out=bias.data)


METHOD = Method(
    "nullspace",
    "applied update kept out of what VQA inputs span",
    train_all,
    start=start,
    needs=frozenset({"inputs"}),
)
