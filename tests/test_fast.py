"""`pytest -m fast`: about 1,500 tests, from every room, by a rule that names real files."""

from __future__ import annotations

from pathlib import Path

import pytest
from samples import fast

TESTS = Path(__file__).parent


class Collected:
    """The tests that a pytest session has collected, by pytest's names."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        self.names = [item.nodeid for item in session.items]


@pytest.fixture(scope="module")
def selected() -> list[str]:
    """The tests that `-m fast` selects, collected in this process, which has most imports."""
    found = Collected()
    options = ["-m", "fast", "--collect-only", "-n", "0", "-p", "no:cacheprovider"]
    assert pytest.main([*options, str(TESTS)], plugins=[found]) == pytest.ExitCode.OK
    return found.names


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
