"""Adding tasks to a finished stream of robot tasks.

The recipe names the tasks that the run has learned, in their order, and then the new ones. The run
goes on from a state like the one after its last task, so it ends in the bytes of a run that had all
tasks from the start.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable
from pathlib import Path

from aegis_cli import recipes
from aegis_cli.common import commands
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Warned
from aegis_cli.common.files import canonical
from aegis_cli.continual import files, state
from aegis_cli.continual.report import ErrorMatrix, StreamReport, SuccessMatrix
from aegis_cli.continual.state import AnyStreamRun, TaskInProgress, changed_inputs
from aegis_cli.recipes import RobotStreamRecipe, StreamRecipe
from aegis_cli.training import folder


def check(
    out: Path,
    recipe: StreamRecipe | RobotStreamRecipe,
    resume: bool,
    overwrite: bool,
    read: Iterable[str | None],
) -> bool:
    """Refuse an existing run as `folder.check` does, except for one to which tasks are added.

    Args:
        read: models and data that the run reads.

    Returns:
        Whether `recipe` adds tasks to the finished run in `out`.

    Raises:
        AegisError: the run may not be continued, or it has not learned its own tasks yet.
    """
    begun = _shorter(out, recipe) if resume and not overwrite else None
    if begun is None:
        folder.check(out, recipe, resume, overwrite, read)
        return False
    if not files.is_done(out):
        assert isinstance(recipe, RobotStreamRecipe)
        new = ", ".join(recipe.tasks[len(begun.tasks) :])
        raise AegisError(
            f"{new} added to the stream in '{out}', which has not learned all its tasks yet",
            "a finished stream to add tasks to",
            f"finish it first: {commands.aegis('train', out)}",
        )
    return True


def begin(run: AnyStreamRun, on_event: OnEvent) -> None:
    """Let a finished run, in memory at its start, go on with the tasks that its recipe adds.

    Nothing of the run is changed if an error is raised. An interruption leaves either the finished
    run or one that can be resumed.

    Raises:
        AegisError: files are missing, damaged or of another backbone, or demonstrations or
            questions differ from those of the run, or a new robot has more joints than its expert.
    """
    from aegis_cli.continual import robots  # loads MuJoCo, which streams of images do not need

    assert isinstance(run, robots.RobotStreamRun)  # `check` accepts no other
    report = files.read(run.out)
    learned = _of_first(run.recipe, len(report.tasks))
    _check_inputs(run, report)
    changes = folder.adjustments(run.out, run.recipe)
    robots.take_over(run, learned)
    run.current = _place_after(report)
    state.save(run, None)
    # A run whose recipe has more tasks than its report is not done: see `files.is_done`.
    folder.write_recipe(run.out, run.recipe)
    (run.out / files.REPORT).unlink()
    new = ", ".join(run.names[len(report.tasks) :])
    if changes:
        new += f" and {changes}"
    text = f"'{run.out}' goes on with {new}; until it has finished, it cannot be served or probed"
    on_event(Warned("train", text))


def _shorter(out: Path, recipe: StreamRecipe | RobotStreamRecipe) -> RobotStreamRecipe | None:
    """The recipe of the run in `out`, if `recipe` is the same with more tasks after its own."""
    if not isinstance(recipe, RobotStreamRecipe) or not recipes.is_robot_stream_run(out):
        return None
    begun = recipes.load(out / "recipe.yaml", kind=RobotStreamRecipe)
    count = len(begun.tasks)
    is_longer = count < len(recipe.tasks)
    return begun if is_longer and folder.continues(out, _of_first(recipe, count)) else None


def _of_first(recipe: RobotStreamRecipe, count: int) -> RobotStreamRecipe:
    """The recipe of its first `count` tasks alone."""
    demos = recipe.demos
    # A single path stands for all tasks.
    paths = demos.paths if isinstance(demos.paths, str | None) else demos.paths[:count]
    only = None if demos.only is None else demos.only[:count]
    demos = dataclasses.replace(demos, paths=paths, only=only)
    return dataclasses.replace(recipe, tasks=recipe.tasks[:count], demos=demos)


def _check_inputs(run: AnyStreamRun, report: StreamReport) -> None:
    """Raise AegisError unless the run's demonstrations, backbone and questions are as they were."""
    # The recipe's digest differs, since it has more tasks; `_shorter` has compared the rest of it.
    then = {name: sha for name, sha in report.inputs.items() if name != "recipe"}
    new = {f"demos of {task}" for task in run.names[len(report.tasks) :]}
    now = {name: sha for name, sha in run.inputs.items() if name not in {"recipe", *new}}
    if changed := changed_inputs(then, now):
        raise AegisError(
            f"a different {', '.join(changed)} than the run in '{run.out}' has learned with",
            "what it began with, and more tasks",
            "bring it back as it was, or begin anew in another --out",
        )


def _place_after(report: StreamReport) -> TaskInProgress:
    """The place in the stream after all tasks of a report."""
    assert isinstance(report, SuccessMatrix | ErrorMatrix)
    records = [json.loads(canonical(dataclasses.asdict(record))) for record in report.records]
    intervals = [
        [None if ends is None else list(ends) for ends in row] for row in report.measured_intervals
    ]
    return TaskInProgress(
        task=len(records),
        records=records,
        oracle=[list(row) for row in report.measured_rows],
        intervals=intervals,
        vqa=[[score.accuracy, score.cross_entropy] for score in report.vqa],
    )
