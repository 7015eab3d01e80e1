"""A long training keeps nothing but its ledger."""

from __future__ import annotations

from pathlib import Path

from campaign import growth
from samples import processes


def test_memory_does_not_grow_with_the_steps(tmp_path: Path) -> None:
    """The ledger of 300 steps is 60 KB; keeping a step's batch would add 100 KB each."""
    found, ledger = processes.alone(growth.measure, tmp_path, 300, 3)
    sizes = list(found.values())
    assert len(sizes) == 3 and ledger < 100_000
    assert sizes[-1] - sizes[0] < 8 << 20
