"""A stream's policy for a single task in plain weights, with the task's experts merged in."""

from __future__ import annotations

from pathlib import Path

import torch

from aegis_cli import recipes
from aegis_cli.common import artifacts, commands
from aegis_cli.common.errors import AegisError
from aegis_cli.common.state_dicts import reading_meta
from aegis_cli.continual import files, learners, robots
from aegis_cli.continual.robots import RobotStreamRun
from aegis_cli.core import routing
from aegis_cli.models.policy import Policy
from aegis_cli.recipes import RobotStreamRecipe


def check(path: Path, task: str | None) -> int:
    """The number of a task, if its policy can be written as plain weights.

    Only headers are read.

    Raises:
        AegisError: the run is not done, it has not learned the task, or one of the task's routers
            mixes several experts.
    """
    number = robots.number_of(path, task)
    recipe = recipes.load(path / "recipe.yaml", kind=RobotStreamRecipe)
    learner, name = learners.get(recipe.train.method), recipe.tasks[number]
    if learner.trains != "experts":
        return number
    saved, router = artifacts.read_header(path / files.EXPERTS), str(learner.router(number))
    with reading_meta(path / files.EXPERTS):
        of_maps = [said["routers"] for said in saved.meta["structure"].values()]
        counts = [len(routers[router]["experts"]) for routers in of_maps if router in routers]
    if several := sum(count > 1 for count in counts):
        raise AegisError(
            f"'{name}' of the stream in '{path}', which mixes several experts at {several} of "
            f"{len(of_maps)} maps, with weights that depend on what is read at each position: no "
            "fixed weight does the same",
            "a task with at most one expert at each map, which can be merged into its weights, as "
            "after isolated-lora and sequential",
            f"use it as it is: {commands.aegis('serve', path, '--task', name)}, or "
            "aegis_cli.load_policy with task=; or train with --method isolated-lora",
        )
    return number


def policy(run: RobotStreamRun, number: int) -> Policy:
    """The policy of a task for which `check` has passed.

    It is built from the run's own weights, so the run cannot be used afterwards. Its positions and
    actions are those of its own robot, even if other tasks of the stream have other robots.
    """
    found = run.policies[number]
    # Half precision would lose most of what is merged.
    found.backbone.round_weights(torch.float32)
    # The policies share backbone and expert, so merging into the first policy changes this one too.
    routing.merge(run.model, run.sites, run.learner.router(number))
    sizes = len(found.proprio_scale.mean), len(found.action_scale.mean)
    expert = found.expert.of_robot(*sizes).to(found.backbone.device)
    scales, relative = (found.proprio_scale, found.action_scale), found.origins.places
    return Policy(found.backbone, expert, *scales, relative).to(found.backbone.device).eval()
