"""Moments: merging equals concatenating, padding never counts, no precision lost far from zero."""

from __future__ import annotations

import itertools

import pytest
import torch
from torch import Tensor

from aegis_cli.core.moments import Moments, batch_moments, empty, masked_moments, merge


def hidden_states(
    seed: int, batch: int = 6, tokens: int = 40, width: int = 16
) -> tuple[Tensor, Tensor]:
    """Columns with means from -5 to 1000 and deviations from 0.1 to 3; ragged masks."""
    generator = torch.Generator().manual_seed(seed)
    h = torch.randn(batch, tokens, width, generator=generator)
    h = h * torch.linspace(0.1, 3, width) + torch.linspace(-5, 1000, width)
    lengths = torch.randint(1, tokens + 1, (batch, 1), generator=generator)
    return h, torch.arange(tokens) < lengths


def direct(h: Tensor, mask: Tensor) -> Moments:
    var, mean = torch.var_mean(h[mask].double(), 0, correction=0)
    return Moments(int(mask.sum()), mean, var)


def assert_same(a: Moments, b: Moments, rtol: float) -> None:
    assert a.count == b.count
    torch.testing.assert_close(a.mean, b.mean, rtol=rtol, atol=1e-12)
    torch.testing.assert_close(a.var, b.var, rtol=rtol, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float64])
def test_equal_float64_statistics_of_the_valid_rows(seed: int, dtype: torch.dtype) -> None:
    h, mask = hidden_states(seed)
    assert_same(masked_moments(h.to(dtype), mask), direct(h.to(dtype), mask), rtol=2e-7)


def test_mean_1000_std_01_keeps_its_variance() -> None:
    h = 1000 + 0.1 * torch.randn(64, 80, 8, generator=torch.Generator().manual_seed(0))
    mask = torch.ones(64, 80, dtype=torch.bool)
    cancelling = h.square().mean((0, 1)) - h.mean((0, 1)).square()
    assert (
        cancelling - 0.01
    ).abs().max() > 0.01  # the unused formula is off by more than the answer
    assert_same(masked_moments(h, mask), direct(h, mask), rtol=1e-6)
    mean, var = batch_moments(h, mask)
    torch.testing.assert_close(mean.double(), direct(h, mask).mean, rtol=1e-6, atol=0)
    torch.testing.assert_close(var.double(), direct(h, mask).var, rtol=1e-4, atol=0)


def test_merge_equals_concatenation_in_any_order() -> None:
    batches = [hidden_states(seed, batch=size) for seed, size in enumerate((1, 5, 2, 9))]
    h, mask = (torch.cat(parts) for parts in zip(*batches, strict=True))
    for order in itertools.permutations([masked_moments(*batch) for batch in batches]):
        total = empty(h.shape[-1])
        for part in order:
            total = merge(total, part)
        assert_same(total, direct(h, mask), rtol=1e-7)


def test_merge_is_exact_on_exact_parts() -> None:
    h, mask = hidden_states(0)
    merged = merge(direct(h[:2], mask[:2]), direct(h[2:], mask[2:]))
    assert_same(merged, direct(h, mask), rtol=1e-13)


def test_merge_is_associative_and_commutative() -> None:
    a, b, c = (masked_moments(*hidden_states(seed, batch=seed + 1)) for seed in range(3))
    assert_same(merge(merge(a, b), c), merge(a, merge(b, c)), rtol=1e-12)
    assert_same(merge(a, b), merge(b, a), rtol=1e-12)


def test_batch_size_changes_nothing() -> None:
    h, mask = hidden_states(3, batch=24)
    for size in (1, 5, 24):
        total = empty(h.shape[-1])
        for rows, valid in zip(h.split(size), mask.split(size), strict=True):
            total = merge(total, masked_moments(rows, valid))
        assert_same(total, direct(h, mask), rtol=1e-7)


def test_empty_is_neutral() -> None:
    a = masked_moments(*hidden_states(0))
    assert_same(merge(a, empty(16)), a, rtol=0)
    assert_same(merge(empty(16), a), a, rtol=0)
    h, mask = hidden_states(0)
    assert_same(masked_moments(h, torch.zeros_like(mask)), empty(16), rtol=0)


@pytest.mark.parametrize("garbage", [1e30, float("nan"), float("inf")])
def test_padding_never_counts(garbage: float) -> None:
    h, mask = hidden_states(1)
    padded = h.masked_fill(~mask[..., None], garbage).requires_grad_()
    assert_same(masked_moments(padded, mask), masked_moments(h, mask), rtol=0)
    mean, var = batch_moments(padded, mask)
    assert torch.equal(mean, batch_moments(h, mask)[0]) and torch.equal(
        var, batch_moments(h, mask)[1]
    )
    (mean.sum() + var.sum()).backward()
    assert (
        padded.grad is not None and padded.grad[~mask].eq(0).all() and padded.grad.isfinite().all()
    )


@pytest.mark.parametrize("scale", [1e-10, 1.0, 1e10])
def test_scale(scale: float) -> None:
    h, mask = hidden_states(2)
    assert_same(masked_moments(h * scale, mask), direct(h * scale, mask), rtol=2e-7)


def test_a_constant_has_variance_zero() -> None:
    h = torch.full((3, 100, 4), 1000.1)
    moments = masked_moments(h, torch.ones(3, 100, dtype=torch.bool))
    torch.testing.assert_close(moments.mean, h[0, 0].double(), rtol=1e-12, atol=0)
    assert (moments.var >= 0).all() and (moments.var < 1e-12).all()


def test_batch_moments_gradients() -> None:
    h, mask = hidden_states(4, batch=2, tokens=5, width=3)
    h = h.double().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: batch_moments(x, mask), h)


def test_batch_moments_stay_float32_under_autocast() -> None:
    h, mask = hidden_states(5)
    with torch.autocast("cpu", torch.bfloat16):
        mean, var = batch_moments(h, mask)
    assert mean.dtype == var.dtype == torch.float32
    torch.testing.assert_close(var.double(), direct(h, mask).var, rtol=1e-4, atol=0)
