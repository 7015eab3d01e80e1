"""`aegis evaluate --task`: open-loop errors of the policy of one task of a stream."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from aegis_cli import recipes
from aegis_cli.common import commands, hub
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, ignore, loading_told
from aegis_cli.continual import files, learners, places, robot_demos, robots
from aegis_cli.continual.robots import RobotStreamRun
from aegis_cli.data.renaming import Renaming
from aegis_cli.evaluation import open_loop
from aegis_cli.evaluation.open_loop import Asked, Earlier, Learned, OpenLoopReport, Source
from aegis_cli.models import backbones
from aegis_cli.recipes import RobotStreamRecipe


@dataclass(frozen=True, kw_only=True)
class TaskOpenLoopReport(OpenLoopReport):
    """How far the predictions of a stream's policy for one task are from the recorded actions.

    Attributes:
        task: the task of the policy.
    """

    task: str


def run(
    run_path: Path,
    task: str | None,
    data: Path | None = None,
    episodes: Sequence[int] | None = None,
    frames: int = 1000,
    seed: int = 0,
    batch_size: int = 64,
    traced: bool = False,
    on_event: OnEvent = ignore,
    rename: Renaming = (),
    backbone: str | None = None,
) -> TaskOpenLoopReport:
    """Compare the predictions of one of a stream's policies with demonstrations, frame by frame.

    Args:
        task: the task of the policy; may be None if the stream has a single task.
        data: demonstrations; None means those that the task was learned from.
        episodes: numbers from 0; None means the task's held-out episodes, or all episodes of other
            data.
        frames, seed, batch_size, traced, rename: as in `open_loop.run`.
        backbone: the new place of the stream's backbone, if it has moved.

    Raises:
        AegisError: the run has not learned the task, or `open_loop.run` raises.
    """
    number = robots.number_of(run_path, task)
    recipe = recipes.load(run_path / "recipe.yaml", kind=RobotStreamRecipe)
    if data is None:
        data = _own(places.here(run_path, recipe, recipe.backbone), number, run_path)
    with loading_told("evaluate", on_event):
        stream = robots.load_to_act(run_path, backbone)
    stream.activate(number)
    source = _source(stream, number, data)
    earlier = [*_of_other_tasks(stream, number, data), *source.before()]
    asked = Asked(episodes, frames, seed, batch_size, traced, rename)
    policy, meta = stream.policies[number].eval(), stream.meta(number)
    found = open_loop.evaluated(source, policy, meta, data, asked, earlier, on_event)
    return TaskOpenLoopReport(task=stream.names[number], **vars(found))


def _own(recipe: RobotStreamRecipe, number: int, run: Path) -> Path:
    """The demonstrations that a task was learned from.

    Raises:
        AegisError: they are not where they were.
    """
    place, task = robot_demos.place_of(recipe, number, run), recipe.tasks[number]
    on_the_hub = recipe.demos.paths is not None and not hub.is_local(str(place))
    if not place.exists() and not on_the_hub:
        again = commands.aegis("evaluate", run, "--task", task, "--demos", "PATH")
        raise AegisError(
            f"'{place}' is gone, the demonstrations of '{task}' in the stream '{run}'",
            "the demonstrations that the task was learned from",
            f"bring it back, or give its new path or other demonstrations: {again}",
        )
    return place


def _source(stream: RobotStreamRun, number: int, data: Path) -> Source:
    """How task `number` was learned."""
    recipe, task, run = stream.recipe, stream.names[number], stream.out
    share, backbone = recipe.train.validation_share, backbones.divided(recipe.backbone)[0]
    read = robot_demos.learned_of(recipe, number, data)
    learned = Learned(read, recipe.demos.camera, share, recipe.seed, (backbone,))
    digests = frozenset({files.read(run).inputs.get(f"demos of {task}", "")})
    place = robot_demos.place_of(recipe, number, run).resolve()
    return Source((str(run), "--task", task), learned, digests, frozenset({place}))


def _of_other_tasks(stream: RobotStreamRun, number: int, data: Path) -> list[Earlier]:
    """The other tasks of the stream that have shaped the weights that serve task `number`."""
    # Weights that are frozen after a task do not depend on later tasks.
    frozen = learners.get(stream.recipe.train.method).frozen
    found = []
    for other in range(number if frozen else len(stream.names)):
        if other != number:
            said = f"as '{stream.names[other]}' of the same stream, which '{stream.names[number]}'"
            said += " may have learned from too"
            found.append(Earlier(said, _source(stream, other, data), stream.meta(other)))
    return found
