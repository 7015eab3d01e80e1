"""`aegis train --dry-run`: check everything that a training run needs, and estimate its cost."""

from __future__ import annotations

import dataclasses
import gc
import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from aegis_cli import methods
from aegis_cli.common import devices, launch, memory, prefetch
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress, Warned, ignore, loading_told
from aegis_cli.common.ranks import Ranks, joined, rows_here
from aegis_cli.data import mixture
from aegis_cli.data.batch import RobotBatch
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.data.selection import Paths
from aegis_cli.models import structure
from aegis_cli.models.buffers import WrittenBuffers
from aegis_cli.models.policy import Policy
from aegis_cli.recipes import Recipe, RobotTrain, Train
from aegis_cli.training import (
    ahead,
    assemble,
    checkpoint,
    inputs,
    longer,
    optimizers,
    parallel,
    retention,
    track,
    train,
    validation_actions,
    validation_rollout,
    validation_time,
    validation_vqa,
)
from aegis_cli.training.assemble import TrainingRun

T = TypeVar("T")

MB = 1e6
WRITTEN_COPIES = 3  # copies of a tensor while it is checked, hashed and written, as measured
# Where the documentation says how.
_SPLITTING = "docs/performance.md, Image splitting"
_LONG_WAIT = 0.2  # the share of a step's time for which it may wait for its batch
TIMED_STEPS = 3  # steps, after a first one that includes one-time work


@dataclass(frozen=True)
class DryRunReport:
    """What a training run would do.

    Megabytes are estimates unless they are said to be measured, and are those of the process that
    needs the most. Activations are those of one frame times the frames of a pass.

    Attributes:
        precision: of the matrix products, bf16 or float32, even if the recipe says `auto`.
        processes: how many share the training.
        parameters, trainable: of backbone and expert; groups: of the backbone, by the groups that
            are projected.
        cameras: of a LeRobot folder, in the order in which the prompt shows their frames.
        training_frames: those that are not held out; epochs: how often each is seen; with
            `demos.weights`, on average.
        sets: for each of several sets of demonstrations, by path, the same figures and its `share`
            of the frames that are seen; None if there is one set.
        tokens_per_frame: of one frame (all cameras) with its instruction.
        memory_mb: by purpose; `method` is what the method keeps throughout the run.
        memory_measured_mb: the peak while building and taking these steps, plus what a checkpoint
            needs in addition; None if no step was taken.
        memory_together_mb: measured, else estimated, for all processes on one machine, which share
            its memory; None on GPUs, which each have their own, and for a single process.
        memory_fits: by what was measured, else by the estimate.
        memory_free_mb: on the device that training would run on; None if not known.
        step_s: of one step, the mean of three, or of as many steps as share a method's constraint
            or anchor gradient, or as a GPU may find prepared; None if there is not enough memory to
            take them.
        data_s: how long of `step_s` a step waited for its batch.
        prepare_s: in which one thread reads and processes a batch; workers: the threads that do so
            for a GPU, None on a CPU, where the step itself processes what one thread has read.
        validation_s: of one validation, by part: its `loss`, `questions`, `episodes` if none ends
            early, and predicted `actions`; None if there is not enough memory.
        hours: for the remaining steps and validations, without checkpoints.
        checkpoints, disk_mb: those still to be written, at most as many as exist at one time;
            disk_free_mb: on the disk that they would be written to.
    """

    method: str
    backbone: str
    device: str
    precision: str
    processes: int
    parameters: int
    trainable: int
    groups: dict[str, int]
    steps: int
    cameras: list[str]
    training_frames: int
    epochs: float
    sets: dict[str, dict[str, float]] | None
    tokens_per_frame: int
    memory_mb: dict[str, float]
    memory_total_mb: float
    memory_measured_mb: float | None
    memory_together_mb: float | None
    memory_free_mb: float | None
    memory_fits: bool | None
    step_s: float | None
    data_s: float | None
    prepare_s: float | None
    workers: int | None
    validation_s: dict[str, float] | None
    hours: float | None
    checkpoints: int
    disk_mb: float
    disk_free_mb: float
    disk_fits: bool
    out: str

    @property
    def memory_needed_mb(self) -> float:
        """What was measured, else the estimate, for all processes that share the free memory."""
        if self.memory_together_mb is not None:
            return self.memory_together_mb
        measured = self.memory_measured_mb
        return self.memory_total_mb if measured is None else measured

    def to_json(self) -> dict[str, Any]:
        values = dataclasses.asdict(self)
        values["tokens_a_frame"] = self.tokens_per_frame  # its old name; it goes after 0.1
        return values


