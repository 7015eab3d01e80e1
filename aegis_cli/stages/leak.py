"""How much of the applied update lies along the directions that VQA inputs use: the same figure for every method."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import nn

from aegis_cli.core import nullspace
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.nullspace import Pair


class LeakMeter:
    """Compares a backbone's effective weights (for LoRA: merged) before and after an update.

    The directions are those that hold `energy` of each map's VQA inputs, whatever a method itself protects,
    so that the figures of all methods can be compared.
    """

    def __init__(self, backbone: nn.Module, sites: Mapping[str, str], anchor: Anchor, energy: float) -> None:
        self._modules = {site: backbone.get_submodule(site) for site in sites}
        weights = {site: module.weight for site, module in self._modules.items()}
        self._protections = nullspace.protections(anchor, weights, nullspace.Strength(energy))

    @torch.no_grad()
    def weights(self) -> dict[str, Pair]:
        """Copies of the effective weights now."""
        return {site: _copy(module) for site, module in self._modules.items()}

    def leak(self, before: Mapping[str, Pair]) -> float:
        """Share of the energy of the update since `before` along the protected directions; 0 if nothing moved."""
        return nullspace.leak(self._protections, {s: nullspace.minus(now, before[s]) for s, now in self.weights().items()}).item()


def _copy(module: nn.Module) -> Pair:
    bias = getattr(module, "bias", None)
    return module.weight.detach().clone(), None if bias is None else bias.detach().clone()

