"""A site's weight and bias, and which sites one computation constrains."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from operator import attrgetter

from torch import Tensor, nn

from aegis_cli.common import devices
from aegis_cli.common.ranks import Ranks, rows_here
from aegis_cli.core import stacking
from aegis_cli.core.pairs import Pair


def weights(backbone: nn.Module, site: str) -> Pair:
    """A site's weight and bias: its module's, or the parameter of that name without a bias."""
    found = attrgetter(site)(backbone)
    if isinstance(found, Tensor):
        return found, None
    return found.weight, getattr(found, "bias", None)


def pair_here(pair: Pair) -> Pair:
    """The rows of a weight and a bias that this process has; all where they are not sharded."""
    weight, bias = pair
    return rows_here(weight), None if bias is None else rows_here(bias)


def stackable(
    pairs: Mapping[str, Pair],
    owners: Ranks,
    directions: Callable[[str], int],
    alone: Callable[[str], bool] = lambda _: False,
) -> list[list[str]]:
    """Sites in groups that one computation constrains: each by itself, or on a GPU several.

    Args:
        pairs: each site's weight and bias.
        directions: how many directions of a site's inputs are known.
        alone: whether a site is never stacked with others.
    """
    waits = any(devices.reading_stalls(weight.device) for weight, _ in pairs.values())
    # Stacking saves kernel launches, for which only a GPU waits. Sharded maps stay apart, since a
    # stack of curvatures has no sum over the processes.
    if owners.several or not waits:
        return [[site] for site in pairs]

    def kind(site: str) -> Hashable:
        return site if alone(site) else stacking.kind_of(pairs[site])

    def size(site: str) -> tuple[int, int]:
        weight, _ = pairs[site]
        return weight.numel(), directions(site)

    return stacking.groups(pairs, kind, size)
