"""A long training keeps no more than its ledger."""

from __future__ import annotations

import subprocess
import sys

from samples.command import ROOT, finding


def test_memory_does_not_grow_with_the_steps() -> None:
    """The ledger of 300 steps is 60 KB; a step that kept its batch would show as 100 KB each."""
    command = [sys.executable, "tests/campaign/growth.py", "--steps", "300", "--points", "3"]
    done = subprocess.run(
        command, cwd=ROOT, env=finding(ROOT), capture_output=True, text=True, check=True
    )
    said = dict(line.split() for line in done.stdout.splitlines())
    sizes = [int(size) for name, size in said.items() if name != "ledger"]
    assert len(sizes) == 3 and int(said["ledger"]) < 100_000
    assert sizes[-1] - sizes[0] < 8 << 20
