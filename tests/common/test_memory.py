"""What a process has taken at most, since it began or since it was asked to begin anew."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from aegis_cli.common import memory

CPU = torch.device("cpu")

# A process of its own: in this one, what earlier tests left behind may be given back meanwhile.
_PEAKS = """
import json
import torch
from aegis_cli.common import memory

cpu, size = torch.device("cpu"), 400_000_000
ballast = bytearray(size)
before = memory.peak(cpu)
del ballast
base = memory.restart_peak(cpu)
ballast = bytearray(size // 2)
print(json.dumps([size, before, base, memory.peak(cpu)]))
"""


@pytest.mark.skipif(
    not os.access("/proc/self/clear_refs", os.W_OK), reason="needs a peak that can begin anew"
)
def test_a_peak_begins_anew() -> None:
    command = [sys.executable, "-c", _PEAKS]
    ran = subprocess.run(command, capture_output=True, text=True, check=True)
    size, before, base, after = json.loads(ran.stdout)
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
