"""Free memory, the peak memory of a process, and returning freed memory to the system."""

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
_RESTART = Path("/proc/self/clear_refs")  # writing 5 to it resets the peak
# Parameters of glibc's `mallopt`: the size from which a block gets its own mapping, which is
# unmapped when it is freed; and how much may be free at the end of the heap before it is returned.
_MAPPED_FROM, _FREE_AT_END = -3, -1
_CGROUPS = Path("/sys/fs/cgroup")
# For each version of cgroups: the files of the limit and of what is used, and the name in
# memory.stat of the cache that can be dropped.
_LIMITS = (
    ("memory.max", "memory.current", "inactive_file"),
    ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "total_inactive_file"),
)
_NO_LIMIT = 2**60  # version 1 has no word for none, but a number near 2^63
_MAPPED, _USUAL = 2**20, 2**25  # bytes


def free(device: torch.device) -> int | None:
    """Bytes that a process may still allocate; None if unknown."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    try:
        listed = Path("/proc/meminfo").read_text(encoding="utf-8")
    except FileNotFoundError:  # not Linux
        return None
    found = re.search(r"^MemAvailable:\s+(\d+) kB", listed, re.MULTILINE)
    machine = None if found is None else int(found[1]) * 1024
    known = [room for room in (machine, _within_limit()) if room is not None]
    return min(known, default=None)


def _within_limit() -> int | None:
    """Bytes below the limit of this container (cgroup v2 or v1); None without a limit."""
    for limit, used, reclaimable in _LIMITS:
        try:
            most = (_CGROUPS / limit).read_text(encoding="ascii").strip()
            now = int((_CGROUPS / used).read_text(encoding="ascii"))
            listed = (_CGROUPS / limit).with_name("memory.stat").read_text(encoding="ascii")
        except (OSError, ValueError):  # no such version, or nothing that may be read
            continue
        if most == "max" or int(most) >= _NO_LIMIT:
            return None
        # The limit counts the cache of files too, which the system drops when memory is short.
        cached = re.search(rf"^{reclaimable} (\d+)$", listed, re.MULTILINE)
        return max(0, int(most) - now + (0 if cached is None else int(cached[1])))
    return None


def restart_peak(device: torch.device) -> int:
    """Let `peak` cover only what comes from now on.

    On a CPU it still covers the whole process if the system cannot reset it.

    Returns:
        The bytes that this process uses now.
    """
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        return torch.cuda.memory_allocated(device)
    with contextlib.suppress(OSError):  # not Linux, or not permitted in a container
        _RESTART.write_text("5", encoding="utf-8")
    return peak(device)


def peak(device: torch.device) -> int:
    """Peak bytes of this process on a device: of its tensors, or on a CPU of its resident memory.

    On Linux this is not `ru_maxrss`, which starts from the maximum of the parent process.

    Raises:
        AegisError: the kernel does not report it.
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
    """Return freed CPU memory to the system inside the block, for blocks of 1 MB or more.

    glibc raises that limit to 32 MB when larger blocks are freed, and keeps smaller ones, which
    leaves holes between live blocks. Mapping each block anew takes time, about a tenth of a forward
    pass. With another C library, nothing changes.
    """
    library = ctypes.CDLL(None)
    if not hasattr(library, "mallopt"):
        yield
        return
    library.mallopt(_MAPPED_FROM, _MAPPED)
    library.malloc_trim(0)  # otherwise the memory kept so far is filled first
    try:
        yield
    finally:
        # The values that both would have reached; glibc no longer raises them by itself.
        library.mallopt(_MAPPED_FROM, _USUAL)
        library.mallopt(_FREE_AT_END, 2 * _USUAL)
