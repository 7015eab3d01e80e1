"""The demonstrations of a stream of robot tasks: which ones each task learns, and where they are.

The recipe names them, or they are recorded beside the run.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch

from aegis_cli import recipes, sim
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Warned, ignore
from aegis_cli.common.files import make_folder
from aegis_cli.common.palette import COLORS
from aegis_cli.data import demonstrations, mixture, relative, renaming, task_episodes
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.data.relative import Places
from aegis_cli.data.selection import Selection
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.recipes import TASK, Demos, RobotStreamRecipe
from aegis_cli.training import loading
from aegis_cli.training.up_to_date import Made, StageRecords


def check_words(backbone: Backbone, task: str) -> None:
    """Raise AegisError unless the backbone knows the words of a simulated task's instructions."""
    size = backbone.image_size or 64
    picture = torch.zeros(1, size, size, 3, dtype=torch.uint8)
    for template in sim.make(task).spec.templates:
        backbone.prepare(picture, [template.format(color=COLORS[0])])


def check_given(recipe: RobotStreamRecipe, on_event: OnEvent) -> None:
    """Raise AegisError for mistakes that the meta folders of given demonstrations already show.

    Without this check they could appear only after hours of decoding the first task's frames.
    """
    if recipe.demos.paths is None:
        return
    sets = [demonstrations.at(name) for name in recipe.demos.named]
    mixture.check_rename(sets, renaming.of(recipe.demos.rename))
    for number in range(len(recipe.tasks)):
        path, selection = given(recipe, number)
        if selection.only is not None:
            count = demonstrations.count_episodes(path)
            demonstrations.learned_from(path, count, selection.only)
        if not recipe.simulated:
            robot = mixture.robot_of(path, selection)  # with its cameras and features
            _check_task(robot.task, recipe.tasks[number], path)
    if not recipe.simulated:
        _check_own_episodes(recipe, on_event)


class Joints(NamedTuple):
    """The names of a robot's actions and positions, () if they have none, and how many there are.

    Attributes:
        sizes: of actions and of positions.
    """

    actions: Sequence[str]
    positions: Sequence[str]
    sizes: tuple[int, int]

    def has(self, word: str) -> bool:
        """Whether an action's name has this word."""
        return any(word.lower() in name.lower() for name in self.actions)

    @classmethod
    def of(cls, shown: Demonstrations) -> Joints:
        """Those of demonstrations."""
        sizes = shown.tensors["actions"].shape[1], shown.tensors["proprio"].shape[1]
        return cls(shown.action_names, shown.proprio_names, sizes)


def relative_places(
    recipe: RobotStreamRecipe, joints: Sequence[Joints], on_event: OnEvent = ignore
) -> list[Places]:
    """The position that each action of each task is relative to; () if all are absolute.

    Robots may differ: a word of `train.relative_exclude` may be in the names of some tasks only. A
    warning tells of tasks for which no word excludes anything.

    Raises:
        AegisError: a word is in no task's names, or `relative.places` raises.
    """
    if not recipe.train.relative_actions:
        return [() for _ in joints]
    words, found = recipe.train.relative_exclude or (), list[Places]()
    known = {word for word in words if any(own.has(word) for own in joints)}
    for task, own in zip(recipe.tasks, joints, strict=True):
        # Without names it is not known what to exclude, which is refused.
        lacking = [word for word in words if own.actions and word in known and not own.has(word)]
        absolute = [word for word in words if word not in lacking]
        try:
            found.append(relative.places(own.actions, own.positions, own.sizes, absolute))
        except AegisError as e:
            raise AegisError(f"for task '{task}', {e.found}", e.expected, e.fix) from None
        if lacking and not absolute:
            text = (
                f"all actions of '{task}' are relative: none of {', '.join(own.actions)} contains "
                f"{' or '.join(lacking)} (train.relative_exclude)"
            )
            on_event(Warned("train", text))
    return found


def check_relative(recipe: RobotStreamRecipe) -> None:
    """Raise AegisError unless each action that is to be relative has a position of its name.

    Nothing is decoded or recorded for this.
    """
    if recipe.train.relative_actions:
        tasks = range(len(recipe.tasks))
        relative_places(recipe, [_joints(recipe, number) for number in tasks])


def _joints(recipe: RobotStreamRecipe, number: int) -> Joints:
    if recipe.demos.paths is None:
        spec = sim.make(recipe.tasks[number]).spec
        names = spec.action_names, spec.proprio_names
        return Joints(*names, (len(names[0]), len(names[1])))
    robot = mixture.robot_of(*given(recipe, number))
    positions, actions = robot.sizes
    names = robot.names.get("action_names", ()), robot.names.get("proprio_names", ())
    return Joints(*names, (actions, positions))


def _check_own_episodes(recipe: RobotStreamRecipe, on_event: OnEvent) -> None:
    """Refuse tasks that learn from the same episodes, and warn of those that share some.

    Raises:
        AegisError: two tasks have all of their episodes in common.
    """
    seen: list[tuple[str, Path, set[int]]] = []
    for number, task in enumerate(recipe.tasks):
        path, selection = given(recipe, number)
        count = demonstrations.count_episodes(path)
        own = set(demonstrations.learned_from(path, count, selection.only).tolist())
        place = demonstrations.locate(path).resolve()  # two paths may name the same folder
        for other, elsewhere, theirs in seen:
            if elsewhere != place or not own & theirs:
                continue
            if own == theirs:
                raise AegisError(
                    f"the same {len(own)} episodes of '{path}' for '{other}' and '{task}'",
                    "episodes of its own for each task",
                    "correct demos.only, or demos.paths",
                )
            shared = f"{len(own & theirs)} episodes of '{path}' are both '{other}' and '{task}'"
            text = (
                f"{shared}: what one holds out the other may learn from, so their errors on "
                "held-out episodes mean little"
            )
            on_event(Warned("train", text))
        seen.append((task, place, own))


