"""The table of a run or study, read back from its folder: the written one, or one error."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from samples.studies import found

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError
from aegis_cli.studies import table


@pytest.mark.parametrize("seeds", [1, 5])
@pytest.mark.parametrize("diverged", [{}, {"x": {0}}])
def test_a_study_comes_back_as_it_was_and_says_where_it_lies(
    seeds: int, diverged: dict[str, set[int]], tmp_path: Path
) -> None:
    written = found(("naive", "cotrain", "x"), seeds, diverged=diverged)
    files.save_json(tmp_path / "table.json", written.to_json())
    read = table.load(tmp_path)
    assert read.out == str(tmp_path) != written.out
    assert (
        read.to_json() | {"out": written.out} == written.to_json() and read.tasks == written.tasks
    )


def test_figures_that_are_no_longer_measured_are_passed_over(tmp_path: Path) -> None:
    written = found(("naive", "x"))
    raw = copy.deepcopy(written.to_json())
    first(raw).update(leak={"mean": 0.5})
    files.save_json(tmp_path / "table.json", raw)
    assert table.load(tmp_path).tasks == written.tasks


def first(raw: dict[str, Any]) -> dict[str, Any]:
    """The first variant's result."""
    return raw["tasks"][0]["results"][0]


Change = Callable[[dict[str, Any]], Any]
CHANGES: dict[str, Change] = {
    "other keys": lambda raw: raw.pop("finished"),
    "tasks.0.task: Field required": lambda raw: raw["tasks"][0].pop("task"),
    "tasks: keys that this version": lambda raw: raw["tasks"][0].update(more=1),
    "tasks.0.results.0.accuracy: ": lambda raw: first(raw).update(accuracy=[0.5]),
    "cells: Input should be a valid integer": lambda raw: raw.update(cells="many"),
    "within: Input should be a valid number": lambda raw: raw.update(within=True),
    "seeds: Input should be a valid array": lambda raw: raw.update(seeds={"0": 1}),
    "accuracy.interval.1: Field required": lambda raw: first(raw)["accuracy"].update(
        interval=[0.5]
    ),
}


@pytest.mark.parametrize("says", CHANGES)
def test_a_table_of_another_version_is_one_error(says: str, tmp_path: Path) -> None:
    raw = copy.deepcopy(found(("naive", "x")).to_json())
    CHANGES[says](raw)
    files.save_json(tmp_path / "table.json", raw)
    with pytest.raises(AegisError, match="no table of this version") as caught:
        table.load(tmp_path)
    assert says in caught.value.found and "aegis run again" in caught.value.fix


def test_of_many_misfits_the_first_are_named(tmp_path: Path) -> None:
    raw = copy.deepcopy(found(("naive", "x")).to_json())
    for name in ("drop_points", "cross_entropy", "success_seen", "success_held_out", "w2"):
        first(raw)[name] = "many"
    files.save_json(tmp_path / "table.json", raw)
    with pytest.raises(AegisError, match="and [0-9]+ more") as caught:
        table.load(tmp_path)
    assert caught.value.found.count("; ") == 3


def test_what_is_no_table_is_one_error(aegis, tmp_path: Path) -> None:
    (tmp_path / "table.json").write_text("[1, 2]")
    code, out, err = aegis("inspect", tmp_path)
    assert code == 2 and out == "" and "no table of this version" in err
    (tmp_path / "table.json").write_text("{")
    assert "is not JSON" in aegis("inspect", tmp_path)[2]
    (tmp_path / "table.json").unlink()
    (tmp_path / "cells.json").write_text("{}")
    assert "measured nothing yet" in aegis("inspect", tmp_path)[2]
