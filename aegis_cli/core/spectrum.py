"""The span of a map's inputs on VQA: eigenvectors of their uncentred second moment C = E[x x^T].

Everything that maps tokens to tokens is linear in its own parameters, so one rule covers all of
them. A linear map with a bias reads (x, 1). A convolution reads the unfolded patch and 1. A
normalisation's scale and shift read (x^_c, 1) in each channel c, where x^ is the normalised input.
A table (word embeddings, positions) reads one-hot rows. A *lone row*, a parameter outside any such
layer (a class token, say), is a table of one row that every question reads.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from aegis_cli.core.numerics import widened

# Maps that mix their inputs; the others read each channel separately.
DENSE = (nn.Linear, nn.Conv2d, nn.Conv3d)
_BLOCK = 4096  # rows multiplied in float32 before the product is added in float64


@dataclass(frozen=True)
class Spectrum:
    """Eigenvalues and leading eigenvectors of one map's inputs.

    Attributes:
        values: energy along each direction, float64. Dense maps: [d], descending. Elementwise:
            [D, m], m = 2 (scale and shift) or 1 (scale alone). Tables: [N], 1 where a row is read.
        vectors: orthonormal columns. Dense: [d, k], k <= d. Elementwise: [D, m, m]. Tables: None
            (one-hot).
        whole: whether every value is known. If not, those without an eigenvector share the
            remaining energy evenly: they are one scalar.
    """

    values: Tensor
    vectors: Tensor | None
    whole: bool = True

    @property
    def kind(self) -> str:
        """Either "dense", "elementwise" or "rows"."""
        if self.vectors is None:
            return "rows"
        return {2: "dense", 3: "elementwise"}[self.vectors.ndim]

    @property
    def rest(self) -> Tensor:
        """The energy along each unresolved direction, [] float64; 0 if all were resolved."""
        if self.whole or self.vectors is None:
            return self.values.new_zeros(())
        if self.vectors.shape[1] == len(self.values):
            return self.values.new_zeros(())
        return self.values[-1]  # values without an eigenvector come last and are equal


def lone_row() -> Spectrum:
    """The spectrum of a row that every question reads."""
    return Spectrum(torch.ones(1, dtype=torch.float64, device="cpu"), None)


def with_rest(found: Tensor, vectors: Tensor, rest: Tensor) -> Spectrum:
    """The spectrum of a dense map for which only the leading directions were resolved.

    Args:
        found: energy along each of them [k], float64, descending.
        vectors: their eigenvectors [d, k].
        rest: energy along each other direction, [] or [1] float64.
    """
    others = vectors.shape[0] - vectors.shape[1]
    values = torch.cat([found, rest.reshape(1).expand(others)])
    return Spectrum(values, vectors, whole=False)


@torch.no_grad()
def second_moment(rows: Tensor) -> Tensor:
    """Sum over rows [n, d] of x x^T: [d, d] float64. The rows of a map with a bias end with a 1.

    C is uncentred by definition, and its diagonal is a sum of squares, so nothing cancels. Rows
    narrower than float32 are upcast first, even under autocast: eight bits would hide the smaller
    directions. On some processors the products are not exactly symmetric, so the lower triangle is
    mirrored.
    """
    x = widened(rows)
    total = torch.zeros(x.shape[1], x.shape[1], dtype=torch.float64, device=x.device)
    with torch.autocast(x.device.type, enabled=False):
        for block in x.split(_BLOCK):
            total += (block.T @ block).double()
    return torch.tril(total) + torch.tril(total, -1).T


@torch.no_grad()
def channel_moment(rows: Tensor, bias: bool) -> Tensor:
    """Sum over rows [n, D] of x_c^2, or with a bias of (x_c, 1) (x_c, 1)^T, in each channel c.

    Returns:
        [D, 1, 1] float64; with a bias [D, 2, 2].
    """
    x = rows.double()
    squares = x.square().sum(0)
    if not bias:
        return squares[:, None, None]
    sums = x.sum(0)
    # [[x x, x 1], [1 x, 1 1]] of each channel, summed over rows.
    of_scale = torch.stack([squares, sums], -1)
    of_shift = torch.stack([sums, torch.full_like(sums, len(x))], -1)
    return torch.stack([of_scale, of_shift], -2)  # [D, 2, 2]


def decompose(moment: Tensor, energy: float = 1.0) -> Spectrum:
    """Eigenvalues and leading eigenvectors of a second moment [d, d] or [D, m, m].

    Args:
        energy: fraction of the sum of eigenvalues that the kept eigenvectors of [d, d] hold.
    """
    rising, vectors = torch.linalg.eigh(moment.double())
    # A second moment has no negative eigenvalues, but the solver's rounding may produce one.
    values, vectors = rising.flip(-1).clamp(min=0), vectors.flip(-1)
    if moment.ndim == 2:
        kept = vectors[:, : rank(values, energy)]
        vectors = kept.clone()  # a view would keep all of them in memory
    return Spectrum(values, vectors)


def orthonormal(vectors: Tensor) -> Tensor:
    """Orthonormalise columns [d, k] that are nearly orthonormal, such as rounded ones.

    One Newton-Schulz step U (3 - U^T U) / 2 squares the error.
    """
    gram = vectors.T @ vectors
    return 1.5 * vectors - 0.5 * (vectors @ gram)


def rank(values: Tensor, energy: float) -> int:
    """How many of the largest values hold the fraction `energy` of their sum.

    Energy 0 takes none. A value below the float32 rounding of the largest never counts, because it
    comes from the arithmetic of the measurement. So energy 1 takes every value above that, and no
    smaller fraction takes more.
    """
    # Values of elementwise maps [D, m] are ranked over all channels.
    falling = values.flatten().sort(descending=True).values
    if energy <= 0 or falling[0] == 0:
        return 0
    rounding = falling[0] * torch.finfo(torch.float32).eps
    resolved = int((falling > rounding).sum())
    if energy >= 1:
        return resolved
    # This many leading values fall short of the fraction; one more reaches it.
    short_of_it = int((falling.cumsum(0) < energy * falling.sum()).sum())
    return min(resolved, short_of_it + 1)
