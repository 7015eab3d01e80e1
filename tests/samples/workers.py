"""What worker processes of tests do; a spawned process finds these by their module."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from aegis_cli.common import locks
from aegis_cli.common.processes import WorkerPool


def keep_while_at_work(path: Path) -> None:
    """Keep a file, with this process's number in it, as long as the work lasts: very long."""
    try:
        path.write_text(str(os.getpid()), encoding="utf-8")
        time.sleep(600)
    finally:
        path.unlink()


def hold(folder: Path) -> None:
    """Hold the folder's lock until this process is ended, and say so on stdout."""
    with locks.alone(folder):
        print("held", flush=True)
        time.sleep(600)


def employ(path: Path) -> None:
    """Have a worker process at work."""
    with WorkerPool(1, "a test's process", "") as pool:
        pool.submit(keep_while_at_work, path).result()


def peaks() -> tuple[int, int, int, int]:
    """A size in bytes, and what the process has had at most.

    With so much more, from when that was given back, and with half of it once more.
    """
    import torch  # which the other processes have no need of

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


if __name__ == "__main__":
    {"hold": hold, "employ": employ}[sys.argv[1]](Path(sys.argv[2]))
