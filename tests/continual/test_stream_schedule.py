"""`train.schedule` of streams: how the learning rates continue in each task."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from samples.lerobot import frame_cache  # noqa: F401
from samples.own_robots import assert_resumes
from samples.robots import STEPS, Make
from samples.streams import recipe as of_images

from aegis_cli import recipes
from aegis_cli.cli import advice
from aegis_cli.continual import dry_run, images, loop, robots
from aegis_cli.continual.state import AnyStreamRun
from aegis_cli.recipes import to_yaml
from aegis_cli.recipes.policy import CONSTANT, LINEAR, SCHEDULES
from aegis_cli.training.schedule import warmup_then_decay

pytestmark = pytest.mark.usefixtures("frame_cache")

SHARE = {"final_lr_share": 0.25}


def shares_taken(run: AnyStreamRun, training: loop.TaskTraining) -> list[set[float]]:
    """The factors on the peak rates with which each step of a task is taken."""
    found = []
    for step in range(run.recipe.train.steps):
        loop.take(run, training, step, training.fetch(step))
        assert training.optimizer is not None
        groups = training.optimizer.param_groups
        assert len({group["peak"] for group in groups}) == len(groups)
        found.append({round(group["lr"] / group["peak"], 12) for group in groups})
    return found


def planned(schedule: str, steps: int, warmup: int) -> list[set[float]]:
    factors = [warmup_then_decay(step, steps, warmup, 0.25, schedule) for step in range(steps)]
    return [{round(factor, 12)} for factor in factors]


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_each_robot_task_follows_the_schedule_from_its_first_step(
    schedule: str, real: Make, tmp_path: Path
) -> None:
    share = {} if schedule == CONSTANT else SHARE
    run = robots.build(real("igsp", schedule=schedule, **share), tmp_path / "run")
    begun = dry_run._Begun.at(run, 0)
    assert shares_taken(run, begun.training) == planned(schedule, STEPS, 1)
    begun.ended()
    second = dry_run._Begun.at(run, 1)
    assert shares_taken(run, second.training) == planned(schedule, STEPS, 1)


@pytest.mark.usefixtures("tiny_streams")
@pytest.mark.parametrize("schedule", SCHEDULES)
def test_a_task_of_images_follows_it_too(schedule: str, tmp_path: Path) -> None:
    share = {} if schedule == CONSTANT else SHARE
    run = images.build(of_images("isolated-lora", schedule=schedule, **share), tmp_path / "run")
    training = loop.prepare(run, [torch.zeros(16)], None)
    assert shares_taken(run, training) == planned(schedule, 12, 2)


def test_interrupted_and_resumed_it_ends_in_the_same_bytes(real: Make, tmp_path: Path) -> None:
    assert_resumes(real("igsp", schedule=LINEAR), tmp_path)


def test_runs_that_began_before_there_was_the_key_are_the_same_runs(real: Make) -> None:
    for made in (real, of_images):
        assert "schedule" not in recipes.training_part(made("igsp"))["train"]
        other = recipes.training_part(made("igsp", schedule=LINEAR))["train"]
        assert other["schedule"] == LINEAR


def test_a_constant_schedule_takes_no_share_to_fall_to(
    real: Make, tmp_path: Path, bad: Callable[..., str]
) -> None:
    says = ("train.final_lr_share: 0.25 with train.schedule: constant", "delete")
    for made in (real, of_images):
        (tmp_path / "stream.yaml").write_text(to_yaml(made("igsp", schedule=CONSTANT, **SHARE)))
        bad("train", tmp_path / "stream.yaml", "--out", tmp_path / "run", says=says)
        # A share of 1 says the same as the schedule.
        same = made("igsp", schedule=CONSTANT, final_lr_share=1.0)
        (tmp_path / "same.yaml").write_text(to_yaml(same))
        assert recipes.load(tmp_path / "same.yaml", kind=type(same)) == same


def test_a_warmup_as_long_as_a_task_is_warned_of_unless_the_rates_stay(
    real: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for schedule, warned in ((LINEAR, True), (CONSTANT, False)):
        advice.of_settings(real("igsp", schedule=schedule, warmup=STEPS))
        assert ("ends within the warmup" in capsys.readouterr().err) is warned
