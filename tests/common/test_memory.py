"""The peak memory of a process, since its start or since the peak was last reset."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

import pytest
import torch
from samples import processes
from samples.workers import faults_after_returned, mapped_blocks, peaks

from aegis_cli.common import memory

CPU = torch.device("cpu")


@pytest.mark.skipif(
    not os.access("/proc/self/clear_refs", os.W_OK), reason="needs a peak that can begin anew"
)
def test_a_peak_begins_anew() -> None:
    # In a process of its own, since memory of earlier tests may be freed meanwhile in this one.
    size, before, base, after = processes.alone(peaks)
    assert base < before - size / 2
    assert size / 4 < after - base < size


def test_what_is_free_is_known_on_linux_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    found = memory.free(CPU)
    if Path("/proc/meminfo").exists():
        assert found is not None and found > 0

    def missing(*_: object, **__: object) -> str:
        raise FileNotFoundError

    monkeypatch.setattr(Path, "read_text", missing)
    assert memory.free(CPU) is None


def write_limits(place: Path, names: tuple[str, str], most: str, used: int, cached: str) -> None:
    (place / names[0]).parent.mkdir(parents=True, exist_ok=True)
    (place / names[0]).write_text(f"{most}\n", encoding="ascii")
    (place / names[1]).write_text(f"{used}\n", encoding="ascii")
    (place / names[0]).with_name("memory.stat").write_text(f"anon 7\n{cached}\n", encoding="ascii")


@pytest.mark.parametrize(
    ("names", "none", "cached"),
    [
        (("memory.max", "memory.current"), "max", "inactive_file 3000"),
        (
            ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes"),
            "9223372036854771712",
            "inactive_file 1\ntotal_inactive_file 3000",
        ),
    ],
)
def test_a_containers_limit_counts(
    names: tuple[str, str], none: str, cached: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "_CGROUPS", tmp_path)
    machine = memory.free(CPU)
    assert machine is not None and machine > 20_000
    write_limits(tmp_path, names, "15000", 10_000, cached)
    assert memory.free(CPU) == 15_000 - 10_000 + 3_000
    write_limits(tmp_path, names, "15000", 30_000, cached)
    assert memory.free(CPU) == 0
    write_limits(tmp_path, names, none, 10_000, cached)
    found = memory.free(CPU)
    assert found is not None and found > 20_000


@pytest.mark.skipif(
    not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="needs glibc 2.33, which tells what it maps"
)
def test_what_is_freed_goes_back_within_the_block_alone() -> None:
    # In a process of its own, since the setting is global to the process.
    before, within, after = processes.alone(mapped_blocks)
    assert before == after == 0
    assert within >= 24_000_000


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="needs glibc")
def test_what_is_freed_after_the_block_is_kept_again() -> None:
    """Otherwise later computations would request the same pages from the system repeatedly."""
    faults, pages = processes.alone(faults_after_returned)
    assert faults < pages / 10
