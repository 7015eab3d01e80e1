"""`aegis train` on a stream: its tasks one after the other, and after each a measurement of them.

    recipe.yaml  metrics.jsonl
    experts.safetensors  routing.safetensors   of a learner with experts
    encoder/, backbone/                        of one that trains the model itself
    expert.safetensors                         a robot's action expert, and scales per task
    accuracy_matrix.json                       of images
    success_matrix.json, error_matrix.json     of robots: simulated ones, others
    parameters.json  stream.json
    state.safetensors                          what --resume needs; gone when the stream is done
    ../demos/                                  what was recorded, for all runs beside this one

All but the metrics, which hold times, are the same bytes in every repetition, interrupted or not.
"""

from __future__ import annotations

import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import torch

from aegis_cli import recipes
from aegis_cli.common import devices, launch, locks
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.common.files import canonical, write_text
from aegis_cli.continual import files, images, loop, state
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
    """Learn `recipe.train.method`'s way through the stream, into the run folder `out`.

    Args:
        resume: go on with the run that is there, if there is one.
        overwrite: remove the run that is there, once everything else has been checked.

    Raises:
        AegisError: inputs that do not fit, an existing run without either, one that another
            process is at, or a disk that cannot be written.
        Diverged: a loss or gradient that is not finite.
    """
    launch.check_one()
    out = Path(out)
    with locks.alone(out):
        return _run(recipe, out, resume, overwrite, on_event)


def _run(
    recipe: StreamRecipe | RobotStreamRecipe,
    out: Path,
    resume: bool,
    overwrite: bool,
    on_event: OnEvent,
) -> StreamReport:
    folder.check(out, recipe, resume, overwrite, read_by(recipe))
    if files.is_done(out) and not overwrite:
        _check_same_recording(out, recipe)
        return files.read(out)
    built = build(recipe, out, on_event)
    devices.warn_of_slow_bf16(built.device, recipe.train.precision, on_event)
    if overwrite:
        folder.remove(out)
    optimizer = None
    if (out / state.STATE).exists():
        optimizer = state.restore(built)
        _truncate_metrics(built)
    else:  # also a run that was interrupted before its first state
        # Written only now, when all that the recipe names has been found to fit.
        folder.begin(out, recipe)
        built.before_stream()
    _learn(built, optimizer, on_event)
    report = built.report()
    files.write(built, report)
    # Last: a run that is interrupted while it writes goes on from its state.
    (out / state.STATE).unlink(missing_ok=True)
    return report


def read_by(recipe: StreamRecipe | RobotStreamRecipe) -> tuple[str | None, ...]:
    """The model and the data that a stream is made from."""
    if isinstance(recipe, StreamRecipe):
        return (recipe.encoder, recipe.path)
    return (recipe.backbone, *recipe.demos.named)


def _check_same_recording(out: Path, recipe: StreamRecipe | RobotStreamRecipe) -> None:
    """Raise AegisError if a finished run learned from demonstrations of other settings.

    Where files are given instead, they may have been moved.
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
    """Model, tasks and learner of a run that is to be trained.

    Raises:
        AegisError: inputs that do not fit together; nothing has been written to `out` then.
    """
    return _module(recipe).build(recipe, out, on_event)


def load(path: Path, before: StreamReport, on_event: OnEvent = ignore) -> AnyStreamRun:
    """A finished run whose figures can be measured again.

    Args:
        before: the run's report.

    Raises:
        AegisError: files that are missing, damaged or not of one run, or something that the run was
            measured with is no longer the same.
    """
    recipe = recipes.load_training(path / "recipe.yaml")
    assert not isinstance(recipe, Recipe)
    return _module(recipe).load(recipe, path, before, on_event)


def _module(recipe: StreamRecipe | RobotStreamRecipe) -> Any:
    """The module of the stream's kind, with its own `build` and `load`."""
    if isinstance(recipe, StreamRecipe):
        return images
    from aegis_cli.continual import robots  # loads MuJoCo, which images do without

    return robots


def _learn(
    stream: AnyStreamRun, optimizer: torch.optim.Optimizer | None, on_event: OnEvent
) -> None:
    """Learn the tasks that are left, and measure after each.

    Args:
        optimizer: of the current task, if it has begun.
    """
    count = len(stream.names)
    while stream.current.task < count:
        learned = stream.current
        prototypes = stream.before_task()
        record = loop.learn(stream, prototypes, optimizer, on_event)
        started = time.perf_counter()
        # through JSON, so that a run that goes on holds the same values as one read from disk
        learned.records.append(json.loads(canonical(dataclasses.asdict(record))))
        figures = stream.after_task()
        line = {"task": learned.task, "step": stream.recipe.train.steps, **figures}
        folder.append_metrics(stream.out, line | {"seconds": time.perf_counter() - started})
        # The next task begins with an optimizer of its own: the state says so by step 0.
        stream.current, optimizer = learned.next_task(), None
        if stream.current.task < count:
            if stream.learner.trains != "nothing":
                state.save(stream, None)
            if stream.partial_matrix:
                files.write_matrix(stream.out, stream.report())
        shown = {stream.score_name: learned.oracle[-1][learned.task]}
        on_event(Progress("stream", stream.current.task, count, "tasks", shown))


def _truncate_metrics(stream: AnyStreamRun) -> None:
    """Forget what was logged after the state was written: a resumed run repeats those steps."""
    at = (stream.current.task, stream.current.step)
    lines = folder.read_metrics(stream.out, "task", "step")
    kept = [json.dumps(line) for line in lines if (line["task"], line["step"]) <= at]
    write_text(stream.out / folder.METRICS, "".join(f"{line}\n" for line in kept))
