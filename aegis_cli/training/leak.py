"""The share of the applied update along the directions that VQA inputs span.

It is the same figure for every method.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from aegis_cli.common.ranks import rows_here, whole
from aegis_cli.core import nullspace
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.nullspace import Pair
from aegis_cli.methods.base import weights


class LeakMeter:
    """Compares a backbone's effective weights (for LoRA: merged) before and after an update.

    The directions are those that hold `energy` of each map's VQA inputs, whatever a method itself
    protects, so that the figures of all methods can be compared.
    """

    def __init__(
        self, backbone: nn.Module, sites: Mapping[str, str], anchor: Anchor, energy: float
    ) -> None:
        self._backbone, self._sites = backbone, tuple(sites)
        likes = {site: rows_here(weights(backbone, site)[0]) for site in sites}
        self._protections = nullspace.protections(anchor, likes, nullspace.Strength(energy))

    @torch.no_grad()
    def weights(self) -> dict[str, Pair]:
        """Copy the effective weights of now, each site's weight and bias."""
        return {site: nullspace.copied(weights(self._backbone, site)) for site in self._sites}

    def leak(self, before: Mapping[str, Pair]) -> Tensor:
        """Share [], from 0 to 1, of the update's energy along the protected directions.

        The update is what has changed since `before`; 0 if nothing moved.
        """
        # One site after the other: all updates together would be a second copy of the weights.
        moved = (
            (site, _whole(nullspace.minus(weights(self._backbone, site), before[site])))
            for site in self._sites
        )
        return nullspace.leak(self._protections, moved)


def _whole(pair: Pair) -> Pair:
    """All rows of a weight and a bias, whose low-rank terms may be sharded in any way."""
    weight, bias = pair
    return whole(weight), None if bias is None else whole(bias)
