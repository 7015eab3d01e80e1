"""Wasserstein-2 transport cost between diagonal Gaussians, and its mean over layers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from aegis_cli.common.errors import AegisError
from aegis_cli.core.moments import Moments

WEIGHTINGS = ("none", "variance")


def w2_diag(mean1: Tensor, var1: Tensor, mean2: Tensor, var2: Tensor) -> Tensor:
    """Squared W2 distance: W2^2 = |mu1 - mu2|^2 + |sigma1 - sigma2|^2, all [..., D] -> [...].

    For diagonal covariances this is the general formula |mu1 - mu2|^2
    + tr(S1 + S2 - 2 (S2^1/2 S1 S2^1/2)^1/2) (Dowson & Landau 1982). The gradient is finite
    everywhere, even where a variance is 0.
    """
    between_means = (mean1 - mean2).square().sum(-1)
    between_deviations = (_std(var1) - _std(var2)).square().sum(-1)
    return between_means + between_deviations


def layer_weights(anchor: Sequence[Moments], weighting: str) -> Tensor:
    """Weight of each layer's W2^2 [L]: 1 (`none`, the paper's plain mean) or 1 / tr var_l.

    Residual streams grow by orders of magnitude with depth. The second weighting, `variance`, keeps
    the last layers from dominating the first.

    Raises:
        AegisError: an unknown weighting, or `variance` with a layer that has no variance.
    """
    if weighting not in WEIGHTINGS:
        raise AegisError(
            f"layer weighting '{weighting}'",
            " or ".join(f"'{w}'" for w in WEIGHTINGS),
            "--set aegis.weighting=none",
        )
    traces = torch.stack([layer.var.sum() for layer in anchor])
    if weighting == "none":
        return torch.ones_like(traces)
    if (traces == 0).any():
        raise AegisError(
            f"layer {int((traces == 0).nonzero()[0])} of the anchor has no variance",
            "a positive variance in every layer: the weighting 'variance' divides by it",
            "--set aegis.weighting=none, or measure the anchor on more samples",
        )
    return 1 / traces


def transport_penalty(
    moments: Sequence[tuple[Tensor, Tensor]], anchor: Sequence[Moments], weights: Tensor
) -> tuple[Tensor, Tensor]:
    """How far each layer's activations are from the anchor.

    Args:
        moments: (mean [D], var [D]) of the current batch, one pair per layer, with their graph.
        anchor: the pre-trained moments, one per layer.
        weights: the result of `layer_weights` for the anchor, [L].

    Returns:
        The penalty to differentiate (mean over layers of the weighted W2^2), and the unweighted
        W2^2 of each layer [L], detached.
    """
    w2 = _of_each_layer(moments, anchor)  # [L]
    # With the weighting `none` this is the paper's plain mean over layers.
    return (w2 * weights).mean(), w2.detach()


def _of_each_layer(moments: Sequence[tuple[Tensor, Tensor]], anchor: Sequence[Moments]) -> Tensor:
    """W2^2 of each layer [L]."""
    each = []
    for (mean, var), measured in zip(moments, anchor, strict=True):
        each.append((mean, var, measured.mean, measured.var))
    if len({mean.shape for mean, *_ in each}) == 1:
        # One computation for all layers instead of dozens of kernel launches for each.
        means, variances, *measured = (torch.stack(part) for part in zip(*each, strict=True))
        return w2_diag(means, variances, *measured)  # each is [L, D]
    return torch.stack([w2_diag(*layer) for layer in each])


def _std(var: Tensor) -> Tensor:
    """sqrt(var), with gradient 0 instead of infinity where var is exactly 0.

    If var > 0, value and gradient are those of sqrt: no epsilon is added. At 0 every activation
    equals the mean, d sigma/dh is 0/0, and 0 is a subgradient, because sigma is a norm of the
    deviations. Both fills are needed: the inner one keeps sqrt'(0) = inf out of the backward pass,
    where it would be multiplied by the 0 of the outer one and become NaN.
    """
    zero = var == 0
    return var.masked_fill(zero, 1).sqrt().masked_fill(zero, 0)
