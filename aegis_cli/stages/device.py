"""Where to compute, and in which precision."""

from __future__ import annotations

import contextlib

import torch


def pick() -> torch.device:
    """The GPU if there is one, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def autocast(device: torch.device, precision: str) -> contextlib.AbstractContextManager[object]:
    """`bf16`: matrix products in bfloat16 (nine times faster where the CPU has AMX); `float32`: as is."""
    return torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16")
