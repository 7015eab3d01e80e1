"""How much memory is free, how much a process has taken at most, and what it gives back."""

from __future__ import annotations

import contextlib
import ctypes
import re
import resource
import sys
from collections.abc import Generator
from pathlib import Path

import torch

from aegis_cli.common.errors import AegisError

_STATUS = Path("/proc/self/status")
_RESTART = Path("/proc/self/clear_refs")  # a 5 in it: the peak begins anew
# glibc's `mallopt`: from which size on a block is mapped by itself, and unmapped when it is freed;
# and how much may be free at the heap's end before that is given back.
_MAPPED_FROM, _FREE_AT_END = -3, -1
_MAPPED, _USUAL = 2**20, 2**25  # bytes


def free(device: torch.device) -> int | None:
    """Bytes that a process may have beside those it has; None where that is not known."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    try:
        listed = Path("/proc/meminfo").read_text(encoding="utf-8")
    except FileNotFoundError:  # not Linux
        return None
    found = re.search(r"^MemAvailable:\s+(\d+) kB", listed, re.MULTILINE)
    return None if found is None else int(found[1]) * 1024


def restart_peak(device: torch.device) -> int:
    """Let `peak` tell what comes from now on.

    A CPU's goes on from the beginning of the process where the system cannot begin anew.

    Returns:
        The bytes that this process has now.
    """
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        return torch.cuda.memory_allocated(device)
    with contextlib.suppress(OSError):  # not Linux, or a container that may not
        _RESTART.write_text("5", encoding="utf-8")
    return peak(device)


def peak(device: torch.device) -> int:
    """Bytes that this process has needed at most on a device: its tensors' there, or on a CPU all
    that is resident.

    On Linux it is not `ru_maxrss`, which begins with the maximum of the process that started this
    one.

    Raises:
        AegisError: the kernel does not tell.
    """
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    if sys.platform == "darwin":
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found = re.search(r"^VmHWM:\s+(\d+) kB", _STATUS.read_text(encoding="utf-8"), re.MULTILINE)
    if found is None:
        raise AegisError(
            f"no VmHWM in {_STATUS}",
            "a kernel that reports peak memory",
            "use another kernel or sandbox",
        )
    return int(found[1]) * 1024


@contextlib.contextmanager
def returned() -> Generator[None]:
    """Within the block, memory of a CPU that is freed goes back to the system, if 1 MB or more.

    glibc raises that limit to 32 MB as it sees larger blocks freed, and keeps what is smaller:
    holes between what stays. To map each block anew takes time, about a tenth of a forward pass.
    Where the C library is another one, nothing changes.
    """
    library = ctypes.CDLL(None)
    if not hasattr(library, "mallopt"):
        yield
        return
    library.mallopt(_MAPPED_FROM, _MAPPED)
    library.malloc_trim(0)  # else what it has kept until now is filled first
    try:
        yield
    finally:
        # What both would have risen to; glibc raises neither any more.
        library.mallopt(_MAPPED_FROM, _USUAL)
        library.mallopt(_FREE_AT_END, 2 * _USUAL)
