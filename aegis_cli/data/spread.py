"""Rows that are spread evenly, where not all are looked at."""

from __future__ import annotations

import torch
from torch import Tensor

_WHOLE = 2**24  # up to here float32 has every whole number


def rows(size: int, most: int) -> Tensor:
    """At most so many of `size` rows, from the first to the last, [n] int64."""
    # Below, float32 stays, since float64 would round some rows to their neighbours, and what was
    # measured on them would be another figure.
    kind = torch.float32 if size <= _WHOLE else torch.float64
    return torch.linspace(0, size - 1, min(most, size), dtype=kind, device="cpu").long()
