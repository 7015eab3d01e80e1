"""Count the operations of matrix products, including those of attention."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Size
from torch.utils.flop_counter import FlopCounterMode

aten = torch.ops.aten
_KERNELS = ("flash_attention", "efficient_attention", "cudnn_attention", "flash_attention_for_cpu")


def counter() -> FlopCounterMode:
    """A context manager that counts operations; `get_total_flops` then returns them.

    PyTorch does not count attention on a CPU. Before 2.13 it also refuses queries with more heads
    than the keys.
    """
    ours = {}
    for kernel in _KERNELS:
        forward = getattr(aten, f"_scaled_dot_product_{kernel}")
        ours[forward] = _attention
        ours[getattr(aten, f"{forward.__name__}_backward")] = _attention_backward
    return FlopCounterMode(display=False, custom_mapping=ours)


def _attention(query: Size, key: Size, value: Size, *_: Any, **__: Any) -> int:
    """Operations of the scores [B, H, T, S] and of the weighted sum of values.

    Args:
        query: [B, H, T, D]; key: [B, h, S, D] with h heads, each shared by equally many query
        heads; value: [B, h, S, E].
    """
    scores = math.prod(query[:3]) * key[2]  # B H T S
    # A multiplication and an addition for each of the D entries of a score, and the E of a value.
    return 2 * scores * (query[3] + value[3])


def _attention_backward(
    gradient: Size, query: Size, key: Size, value: Size, *_: Any, **__: Any
) -> int:
    """Operations of its gradients: the recomputed scores and four products of their size."""
    scores = math.prod(query[:3]) * key[2]  # B H T S
    # D each: the recomputed scores, and the gradients of queries and keys. E each: the gradients of
    # values and weights.
    return 2 * scores * (3 * query[3] + 2 * value[3])
