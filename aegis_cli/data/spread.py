"""Evenly spread rows, for looking at only some of them."""

from __future__ import annotations

import torch
from torch import Tensor

_WHOLE = 2**24  # up to here float32 represents every whole number


def rows(size: int, most: int) -> Tensor:
    """At most `most` of `size` rows, from the first to the last, [n] int64."""
    # Smaller sizes stay in float32: float64 would round some rows to their neighbours, which would
    # change earlier figures.
    kind = torch.float32 if size <= _WHOLE else torch.float64
    return torch.linspace(0, size - 1, min(most, size), dtype=kind, device="cpu").long()
