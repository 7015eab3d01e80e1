"""A stream of two tasks of robots that have no simulator; a tiny VLM learns it in a second."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aegis_cli.continual import train
from aegis_cli.continual.report import RecordedStreamReport
from aegis_cli.data.lerobot.write import NewEpisode
from aegis_cli.recipes import RobotDemos, RobotRollout, RobotStreamRecipe
from samples.interrupted import at_each
from samples.lerobot import save
from samples.robots import Make
from samples.training_runs import contents

Done = Callable[[str], tuple[RecordedStreamReport, Path]]
TASKS = ("pick", "open-drawer")
JOINTS = {"pick": 3, "open-drawer": 2}  # two robots
TEXTS = {"pick": "go to the red target", "open-drawer": "move the finger to the red target"}
FRAMES = 9  # of the held-out episodes


def robot(
    folder: Path,
    task: str = "pick",
    cameras: Sequence[str] = ("top",),
    scale: float = 1.0,
    actions: Sequence[str] | None = None,
    count: int = 6,
) -> Path:
    """A dataset of a real robot, whose actions are target positions.

    Args:
        scale: factor of all numbers.
        actions: their names; by default those of the positions.
    """
    rng = np.random.default_rng(len(task))
    made = []
    for number in range(count):
        length = 6 + number % 3
        path = scale * rng.normal(size=(length + 1, JOINTS[task])).cumsum(0).astype(np.float32)
        shown = rng.integers(0, 256, (length, 16, 16, 3), dtype=np.uint8)
        made.append(NewEpisode(dict.fromkeys(cameras, shown), path[:-1], path[1:], TEXTS[task]))
    names = tuple(f"joint {n}.pos" for n in range(JOINTS[task]))
    return save(folder, made, state_names=names, action_names=tuple(actions or names))


@pytest.fixture(scope="session")
def paths(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A dataset of each task; read-only."""
    folder = tmp_path_factory.mktemp("robots")
    return {task: robot(folder / task, task) for task in TASKS}


@pytest.fixture(scope="session")
def real(make: Make, paths: dict[str, Path]) -> Make:
    """A recipe; `changes` replace keys of `train`, or whole keys."""

    def recipe(method: str = "igsp", **changes: Any) -> RobotStreamRecipe:
        own = {"demos": RobotDemos(paths=tuple(str(paths[task]) for task in TASKS))}
        own |= {"rollout": RobotRollout(replan=2, frames=FRAMES)}
        settings = {"chunk": 4, "validation_share": 0.4}
        return dataclasses.replace(make(method, **settings | own | changes), tasks=TASKS)

    return recipe


@pytest.fixture(scope="session")
def done(real: Make, tmp_path_factory: pytest.TempPathFactory) -> Done:
    """A finished run of a learner; read-only."""
    made: dict[str, tuple[RecordedStreamReport, Path]] = {}

    def get(method: str) -> tuple[RecordedStreamReport, Path]:
        if method not in made:
            out = tmp_path_factory.mktemp("recorded") / method
            report = train.run(real(method), out)
            assert isinstance(report, RecordedStreamReport)
            made[method] = report, out
        return made[method]

    return get


def assert_resumes(recipe: RobotStreamRecipe, folder: Path) -> None:
    """A run that is interrupted in each task and resumed ends with the bytes of a whole run."""
    train.run(recipe, folder / "whole")
    begin = partial(train.run, recipe, folder / "run")
    for _ in at_each(((f"task 1 {TASKS[0]}", 3), (f"task 2 {TASKS[1]}", 3)), begin):
        pass
    begin(resume=True)
    assert contents(folder / "run") == contents(folder / "whole")
