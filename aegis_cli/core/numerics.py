"""Small numerical helpers that several modules share."""

from __future__ import annotations

import torch
from torch import Tensor


def ratio(x: Tensor, y: Tensor) -> Tensor:
    """x / y, or 0 where y is exactly 0, whatever x is."""
    # Filled twice: inside, so that no backward pass sees x / 0; outside, for the result.
    zero = y == 0
    return (x / y.masked_fill(zero, 1)).masked_fill(zero, 0)


def wide_type(dtype: torch.dtype) -> torch.dtype:
    """float64 for float64, and float32 for every narrower floating-point type."""
    return torch.promote_types(dtype, torch.float32)


def widened(x: Tensor) -> Tensor:
    """The tensor upcast to float32; a float32 or float64 tensor is returned as it is."""
    return x.to(wide_type(x.dtype))