def run(
    recipe: Recipe,
    method: str,
    demos: Paths,
    anchor: Path | None,
    out: Path,
    resume: bool = False,
    on_event: OnEvent = ignore,
    overwrite: bool = False,
) -> DryRunReport:
    """Build the training, pass one frame through it, and time some steps.

    Nothing is written but the cache of decoded frames.

    If torchrun has started several processes, each calls this, and they share the steps.

    Raises:
        AegisError: what `train` would raise before its first step.
    """
    track.check(recipe)
    recipe = dataclasses.replace(recipe, train=dataclasses.replace(recipe.train, method=method))
    out = Path(out)
    with joined() as ranks, prefetch.using(recipe.train.workers):
        if resume:
            recipe = ranks.agree(longer.plan(out, recipe) if ranks.first else recipe)
        if ranks.first:
            places = inputs.Inputs.given(demos, anchor)
            longer.check(out, recipe, resume, overwrite, places, on_event)
        return _planned(recipe, demos, anchor, out, overwrite, on_event, ranks)


def _planned(
    recipe: Recipe,
    demos: Paths,
    anchor: Path | None,
    out: Path,
    overwrite: bool,
    on_event: OnEvent,
    ranks: Ranks,
) -> DryRunReport:
    device = devices.pick()
    # Before this process, or another one on its machine, allocates any.
    there, free, base = _alive(device), memory.free(device), memory.restart_peak(device)
    ranks.wait()
    method = methods.get(recipe.train.method)
    told = on_event if ranks.first else ignore
    with loading_told("dry run", told):
        training = assemble.build(recipe, method, demos, anchor, out, on_event, ranks)
    training.questions = validation_vqa.chosen(recipe, training.policy.backbone, told)
    training.episodes = validation_rollout.chosen(recipe, training.shown, training.meta, ranks)
    training.actions = validation_actions.chosen(
        recipe, training.policy, training.demos, training.meta
    )
    held = _held(training, there)
    passing = Passing(
        training.policy,
        training.demos,
        recipe.train,
        training.method.stop_gradient,
        training.masters.rounded,
    )
    tokens, activations = pass_kept(passing, _frames_of_a_pass(recipe.train, ranks), told)
    parts = _memory(training, held, activations)
    written = [] if overwrite else checkpoint.whole(out)
    disk = _disk(training, written)
    buffers = WrittenBuffers(training.policy.backbone)
    # Last of all: the steps fill the optimizer state and change the weights.
    needs = _needs(training, parts, free, base, ranks, told)
    train.warn_of_written(training.policy.backbone, buffers, told)
    warn_of_preparing(needs.timed, ahead.workers(device), told)
    return _report(training, tokens, needs, free, disk, _done(written))


def _report(
    training: TrainingRun, tokens: int, needs: _Needs, free: int | None, disk: _Disk, done: int
) -> DryRunReport:
    """The report of what was found, in megabytes and hours.

    Args:
        tokens: of one frame.
        free: bytes of memory before anything was built.
        done: steps already taken.
    """
    recipe, policy, frames = training.recipe, training.policy, len(training.demos.train)
    groups = policy.backbone.parameter_groups()
    step_s, data_s, prepare_s = needs.timed or (None, None, None)
    return DryRunReport(
        method=training.method.name,
        backbone=recipe.backbone,
        device=str(policy.backbone.device),
        precision=devices.precision_taken(policy.backbone.device, recipe.train.precision),
        processes=training.ranks.count,
        parameters=_count(policy.parameters()),
        trainable=_count(p for p in policy.parameters() if p.requires_grad),
        groups={name: _count(group) for name, group in groups.items()},
        steps=recipe.train.steps,
        cameras=list(training.demos.cameras),
        training_frames=frames,
        epochs=recipe.train.steps * recipe.train.batch_size / frames,
        sets=_sets(training),
        tokens_per_frame=tokens,
        memory_mb={name: size / MB for name, size in needs.parts.items()},
        memory_total_mb=sum(needs.parts.values()) / MB,
        memory_measured_mb=_in_mb(needs.measured),
        memory_together_mb=_in_mb(needs.together),
        memory_free_mb=_in_mb(free),
        memory_fits=needs.fits,
        step_s=step_s,
        data_s=data_s,
        prepare_s=prepare_s,
        workers=ahead.workers(policy.backbone.device),
        validation_s=needs.validation_s,
        hours=_hours(recipe.train, needs, done),
        checkpoints=disk.checkpoints,
        disk_mb=disk.needed / MB,
        disk_free_mb=disk.free / MB,
        disk_fits=disk.needed <= disk.free,
        out=str(training.out),
    )


