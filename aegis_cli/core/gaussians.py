"""Which task is an image of? A Gaussian a task over frozen features, and a threshold under which it is of none.

The features are those of the bare model, so that nothing learned later moves them. Covariances are diagonal and drawn
towards their mean, since a task may bring fewer images than a feature has entries.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

NONE = -1


@dataclass(frozen=True)
class Gaussian:
    """One task's features.

    Attributes:
        mean, variance: [D] float64.
        threshold: log-density [] float64 under which an image counts as none of the task's.
    """

    mean: Tensor
    variance: Tensor
    threshold: Tensor

    def log_density(self, features: Tensor) -> Tensor:
        """Features [N, D] -> [N] float64, in nats."""
        far = (features.double() - self.mean).square() / self.variance
        return -0.5 * (far + (2 * torch.pi * self.variance).log()).sum(-1)

    def count(self) -> int:
        """Numbers that it stores."""
        return self.mean.numel() + self.variance.numel() + 1


@torch.no_grad()
def fit(features: Tensor, shrinkage: float, quantile: float) -> Gaussian:
    """A Gaussian of a task's training features [N, D].

    Args:
        shrinkage: share in [0, 1] of the variance that is replaced by its mean over the D entries.
        quantile: share of the task's own training images that fall under the threshold.
    """
    wide = features.double()
    variance = wide.var(0, correction=0)
    variance = (1 - shrinkage) * variance + shrinkage * variance.mean()
    # an entry that never varies would make every other value infinitely unlikely
    variance = variance.clamp(min=torch.finfo(torch.float32).eps * float(wide.square().mean()))
    plain = Gaussian(wide.mean(0), variance, torch.zeros((), dtype=torch.float64))
    return Gaussian(plain.mean, variance, torch.quantile(plain.log_density(wide), quantile))


@torch.no_grad()
def infer(features: Tensor, tasks: Sequence[Gaussian]) -> Tensor:
    """Features [N, D] -> the most likely task of each image [N] int64; NONE where even that one's threshold is missed."""
    if not tasks:
        return torch.full((len(features),), NONE)
    scores = torch.stack([g.log_density(features) for g in tasks], dim=1)
    best, task = scores.max(1)
    thresholds = torch.stack([g.threshold for g in tasks])
    return torch.where(best >= thresholds[task], task, NONE)
