"""Settings of memory, time and what is written that change when a stream is resumed."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.interrupted import stop
from samples.lerobot import frame_cache  # noqa: F401
from samples.own_robots import TASKS, Done
from samples.robots import Make

from aegis_cli import recipes
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Warned
from aegis_cli.continual import files, robots, state, train
from aegis_cli.recipes import RobotStreamRecipe, to_yaml
from aegis_cli.training import folder

pytestmark = pytest.mark.usefixtures("frame_cache")
Aegis = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(real: Make, tmp_path: Path) -> Path:
    """A run that was interrupted in its first task."""
    interrupt(real(), tmp_path / "run", 3, resume=False)
    return tmp_path / "run"


def interrupt(recipe: RobotStreamRecipe, out: Path, at: int, resume: bool = True) -> None:
    with pytest.raises(KeyboardInterrupt):
        train.run(recipe, out, resume, partial(stop, f"task 1 {TASKS[0]}", at))


def assert_learned_as(found: Path, wanted: Path) -> None:
    for name in (robots.ACTION_EXPERT, files.EXPERTS):
        tensors = (artifacts.load(out / name).tensors for out in (found, wanted))
        torch.testing.assert_close(*tensors, rtol=1e-4, atol=1e-5)


def test_they_are_said_and_written_and_change_what_is_learned_by_rounding(
    run: Path, real: Make, done: Done
) -> None:
    told: list[Any] = []
    changed = real(accumulate=2, checkpoint_every=3, log_every=2)
    train.run(changed, run, resume=True, on_event=told.append)
    said = [event.text for event in told if isinstance(event, Warned)]
    for change in (
        "accumulate: 2 instead of 1",
        "checkpoint_every: 3 instead of 2",
        "log_every: 2",
    ):
        assert any(f"train.{change}" in text for text in said), change
    assert recipes.load(run / "recipe.yaml", kind=RobotStreamRecipe).train == changed.train
    assert_learned_as(run, done("igsp")[1])


def test_killed_while_they_are_written_it_goes_on_with_either(
    run: Path, real: Make, done: Done, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*given: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(folder, "write_recipe", killed)
        interrupt(real(accumulate=2), run, 4)
    assert recipes.load(run / "recipe.yaml", kind=RobotStreamRecipe).train.accumulate == 1
    interrupt(real(), run, 5)
    interrupt(real(accumulate=4), run, 6)
    train.run(recipes.load(run / "recipe.yaml", kind=RobotStreamRecipe), run, resume=True)
    assert_learned_as(run, done("igsp")[1])


def test_so_goes_a_run_that_an_earlier_version_began(run: Path, real: Make, done: Done) -> None:
    saved = artifacts.load(run / state.STATE)
    header = saved.header
    meta = {key: value for key, value in header.meta.items() if key != "learns"}
    kept = {"seed": header.seed, "inputs": header.inputs, "fingerprint": header.fingerprint}
    artifacts.save(run / state.STATE, "training-state", saved.tensors, meta=meta, **kept)
    train.run(real(accumulate=2), run, resume=True)
    assert_learned_as(run, done("igsp")[1])


@pytest.mark.parametrize("changes", [{"lr": 1e-3}, {"batch_size": 2}, {"precision": "bf16"}])
def test_others_may_not_change(changes: dict[str, Any], run: Path, real: Make) -> None:
    with pytest.raises(AegisError, match=f"started with other settings: train.{min(changes)}"):
        train.run(real(accumulate=2, **changes), run, resume=True)


def test_a_finished_run_stays_as_it_is(done: Done, real: Make) -> None:
    report, out = done("igsp")
    again = train.run(real(accumulate=2), out, resume=True)
    assert dataclasses.replace(again, out=report.out, minutes=report.minutes) == report
    assert recipes.load(out / "recipe.yaml", kind=RobotStreamRecipe).train.accumulate == 1


def test_out_of_memory_names_what_takes_less(
    run: Path, real: Make, aegis: Aegis, monkeypatch: pytest.MonkeyPatch
) -> None:
    def too_large(*given: Any) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(train, "_learn", too_large)
    (run.parent / "bench.yaml").write_text(to_yaml(real()))
    code, _, err = aegis("train", run.parent / "bench.yaml", "--out", run, "--resume")
    assert code == 2 and f"aegis train {run} --set train.accumulate=2" in err
