"""Which task is an image of? A Gaussian a task over frozen features, and a threshold under which it
is of none.

The features are those of the bare model, so that nothing learned later moves them. A task may bring
fewer images than a
covariance has entries: it keeps the leading directions, and all others have one variance between
them (probabilistic principal components, Tipping and Bishop 1999):

    C = U diag(v) U^T + n (I - U U^T),    n the mean of the variances that are left
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

NONE = -1


@dataclass(frozen=True)
class Gaussian:
    """One task's features.

    Attributes:
        mean: [D] float64.
        directions: U [D, r] float64, orthonormal columns; variances: v [r] along them.
        noise: n [], in every direction that is orthogonal to these.
        threshold: log-density [] float64 under which an image counts as none of the task's.
    """

    mean: Tensor
    directions: Tensor
    variances: Tensor
    noise: Tensor
    threshold: Tensor

    def log_density(self, features: Tensor) -> Tensor:
        """Features [N, D] -> [N] float64, in nats."""
        away = features.double() - self.mean
        along = (away @ self.directions).square()
        across = (away.square().sum(-1) - along.sum(-1)).clamp(min=0)
        size, rank = self.directions.shape
        volume = self.variances.log().sum() + (size - rank) * self.noise.log()
        return -0.5 * (
            (along / self.variances).sum(-1)
            + across / self.noise
            + volume
            + size * math.log(2 * math.pi)
        )

    def count(self) -> int:
        """Numbers that it stores."""
        return self.mean.numel() + self.directions.numel() + self.variances.numel() + 2


@torch.no_grad()
def fit(features: Tensor, rank: int, shrinkage: float, quantile: float) -> Gaussian:
    """A Gaussian of a task's training features [N, D], D >= 2.

    Args:
        rank: directions with a variance of their own, at most D - 1 of which are taken.
        shrinkage: share in [0, 1] of each variance that is replaced by the mean of all D.
        quantile: share of the task's own training images that fall under the threshold.
    """
    wide = features.double()
    mean, size = wide.mean(0), wide.shape[1]
    away = wide - mean
    values, vectors = torch.linalg.eigh(away.T @ away / len(wide))
    values = (1 - shrinkage) * values.flip(0) + shrinkage * values.mean()
    # a direction that never varies would make every other value infinitely unlikely
    values = values.clamp(min=torch.finfo(torch.float32).eps * float(wide.square().mean()))
    taken = min(rank, size - 1)
    directions = vectors.flip(1)[:, :taken].contiguous()
    found = Gaussian(
        mean, directions, values[:taken].clone(), values[taken:].mean(), values.new_zeros(())
    )
    return replace(found, threshold=torch.quantile(found.log_density(wide), quantile))


@torch.no_grad()
def infer(features: Tensor, tasks: Sequence[Gaussian]) -> Tensor:
    """Features [N, D] -> the most likely task of each image [N] int64; NONE where even that one's
    threshold is missed.
    """
    if not tasks:
        return torch.full((len(features),), NONE)
    scores = torch.stack([g.log_density(features) for g in tasks], dim=1)
    best, task = scores.max(1)
    thresholds = torch.stack([g.threshold for g in tasks])
    return torch.where(best >= thresholds[task], task, NONE)