def _hours(settings: Train, needs: _Needs, done: int) -> float | None:
    """Hours for the steps after the first `done` ones, and for their validations."""
    if needs.timed is None or needs.validation_s is None:
        return None
    validations = _left(settings, settings.validate_every, done)
    seconds = needs.timed.step_s * (settings.steps - done)
    seconds += sum(needs.validation_s.values()) * validations
    return seconds / 3600


def _in_mb(size: int | None) -> float | None:
    return None if size is None else size / MB


def _sets(training: TrainingRun) -> dict[str, dict[str, float]] | None:
    """The frames of each of several sets of demonstrations, and how often they are seen."""
    demos, settings = training.demos, training.recipe.train
    counts = mixture.drawn(demos, training.recipe.demos.weights)
    seen = settings.steps * settings.batch_size / len(demos.train)  # epochs of all together
    found = {
        member.name: {
            "training_frames": member.train,
            "share": count / len(demos.train),
            "epochs": seen * count / member.train,
        }
        for member, count in zip(demos.members, counts, strict=True)
    }
    return found or None


class Timed(NamedTuple):
    """Seconds: of a step, of which it waits for its batch, and of a thread per batch."""

    step_s: float
    data_s: float
    prepare_s: float


class _Needs(NamedTuple):
    """What the processes need, in bytes.

    Attributes:
        parts: the largest estimate, by purpose.
        measured: the most that a process took; None if no step was taken.
        together: for the processes that share a machine's memory; None if none do.
        fits: whether every process has what it needs; None if the free memory is not known.
        timed: the times of a step; None if none was taken.
        validation_s: seconds of one validation, by part; None if none was started.
    """

    parts: dict[str, int]
    measured: int | None
    together: int | None
    fits: bool | None
    timed: Timed | None
    validation_s: dict[str, float] | None


def _needs(
    training: TrainingRun,
    parts: dict[str, int],
    free: int | None,
    base: int,
    ranks: Ranks,
    on_event: OnEvent,
) -> _Needs:
    """What the processes need, measured on some steps if the estimate fits.

    Args:
        parts: this process's estimate, in bytes by purpose.
        free: free bytes before anything was built; `base` is what the process used then.
    """
    device, needed = training.policy.backbone.device, sum(parts.values())
    fits = fits_in(needed, free, device, ranks)
    timed, validation_s, measured = None, None, None
    if fits is not False:
        timed = where_it_fits(partial(_timed, training, on_event), ranks)
        if timed is not None:
            # After the steps, since gradients and optimizer state exist during a validation:
            # together they are part of the training's peak.
            measure = partial(validation_time.measured, training, on_event)
            validation_s = where_it_fits(measure, ranks)
        fits = False  # unless both measurements succeed
    if validation_s is not None:
        # No checkpoint was written: its share is still estimated.
        needed = memory.peak(device) - base + parts["checkpoint"]
        measured = max(ranks.gathered(needed))
        fits = fits_in(needed, free, device, ranks)
    largest = max(ranks.gathered(parts), key=lambda found: sum(found.values()))
    together = _together(needed, device, ranks)
    return _Needs(largest, measured, together, fits, timed, validation_s)


