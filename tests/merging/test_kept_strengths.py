"""What a sweep has measured is kept: an interrupted one goes on, to the same report."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.merges import QUESTIONS, Place
from samples.vqa_files import write_jsonl

from aegis_cli.common import cache, version
from aegis_cli.common.events import Event, OnEvent, Progress, ignore
from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.evaluation import kept_answers
from aegis_cli.merging import merge
from aegis_cli.merging.settings import MergeSettings
from aegis_cli.models import backbones
from aegis_cli.training import train

SWEEP = (0.3, 0.6, 0.9)
SETTINGS = MergeSettings("linear", questions=QUESTIONS)

Sweep = Callable[..., str]


class Stopped(Exception):
    """Whoever merges is stopped."""


@pytest.fixture
def sweep(merge_place: Place) -> Sweep:
    def swept(
        on_event: OnEvent = ignore,
        target: Path = merge_place.run,
        settings: MergeSettings = SETTINGS,
        sweep: tuple[float, ...] = SWEEP,
    ) -> str:
        torch.manual_seed(torch.seed())  # another process has another random state
        report = merge.run(str(target), settings, None, sweep=sweep, on_event=on_event)
        return json.dumps(report.to_json())

    return swept


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What was measured: each loss, and each set of questions that a model was asked."""
    done: list[str] = []
    loss, grade = train.validation_loss, kept_answers.grade

    def losses(*given: Any, **named: Any) -> float:
        done.append("loss")
        return loss(*given, **named)

    def graded(answers: Any, asked: VQASet, *given: Any, **named: Any) -> Any:
        done.append("answers")
        return grade(answers, asked, *given, **named)

    monkeypatch.setattr(train, "validation_loss", losses)
    monkeypatch.setattr(kept_answers, "grade", graded)
    return done


def stop_after(strengths: int, sweep: Sweep, **named: Any) -> None:
    def stop(event: Event) -> None:
        if isinstance(event, Progress) and event.unit == "strengths" and event.done >= strengths:
            raise Stopped

    with pytest.raises(Stopped):
        sweep(stop, **named)


def test_an_interrupted_sweep_goes_on_to_the_same_report(
    sweep: Sweep, work: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for strengths in (1, 3):
        stop_after(strengths, sweep)
    assert work == ["answers", *["answers", "loss"] * 3]  # of the base, and of 0, 0.3 and 0.6
    del work[:]
    found = sweep()
    assert work == ["answers", "loss"]
    for name in ("answers", "merges"):
        for path in cache.folder(name).iterdir():
            path.unlink()
    del work[:]
    assert sweep() == found and len(work) == 9


def test_a_finer_sweep_measures_the_strengths_that_are_new(sweep: Sweep, work: list[str]) -> None:
    sweep(sweep=(0.3, 0.9))
    del work[:]
    sweep()
    assert work == ["answers", "loss"]


def test_other_weights_another_run_and_other_code_take_nothing(
    sweep: Sweep, work: list[str], merge_place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop_after(4, sweep)
    earlier = merge_place.run / "checkpoints" / "000004"
    every = ["answers", "loss"] * 4
    del work[:]
    sweep(target=earlier)
    assert work == every  # the base is the same one
    del work[:]
    sweep(sweep=(0.2, 0.5, 0.8))
    assert work == every[2:]  # 0 is the run itself
    monkeypatch.setattr(version, "code", lambda: "another")
    del work[:]
    sweep()
    assert work == ["answers", *every]


def test_a_task_of_other_questions_is_measured_again(
    sweep: Sweep, merge_place: Place, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_jsonl(tmp_path)
    settings = dataclasses.replace(SETTINGS, base=str(merge_place.base), task_vqa=str(path))
    target = tmp_path / "tuned"
    backbones.load(str(merge_place.run)).save(target)
    first = json.loads(sweep(target=target, settings=settings, sweep=(0.5,)))
    path.write_text(path.read_text().replace('"two"', '"red"'))
    asked: list[int] = []
    plain = merge._performance
    monkeypatch.setattr(merge, "_performance", lambda *given: asked.append(1) or plain(*given))
    again = json.loads(sweep(target=target, settings=settings, sweep=(0.5,)))
    assert len(asked) == len(first["points"]) == 2
    assert [point["accuracy"] for point in first["points"]] == [
        point["accuracy"] for point in again["points"]
    ]


def test_what_is_damaged_is_measured_again(sweep: Sweep, work: list[str]) -> None:
    wanted = sweep()
    (store,) = cache.folder("merges").iterdir()
    first, second, *lines = store.read_text().splitlines()
    said = json.loads(first)
    said["figures"]["validation_loss"] += 1
    store.write_text("\n".join([json.dumps(said), second[:-9], "7", *lines, ""]))
    del work[:]
    assert sweep() == wanted and work == ["loss"] * 2
