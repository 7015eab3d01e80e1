"""A study by several processes: the same results, nothing left running, nothing lost."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from samples.studies import fake_bench, study

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Progress
from aegis_cli.recipes import StudyRecipe
from aegis_cli.studies import study as stage

VARIANTS: dict[str, Any] = {
    "naive": {"method": "naive"},
    "again": {"method": "naive"},  # equal cells are measured once
    "wild": {"method": "naive", "set": {"train.expert_lr": 1e30, "train.warmup": 0}},
    "aegis": {"method": "aegis"},
}


class Stop(Exception):
    """Stands for the user's Ctrl-C."""


@pytest.fixture(autouse=True)
def benched() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        fake_bench(patch)
        yield


@pytest.fixture
def small(tiny_folder: Path, tmp_path: Path) -> StudyRecipe:
    return study(tmp_path, tiny_folder, variants=VARIANTS, tuning=None, seeds=[0])


@pytest.mark.usefixtures("quick_workers")
def test_processes_find_what_one_finds(small: StudyRecipe, tmp_path: Path) -> None:
    alone = stage.run(small, tmp_path / "alone")
    events: list[Progress] = []
    together = stage.run(small, tmp_path / "together", events.append, workers=2)
    assert [r.variant for r in together.tasks[0].results] == list(VARIANTS)  # in the recipe's order
    for one, other in zip(alone.tasks[0].results, together.tasks[0].results, strict=True):
        assert one.diverged == other.diverged == ([0] if one.variant == "wild" else [])
        if one.accuracy is not None:
            assert (
                other.accuracy.mean == one.accuracy.mean
                and other.success_seen.mean == one.success_seen.mean
            )
            assert other.validation_loss.mean == pytest.approx(
                one.validation_loss.mean, rel=1e-4
            )  # threads sum in another order
    assert [e.done for e in events if e.stage == "study"] == [1, 2, 3, 4]
    trained = {e.stage for e in events if e.stage.endswith("/train")}
    assert {
        "reach/naive/0/train",
        "reach/aegis/0/train",
    } <= trained and "reach/again/0/train" not in trained
    assert not list((tmp_path / "together").rglob("checkpoints"))
    assert multiprocessing.active_children() == []


@pytest.mark.usefixtures("quick_workers")
def test_interrupted_processes_stop_and_go_on_later(small: StudyRecipe, tmp_path: Path) -> None:
    def stop(event: Progress) -> None:
        if event.stage.endswith("/train") and event.done == 3:
            raise Stop

    with pytest.raises(Stop):
        stage.run(small, tmp_path, stop, workers=2)
    assert multiprocessing.active_children() == []
    report = stage.run(small, tmp_path, workers=2)
    assert (report.finished, len(files.load_json(tmp_path / "small" / "cells.json"))) == (
        4,
        3 + 3,
    )  # and three costs


@pytest.mark.usefixtures("quick_workers")
def test_a_process_that_dies_is_one_error(small: StudyRecipe, tmp_path: Path) -> None:
    def kill(event: Progress) -> None:
        if event.stage.endswith("/train"):
            for process in multiprocessing.active_children():
                os.kill(process.pid, signal.SIGKILL)

    with pytest.raises(AegisError, match="process of the study died"):
        stage.run(small, tmp_path, kill, workers=2)
    assert multiprocessing.active_children() == []


def test_a_plain_recipe_has_no_workers(aegis: Any, tmp_path: Path) -> None:
    code, _, err = aegis(
        "run",
        Path(__file__).parent.parent.parent / "recipes" / "quickstart.yaml",
        "--workers",
        "2",
        "--out",
        tmp_path,
    )
    assert code == 2 and "--workers 2" in err and not list(tmp_path.iterdir())
