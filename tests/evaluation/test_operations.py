"""Counted operations, compared with those that follow from the shapes."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional as F

from aegis_cli.evaluation import operations

SIZES = st.integers(1, 5)


@given(SIZES, SIZES, SIZES, SIZES, SIZES, SIZES)
@settings(max_examples=20)
def test_attention_counts_whatever_the_heads_of_keys(
    rows: int, heads: int, shared: int, queries: int, keys: int, width: int
) -> None:
    """Forward: two products of B H T S D multiplications and additions; backward: five."""
    query = torch.randn(rows, heads * shared, queries, width, requires_grad=True)
    key, value = (torch.randn(rows, heads, keys, width, requires_grad=True) for _ in range(2))
    with operations.counter() as forward:
        found = F.scaled_dot_product_attention(query, key, value, enable_gqa=shared > 1)
    with operations.counter() as both:
        F.scaled_dot_product_attention(query, key, value, enable_gqa=shared > 1).sum().backward()
    product = 2 * rows * heads * shared * queries * keys * width
    assert found.shape == query.shape
    assert forward.get_total_flops() == 2 * product
    assert both.get_total_flops() == 7 * product


def test_linear_maps_count_as_ever() -> None:
    x, weight = torch.randn(3, 5), torch.randn(7, 5, requires_grad=True)
    with operations.counter() as counted:
        F.linear(x, weight).sum().backward()
    assert counted.get_total_flops() == 2 * (2 * 3 * 5 * 7)
