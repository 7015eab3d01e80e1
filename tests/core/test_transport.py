"""W2 between diagonal Gaussians: the general formula, its gradient, and the mean over layers."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest
import torch
from torch import Tensor

from aegis_cli.common.errors import AegisError
from aegis_cli.core.moments import Moments, batch_moments, joint_moments, shared_moments
from aegis_cli.core.transport import layer_weights, transport_penalty, w2_diag

MomentsOf = Callable[[Sequence[Tensor], Tensor], Sequence[tuple[Tensor, Tensor]]]


def gaussian(seed: int, width: int = 7) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    mean = torch.randn(width, dtype=torch.float64, generator=generator)
    return mean, torch.rand(width, dtype=torch.float64, generator=generator) * 3


def w2_full(mean1: Tensor, cov1: Tensor, mean2: Tensor, cov2: Tensor) -> Tensor:
    """|mu1 - mu2|^2 + tr(S1 + S2 - 2 (S2^1/2 S1 S2^1/2)^1/2) on full matrices."""
    root = sqrtm(cov2)
    return (mean1 - mean2).square().sum() + (cov1 + cov2 - 2 * sqrtm(root @ cov1 @ root)).trace()


def sqrtm(matrix: Tensor) -> Tensor:
    values, vectors = torch.linalg.eigh(matrix)
    return vectors @ values.clamp(min=0).sqrt().diag() @ vectors.T


@pytest.mark.parametrize("seed", range(10))
def test_equals_the_full_matrix_formula(seed: int) -> None:
    (m1, v1), (m2, v2) = gaussian(seed), gaussian(seed + 100)
    v1[0] = 0  # also for a degenerate Gaussian
    torch.testing.assert_close(
        w2_diag(m1, v1, m2, v2), w2_full(m1, v1.diag(), m2, v2.diag()), rtol=1e-10, atol=1e-10
    )


def test_is_a_squared_metric() -> None:
    a, b, c = gaussian(0), gaussian(1), gaussian(2)
    assert w2_diag(*a, *a) == 0
    assert w2_diag(*a, *b) == w2_diag(*b, *a) > 0
    assert w2_diag(*a, *c).sqrt() <= w2_diag(*a, *b).sqrt() + w2_diag(*b, *c).sqrt()


@pytest.mark.parametrize("seed", range(3))
def test_gradcheck(seed: int) -> None:
    inputs = [x.requires_grad_() for x in (*gaussian(seed), *gaussian(seed + 50))]
    assert torch.autograd.gradcheck(w2_diag, inputs)


def test_gradient_is_finite_at_zero_variance_and_exact_elsewhere() -> None:
    mean, var = gaussian(0)
    var[2] = 0
    var.requires_grad_()
    w2_diag(mean, var, *gaussian(1)).backward()
    std1, std2 = var.detach().sqrt(), gaussian(1)[1].sqrt()
    expected = (std1 - std2) / std1
    expected[2] = 0
    assert var.grad is not None
    torch.testing.assert_close(var.grad, expected, rtol=1e-14, atol=0)


@pytest.mark.parametrize("tokens", [1, 4])
def test_identical_tokens_give_a_finite_gradient(tokens: int) -> None:
    h = torch.ones(1, tokens, 7, requires_grad=True)
    moments = batch_moments(h, torch.ones(1, tokens, dtype=torch.bool))
    w2_diag(*moments, *gaussian(1)).backward()
    assert h.grad is not None and h.grad.isfinite().all() and h.grad.abs().sum() > 0


def test_nan_is_not_swallowed() -> None:
    mean, var = gaussian(0)
    assert w2_diag(mean, var.index_fill(0, torch.tensor([1]), float("nan")), mean, var).isnan()
    assert w2_diag(mean, var.index_fill(0, torch.tensor([1]), -1.0), mean, var).isnan()


@pytest.mark.parametrize("weighting", ["none", "variance"])
@pytest.mark.parametrize("widens", [0, 1])
def test_penalty_is_the_weighted_mean_over_layers(weighting: str, widens: int) -> None:
    """For layers of one width, which are compared at once, and for several widths."""
    anchor = [Moments(10, *gaussian(i, width=5 + widens * i)) for i in range(3)]
    now = [gaussian(i + 20, width=5 + widens * i) for i in range(3)]
    penalty, w2 = transport_penalty(now, anchor, layer_weights(anchor, weighting))
    each = [w2_diag(*moments, a.mean, a.var) for moments, a in zip(now, anchor, strict=True)]
    scale = [a.var.sum() if weighting == "variance" else 1.0 for a in anchor]
    torch.testing.assert_close(w2, torch.stack(each))
    torch.testing.assert_close(penalty, sum(x / s for x, s in zip(each, scale, strict=True)) / 3)


def test_variance_weighting_makes_the_penalty_scale_free() -> None:
    anchor, now = Moments(10, *gaussian(0)), gaussian(1)
    scaled = Moments(10, anchor.mean * 1e3, anchor.var * 1e6), (now[0] * 1e3, now[1] * 1e6)
    plain, wide = (
        transport_penalty([seen], [then], layer_weights([then], "variance"))[0]
        for then, seen in ((anchor, now), scaled)
    )
    torch.testing.assert_close(wide, plain)


def test_penalty_carries_the_graph_and_w2_does_not() -> None:
    mean, var = (x.float().requires_grad_() for x in gaussian(0))
    penalty, w2 = transport_penalty([(mean, var)], [Moments(10, *gaussian(1))], torch.ones(1))
    penalty.backward()
    assert mean.grad is not None and mean.grad.dtype == torch.float32 and mean.grad.abs().sum() > 0
    assert not w2.requires_grad


@pytest.mark.parametrize(
    "moments_of",
    [
        lambda hidden, mask: [batch_moments(h, mask) for h in hidden],
        joint_moments,
        lambda hidden, mask: shared_moments(hidden, mask, lambda x: x),
        lambda hidden, mask: shared_moments(hidden, mask, lambda x: x, reads=False),
    ],
)
def test_each_token_moves_as_the_closed_form_says(moments_of: MomentsOf) -> None:
    """dP/dh_t = 2 / (n L) (mean - mean0 + (1 - sigma0 / sigma) (h_t - mean)); 0 at padding.

    This holds however the moments were computed.
    """
    generator = torch.Generator().manual_seed(3)
    hidden = [torch.randn(2, 5, 7, dtype=torch.float64, generator=generator) for _ in range(3)]
    mask = torch.arange(5) < torch.tensor([[3], [5]])
    anchor = [Moments(10, *gaussian(i)) for i in range(3)]
    leaves = [h.requires_grad_() for h in hidden]
    penalty, _ = transport_penalty(moments_of(leaves, mask), anchor, torch.ones(3))
    for h, then, found in zip(hidden, anchor, torch.autograd.grad(penalty, leaves), strict=True):
        tokens = h.detach()[mask]
        var, mean = torch.var_mean(tokens, 0, correction=0)
        wanted = mean - then.mean + (1 - (then.var / var).sqrt()) * (tokens - mean)
        torch.testing.assert_close(found[mask], 2 / (8 * 3) * wanted)
        assert (found[~mask] == 0).all()


def test_layers_must_match() -> None:
    with pytest.raises(ValueError, match="zip"):
        transport_penalty([gaussian(0)], [Moments(1, *gaussian(i)) for i in (0, 1)], torch.ones(2))


def test_unknown_weighting_and_dead_layer_are_refused() -> None:
    anchor = [Moments(1, *gaussian(0)), Moments(1, torch.zeros(7), torch.zeros(7))]
    with pytest.raises(AegisError, match="'trace'"):
        layer_weights(anchor, "trace")
    with pytest.raises(AegisError, match="layer 1 of the anchor has no variance"):
        layer_weights(anchor, "variance")
