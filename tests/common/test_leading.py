"""One process leads a job; the others do their share of it, and learn how it ended."""

from __future__ import annotations

from pathlib import Path

import pytest
from samples.parallel_runs import Leading, run_together

FAILS = ("", "within", "after")


@pytest.fixture(scope="module")
def led(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for each way in which a job of two processes may end."""
    out = tmp_path_factory.mktemp("led")
    run_together(2, [Leading(out / (fails or "well"), fails) for fails in FAILS])
    return out


def notes(folder: Path, rank: int) -> list[str]:
    return (folder / f"{rank}.txt").read_text().splitlines()


def test_what_is_shared_all_do_and_all_else_the_first(led: Path) -> None:
    first, other = (notes(led / "well", rank) for rank in (0, 1))
    assert first == ["alone", "one of 1", "shared 3, twice: True", "ended: 7"]
    assert other == ["shared 4, twice: True", "ended: 7"]


def test_a_problem_of_the_first_is_that_of_all(led: Path) -> None:
    for rank in (0, 1):
        assert notes(led / "after", rank)[-1] == "ended: broken"


def test_a_problem_in_a_shared_part_ends_all(led: Path) -> None:
    for rank in (0, 1):
        assert notes(led / "within", rank)[-1] == "ended: nothing finite"


def test_a_process_alone_does_it_all(tmp_path: Path) -> None:
    Leading(tmp_path).run()
    assert notes(tmp_path, 0) == ["alone", "one of 1", "shared 3, twice: True", "ended: 3"]
