"""Task inference: one Gaussian per task over frozen features, and a threshold for "no task".

The features are those of the bare model, so nothing learned later changes them. A task may have
fewer images than a covariance has entries. So only the leading directions are kept, and all others
share one variance (probabilistic PCA, Tipping & Bishop 1999):

    C = U diag(v) U^T + n (I - U U^T),    n the mean of the remaining variances
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

NONE = -1  # the inferred task of an image that belongs to no task


@dataclass(frozen=True)
class Gaussian:
    """The distribution of one task's features.

    Attributes:
        mean: [D] float64.
        directions: orthonormal columns U [D, r] float64.
        variances: v [r] along these directions.
        noise: variance n [] along every direction orthogonal to them.
        threshold: log-density [] float64, in nats; an image below it does not belong to the task.
    """

    mean: Tensor
    directions: Tensor
    variances: Tensor
    noise: Tensor
    threshold: Tensor

    def log_density(self, features: Tensor) -> Tensor:
        """Log-density of features [N, D] as [N] float64, in nats.

        C^-1 and log det C follow from C = U diag(v) U^T + n (I - U U^T) without any D x D matrix.
        """
        away = features.double() - self.mean  # [N, D]
        along = (away @ self.directions).square()  # [N, r]
        in_all = away.square().sum(-1)  # [N]
        # The rest is a sum of squares too, but rounding could put it slightly below 0.
        across = (in_all - along.sum(-1)).clamp(min=0)
        mahalanobis = (along / self.variances).sum(-1) + across / self.noise
        size, rank = self.directions.shape
        log_determinant = self.variances.log().sum() + (size - rank) * self.noise.log()
        return -0.5 * (mahalanobis + log_determinant + size * math.log(2 * math.pi))

    def count(self) -> int:
        """How many numbers it stores."""
        return self.mean.numel() + self.directions.numel() + self.variances.numel() + 2


@torch.no_grad()
def fit(features: Tensor, rank: int, shrinkage: float, quantile: float) -> Gaussian:
    """A Gaussian of a task's training features [N, D], D >= 2.

    Args:
        rank: number of directions with a variance of their own, capped at D - 1.
        shrinkage: fraction in [0, 1] of each variance that is replaced by the mean of all D.
        quantile: fraction of the task's own training images that fall below the threshold.
    """
    wide = features.double()
    mean, size = wide.mean(0), wide.shape[1]
    away = wide - mean
    covariance = away.T @ away / len(wide)  # [D, D]
    rising, vectors = torch.linalg.eigh(covariance)
    values, vectors = rising.flip(0), vectors.flip(1)
    # Shrinking towards the mean moves variance between directions and keeps their sum.
    values = (1 - shrinkage) * values + shrinkage * rising.mean()
    # A direction that never varies would make every other value infinitely unlikely.
    rounding = torch.finfo(torch.float32).eps * float(wide.square().mean())
    values = values.clamp(min=rounding)
    taken = min(rank, size - 1)  # leave at least one direction for the noise
    directions = vectors[:, :taken].contiguous()
    variances, noise = values[:taken].clone(), values[taken:].mean()
    # The threshold is a quantile of the densities, which are computed with a placeholder for it.
    found = Gaussian(mean, directions, variances, noise, threshold=values.new_zeros(()))
    return replace(found, threshold=torch.quantile(found.log_density(wide), quantile))


@torch.no_grad()
def infer(features: Tensor, tasks: Sequence[Gaussian]) -> Tensor:
    """The most likely task [N] int64 of each image, from its features [N, D].

    It is NONE where the log-density lies below even that task's threshold.
    """
    if not tasks:
        return torch.full((len(features),), NONE, device=features.device)
    scores = torch.stack([g.log_density(features) for g in tasks], dim=1)  # [N, tasks]
    best, task = scores.max(1)
    thresholds = torch.stack([g.threshold for g in tasks])
    return torch.where(best >= thresholds[task], task, NONE)
