"""How much of a matrix lies in a subspace."""

from __future__ import annotations

from torch import Tensor


def share_inside(matrix: Tensor, columns: Tensor) -> float:
    """||Q^T G||^2 / ||G||^2 of G [d, n] and orthonormal columns Q [d, k]; 0 for G = 0."""
    wide = matrix.double()
    total = float(wide.square().sum())
    return float((columns.T @ wide).square().sum()) / total if total else 0.0
