"""LoRA (arXiv 2106.09685) on the language layers' maps: W x + (alpha / rank) B A x, W frozen."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from aegis_cli.core.numerics import wide_type
from aegis_cli.methods.base import Method


class LowRankLinear(nn.Module):
    """A frozen map with a trainable low-rank term.

    A [rank, in] is random and B [out, rank] zero, so that nothing changes at first.
    """

    def __init__(self, base: nn.Linear, rank: int, alpha: float) -> None:
        super().__init__()
        self.base, self.scale = base, alpha / rank
        # The term is small, and so are its steps: half precision would lose them.
        wide = wide_type(base.weight.dtype)
        # Drawn on the CPU, so that a seed gives the same start on every device; uniform in
        # +-1/sqrt(in), as in the paper's own code.
        drawn = nn.init.kaiming_uniform_(
            torch.empty(rank, base.in_features, dtype=wide), a=math.sqrt(5)
        )
        self.a = nn.Parameter(drawn.to(base.weight.device))
        self.b = nn.Parameter(base.weight.new_zeros(base.out_features, rank, dtype=wide))

    def forward(self, x: Tensor) -> Tensor:
        # Two thin products: forming B A first would cost as much as W x again.
        code = nn.functional.linear(x, self.a.to(x.dtype))  # [..., rank]
        low = nn.functional.linear(code, self.b.to(x.dtype))
        return self.base(x) + self.scale * low

    @property
    def weight(self) -> Tensor:
        """The effective weight [out, in]."""
        return self.base.weight + self.scale * (self.b @ self.a)

    @property
    def bias(self) -> Tensor | None:
        return self.base.bias

    @torch.no_grad()
    def merged(self) -> nn.Linear:
        """The plain map with the same outputs."""
        self.base.weight += self.scale * (self.b @ self.a)
        return self.base


def inject(
    backbone: nn.Module, maps: Mapping[str, nn.Linear], options: Mapping[str, float]
) -> None:
    """Freeze the backbone and add a trainable low-rank term to each of `maps`.

    Args:
        maps: linear maps by their dotted names in the backbone.
        options: `rank` and `alpha`.
    """
    backbone.requires_grad_(False)
    for name, linear in maps.items():
        term = LowRankLinear(linear, int(options["rank"]), options["alpha"])
        _replace(backbone, name, term)


def merge(backbone: nn.Module) -> None:
    """Merge every low-rank term into its weight, in place; outputs do not change."""
    # A list, because the loop replaces modules while iterating.
    for name, module in list(backbone.named_modules()):
        if isinstance(module, LowRankLinear):
            _replace(backbone, name, module.merged())


def _replace(root: nn.Module, name: str, module: nn.Module) -> None:
    parent, _, leaf = name.rpartition(".")
    setattr(root.get_submodule(parent), leaf, module)


METHOD = Method("lora", "low-rank update of the language layers", inject, export=merge)
