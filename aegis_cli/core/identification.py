"""What a router's weights say about a new task: where its gradient flows, which experts it needs, what lies inside the old.

All rules here are choices of this package: of iGSP (arXiv 2605.19301) nothing but the abstract was read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from aegis_cli.core.routing import Expert, Traced


@dataclass(frozen=True)
class Flow:
    """What a map's router does on a batch.

    Attributes:
        mass: mean weight of each expert [E] float64; sums to 1.
        load: share of each expert in the sum of mean p_e ||B_e A_e x|| [E] float64; all 0 where no expert says anything.
    """

    mass: Tensor
    load: Tensor


@torch.no_grad()
def flow(passes: Sequence[Traced], experts: Sequence[Expert]) -> Flow:
    """Mass and load of each expert over all positions of `passes`."""
    weights = torch.cat([p.weights for p in passes]).double()
    codes = torch.cat([p.codes for p in passes]).double()
    grams = torch.stack([e.b.double().T @ e.b.double() for e in experts])
    # ||B c||^2 = c^T (B^T B) c, without ever making B c [n, d_out]
    norms = torch.einsum("ner,ers,nes->ne", codes, grams, codes).clamp(min=0).sqrt()
    load = (weights * norms).mean(0)
    return Flow(weights.mean(0).cpu(), (load / load.sum() if load.sum() > 0 else load).cpu())


def mass_on(weights: Tensor, columns: Sequence[int]) -> Tensor:
    """Mean over positions of the weight [n, E] that falls on some experts: a number [] with its graph."""
    return weights[:, list(columns)].sum(-1).mean()


def squared_norm(expert: Expert) -> Tensor:
    """||B A||_F^2 = tr((B^T B)(A A^T)): two r x r matrices instead of one of d_out x d_in."""
    return ((expert.b.T @ expert.b) * (expert.a @ expert.a.T)).sum()


def total_variation(before: Tensor, after: Tensor) -> float:
    """Distance of two distributions over experts [E]: half the sum of absolute differences, in [0, 1]."""
    return float((before.double() - after.double()).abs().sum() / 2)


def needed(found: Flow, history: int, kappa: float, load: float) -> tuple[int, ...]:
    """Columns of the experts that stay.

    One goes only if its mass is under kappa / E *and* its load under `load`. Mass alone deceives: a router that is
    paid for avoiding an expert can give it little weight and let ||B A|| grow instead, until the expert carries the
    fit at a weight near zero. Zero new experts may stay, unless there is no history at all: then the heaviest does.

    Args:
        found: of all experts, the `history` old ones first.
        kappa: share of the uniform weight 1 / E.
        load: share of the summed load.
    """
    limit = kappa / len(found.mass)
    kept = [i for i in range(len(found.mass)) if found.mass[i] >= limit or found.load[i] >= load]
    if not kept and not history:
        kept = [int(found.load.argmax())]
    return tuple(kept)


def basis(matrices: Sequence[Tensor]) -> Tensor:
    """Orthonormal columns [d, k] float64 of what the columns of matrices [d, r] span together."""
    joined = torch.cat([m.detach().double() for m in matrices], dim=1)
    left, values, _ = torch.linalg.svd(joined, full_matrices=False)
    return left[:, values > values.max().clamp(min=torch.finfo(torch.float64).tiny) * 1e-6]


def off(matrix: Tensor, columns: Tensor) -> Tensor:
    """matrix [d, n] without its part in the span of orthonormal `columns` [d, k]: (I - Q Q^T) M, in M's own type."""
    wide = matrix.double()
    return (wide - columns @ (columns.T @ wide)).to(matrix.dtype)


def share_inside(matrix: Tensor, columns: Tensor) -> float:
    """||P_H G||^2 / ||G||^2 of G [d, n] and orthonormal `columns` [d, k] of H; 0 for G = 0."""
    wide = matrix.double()
    total = float(wide.square().sum())
    return float((columns.T @ wide).square().sum()) / total if total else 0.0
