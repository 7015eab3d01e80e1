"""`rollout.ensemble` of streams: what acts averages overlapping chunks, as a single policy does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from samples.lerobot import frame_cache  # noqa: F401
from samples.own_robots import FRAMES, TASKS, Done, assert_resumes
from samples.robots import Make

from aegis_cli import load_policy, recipes
from aegis_cli.continual import robot_evaluators, train
from aegis_cli.deploy import load_acting
from aegis_cli.models.acting import Acting
from aegis_cli.publishing import export
from aegis_cli.recipes import RobotRollout, to_yaml

pytestmark = pytest.mark.usefixtures("frame_cache")

DECAY = 0.1
OWN = RobotRollout(replan=1, frames=FRAMES, ensemble=DECAY)


def test_simulated_tasks_are_played_with_it(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """During training, in `aegis rollout` and in `load_policy`."""
    played: list[tuple[int, float | None]] = []

    class Found:
        success, return_share = 1.0, None

    def play(acting: Acting, *_: Any, **__: Any) -> Found:
        played.append((acting.replan, acting.ensemble))
        return Found()

    monkeypatch.setattr(robot_evaluators, "play", play)
    settings = RobotRollout(episodes=1, replan=1, ensemble=DECAY)
    train.run(make("igsp", steps=1, rollout=settings), tmp_path / "run")
    assert played == [(1, DECAY)] * 3
    assert load_acting(tmp_path / "run", "point").ensemble == DECAY
    policy = load_policy(tmp_path / "run", "point")
    assert (policy.ensemble, policy.replan) == (DECAY, 1)


def test_what_acts_on_the_robot_has_it_and_errors_have_not(
    real: Make, done: Done, tmp_path: Path
) -> None:
    report = train.run(real("isolated-lora", rollout=OWN), tmp_path / "run")
    wanted, without = done("isolated-lora")
    assert report.errors == wanted.errors
    for task in TASKS:
        policy = load_policy(tmp_path / "run", task)
        assert (policy.ensemble, policy.replan) == (DECAY, 1)
        assert load_policy(tmp_path / "run", task, ensemble=0.5).ensemble == 0.5
        assert load_policy(without, task).ensemble is None
        for form in ("lerobot", "aegis"):
            folder = tmp_path / f"{task}-{form}"
            export.run(tmp_path / "run", folder, form, task=task)
            assert load_policy(folder).ensemble == DECAY


def test_interrupted_and_resumed_it_ends_in_the_same_bytes(real: Make, tmp_path: Path) -> None:
    assert_resumes(real("isolated-lora", rollout=OWN), tmp_path)


def test_runs_that_began_before_there_was_the_key_are_the_same_runs(real: Make) -> None:
    assert "ensemble" not in recipes.training_part(real("igsp"))["rollout"]
    assert recipes.training_part(real("igsp", rollout=OWN))["rollout"]["ensemble"] == DECAY


def test_chunks_that_are_executed_further_are_refused(
    real: Make, make: Make, tmp_path: Path, bad: Callable[..., str]
) -> None:
    for made in (real, make):
        recipe = made("igsp", rollout=RobotRollout(replan=2, ensemble=DECAY))
        (tmp_path / "robot.yaml").write_text(to_yaml(recipe))
        says = ("rollout.ensemble: 0.1 with rollout.replan: 2", "set rollout.replan to 1")
        bad("train", tmp_path / "robot.yaml", "--out", tmp_path / "run", says=says)
