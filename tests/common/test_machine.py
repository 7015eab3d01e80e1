"""The name of a machine distinguishes machines whose times are not comparable."""

from __future__ import annotations

import os

import pytest
import torch

from aegis_cli.common import machine


@pytest.mark.parametrize(("threads", "used"), [(4, "4 cores"), (1, "1 of 4 cores")])
def test_fewer_threads_than_cores_are_another_machine(
    threads: int, used: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert machine.name().endswith(f", {used}")
