"""What a process has taken at most, since it began or since it was asked to begin anew."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

from aegis_cli.common import memory

CPU = torch.device("cpu")
SIZE = 400_000_000


@pytest.mark.skipif(
    not os.access("/proc/self/clear_refs", os.W_OK), reason="needs a peak that can begin anew"
)
def test_a_peak_begins_anew() -> None:
    ballast = bytearray(SIZE)
    before = memory.peak(CPU)
    del ballast
    base = memory.restart_peak(CPU)
    assert base < before - SIZE / 2
    ballast = bytearray(SIZE // 2)
    assert SIZE / 4 < memory.peak(CPU) - base < SIZE
    del ballast


def test_what_is_free_is_known_on_linux_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    found = memory.free(CPU)
    if Path("/proc/meminfo").exists():
        assert found is not None and found > 0

    def missing(*_: object, **__: object) -> str:
        raise FileNotFoundError

    monkeypatch.setattr(Path, "read_text", missing)
    assert memory.free(CPU) is None
