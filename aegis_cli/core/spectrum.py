"""What a map's inputs span on VQA: eigenvectors of their uncentred second moment C = E[x x^T].

Everything that maps tokens to tokens is linear in its own parameters, so one rule serves all of
them. A linear map with a bias reads (x, 1); a convolution the unfolded patch and 1; a
normalisation's scale and shift read (x^_c, 1) in each channel c; a table (word embeddings,
positions) reads one-hot rows. A lone row that is a parameter by itself is a table of one row, which
every question reads.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

DENSE = (
    nn.Linear,
    nn.Conv2d,
    nn.Conv3d,
)  # what mixes its inputs; the other maps read each channel for itself
_BLOCK = 4096  # rows multiplied in float32 before the product is added in float64


@dataclass(frozen=True)
class Spectrum:
    """Eigenvalues and leading eigenvectors of one map's inputs.

    Attributes:
        values: energy along each direction, float64. Dense maps: [d], falling. Elementwise: [D, m],
            m = 2 (scale and shift) or 1 (scale alone). Tables: [N], 1 where a row is read.
        vectors: orthonormal columns. Dense: [d, k], k <= d. Elementwise: [D, m, m]. Tables: None
            (one-hot).
    """

    values: Tensor
    vectors: Tensor | None

    @property
    def kind(self) -> str:
        """dense, elementwise or rows."""
        return "rows" if self.vectors is None else {2: "dense", 3: "elementwise"}[self.vectors.ndim]


def lone_row() -> Spectrum:
    """Of a row that every question reads."""
    return Spectrum(torch.ones(1, dtype=torch.float64), None)


@torch.no_grad()
def second_moment(rows: Tensor, bias: bool) -> Tensor:
    """Sum over rows of x x^T, of (x, 1) (x, 1)^T with a bias: rows [n, d] -> [d or d + 1, same]
    float64.

    Products of non-negative sums need no centring: C is uncentred by definition, its diagonal never
    cancels. Narrower rows than float32 are widened first, also inside of autocast: eight bits would
    hide the smaller directions. The result is symmetric bit by bit: some processors' products are
    not, so the lower triangle is mirrored.
    """
    x = rows.to(torch.promote_types(rows.dtype, torch.float32))
    x = torch.cat([x, x.new_ones(len(x), 1)], dim=1) if bias else x
    total = torch.zeros(x.shape[1], x.shape[1], dtype=torch.float64, device=x.device)
    with torch.autocast(x.device.type, enabled=False):
        for block in x.split(_BLOCK):
            total += (block.T @ block).double()
    return torch.tril(total) + torch.tril(total, -1).T


@torch.no_grad()
def channel_moment(rows: Tensor, bias: bool) -> Tensor:
    """The same in each channel: sum of (x_c, 1) (x_c, 1)^T, or of x_c^2: [n, D] -> [D, 2, 2] or [D,
    1, 1] float64.
    """
    x = rows.double()
    squares, first, ones = x.square().sum(0), x.sum(0), torch.full_like(x[0], len(x))
    if not bias:
        return squares[:, None, None]
    return torch.stack([torch.stack([squares, first], -1), torch.stack([first, ones], -1)], -2)


def decompose(moment: Tensor, energy: float = 1.0) -> Spectrum:
    """Eigenvalues of a second moment [d, d] or [D, m, m], and the eigenvectors that hold `energy`
    of their sum.
    """
    values, vectors = torch.linalg.eigh(moment.double())
    values, vectors = values.flip(-1).clamp(min=0), vectors.flip(-1)
    if moment.ndim == 2:
        vectors = vectors[
            :, : rank(values, energy)
        ].clone()  # not a view, which would keep all of them
    return Spectrum(values, vectors)


def rank(values: Tensor, energy: float) -> int:
    """How many of the largest values it takes to hold the share `energy` of their sum.

    0 for energy 0. Nothing below the float32 rounding of the largest ever counts: it is what the
    measurement's own arithmetic left. So energy 1 takes every value above that, and no smaller
    share takes more.
    """
    falling = values.flatten().sort(descending=True).values
    if energy <= 0 or falling[0] == 0:
        return 0
    resolved = int((falling > falling[0] * torch.finfo(torch.float32).eps).sum())
    if energy >= 1:
        return resolved
    return min(resolved, int((falling.cumsum(0) < energy * falling.sum()).sum()) + 1)
