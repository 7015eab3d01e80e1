"""The environment of tests and of the processes that they start."""

from __future__ import annotations

import gc
import os
import sys
from pathlib import Path
from types import SimpleNamespace

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


def test_no_collection_of_garbage_looks_through_the_modules_and_what_earlier_files_left() -> None:
    assert gc.get_freeze_count() > 100_000 > len(gc.get_objects())


def test_what_stays_is_left_out_after_each_file_and_after_large_imports(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    plugins = request.config.pluginmanager.get_plugins()
    rules = next(p for p in plugins if hasattr(p, "keep_what_is_there"))
    found: list[pytest.Session] = []
    monkeypatch.setattr(rules, "keep_what_is_there", found.append)
    here, elsewhere = request.node, SimpleNamespace(path=TESTS / "test_other.py")
    monkeypatch.setitem(request.session.stash, rules.MODULES, len(sys.modules))
    for following, more, times in ((here, 0, 0), (None, 0, 1), (elsewhere, 0, 2), (here, 999, 3)):
        request.session.stash[rules.MODULES] = len(sys.modules) - more
        rules.pytest_runtest_teardown(here, following)
        assert found == [request.session] * times
