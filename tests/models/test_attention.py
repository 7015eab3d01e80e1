"""Block attention against one dense softmax attention over everything, in float64."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from aegis_cli.core.attention import KeyValue, additive, block_attention

BATCH, HEADS, BLOCKS, LENGTH, PREFIX, WIDTH = 3, 2, 4, 5, 6, 8


def draw(*shape: int, seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def blocks(seed: int) -> Tensor:
    return draw(BATCH, HEADS, BLOCKS, LENGTH, WIDTH, seed=seed)


@pytest.fixture
def query() -> Tensor:
    return blocks(1)


@pytest.fixture
def own() -> KeyValue:
    return KeyValue(blocks(2), blocks(3))


@pytest.fixture
def prefix() -> KeyValue:
    return KeyValue(
        draw(BATCH, HEADS, PREFIX, WIDTH, seed=4), draw(BATCH, HEADS, PREFIX, WIDTH, seed=5)
    )


def own_allowed() -> Tensor:
    """A causal mask [B, N, S, S] bool that forbids one more key.

    Only its own query may read the first key of every second block.
    """
    allowed = torch.ones(LENGTH, LENGTH, dtype=torch.bool).tril().repeat(BATCH, BLOCKS, 1, 1)
    allowed[:, ::2, 1:, 0] = False
    return allowed


def prefix_allowed() -> Tensor:
    """[B, P] bool, a different length of prefix in each row."""
    return torch.arange(PREFIX) < torch.tensor([[6], [4], [1]])


def dense(
    query: Tensor, own: KeyValue, allowed: Tensor, prefix: KeyValue | None, seen: Tensor
) -> Tensor:
    """Attention by one matrix over prefix and all blocks.

    A boolean mask with -inf keeps the blocks apart.
    """
    total = BLOCKS * LENGTH
    mask = torch.zeros(BATCH, total, total, dtype=torch.bool)
    for n in range(BLOCKS):
        rows = slice(n * LENGTH, (n + 1) * LENGTH)
        mask[:, rows, rows] = allowed[:, n]
    q, key, value = (x.flatten(2, 3) for x in (query, own.key, own.value))
    if prefix is not None:
        key, value = torch.cat([prefix.key, key], 2), torch.cat([prefix.value, value], 2)
        mask = torch.cat([seen[:, None].expand(-1, total, -1), mask], 2)
    scores = q @ key.transpose(-1, -2) / math.sqrt(WIDTH)
    weights = scores.masked_fill(~mask[:, None], -math.inf).softmax(-1)
    return (weights @ value).unflatten(2, (BLOCKS, LENGTH))


@pytest.mark.parametrize("with_prefix", [False, True])
@pytest.mark.parametrize("with_own_mask", [False, True])
@pytest.mark.parametrize("with_prefix_mask", [False, True])
def test_equals_dense_attention(
    query: Tensor,
    own: KeyValue,
    prefix: KeyValue,
    with_prefix: bool,
    with_own_mask: bool,
    with_prefix_mask: bool,
) -> None:
    allowed = (
        own_allowed()
        if with_own_mask
        else torch.ones(BATCH, BLOCKS, LENGTH, LENGTH, dtype=torch.bool)
    )
    seen = prefix_allowed() if with_prefix_mask else torch.ones(BATCH, PREFIX, dtype=torch.bool)
    got = block_attention(
        query,
        own,
        additive(allowed, torch.float64)[:, None] if with_own_mask else None,
        prefix if with_prefix else None,
        additive(seen, torch.float64)[:, None, None, None] if with_prefix_mask else None,
    )
    expected = dense(query, own, allowed, prefix if with_prefix else None, seen)
    torch.testing.assert_close(got, expected, rtol=1e-12, atol=1e-12)


def test_gradients_equal_those_of_dense_attention(
    query: Tensor, own: KeyValue, prefix: KeyValue
) -> None:
    inputs = [x.requires_grad_(True) for x in (query, *own, *prefix)]
    allowed, seen, weight = own_allowed(), prefix_allowed(), blocks(9)
    masks = (
        additive(allowed, torch.float64)[:, None],
        additive(seen, torch.float64)[:, None, None, None],
    )
    got = block_attention(query, own, masks[0], prefix, masks[1])
    expected = dense(query, own, allowed, prefix, seen)
    pairs = zip(
        torch.autograd.grad((got * weight).sum(), inputs),
        torch.autograd.grad((expected * weight).sum(), inputs),
        strict=True,
    )
    for x, y in pairs:
        torch.testing.assert_close(x, y, rtol=1e-11, atol=1e-11)


def test_blocks_do_not_see_each_other(query: Tensor, own: KeyValue, prefix: KeyValue) -> None:
    before = block_attention(query, own, None, prefix)
    own.key[:, :, 2] += 1
    own.value[:, :, 2] += 1
    after = block_attention(query, own, None, prefix)
    others = [0, 1, 3]
    assert torch.equal(before[:, :, others], after[:, :, others])
    assert not torch.equal(before[:, :, 2], after[:, :, 2])


def test_a_masked_prefix_counts_for_nothing(query: Tensor, own: KeyValue, prefix: KeyValue) -> None:
    """The result is exactly equal, in float32 too: exp of the mask underflows to 0."""
    query, own, prefix = (
        query.float(),
        KeyValue(*(x.float() for x in own)),
        KeyValue(*(x.float() for x in prefix)),
    )
    mask = additive(prefix_allowed())[:, None, None, None]
    before = block_attention(query, own, None, prefix, mask)
    hidden = ~prefix_allowed()[:, None, :, None]
    changed = KeyValue(*(torch.where(hidden, x + 3, x) for x in prefix))
    assert torch.equal(before, block_attention(query, own, None, changed, mask))


def test_additive_is_zero_where_true() -> None:
    mask = additive(torch.tensor([True, False]))
    assert mask.dtype == torch.float32
    assert mask[0] == 0 and mask[1] <= -1e4
    assert torch.tensor([0.0, 0.0]).add(mask).softmax(-1).tolist() == [1.0, 0.0]
