"""Attention of independent blocks to one shared prefix and to themselves.

An image's questions, or the flow samples of a robot frame, are blocks: each attends to the prefix
(the image; the image and the instruction) and to its own tokens, never to another block. Scores are
explicit matrix products because the backward pass of PyTorch's fused CPU attention took half of a
training step.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor


class KeyValue(NamedTuple):
    """Keys and values [B, heads, T, head_dim] each."""

    key: Tensor
    value: Tensor


class Rotation(NamedTuple):
    """Cosines and sines of a rotary embedding, [B, S, head_dim] each.

    The second half of the channels repeats the first.
    """

    cos: Tensor
    sin: Tensor


def rotate(x: Tensor, rotation: Rotation) -> Tensor:
    """Rotate channel i of x [B, h, N, S, d] with its channel i + d/2.

    This is RoFormer's embedding (arXiv 2104.09864) with channels in GPT-NeoX's order.
    """
    # In x's dtype: multiplying by float32 tables would upcast half-precision keys and queries.
    cos, sin = (t[:, None, None].to(x.dtype) for t in rotation)  # [B, 1, 1, S, d]
    low, high = x.chunk(2, dim=-1)
    quarter_turn = torch.cat([-high, low], dim=-1)
    return x * cos + quarter_turn * sin


def block_attention(
    query: Tensor,
    own: KeyValue,
    own_mask: Tensor | None = None,
    prefix: KeyValue | None = None,
    prefix_mask: Tensor | None = None,
) -> Tensor:
    """Softmax attention of N blocks of S tokens over a prefix of P tokens and over themselves.

    Args:
        query: [B, h, N, S, d].
        own: keys and values of the same blocks, [B, h, N, S, d] each.
        own_mask: additive, broadcastable to [B, 1, N, S, S]: which tokens of a block attend to
            which.
        prefix: keys and values shared by all blocks, [B, h, P, d] each.
        prefix_mask: additive, broadcastable to [B, 1, 1, 1, P].

    Returns:
        [B, h, N, S, d].
    """
    batch, heads, blocks, length, width = query.shape
    # Scale the queries rather than the scores, because they have fewer entries.
    query = query * (1 / math.sqrt(width))
    own_scores = query @ own.key.transpose(-1, -2)  # [B, h, N, S, S]
    if own_mask is not None:
        own_scores = own_scores + own_mask
    if prefix is None:
        return own_scores.softmax(-1) @ own.value
    # All blocks share the prefix, so their queries are the rows of one product with its keys.
    flat = query.reshape(batch, heads, blocks * length, width)
    prefix_scores = flat @ prefix.key.transpose(-1, -2)  # [B, h, N*S, P]
    prefix_scores = prefix_scores.unflatten(2, (blocks, length))
    if prefix_mask is not None:
        prefix_scores = prefix_scores + prefix_mask
    # One softmax over both, so that a token weighs the prefix against its own block.
    weights = torch.cat([prefix_scores, own_scores], dim=-1).softmax(-1)
    to_prefix, to_own = weights.split([prefix.key.shape[2], length], dim=-1)
    from_prefix = to_prefix.flatten(2, 3) @ prefix.value  # [B, h, N*S, d]
    from_own = to_own @ own.value  # [B, h, N, S, d]
    return from_prefix.unflatten(2, (blocks, length)) + from_own


def additive(mask: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
    """A boolean mask (True: attend) as zeros and large negatives to add to scores.

    The negatives are finite: a row without any True stays free of NaN.
    """
    scores = torch.zeros(mask.shape, dtype=dtype, device=mask.device)
    # The largest float16 is 65,504, and exp(-1e4) is exactly 0 in every dtype.
    return scores.masked_fill(~mask, -1e4)
