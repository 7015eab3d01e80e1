"""`aegis train` on a stream: learns its tasks one after the other and measures them after each.

    recipe.yaml  metrics.jsonl
    experts.safetensors  routing.safetensors   for a learner with experts
    encoder/, backbone/                        for one that trains the model itself
    expert.safetensors                         a robot's action expert, and scales per task
    accuracy_matrix.json                       for images
    success_matrix.json, error_matrix.json     for robots: simulated, or not
    parameters.json  stream.json
    inputs.json                                where a robot's backbone and demonstrations lie
    state.safetensors                          what --resume needs; gone when the stream is done
    ../demos/                                  recordings, for all runs beside this one

All files but the metrics, which hold times, and inputs.json have the same bytes in every equal run,
interrupted or not.
"""

from __future__ import annotations

import dataclasses
import json
import time
from pathlib import Path
from typing import Any, cast

import torch

from aegis_cli import recipes
from aegis_cli.common import devices, launch, locks, prefetch
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress, Warned, ignore
from aegis_cli.common.files import canonical, write_text
from aegis_cli.continual import files, images, loop, more_tasks, places, state
from aegis_cli.continual.report import StreamReport
from aegis_cli.continual.state import AnyStreamRun
from aegis_cli.recipes import Recipe, RobotStreamRecipe, StreamRecipe
from aegis_cli.training import folder


def run(
    recipe: StreamRecipe | RobotStreamRecipe,
    out: Path,
    resume: bool = False,
    on_event: OnEvent = ignore,
    overwrite: bool = False,
) -> StreamReport:
    """Learn the stream with the learner `recipe.train.method`, into the run folder `out`.

    Args:
        resume: continue the run in `out`, if there is one; a finished stream of robot tasks also
            with more tasks after its own.
        overwrite: remove the run in `out`, once everything else has been checked.

    Raises:
        AegisError: inputs that do not fit, a run in `out` without either flag, a run that another
            process is using, or a disk that cannot be written.
        Diverged: a loss or gradient is not finite.
    """
    launch.check_one()
    out = Path(out)
    workers = recipe.train.workers if isinstance(recipe, RobotStreamRecipe) else None
    with locks.alone(out), prefetch.using(workers):
        return _run(recipe, out, resume, overwrite, on_event)


def _run(
    recipe: StreamRecipe | RobotStreamRecipe,
    out: Path,
    resume: bool,
    overwrite: bool,
    on_event: OnEvent,
) -> StreamReport:
    adds = more_tasks.check(out, recipe, resume, overwrite, read_by(recipe))
    # With `overwrite`, a damaged report of the run that goes does not matter.
    if not overwrite and not adds and files.is_done(out):
        _check_same_recording(out, recipe)
        return files.read(out)
    recipe, here = _located(recipe, out, resume and not overwrite)
    built = build(here, out, on_event)
    # Its files hold the digest of the recipe that it began with, of the same kind.
    cast(Any, built).recipe = recipe
    devices.warn_of_slow_bf16(built.device, recipe.train.precision, on_event)
    if overwrite:
        folder.remove(out)
    if adds:
        more_tasks.begin(built, on_event)
    optimizer = None
    if (out / state.STATE).exists():
        optimizer = state.restore(built)
        if not adds:
            _adjust(built, optimizer, on_event)
        _truncate_metrics(built)
        _keep_places(out, here)
    else:  # also a run that was interrupted before its first state
        # Written only now, after all inputs of the recipe have been checked.
        folder.begin(out, recipe)
        _keep_places(out, here)
        built.before_stream()
    _learn(built, optimizer, on_event)
    report = built.report()
    files.write(built, report)
    # Last, so that a run that is interrupted while writing can resume from its state.
    (out / state.STATE).unlink(missing_ok=True)
    return report


def _located(
    recipe: StreamRecipe | RobotStreamRecipe, out: Path, resume: bool
) -> tuple[StreamRecipe | RobotStreamRecipe, StreamRecipe | RobotStreamRecipe]:
    """The recipe of a run, and the same with the present places of what it reads.

    Raises:
        AegisError: the run is resumed, and its backbone or demonstrations are gone.
    """
    if not isinstance(recipe, RobotStreamRecipe) or not resume:
        return recipe, recipe
    return places.as_begun(out, recipe), places.to_learn(out, recipe)


