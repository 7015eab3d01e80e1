"""`aegis train --dry-run` of robot tasks: measures a stream by steps of its first and last task.

The last task is as large as it can get: it assumes that every earlier task kept all its experts.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch

from aegis_cli.common import commands, devices, launch, memory, prefetch
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress, ignore, loading_told
from aegis_cli.common.ranks import ALONE
from aegis_cli.continual import (
    files,
    loop,
    more_tasks,
    places,
    robot_demos,
    robots,
    state,
    train,
)
from aegis_cli.continual.loop import TaskTraining
from aegis_cli.continual.robots import RobotStreamRun
from aegis_cli.continual.state import TaskInProgress
from aegis_cli.core.routing import traced
from aegis_cli.recipes import RobotStreamRecipe
from aegis_cli.training import ahead, optimizers
from aegis_cli.training.dry_run import (
    MB,
    TIMED_STEPS,
    WRITTEN_COPIES,
    Passing,
    Timed,
    fits_in,
    free_disk,
    pass_kept,
    seconds_of,
    to_time,
    too_little,
    warn_of_preparing,
    where_it_fits,
)
from aegis_cli.training.validation_time import expected_s

_STAGE = "dry run"


@dataclass(frozen=True)
class StreamDryRunReport:
    """What training a stream of robot tasks would need.

    Megabytes are estimates unless they are called measured. Both refer to the task that needs most.

    Attributes:
        parameters: parameters of backbone and action expert before the first task.
        steps: steps of each task.
        tasks: by name: `training_frames`, `epochs`, `trainable` (parameters that learn when the
            task begins); `step_s`, `data_s` and `prepare_s` (seconds of a step, of its wait for
            its batch, and in which one thread reads and processes a batch; interpolated for the
            tasks between the first and the last; None if memory does not suffice).
        workers: threads that prepare batches for a GPU; None on a CPU, where the step itself
            processes what one thread has read.
        tokens_per_frame: tokens of one frame (all cameras) and its instruction, in the task with
            the most.
        memory_mb: estimated memory by component.
        memory_measured_mb: peak memory of building, these steps and the evaluation, plus the
            estimate for writing the state; None if no step was taken.
        memory_free_mb: free memory where training would run; None if that is not known.
        memory_fits: by the measurement if there is one, else by the estimate.
        measuring_s: seconds of the evaluation after the last task, by component: `questions`, each
            `task TASK`, the validation `loss`, and for a learner with experts `routing` (each time
            the routers are measured); None if memory does not suffice.
        hours: hours of the rest of the stream.
        disk_mb: disk space of the state and of the files of a finished run; disk_free_mb: free
            space where they would be.
    """

    method: str
    backbone: str
    device: str
    precision: str
    parameters: int
    steps: int
    cameras: list[str]
    tasks: dict[str, dict[str, float | None]]
    workers: int | None
    tokens_per_frame: int
    memory_mb: dict[str, float]
    memory_total_mb: float
    memory_measured_mb: float | None
    memory_free_mb: float | None
    memory_fits: bool | None
    measuring_s: dict[str, float] | None
    hours: float | None
    disk_mb: float
    disk_free_mb: float
    disk_fits: bool
    out: str

    @property
    def memory_needed_mb(self) -> float:
        """The measured memory if there is one, else the estimate."""
        measured = self.memory_measured_mb
        return self.memory_total_mb if measured is None else measured

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def run(
    recipe: RobotStreamRecipe,
    out: Path,
    resume: bool = False,
    on_event: OnEvent = ignore,
    overwrite: bool = False,
) -> StreamDryRunReport:
    """Build the stream, take some steps of its first and its last task, and write nothing.

    Raises:
        AegisError: what `train` would raise before its first step, or demonstrations that it would
            have to record.
    """
    launch.check_one()
    with prefetch.using(recipe.train.workers):
        return _run(recipe, Path(out), resume, on_event, overwrite)


def _run(
    recipe: RobotStreamRecipe, out: Path, resume: bool, on_event: OnEvent, overwrite: bool
) -> StreamDryRunReport:
    device = devices.pick()
    more_tasks.check(out, recipe, resume, overwrite, train.read_by(recipe))
    if resume and not overwrite:
        recipe = places.to_learn(out, recipe)
    recipe = _recorded(recipe, out)
    # Measured before this process allocates any.
    free, base = memory.free(device), memory.restart_peak(device)
    with loading_told(_STAGE, on_event):
        stream = robots.build(recipe, out, on_event)
    devices.warn_of_slow_bf16(device, recipe.train.precision, on_event)
    parameters = sum(p.numel() for p in stream.model.parameters())
    left = _left(stream, overwrite)
    frames = _frames_of_a_pass(stream)
    begun = _Begun.at(stream, 0)
    found = [_estimated(begun, frames, on_event)]
    fits = fits_in(found[0].needed, free, device, ALONE)
    measured: _Measured | None = None
    if fits is not False:
        taking = partial(_measured, begun, frames, found, free, on_event)
        measured = where_it_fits(taking, ALONE)
        fits = False  # unless the measurement shows that it does
    most = max(found, key=lambda one: one.needed)
    if measured is not None:
        # The dry run writes no state, so that part stays an estimate.
        needed = memory.peak(device) - base + most.parts["state"]
        fits = fits_in(needed, free, device, ALONE)
        measured = measured._replace(needed=needed)
        _warn_of_waiting(measured.steps, ahead.workers(device), on_event)
    return _report(stream, parameters, found, most, measured, free, fits, left)


def shortage(report: StreamDryRunReport) -> str | None:
    """What does not fit and what to do about it, on one line; None if everything fits."""
    missing = []
    if report.memory_fits is False:
        assert report.memory_free_mb is not None  # otherwise memory_fits would be None
        smaller = "use a smaller backbone"
        if report.memory_needed_mb - report.memory_mb["activations"] < report.memory_free_mb:
            smaller = "take a step in more passes: set train.accumulate"
        missing.append(too_little(report.memory_needed_mb, report.memory_free_mb, smaller))
    if not report.disk_fits:
        missing.append(
            f"the stream needs {report.disk_mb:,.0f} MB on the disk of '{report.out}', and "
            f"{report.disk_free_mb:,.0f} MB are free: free some, or choose another --out"
        )
    return "; ".join(missing) or None


def _recorded(recipe: RobotStreamRecipe, out: Path) -> RobotStreamRecipe:
    """The recipe with the demonstrations that are already recorded filled in.

    Raises:
        AegisError: there are none yet.
    """
    if recipe.demos.paths is not None:
        return recipe
    places = [robot_demos.place_of(recipe, number, out) for number in range(len(recipe.tasks))]
    for task, place in zip(recipe.tasks, places, strict=True):
        if not place.is_file():
            record = ("demos", task, "--episodes", str(recipe.demos.episodes), "--out", "FILE")
            raise AegisError(
                f"no demonstrations of '{task}' yet, which training would record as '{place}'",
                "demonstrations of every task: a dry run records none",
                f"record them, and name them in demos.paths: {commands.aegis(*record)}",
            )
    paths = tuple(map(str, places))
    return dataclasses.replace(recipe, demos=dataclasses.replace(recipe.demos, paths=paths))


def _left(stream: RobotStreamRun, overwrite: bool) -> list[int]:
    """How many steps of each task are still to be taken."""
    steps, count, place = stream.recipe.train.steps, len(stream.names), TaskInProgress()
    saved = stream.out / state.STATE
    if not overwrite and (learned := files.learned(stream.out)):
        place = TaskInProgress(task=learned)  # of all tasks, or of those that others are added to
    elif saved.is_file() and not overwrite:
        place = state.place_in(saved)
    before = [0] * place.task
    return [*before, *([steps - place.step] if place.task < count else []), *[steps] * count][
        :count
    ]


def _frames_of_a_pass(stream: RobotStreamRun) -> int:
    """The most frames in one forward pass, of a training step or of measuring the routers."""
    settings = stream.recipe.train
    frames = -(-settings.batch_size // settings.accumulate)  # rounded up
    looked_at = robots.CALIBRATION_FRAMES
    whole = robots.calibration_passes(settings, looked_at) == 1
    return max(frames, looked_at) if stream.sites and whole else frames


# --- tasks that have begun ------------------------------------------------------------------------


class _Begun(NamedTuple):
    """A task that has begun, and how many parameters learn in it."""

    stream: RobotStreamRun
    number: int
    training: TaskTraining
    trainable: int

    def preparing_s(self) -> float:
        """Seconds in which one thread reads and processes a batch."""
        objective = self.training.objective
        assert isinstance(objective, robots.FlowMatchingLoss)
        return objective.preparing_s(torch.from_numpy(self.training.order.rows(0)))

    @classmethod
    def at(cls, stream: RobotStreamRun, number: int) -> _Begun:
        """The stream at the beginning of task `number`, after all earlier tasks."""
        stream.current = TaskInProgress(task=number)
        training = loop.prepare(stream, (), None)
        trainable = sum(p.numel() for p in stream.learning().values())
        return cls(stream, number, training, trainable)

    def ended(self) -> None:
        """End the task and keep every expert that it began with."""
        self.stream.learner.finish(self.training.context, {})
        self.stream.model.requires_grad_(False).zero_grad()


class _Estimated(NamedTuple):
    """What a task needs when it begins: bytes of memory by component, and bytes of its state."""

    trainable: int
    tokens: int
    parts: dict[str, int]
    state: int

    @property
    def needed(self) -> int:
        """Bytes of memory."""
        return sum(self.parts.values())


def _estimated(begun: _Begun, frames: int, on_event: OnEvent) -> _Estimated:
    stream, number, optimizer = begun.stream, begun.number, begun.training.optimizer
    stream.activate(number)
    seen = partial(traced, stream.sites)
    passing = Passing(stream.policies[number], stream.demos[number], stream.recipe.train, seen=seen)
    tokens, activations = pass_kept(passing, frames, on_event)
    moments = 0 if optimizer is None else optimizers.state_bytes([optimizer])
    largest = max(p.nbytes for p in stream.model.parameters())
    parts = {
        "weights": _bytes(stream.model.parameters()),
        "gradients": _bytes(stream.learning().values()),
        "optimizer": moments,
        "activations": activations,
        "state": 0,
    }
    # The state is written between two steps, when a step's activations are free again.
    parts["state"] = max(0, WRITTEN_COPIES * largest - activations)
    state_bytes = _bytes(stream.parameters().values()) + moments
    return _Estimated(begun.trainable, tokens, parts, state_bytes)


def _bytes(tensors: Iterable[torch.Tensor]) -> int:
    return sum(t.nbytes for t in tensors)


# --- measurements ---------------------------------------------------------------------------------


class _Measured(NamedTuple):
    """Measured times and memory.

    Attributes:
        steps: the times of a step in the first and in the last task.
        looks_s: seconds of measuring the routers once; None for a learner without routers.
        needed: peak memory in bytes.
    """

    steps: tuple[Timed, Timed]
    tried_s: list[float]
    vqa_s: float
    loss_s: float
    looks_s: float | None
    needed: int = 0


def _measured(
    begun: _Begun,
    frames: int,
    found: list[_Estimated],
    free: int | None,
    on_event: OnEvent,
) -> _Measured | None:
    """Time steps of the first and the last task, and the evaluation that follows.

    Args:
        begun: the first task.
        found: the estimates, to which those of the later tasks are appended.
        free: free bytes before anything was built.

    Returns:
        The measurements, or None if a later task does not fit by its estimate.
    """
    stream, count = begun.stream, len(begun.stream.names)
    first = last = _timed(begun, on_event)
    for number in range(1, count):
        begun.ended()
        begun = _Begun.at(stream, number)
        found.append(_estimated(begun, frames, ignore))
        if fits_in(found[-1].needed, free, stream.device, ALONE) is False:
            return None
    if count > 1:
        last = _timed(begun, on_event)
    looks_s = None
    if stream.sites:
        started = time.perf_counter()
        loop.measure(stream, begun.training)
        looks_s = time.perf_counter() - started
    evaluator = stream.measuring
    tried_s = [evaluator.tried_s(number) for number in range(count)]
    loss_s = expected_s(stream.validation_loss)
    return _Measured((first, last), tried_s, evaluator.vqa_s(), loss_s, looks_s)


def _warn_of_waiting(steps: tuple[Timed, Timed], workers: int | None, on_event: OnEvent) -> None:
    """Warn if steps wait for their batches, by the task in which they wait longest."""
    waited = Timed._fields.index("prepare_s" if workers is None else "data_s")
    longest = max(steps, key=lambda timed: timed[waited] / timed.step_s)
    warn_of_preparing(longest, workers, on_event)


def _timed(begun: _Begun, on_event: OnEvent) -> Timed:
    """The times of a step of the first or the last task."""
    stream, training = begun.stream, begun.training
    steps, first = to_time(TIMED_STEPS, stream.recipe.train.steps, stream.device)
    # The same number of steps for both of them; a stream of one task has its first one only.
    last, total = begun.number > 0, len(steps) * min(2, len(stream.names))
    done = len(steps) if last else 0
    on_event(Progress(_STAGE, done, total, "steps"))
    prepare_s = begun.preparing_s()
    stream.model.train()

    def take(step: int, batch: Any) -> None:
        loop.take(stream, training, step, batch)
        on_event(Progress(_STAGE, done + step + 1, total, "steps"))

    with training.batches(steps) as batches:
        # A step of a stream reads its loss, and so has ended when `take` returns.
        step_s, data_s = seconds_of(steps, first, batches, take, wait=lambda: None)
    return Timed(step_s, data_s, prepare_s)


# --- the report -----------------------------------------------------------------------------------


def _report(
    stream: RobotStreamRun,
    parameters: int,
    found: list[_Estimated],
    most: _Estimated,
    measured: _Measured | None,
    free: int | None,
    fits: bool | None,
    left: list[int],
) -> StreamDryRunReport:
    recipe, names = stream.recipe, stream.names
    times = None if measured is None else _between(measured.steps, len(names))
    tasks = {}
    for number, name in enumerate(names):
        frames = len(stream.demos[number].train)
        tasks[name] = {
            "training_frames": frames,
            "epochs": recipe.train.steps * recipe.train.batch_size / frames,
            "trainable": found[number].trainable if number < len(found) else None,
            **(dict.fromkeys(Timed._fields) if times is None else times[number]._asdict()),
        }
    disk, disk_free = _disk(stream, max(one.state for one in found)), free_disk(stream.out)
    return StreamDryRunReport(
        method=recipe.train.method,
        backbone=recipe.backbone,
        device=str(stream.device),
        precision=devices.precision_taken(stream.device, recipe.train.precision),
        parameters=parameters,
        steps=recipe.train.steps,
        cameras=list(stream.demos[0].cameras),
        tasks=tasks,
        workers=ahead.workers(stream.device),
        tokens_per_frame=max(one.tokens for one in found),
        memory_mb={name: size / MB for name, size in most.parts.items()},
        memory_total_mb=most.needed / MB,
        memory_measured_mb=None if measured is None else measured.needed / MB,
        memory_free_mb=None if free is None else free / MB,
        memory_fits=fits,
        measuring_s=None if measured is None else _measuring_s(names, measured),
        hours=None if measured is None else _hours(stream, measured, left),
        disk_mb=disk / MB,
        disk_free_mb=disk_free / MB,
        disk_fits=disk <= disk_free,
        out=str(stream.out),
    )


def _between(ends: tuple[Timed, Timed], count: int) -> list[Timed]:
    """`count` evenly spaced times from the first to the last of `ends`."""
    found = []
    for i in range(count):
        share = i / max(1, count - 1)
        found.append(Timed(*(a + (b - a) * share for a, b in zip(*ends, strict=True))))
    return found


def _measuring_s(names: tuple[str, ...], measured: _Measured) -> dict[str, float]:
    found = {"questions": measured.vqa_s, "loss": measured.loss_s}
    found |= {f"task {n}": s for n, s in zip(names, measured.tried_s, strict=True)}
    return found if measured.looks_s is None else {**found, "routing": measured.looks_s}


def _hours(stream: RobotStreamRun, measured: _Measured, left: list[int]) -> float:
    """Hours of the remaining steps and of the evaluation after their tasks."""
    seconds = measured.vqa_s if left[0] == stream.recipe.train.steps else 0.0  # before the first
    looks_s = (measured.looks_s or 0.0) * _looks(stream)
    for number, timed in enumerate(_between(measured.steps, len(left))):
        if left[number]:
            seconds += timed.step_s * left[number] + looks_s
            seconds += sum(measured.tried_s[: number + 1]) + measured.vqa_s + measured.loss_s
    return seconds / 3600


def _looks(stream: RobotStreamRun) -> int:
    """How often a task's routers are measured at most, in its first phase and at its end."""
    if stream.learner.identification is None:
        return 1
    options = stream.options
    limit = max(1, round(options["identify"] * stream.recipe.train.steps))
    return limit // options["check_every"] + (limit % options["check_every"] > 0) + 1


def _disk(stream: RobotStreamRun, kept: int) -> int:
    """Most bytes on disk: two states while one replaces the other, or one and a finished run.

    Args:
        kept: bytes of a state.
    """
    finished = _bytes(stream.parameters().values())
    if stream.learner.trains == "model":
        finished = _bytes(stream.model.parameters())
    return max(2 * kept, kept + finished)
