"""Where to compute, and in which precision."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch
from torch import Tensor


def pick() -> torch.device:
    """The GPU if there is one, else the CPU.

    From here on float32 means float32: cuDNN would round to TF32 in convolutions.
    """
    torch.backends.cudnn.allow_tf32 = False
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def reading_waits(device: torch.device) -> bool:
    """Whether to read a number of that device is to wait until it has done all it was given.

    A GPU then stands still until it is given more. So what a step leaves is read now and then, and
    what it decides on the way it decides without the number.
    """
    return device.type != "cpu"


def send(x: Tensor, device: torch.device) -> Tensor:
    """A tensor of the CPU on that device; the program goes on while a GPU copies it."""
    if device.type != "cuda" or not x.is_cpu:
        return x.to(device)
    return x.pin_memory().to(device, non_blocking=True)  # only pinned memory is copied meanwhile


def autocast(device: torch.device, precision: str) -> contextlib.AbstractContextManager[object]:
    """A context in which matrix products are taken in the type that `precision` names.

    `bf16` means matrix products in bfloat16, `float32` changes nothing, and `auto` is bf16 where
    the hardware multiplies in it. With AMX or on a GPU bf16 is several times faster than float32; a
    CPU without AMX took 1.7 times as long.
    """
    enabled = precision == "bf16" or (precision == "auto" and multiplies_bf16(device))
    return torch.autocast(device.type, torch.bfloat16, enabled=enabled)


def multiplies_bf16(device: torch.device) -> bool:
    """Whether the hardware multiplies in bfloat16: a GPU, or a processor with AMX.

    ARM's list of features has no such entry, and an older torch has no list at all. Both count as
    no.
    """
    asked = getattr(torch.cpu, "get_capabilities", dict)
    return device.type != "cpu" or bool(asked().get("amx_bf16", False))


@contextlib.contextmanager
def single_threaded() -> Iterator[None]:
    """Use one CPU thread inside the block.

    LAPACK's eigensolver waits at thousands of small barriers. On two cores that other work shares,
    two threads took from 3 to 280 times as long as one.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