def _adjust(run: AnyStreamRun, optimizer: torch.optim.Optimizer | None, on_event: OnEvent) -> None:
    """Say and write which settings a resumed run takes that it did not have so far."""
    recipe = run.recipe
    if not isinstance(recipe, RobotStreamRecipe):
        return
    if changes := folder.adjustments(run.out, recipe):
        text = (
            f"'{run.out}' goes on with {changes}. This changes memory, time or what is written, "
            "and what is learned at most by rounding (with igsp and train.accumulate also a little "
            "where instructions have several lengths); files may differ from those of an "
            "uninterrupted run"
        )
        on_event(Warned("train", text))
        state.save(run, optimizer)  # first, as it can be resumed with either recipe
        folder.write_recipe(run.out, recipe)


def _keep_places(out: Path, here: StreamRecipe | RobotStreamRecipe) -> None:
    if isinstance(here, RobotStreamRecipe):
        places.keep(out, places.of(here))


def read_by(recipe: StreamRecipe | RobotStreamRecipe) -> tuple[str | None, ...]:
    """The model and the data that a stream is made from."""
    if isinstance(recipe, StreamRecipe):
        return (recipe.encoder, recipe.path)
    return (recipe.backbone, *recipe.demos.named)


def _check_same_recording(out: Path, recipe: StreamRecipe | RobotStreamRecipe) -> None:
    """Raise AegisError if a finished run learned from demonstrations with other settings.

    Given files are not compared, because they may have been moved.
    """
    if not isinstance(recipe, RobotStreamRecipe) or recipe.demos.paths is not None:
        return
    learned = recipes.load(out / "recipe.yaml", kind=RobotStreamRecipe).demos
    if dataclasses.replace(learned, paths=None) != recipe.demos:
        raise AegisError(
            f"different demonstrations than the finished stream in '{out}' learned from",
            f"episodes {learned.episodes}, noise {learned.noise:g} and seed {learned.seed}",
            "give what it was trained with, start anew in another --out, or --overwrite it",
        )


def build(
    recipe: StreamRecipe | RobotStreamRecipe, out: Path, on_event: OnEvent = ignore
) -> AnyStreamRun:
    """Build model, tasks and learner of a run that is to be trained.

    Raises:
        AegisError: inputs that do not fit together; nothing has been written to `out` then.
    """
    return _module(recipe).build(recipe, out, on_event)


def load(
    path: Path, before: StreamReport, on_event: OnEvent = ignore, **moved: Any
) -> AnyStreamRun:
    """Load a finished run whose figures can be measured again.

    Args:
        before: the run's report.
        moved: of a stream of robot tasks, new places of its inputs, as in `robots.load`.

    Raises:
        AegisError: files are missing, damaged or not of one run, or an input that the run was
            measured with has changed.
    """
    recipe = recipes.load_training(path / "recipe.yaml")
    assert not isinstance(recipe, Recipe)
    return _module(recipe).load(recipe, path, before, on_event, **moved)


def _module(recipe: StreamRecipe | RobotStreamRecipe) -> Any:
    """The module of the stream's kind, with its own `build` and `load`."""
    if isinstance(recipe, StreamRecipe):
        return images
    from aegis_cli.continual import robots  # loads MuJoCo, which images do not need

    return robots


def _learn(
    stream: AnyStreamRun, optimizer: torch.optim.Optimizer | None, on_event: OnEvent
) -> None:
    """Learn the remaining tasks, and measure after each.

    Args:
        optimizer: the optimizer of the current task, if it has begun.
    """
    count = len(stream.names)
    while stream.current.task < count:
        learned = stream.current
        prototypes = stream.before_task()
        record = loop.learn(stream, prototypes, optimizer, on_event)
        started = time.perf_counter()
        # Through JSON, so that an uninterrupted run holds the same values as a resumed one.
        learned.records.append(json.loads(canonical(dataclasses.asdict(record))))
        figures = stream.after_task()
        line = {"task": learned.task, "step": stream.recipe.train.steps, **figures}
        folder.append_metrics(stream.out, line | {"seconds": time.perf_counter() - started})
        # The next task begins with a new optimizer; step 0 marks this in the state.
        stream.current, optimizer = learned.next_task(), None
        if stream.current.task < count:
            if stream.learner.trains != "nothing":
                state.save(stream, None)
            if stream.partial_matrix:
                files.write_matrix(stream.out, stream.report())
        shown = {stream.score_name: learned.oracle[-1][learned.task]}
        on_event(Progress("stream", stream.current.task, count, "tasks", shown))


def _truncate_metrics(stream: AnyStreamRun) -> None:
    """Drop the lines logged after the state was written: a resumed run repeats those steps."""
    at = (stream.current.task, stream.current.step)
    lines = folder.read_metrics(stream.out, "task", "step")
    kept = [json.dumps(line) for line in lines if (line["task"], line["step"]) <= at]
    write_text(stream.out / folder.METRICS, "".join(f"{line}\n" for line in kept))
