"""A stream of two robot tasks that an untrained two-layer VLM learns in a second."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from aegis_cli.data import record
from aegis_cli.recipes import (
    Expert,
    Igsp,
    IsolatedLora,
    Probe,
    RobotDemos,
    RobotRollout,
    RobotStreamRecipe,
    RobotTrain,
)

STEPS = 6
Make = Callable[..., RobotStreamRecipe]


@pytest.fixture(scope="session")
def point_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("demos") / "point.safetensors"
    record.run("point", 6, 0, path, workers=1)
    return path


@pytest.fixture(scope="session")
def make(tiny_folder: Path, demos_file: Path, point_file: Path) -> Make:
    """A recipe; `changes` replace keys of `train`, or whole keys."""
    paths = {"reach": str(demos_file), "point": str(point_file)}

    def recipe(
        method: str = "igsp", tasks: tuple[str, ...] = ("reach", "point"), **changes: Any
    ) -> RobotStreamRecipe:
        train = {
            "method": method,
            "steps": STEPS,
            "batch_size": 4,
            "chunk": 20,  # all of them are executed, so a rollout needs few predictions
            "flow_samples": 2,
            "lr": 1e-2,
            "expert_lr": 3e-3,
            "warmup": 1,
            "checkpoint_every": 2,
            "log_every": 1,
            "precision": "float32",
        }
        top = {
            name: changes.pop(name)
            for name in list(changes)
            if name in RobotStreamRecipe.__dataclass_fields__
        }
        made = RobotStreamRecipe(
            name="small",
            tasks=tasks,
            backbone=str(tiny_folder),
            demos=RobotDemos(paths=tuple(paths[t] for t in tasks)),
            train=RobotTrain(**train | changes),
            expert=Expert(width=16, mlp_ratio=1),
            rollout=RobotRollout(episodes=1, replan=20),
            probe=Probe(questions=7),
            isolated_lora=IsolatedLora(rank=2),
            igsp=Igsp(rank=2, identify=0.5, check_every=2, checks=1),
        )
        return dataclasses.replace(made, **top)

    return recipe
