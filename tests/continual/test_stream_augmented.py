"""`train.augment` in streams of robot tasks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.lerobot import frame_cache  # noqa: F401
from samples.own_robots import TASKS, assert_resumes
from samples.robots import STEPS, Make

from aegis_cli import recipes
from aegis_cli.continual import robots, train
from aegis_cli.data import augment
from aegis_cli.recipes import to_yaml

pytestmark = pytest.mark.usefixtures("frame_cache")

NAMES = ("brightness", "affine")


def test_each_step_changes_its_frames_anew_and_what_is_measured_sees_them_as_they_are(
    real: Make, tmp_path: Path
) -> None:
    run = robots.build(real("igsp", augment=NAMES, augment_count=1), tmp_path / "run")
    rows = torch.arange(4)
    for number in range(len(TASKS)):
        task, demos = run.objective(number), run.demos[number]
        frames = demos.train[rows]
        bare = demos.batch(frames, 4)
        assert torch.equal(task.fetch(rows).images, bare.images)
        for step in range(2):
            found = task.fetch(rows, step)
            # By the step count of the whole stream.
            given = bare.images, frames.tolist(), NAMES, 1, 0, number * STEPS + step
            assert torch.equal(found.images, augment.augmented(*given))
            assert not torch.equal(found.images, bare.images)
            assert torch.equal(found.actions, bare.actions)
    calibration = run.objective(0)._calibration
    assert torch.equal(calibration.images, run.objective(0).fetch(rows_of(run)).images)


def rows_of(run: robots.RobotStreamRun) -> torch.Tensor:
    return robots.spread.rows(len(run.demos[0].train), robots.CALIBRATION_FRAMES)


def test_steps_learn_from_changed_frames_alone(
    real: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changed: list[tuple[int, int]] = []
    augmented = augment.augmented

    def noted(images: Any, frames: Any, names: Any, count: int, seed: int, *rest: Any) -> Any:
        changed.append((len(frames), rest[0]))
        return augmented(images, frames, names, count, seed, *rest)

    monkeypatch.setattr(augment, "augmented", noted)
    train.run(real("igsp", augment=NAMES), tmp_path / "run")
    assert changed == [(4, step) for step in range(2 * STEPS)]


def test_interrupted_and_resumed_it_ends_in_the_same_bytes(real: Make, tmp_path: Path) -> None:
    recipe = real("isolated-lora", augment=NAMES, accumulate=2)
    assert_resumes(recipe, tmp_path)


def test_runs_that_began_before_there_was_the_key_are_the_same_runs(real: Make) -> None:
    known = recipes.training_part(real("igsp"))["train"]
    assert not {"augment", "augment_count"} & known.keys()
    assert recipes.training_part(real("igsp", augment=NAMES))["train"]["augment"] == NAMES


def test_a_count_of_nothing_is_refused(real: Make, tmp_path: Path, bad: Callable[..., str]) -> None:
    (tmp_path / "robot.yaml").write_text(to_yaml(real("igsp", augment_count=2)))
    says = ("train.augment_count: 2 without train.augment",)
    bad("train", tmp_path / "robot.yaml", "--out", tmp_path / "run", says=says)
