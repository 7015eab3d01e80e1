"""The weight and bias of a site, and which sites are constrained in one computation."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from operator import attrgetter

from torch import Tensor, nn

from aegis_cli.common import devices
from aegis_cli.common.ranks import Ranks, rows_here
from aegis_cli.core import stacking
from aegis_cli.core.pairs import Pair


def weights(backbone: nn.Module, site: str) -> Pair:
    """Weight and bias of a site: those of its module, or the parameter of that name and None."""
    found = attrgetter(site)(backbone)
    if isinstance(found, Tensor):
        return found, None
    return found.weight, getattr(found, "bias", None)


def pair_here(pair: Pair) -> Pair:
    """The rows of a weight and a bias that this process has; all if they are not sharded."""
    weight, bias = pair
    return rows_here(weight), None if bias is None else rows_here(bias)


def stackable(
    pairs: Mapping[str, Pair],
    owners: Ranks,
    directions: Callable[[str], int],
    alone: Callable[[str], bool] = lambda _: False,
) -> list[list[str]]:
    """Group sites that one computation constrains: each alone, or on a GPU several together.

    Args:
        pairs: each site's weight and bias.
        directions: how many directions of a site's inputs are known.
        alone: whether a site is never stacked with others.
    """
    waits = any(devices.reading_stalls(weight.device) for weight, _ in pairs.values())
    # Stacking saves kernel launches, which only matter on a GPU. Sharded maps stay apart, because a
    # stack of curvatures has no sum over the processes.
    if owners.several or not waits:
        return [[site] for site in pairs]

    def kind(site: str) -> Hashable:
        return site if alone(site) else stacking.kind_of(pairs[site])

    def size(site: str) -> tuple[int, int]:
        weight, _ = pairs[site]
        return weight.numel(), directions(site)

    return stacking.groups(pairs, kind, size)
