"""What the worker processes of tests do; a spawned process finds these by their module."""

from __future__ import annotations

import ctypes
import os
import resource
import sys
import time
from pathlib import Path

from aegis_cli.common import locks
from aegis_cli.common.processes import WorkerPool


def keep_while_at_work(path: Path) -> None:
    """Keep a file with this process's number in it during the work, which takes very long."""
    try:
        path.write_text(str(os.getpid()), encoding="utf-8")
        time.sleep(600)
    finally:
        path.unlink()


def hold(folder: Path) -> None:
    """Hold the folder's lock until this process is killed, and say so on stdout."""
    with locks.alone(folder):
        print("held", flush=True)
        time.sleep(600)


def employ(path: Path) -> None:
    """Start a worker process and keep it at work."""
    with WorkerPool(1, "a test's process", "") as pool:
        pool.submit(keep_while_at_work, path).result()


def peaks() -> tuple[int, int, int, int]:
    """A size in bytes, and three peaks of the process's memory.

    The peaks: after allocating that size, since it was freed, and with half of it allocated again.
    """
    import torch  # which the other processes do not need

    from aegis_cli.common import memory

    cpu, size = torch.device("cpu"), 400_000_000
    ballast = bytearray(size)
    before = memory.peak(cpu)
    del ballast
    base = memory.restart_peak(cpu)
    ballast = bytearray(size // 2)
    after = memory.peak(cpu)
    assert ballast
    return size, before, base, after


class _Allocated(ctypes.Structure):
    """What glibc's `mallinfo2` returns; `hblkhd` is the size of the blocks mapped separately."""

    _fields_ = [
        *((name, ctypes.c_size_t) for name in ("arena", "ordblks", "smblks", "hblks")),
        ("hblkhd", ctypes.c_size_t),
        ("others", ctypes.c_size_t * 5),
    ]


def mapped_blocks() -> tuple[int, int, int]:
    """How many more bytes are mapped separately while a process has a tensor of 24 MB.

    The values are from before `memory.returned`, within it, and after it.
    """
    import torch

    from aegis_cli.common import memory

    tell = ctypes.CDLL(None).mallinfo2
    tell.restype = _Allocated

    def of_a_tensor() -> int:
        before = tell().hblkhd
        tensor = torch.empty(24_000_000, dtype=torch.uint8)  # larger than any gap
        more = tell().hblkhd - before
        assert len(tensor)
        return more

    for _ in range(2):  # freeing a large block raises the limit
        torch.empty(30_000_000, dtype=torch.uint8)
    before = of_a_tensor()
    with memory.returned():
        within = of_a_tensor()
    return before, within, of_a_tensor()


def faults_after_returned() -> tuple[int, int]:
    """Page faults of ten blocks of 20 MB after `memory.returned`, and their number of pages."""
    import torch

    from aegis_cli.common import memory

    def fill() -> None:
        assert torch.ones(20_000_000, dtype=torch.uint8).numel()

    def faults() -> int:
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

    with memory.returned():
        pass
    for _ in range(10):  # the first ones have to get their memory
        fill()
    before = faults()
    for _ in range(10):
        fill()
    return faults() - before, 10 * 20_000_000 // resource.getpagesize()


if __name__ == "__main__":
    {"hold": hold, "employ": employ}[sys.argv[1]](Path(sys.argv[2]))