def load(
    recipe: RobotStreamRecipe, number: int, backbone: Backbone, out: Path, on_event: OnEvent
) -> Demonstrations:
    """Load the demonstrations of one task and check that the backbone can read their instructions.

    Raises:
        AegisError: they cannot be read, belong to another task, or contain an unknown word.
    """
    task = recipe.tasks[number]
    path, selection = _source(recipe, number, out, on_event)
    found = demonstrations.load(
        path,
        recipe.train.validation_share,
        recipe.seed,
        selection,
        image_size=backbone.image_size,
        on_event=on_event,
        cache=recipe.demos.cache,
        check_text=backbone.check_prompt,
    )
    if found.task is None:
        found = loading.of_named_task(found, task, recipe.demos.rename or {})
    _check_task(found.task, task, path)
    if sim.of_datasets(task) is not None:
        task_episodes.check_own(found.texts, task, f"'{path}'")
    # Check all texts now, so that an unknown word cannot stop the training halfway.
    backbone.check_prompts(found.images(found.read[:1]), found.texts)
    if not recipe.simulated:
        loading.warn_of_outliers(path, found, recipe.train, on_event)
    return found


def _check_task(recorded: str | None, task: str, path: Path) -> None:
    """Raise AegisError if the demonstrations are of another task.

    Args:
        recorded: the simulated task of the demonstrations; None if the task is not simulated.
        task: the recipe's task.
    """
    if recorded == (task if TASK.accepts(task) else None):
        return
    of = "no simulated task" if recorded is None else f"'{recorded}'"
    fix = f"record with: aegis demos {task}"
    if not TASK.accepts(task):
        fix = f"call the task '{recorded}' in tasks, or correct demos.paths"
    elif sim.of_datasets(task) is not None:
        fix = "correct tasks, or demos.paths"
    elif recorded is None:
        fix += "; or give the task, if it is another robot's, a name of your own in tasks"
    raise AegisError(
        f"demonstrations of {of} in '{path}' for the task '{task}'", "one and the same task", fix
    )


def _source(
    recipe: RobotStreamRecipe, number: int, out: Path, on_event: OnEvent
) -> tuple[Path, Selection]:
    """Where a task's demonstrations are, and which part of them it learns.

    They are recorded if the recipe names none.
    """
    if recipe.demos.paths is not None:
        return given(recipe, number)
    records = _records(out, on_event)
    make_folder(records.folder)
    made = record(recipe, number, records)
    return made.path, recipe.demos.selection(only=None)


def given(recipe: RobotStreamRecipe, number: int) -> tuple[Path, Selection]:
    """The demonstrations that a recipe names for a task, and which part of them it learns.

    Raises:
        AegisError: they do not exist, or it is not known which episodes belong to the task.
    """
    demos = recipe.demos
    path = demonstrations.at(demos.of_task(number))
    if demos.only is not None:
        return path, demos.selection(demos.only[number])
    if _is_shared(recipe, number) and not recipe.simulated:
        raise AegisError(
            f"'{path}' for '{recipe.tasks[number]}' and other tasks, each of which would "
            "learn all its episodes",
            "demonstrations of its own for each task, or a choice of episodes for each",
            "choose the episodes of each task: demos.only, such as [0-49, 50-99]",
        )
    only = demonstrations.part_of(path, recipe.tasks[number], _is_shared(recipe, number))
    return path, demos.selection(only)


def _is_shared(recipe: RobotStreamRecipe, number: int) -> bool:
    """Whether other tasks learn from the same demonstrations as task `number`."""
    of_each = [recipe.demos.of_task(i) for i in range(len(recipe.tasks))]
    return of_each.count(of_each[number]) > 1


def learned_of(recipe: RobotStreamRecipe, number: int, path: Path) -> dict[str, Any]:
    """The part of some demonstrations that task `number` would learn, as in `recipes.selected`.

    Args:
        path: the current path of its demonstrations, or the path of others.
    """
    chosen, demos = recipes.selected(recipe), recipe.demos
    only = None
    if demos.only is not None:
        only = demos.only[number]
    elif demos.paths is not None:
        try:
            shared = _is_shared(recipe, number)
            only = demonstrations.part_of(path, recipe.tasks[number], shared)
        except AegisError:  # other demonstrations that do not tell episodes apart: take them all
            only = None
    return chosen if only is None else {**chosen, "only": only}


def place_of(recipe: RobotStreamRecipe, number: int, run: Path) -> Path:
    """Where the demonstrations that task `number` learned from are, or were."""
    if recipe.demos.paths is not None:
        return Path(recipe.demos.of_task(number))
    return _records(run, ignore).recorded(recipe.tasks[number], _to_record(recipe))


def record(recipe: RobotStreamRecipe, number: int, records: StageRecords) -> Made:
    """The demonstrations of one task, recorded with the recipe's settings unless they exist."""
    return records.demonstrations(recipe.tasks[number], _to_record(recipe))


def _records(run: Path, on_event: OnEvent) -> StageRecords:
    """The recordings for a run, in a folder beside it."""
    return StageRecords(run.parent / "demos", on_event)


def _to_record(recipe: RobotStreamRecipe) -> Demos:
    settings = recipe.demos
    return Demos(episodes=settings.episodes, noise=settings.noise, seed=settings.seed)
