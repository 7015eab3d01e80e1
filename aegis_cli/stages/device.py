"""Where to compute, and in which precision."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch


def pick() -> torch.device:
    """The GPU if there is one, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def autocast(device: torch.device, precision: str) -> contextlib.AbstractContextManager[object]:
    """`bf16`: matrix products in bfloat16; `float32`: as is; `auto`: bf16 where the hardware multiplies in it.

    With AMX or on a GPU bf16 is several times faster than float32; a CPU without AMX took 1.7 times as long.
    """
    fast = device.type != "cpu" or torch.cpu.get_capabilities()["amx_bf16"]
    return torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16" or (precision == "auto" and fast))


@contextlib.contextmanager
def single_threaded() -> Iterator[None]:
    """One CPU thread inside: LAPACK's eigensolver waits at thousands of small barriers.

    On two cores that other work shares, two threads took from 3 to 280 times as long as one.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
