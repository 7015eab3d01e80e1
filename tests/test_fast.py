"""`pytest -m fast`: about a thousand tests, of every room, by a rule that names what exists."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from samples import fast

TESTS = Path(__file__).parent


@pytest.fixture(scope="module")
def selected() -> list[str]:
    """The tests that `-m fast` selects, as pytest names them."""
    options = ["-m", "fast", "--collect-only", "-n", "0", "-p", "no:cacheprovider"]
    command = [sys.executable, "-m", "pytest", *options, str(TESTS)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=TESTS.parent)
    return [line for line in done.stdout.splitlines() if "::" in line]


def test_about_a_thousand_are_fast(selected: list[str]) -> None:
    assert 800 <= len(selected) <= 1500


def test_every_room_has_fast_tests(selected: list[str]) -> None:
    rooms = {path.name for path in TESTS.iterdir() if any(path.glob("**/test_*.py"))}
    assert len(rooms) > 10
    assert {test.removeprefix("tests/").split("/")[0] for test in selected} >= rooms


@pytest.mark.parametrize("name", [*fast.FILES, *fast.MANY_DRAWS])
def test_every_file_that_the_rule_names_exists(name: str) -> None:
    assert (TESTS / name).is_file()


@pytest.mark.parametrize("name", fast.TESTS)
def test_every_test_that_the_rule_names_exists(name: str) -> None:
    path, function = name.split("::")
    assert f"def {function}(" in (TESTS / path).read_text(encoding="utf-8")
