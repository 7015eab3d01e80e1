"""What tests and the processes that they start find in their environment."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
from samples.command import finding

from aegis_cli.common import devices

TESTS = Path(__file__).parent
HELPER = TESTS / "samples" / "command.py"


def test_what_pythonpath_had_stays_behind_what_a_test_adds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folders = Path("first"), Path("second")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(["third", "fourth"]))
    expected = os.pathsep.join(["first", "second", "third", "fourth"])
    assert finding(*folders) == os.environ | {"PYTHONPATH": expected}
    monkeypatch.delenv("PYTHONPATH")
    assert finding(*folders)["PYTHONPATH"] == os.pathsep.join(["first", "second"])


def test_no_other_code_sets_it() -> None:
    others = set(TESTS.rglob("*.py")) - {HELPER, Path(__file__)}
    assert [path for path in others if "PYTHONPATH" in path.read_text(encoding="utf-8")] == []


def test_tests_run_on_the_cpu_unless_somebody_chose_another_device() -> None:
    assert os.environ.get(devices.VARIABLE)


def test_what_is_compiled_is_kept_for_the_next_process() -> None:
    assert not sys.dont_write_bytecode
    assert "PYTHONDONTWRITEBYTECODE" not in os.environ