def _frames_of_a_pass(settings: Train, ranks: Ranks) -> int:
    """The most frames that one process puts through the model at once."""
    # -(-a // b) rounds up: shares differ by one frame at most, and the largest decides.
    return -(-settings.batch_size // (ranks.count * settings.accumulate))


def _together(needed: int, device: torch.device, ranks: Ranks) -> int | None:
    """Bytes that the processes on this machine need together; None if they do not share memory."""
    if device.type == "cuda" or not ranks.several:
        return None
    # The launcher numbers the processes of one machine consecutively, and starts equally many on
    # each.
    here = launch.local_world_size()
    first = ranks.rank // here * here
    return sum(ranks.gathered(needed)[first : first + here])


def fits_in(needed: int, free: int | None, device: torch.device, ranks: Ranks) -> bool | None:
    """Whether every process has what it needs; None if the free memory is not known."""
    together = _together(needed, device, ranks)
    short = free is not None and (needed if together is None else together) > free
    unknown, lacking = ranks.any(free is None, short)
    return None if unknown else not lacking


def shortage(report: DryRunReport) -> str | None:
    """What does not fit, on one line, and what to do about it; None if everything fits."""
    missing = []
    if report.memory_fits is False:
        assert report.memory_free_mb is not None  # otherwise memory_fits is None
        # Only activations shrink with the batch.
        shared = 1 if report.memory_together_mb is None else report.processes
        rest = report.memory_needed_mb - shared * report.memory_mb["activations"]
        smaller = "use a smaller backbone, or a method that trains less"
        if report.processes > 1:
            smaller += ", or --set train.parallel=fsdp"
        if rest < report.memory_free_mb:
            smaller = "lower train.batch_size"
        missing.append(too_little(report.memory_needed_mb, report.memory_free_mb, smaller))
    if not report.disk_fits:
        missing.append(
            f"the checkpoints need {report.disk_mb:,.0f} MB on the disk of '{report.out}', and "
            f"{report.disk_free_mb:,.0f} MB are free: free some, choose another --out, or set "
            "train.keep_checkpoints, or train.checkpoint_every higher"
        )
    return "; ".join(missing) or None


def too_little(needed_mb: float, free_mb: float, smaller: str) -> str:
    """The message if there is not enough memory."""
    needs = f"about {needed_mb:,.0f} MB of memory, and"
    if needed_mb <= free_mb:  # a step ran out of memory all the same
        needs = f"more memory than the estimate of {needed_mb:,.0f} MB, and"
    return f"training needs {needs} {free_mb:,.0f} MB are free: {smaller}"


def _count(parameters: Iterable[Tensor]) -> int:
    return sum(p.numel() for p in parameters)


def _bytes(tensors: Iterable[Tensor]) -> int:
    """Bytes of whole tensors, including other processes' rows."""
    return sum(t.nbytes for t in tensors)


def _bytes_here(tensors: Iterable[Tensor]) -> int:
    """Bytes of the rows that this process has."""
    return sum(rows_here(t).nbytes for t in tensors)


# --- memory ---------------------------------------------------------------------------------------


class Passing(NamedTuple):
    """Which frames are passed through which policy, and how.

    Attributes:
        detach: whether the gradient stops at the keys and values.
        seen: a context in which the weights are as a training pass sees them.
    """

    policy: Policy
    demos: Demonstrations
    settings: Train | RobotTrain
    detach: bool = False
    seen: Callable[[], AbstractContextManager[object]] = nullcontext


def pass_kept(passing: Passing, frames: int, on_event: OnEvent) -> tuple[int, int]:
    """Tokens per frame, and bytes that the forward pass of `frames` keeps for the backward pass.

    Passes of two and of three frames separate what grows with the frames from what does not
    (weights that autocast has rounded). A single frame would keep less, since it is no real batch.
    """
    on_event(Progress("dry run (memory)", 0, 2, "passes"))
    tokens, of_two = _pass_some(passing, 2)
    on_event(Progress("dry run (memory)", 1, 2, "passes"))
    _, of_three = _pass_some(passing, 3)
    on_event(Progress("dry run (memory)", 2, 2, "passes"))
    per_frame = of_three - of_two
    return tokens, of_two + (frames - 2) * per_frame


def _pass_some(passing: Passing, frames: int) -> tuple[int, int]:
    """Tokens per frame, and bytes kept by a pass of the first frame repeated `frames` times."""
    settings, policy = passing.settings, passing.policy.train()
    # The same frame repeated, so that passes differ only in the number of frames.
    batch = passing.demos.batch(passing.demos.train[:1].repeat(frames), settings.chunk)
    own: set[int] = set()
    # References keep the storages alive, so that no address is reused meanwhile.
    kept: dict[int, torch.UntypedStorage] = {}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in own:
            kept[storage.data_ptr()] = storage
        # Not the tensor itself: an operation that saves its own result would then keep itself
        # alive.
        return tensor.detach()

    hooks = torch.autograd.graph.saved_tensors_hooks(keep, lambda t: t)
    with passing.seen(), hooks, devices.autocast(policy.backbone.device, settings.precision):
        # A weight that the graph saves takes no additional memory.
        own.update(rows_here(p).untyped_storage().data_ptr() for p in policy.parameters())
        encoding = policy.encode(batch.images, batch.instructions)
        generator = torch.Generator().manual_seed(0)
        loss = policy.flow_loss(batch, encoding, settings.flow_samples, generator, passing.detach)
    if not loss.isfinite():
        found = f"a loss of {loss.item():g} before the first step"
        raise AegisError(found, "a finite loss", "look at the demonstrations: aegis inspect")
    return encoding.mask.shape[1], sum(storage.nbytes() for storage in kept.values())


def _alive(device: torch.device) -> dict[int, torch.UntypedStorage]:
    """The storages of all tensors on a device by address, including uncollected garbage.

    References keep them alive, so that no address is reused meanwhile.
    """
    tensors = [thing for thing in gc.get_objects() if type(thing) in (Tensor, nn.Parameter)]
    storages = [t.untyped_storage() for t in map(rows_here, tensors)]
    return {s.data_ptr(): s for s in storages if s.device.type == device.type}


def _held(training: TrainingRun, there: Mapping[int, torch.UntypedStorage]) -> int:
    """Bytes that the method keeps throughout the run."""
    weights = [*training.policy.parameters(), *training.policy.buffers()]
    known = [*weights, *training.average.weights.values()]
    known += [*training.demos.held, *_plain(training)]
    # Tensors from before anything was built, and those counted under another name.
    others = there.keys() | {rows_here(t).untyped_storage().data_ptr() for t in known}
    gc.collect()  # garbage does not count as kept
    alive = _alive(training.policy.backbone.device)
    return sum(storage.nbytes() for place, storage in alive.items() if place not in others)


def _memory(training: TrainingRun, held: int, activations: int) -> dict[str, int]:
    """Bytes by purpose at the peak: of a step or, if that takes more, of a checkpoint."""
    learning = [p for p in training.policy.parameters() if p.requires_grad]
    backbone = [p for p in training.policy.backbone.parameters() if p.requires_grad]
    # A pass sees rounded weights beside their masters, and leaves gradients in bfloat16 too. The
    # step has float32 gradients instead of both or, with several passes, float32 sums beside both.
    rounded = training.masters.rounded_bytes
    several = training.recipe.train.accumulate > 1
    on_cpu = training.policy.backbone.device.type == "cpu"
    beside = _bytes(_plain(training)) if on_cpu else 0
    throughout = {
        "weights": _bytes_here(training.policy.parameters()) + rounded + beside,
        "gradients": _bytes_here(learning) + (rounded if several else -rounded),
        "optimizer": optimizers.state_bytes(training.optimizers, here=True),
        "average": _bytes_here(training.average.weights.values()),
        "method": held,
    }
    in_a_step = {
        "anchor gradient": _bytes_here(backbone) if training.parts.penalty is not None else 0,
        "weights before the step": _remembered(training),
        "activations": activations,
    }
    # A checkpoint is written between two steps, when a step's memory is free again: only what it
    # takes beyond that raises the peak.
    more = _while_saving(training) - sum(in_a_step.values())
    return throughout | in_a_step | {"checkpoint": max(0, more)}


def _plain(training: TrainingRun) -> list[Tensor]:
    """The whole weights on the CPU, through which the first process writes sharded ones."""
    return [] if training.plain is None else list(training.plain.parameters())


def _remembered(training: TrainingRun) -> int:
    """Bytes of the copies of weights kept while steps wait for the method to constrain them."""
    parts = training.parts
    if parts.copies:
        return _bytes_here(p for p in training.policy.backbone.parameters() if p.requires_grad)
    if parts.begin is None:
        return 0
    device = training.policy.backbone.device
    there = _alive(device)
    parts.begin()  # called again before the first step
    gc.collect()
    alive = _alive(device)
    return sum(storage.nbytes() for place, storage in alive.items() if place not in there)


def _while_saving(training: TrainingRun) -> int:
    """Bytes that a checkpoint takes beside what is allocated throughout."""
    largest = max(p.nbytes for p in training.policy.parameters())
    if parallel.is_sharded(training.policy):
        # All processes gather one weight after the other; the first one keeps them on its CPU.
        on_cpu = training.policy.backbone.device.type == "cpu" and training.ranks.first
        return _state_bytes(training) + WRITTEN_COPIES * largest if on_cpu else largest
    # A method that has added modules removes them from a copy.
    copied = 0 if training.method.export is None else _plain_bytes(training)
    return copied + WRITTEN_COPIES * largest


# --- time -----------------------------------------------------------------------------------------


def where_it_fits(found: Callable[[], T], ranks: Ranks) -> T | None:
    """The result of `found`; None if a GPU runs out of memory.

    With several processes that is an error, since the others wait in the same step.
    """
    try:
        return found()
    except torch.OutOfMemoryError:
        if ranks.several:
            raise
        return None


def warn_of_preparing(timed: Timed | None, workers: int | None, on_event: OnEvent) -> None:
    """Warn if steps wait for their batches to be prepared."""
    if timed is None:
        return
    splits = (
        "if the model's processor splits images or scales them up, switch that off in its "
        f"configuration ({_SPLITTING})"
    )
    step_s, data_s, prepare_s = (f"{seconds:,.2f}" for seconds in timed)
    if workers is not None and timed.data_s > _LONG_WAIT * timed.step_s:
        text = (
            f"a step waits {data_s} of its {step_s} s for its batch: preparing one takes a thread "
            f"{prepare_s} s, and there are {workers}; {splits}, or set train.workers higher where "
            "there are more cores"
        )
        on_event(Warned("dry run", text))
    # On a CPU the step itself does most of this.
    if workers is None and timed.prepare_s > timed.step_s / 2:
        text = f"preparing a batch takes {prepare_s} s, and a step {step_s} s; {splits}"
        on_event(Warned("dry run", text))


def _timed(training: TrainingRun, on_event: OnEvent) -> Timed:
    """The times of a step, measured on the training's first steps; nothing is written.

    Raises:
        Diverged: a step at which the training would end, too.
    """
    settings, parts = training.recipe.train, training.parts
    least = max(TIMED_STEPS, parts.every, parts.refresh)
    steps, first = to_time(least, settings.steps, training.policy.backbone.device)
    window = train.Window()
    training.policy.train()
    on_event(Progress("dry run", 0, len(steps), "steps"))
    prepare_s = train.preparing_s(training)

    def take(index: int, batch: RobotBatch) -> None:
        train.update(training, index, batch, window)
        on_event(Progress("dry run", index + 1, len(steps), "steps"))

    def wait() -> None:
        train.read_figures(training, window)  # waits until the GPU has finished

    with train.batches_of(training, steps) as batches:
        step_s, data_s = seconds_of(steps, first, batches, take, wait)
    return Timed(step_s, data_s, prepare_s)


def to_time(least: int, most: int, device: torch.device) -> tuple[range, int]:
    """The steps to take so that `least` or more can be timed, and the first of these.

    Args:
        most: number of steps of the training.
    """
    # The first step includes one-time work, and batches are fetched meanwhile: those that a GPU
    # finds ready do not show how long they took, and the next ones may arrive in a burst as large.
    ready = ahead.ready_at_once(device)
    steps = range(min(1 + ready + max(least, ready), most))
    return steps, (1 + ready if 1 + ready < len(steps) else 0)


def seconds_of(
    steps: range,
    first: int,
    batches: Iterator[Any],
    take: Callable[[int, Any], object],
    wait: Callable[[], object],
) -> tuple[float, float]:
    """Mean seconds of a step from `first` on, and of its wait for its batch.

    Args:
        take: takes a step, on its batch.
        wait: waits until the steps taken have ended.
    """
    started_s = data_s = 0.0
    for index in steps:
        if index == first:
            wait()
            started_s, data_s = time.perf_counter(), 0.0
        asked_s = time.perf_counter()
        batch = next(batches)
        data_s += time.perf_counter() - asked_s
        take(index, batch)
    wait()
    count = len(steps) - first
    return (time.perf_counter() - started_s) / count, data_s / count


# --- disk -----------------------------------------------------------------------------------------


class _Disk(NamedTuple):
    """What checkpoints take, in bytes.

    Attributes:
        checkpoints: the most of those still to be written that exist at one time.
    """

    checkpoints: int
    needed: int
    free: int


def _disk(training: TrainingRun, written: Sequence[Path]) -> _Disk:
    """The space that the remaining checkpoints take, and the free space.

    Args:
        written: existing checkpoints.
    """
    to_come, kept = _to_come(training.recipe, written), training.recipe.train.keep_checkpoints
    checkpoints = retention.most_at_once(to_come, len(written), kept)
    # Free space changes meanwhile: all report what the first process, which writes, has seen.
    free = training.ranks.agree(free_disk(training.out))
    return _Disk(checkpoints, checkpoints * _checkpoint_bytes(training), free)


def _to_come(recipe: Recipe, written: Sequence[Path]) -> int:
    """Checkpoints that are still to be written."""
    return _left(recipe.train, recipe.train.checkpoint_every, _done(written))


def _left(settings: Train, every: int, done: int) -> int:
    """How often something is still due that is done every `every` steps and after the last one."""
    if done >= settings.steps:
        return 0
    # Rounded up: it is done after the last step, even if that is no multiple of `every`.
    return -(-settings.steps // every) - done // every


def _done(written: Sequence[Path]) -> int:
    """Steps taken by a run with these checkpoints."""
    return int(written[-1].name) if written else 0


def _checkpoint_bytes(training: TrainingRun) -> int:
    """Bytes of a plain backbone, the expert, and what --resume needs.

    The latter is every trainable weight with its moments, and an anchor gradient that later steps
    share.
    """
    plain = _plain_bytes(training)
    expert = _bytes(_tensors(training.policy.expert))
    backbone = [p for p in training.policy.backbone.parameters() if p.requires_grad]
    reused = _bytes(backbone) if training.parts.refresh > 1 else 0
    return plain + expert + _state_bytes(training) + reused


def _state_bytes(training: TrainingRun) -> int:
    """Bytes of what learns, its average and the optimizer state, over all processes."""
    learning = checkpoint.learning(training.policy).values()
    weights = [*learning, *training.average.weights.values()]
    return _bytes(weights) + optimizers.state_bytes(training.optimizers)


def _plain_bytes(training: TrainingRun) -> int:
    """Bytes of the backbone, which is written in one dtype: the widest of its weights."""
    backbone = training.policy.backbone
    if training.recipe.train.weights == "bf16":
        return _bytes(_tensors(backbone))  # a method's wider terms are merged into these
    wide = structure.widest(backbone.parameters()).itemsize
    widened = 0
    for parameter in backbone.parameters():
        widened += parameter.numel() * (wide - parameter.itemsize)
    return _bytes(_tensors(backbone)) + widened


def _tensors(module: nn.Module) -> Iterable[Tensor]:
    """Each tensor once, however many names it has."""
    found: dict[int | str, Tensor] = {}
    for name, tensor in module.state_dict().items():
        # A process may have no rows of a sharded tensor: then there is no address.
        found.setdefault(rows_here(tensor).data_ptr() or name, tensor)
    return found.values()


def free_disk(out: Path) -> int:
    """Free bytes on the disk of the nearest existing folder above `out`, which must be writable."""
    whole = out.absolute()
    there = next(path for path in (whole, *whole.parents) if path.exists())
    if not there.is_dir() or not os.access(there, os.W_OK):
        raise AegisError(
            f"'{there}' cannot be written to", "a writable folder", "choose another --out"
        )
    return shutil.disk_usage(there).free
