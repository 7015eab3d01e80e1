"""A selection of the campaign: the part that README's test command runs in half a minute."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from samples.command import ROOT, finding

pytestmark = pytest.mark.campaign
MUTATIONS, KILLS = 40, 2


def test_no_damage_no_signal_and_no_trouble_ends_in_a_defect(tmp_path: Path) -> None:
    """Each file is read as it was, or refused with one clear error; interrupted work resumes."""
    counts = ("--mutations", str(MUTATIONS), "--kills", str(KILLS), "--troubles", "9")
    state = tmp_path / "state.jsonl"
    command = [sys.executable, "tests/campaign", *counts, "--state", str(state)]
    done = subprocess.run(
        [*command, "--scratch", str(tmp_path)],
        cwd=ROOT,
        env=finding(ROOT),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    lines = [json.loads(line) for line in state.read_text().splitlines()]
    tried = Counter(line["kind"] for line in lines)
    assert (tried["mutations"], tried["kills"]) == (MUTATIONS, KILLS)
    # A campaign in which nothing is refused, or nothing read, proves nothing.
    codes = {line["code"] for line in lines if line["kind"] == "mutations"}
    assert codes == {0, 2}
