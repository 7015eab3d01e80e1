"""`aegis bench --shape`: the cost of a step of each method and of each anchor part at true size.

The model has random weights (models/backbones/shapes.py). It fits into memory only once, so
measurements follow each other and do not alternate. On a CPU each has a process of its own, since
a process's peak memory never falls; the seconds are CPU time, which other work on the machine
affects least. On a GPU one process measures everything: the peak memory of its tensors is reset for
each measurement, and the seconds are wall time.
"""

from __future__ import annotations

import contextlib
import gc
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import torch

from aegis_cli import methods, recipes
from aegis_cli.anchors import measure
from aegis_cli.common import devices, machine, memory
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.common.processes import WorkerPool
from aegis_cli.evaluation import bench_runs, operations
from aegis_cli.evaluation.bench_runs import NAIVE
from aegis_cli.evaluation.peaks import Peak, peak_of
from aegis_cli.models.backbones import shapes
from aegis_cli.recipes import Recipe
from aegis_cli.training.assemble import TrainingRun

_BYTES = 4 * 4  # per trainable parameter: weight, gradient and two moments in float32
# Questions for an anchor's parts, and questions per pass; a part's time is per question.
_SAMPLES, _AT_ONCE = 8, 2
_SAMPLES_OF_GPU, _AT_ONCE_OF_GPU = 64, 8
_KEPT = 256 * 2**20  # bytes that CUDA's libraries may keep allocated on a GPU
_FIX = "free some memory, use a smaller --shape, or leave methods out with --methods"
T = TypeVar("T")


@dataclass(frozen=True)
class StepCost:
    """A method's training step at that shape; all None if it did not fit into memory.

    Attributes:
        step_s: seconds.
        step_time: seconds over naive's.
        own_share: seconds per step that the method spends between the passes, on the gradient and
            on the update, over naive's step. They are timed separately, and more precise than
            `step_time`, which is the ratio of two medians. None for a method that does nothing
            there; the work of `aegis` on two gradients is not included.
        peak_gb: peak memory of the process, or of the GPU, in 10^9 bytes.
        peak_memory: peak memory over naive's.
        tflop: 10^12 operations of its matrix products.
        mfu: the operations that training needs, as a share of the device's peak. At most naive's
            operations count, since a second backward pass is no use in itself. Under gradient
            checkpointing the second forward pass counts, for naive too. None if the device's peak
            is not known.
    """

    step_s: float | None = None
    step_time: float | None = None
    own_share: float | None = None
    peak_gb: float | None = None
    peak_memory: float | None = None
    tflop: float | None = None
    mfu: float | None = None


@dataclass(frozen=True)
class PartCost:
    """What a part of an anchor cost.

    Attributes:
        question_s: seconds per question.
        peak_gb: peak memory in 10^9 bytes.
        megabytes: size of its file, in 10^6 bytes.
    """

    question_s: float
    peak_gb: float
    megabytes: float


@dataclass(frozen=True)
class ShapeReport:
    """Costs at a true shape.

    Attributes:
        parameters: the backbone's, in millions.
        device: its name; clock: which kind of seconds is measured.
        assumed: the peak that the MFU is relative to, and its device; None if it is not known.
        tokens: number of tokens of a frame with its instruction in the language model.
        turns: how often a method's steps between two constraints were timed; the time is the
            median.
        questions: number of questions on which each part of the anchor was measured.
    """

    shape: str
    parameters: int
    device: str
    threads: int
    clock: str
    assumed: Peak | None
    batch_size: int
    precision: str
    weights: str
    tokens: int
    turns: int
    questions: int
    methods: dict[str, StepCost]
    anchor: dict[str, PartCost]

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True)
class _Measured:
    """What a process measured."""

    seconds: float
    peak: int
    own: float | None = None
    flop: int = 0
    tokens: int = 0
    megabytes: float = 0.0


def run(
    shape: str,
    chosen: Sequence[str] = (),
    batch_size: int = 2,
    turns: int = 2,
    overrides: Sequence[str] = (),
    on_event: OnEvent = ignore,
) -> ShapeReport:
    """Measure each method's step at a shape, and the parts of an anchor that the methods read.

    Args:
        shape: one of `shapes.SHAPES`.
        chosen: methods; empty: all. `naive` is always among them.
        turns: how often the steps between two constraints are timed.
        overrides: `key=value` of the recipe, as for `--set`.

    Raises:
        AegisError: an unknown shape, method or key, or a shape that cannot fit into memory.
    """
    recipes_by_name = bench_runs.recipes_by_method(chosen, _shared(shape, batch_size), overrides)
    names = list(recipes_by_name)
    _check_fits(shapes.get(shape))
    parts = sorted({part for name in names for part in methods.get(name).needs})
    measured: dict[str, _Measured | None] = {}  # parts; None did not fit into memory
    found: dict[str, _Measured | None] = {}  # methods, likewise

    def tell(name: str, last: _Measured | None) -> None:
        """Report the progress and the last measurement, which an interruption would lose."""
        done, total = len(measured) + len(found), len(parts) + len(names)
        figures = {} if last is None else {f"{name} s": last.seconds, "GB": last.peak / 1e9}
        on_event(Progress("bench shape", done, total, "processes", figures))

    with tempfile.TemporaryDirectory() as folder, _Processes() as processes:
        out = Path(folder)
        for part in parts:
            measured[part] = processes.run(_measure_part, f"random:{shape}", part, out)
            tell(part, measured[part])
        for name, recipe in recipes_by_name.items():
            lacks = any(measured[part] is None for part in methods.get(name).needs)
            found[name] = None if lacks else processes.run(_measure_method, recipe, out, turns)
            tell(name, found[name])
    costs = {part: _part_cost(each) for part, each in measured.items() if each is not None}
    return _report(shape, recipes_by_name[NAIVE].train, turns, found, costs)


def _report(
    shape: str,
    used: recipes.Train,
    turns: int,
    found: Mapping[str, _Measured | None],
    costs: dict[str, PartCost],
) -> ShapeReport:
    """The costs, compared with naive's.

    Args:
        used: naive's settings, which all methods share.

    Raises:
        AegisError: naive did not fit into memory.
    """
    naive = found[NAIVE]
    if naive is None:
        raise AegisError(f"naive at the shape '{shape}' ran out of memory", "more memory", _FIX)
    on_gpu = devices.on_gpu()
    precision = devices.precision_taken(devices.pick(), used.precision)
    assumed = peak_of(torch.cuda.get_device_name(), precision == "bf16") if on_gpu else None
    about = machine.describe()
    return ShapeReport(
        shape=shape,
        parameters=shapes.get(shape).parameters,
        device=str(about["gpu"] if on_gpu else about["processor"]),
        threads=int(about["threads"]),
        clock="wall" if on_gpu else "cpu",
        assumed=assumed,
        batch_size=used.batch_size,
        precision=precision,
        weights=used.weights,
        tokens=naive.tokens,
        turns=turns,
        questions=_samples(),
        methods={name: _cost(each, naive, assumed) for name, each in found.items()},
        anchor=costs,
    )


def _shared(shape: str, batch_size: int) -> dict[str, Any]:
    """What the recipes of all methods at that shape have in common."""
    return {
        "backbone": f"{shapes.PREFIX}{shape}",
        "train": {"batch_size": batch_size},
        "cotrain": {"batch_size": batch_size, "questions": max(batch_size, _SAMPLES)},
        "insulate": {"batch_size": batch_size, "questions": max(batch_size, _SAMPLES)},
    }


def _check_fits(shape: shapes.Shape) -> None:
    """Refuse a shape for which even naive's step cannot fit, before anything is built."""
    free, need = memory.free(devices.pick()), shape.parameters * 1e6 * _BYTES
    if free is not None and need > free:
        raise AegisError(
            f"{shape.parameters:,} million parameters, which need {need / 1e9:.1f} GB to train, "
            f"where {free / 1e9:.1f} GB are free",
            "memory for weights, gradients and the optimizer's states",
            _FIX,
        )


# --- in processes of their own --------------------------------------------------------------------


class _Processes:
    """Runs each measurement in a `with` block: on a CPU, each in a new process.

    On a GPU one process is reused until its memory is full, or something stays allocated there.
    """

    def __init__(self) -> None:
        self._open = contextlib.ExitStack()
        self._pool: WorkerPool | None = None

    def __enter__(self) -> _Processes:
        return self

    def __exit__(self, *error: Any) -> None:
        self._open.__exit__(*error)

    def run(self, work: Callable[..., T], *arguments: Any) -> T | None:
        """What `work` returns; None if a GPU had too little memory."""
        if self._pool is None:
            pool = WorkerPool(1, "a process of the benchmark", _FIX)
            self._pool = self._open.enter_context(pool)
        found, as_new = self._pool.submit(_unless_full, work, *arguments).result()
        if not as_new:
            self._open.close()
            self._pool = None
        return found


def _unless_full(work: Callable[..., T], *arguments: Any) -> tuple[T | None, bool]:
    """What `work` returns, or None if memory ran out; and whether this process can be reused."""
    try:
        memory.restart_peak(devices.pick())
        found = work(*arguments)
    except torch.OutOfMemoryError:
        return None, False
    if not devices.on_gpu():
        return found, False  # a process's peak never falls again
    gc.collect()
    torch.cuda.empty_cache()
    return found, torch.cuda.memory_allocated() <= _KEPT


def _measure_part(backbone: str, part: str, out: Path) -> _Measured:
    """Measure a part of the anchor, and write it for the methods."""
    count, at_once = _samples(), _AT_ONCE_OF_GPU if devices.on_gpu() else _AT_ONCE
    settings = recipes.Anchor(
        samples=count, fisher_samples=count, batch_size=at_once, parts=(part,)
    )
    start = _now()
    # Saved progress is not used, since the time is measured.
    report = measure.run(backbone, settings, _anchor(out, [part]), keep=False)
    seconds = report.seconds[part] if devices.on_gpu() else _now() - start
    return _Measured(seconds, memory.peak(devices.pick()), megabytes=report.megabytes)


def _measure_method(recipe: Recipe, out: Path, turns: int) -> _Measured:
    """Measure a method's step: time and peak memory of some turns after the first one.

    Operations are counted in a later turn, after the peak is read, since counting takes memory too.
    """
    needs = methods.get(recipe.train.method).needs
    bench_runs.save_demos(out, recipe.task)
    anchor = _anchor(out, needs) if needs else None
    run, batch = bench_runs.begun(recipe, anchor, out)
    steps = bench_runs.Steps(run, batch)
    steps.turn()
    times = [_seconds(steps.turn)[0] / steps.in_turn for _ in range(turns)]
    needed = memory.peak(devices.pick())
    own = _own_seconds(run, steps.turn)
    with operations.counter() as counter:
        steps.turn()
    prepared = run.policy.backbone.prepare(batch.images[:1], batch.instructions[:1])
    tokens = prepared.ids.shape[1]
    flop = counter.get_total_flops() // steps.in_turn
    own = None if own is None else own / steps.in_turn
    return _Measured(statistics.median(times), needed, own, flop, tokens)


def _own_seconds(run: TrainingRun, turn: Callable[[], None]) -> float | None:
    """Seconds that the method spends between the passes, in one more turn; None if none.

    This is its work on the gradient before the optimizer's step and on the update after it,
    including copies of the weights. On a GPU timing it requires waiting, so the time of a whole
    step comes from other turns.
    """
    parts, stepper = run.parts, run.stepper
    if not parts.constrains and parts.pull is None:
        return None
    seconds: list[float] = []

    def timed(work: Callable[..., T]) -> Callable[..., T]:
        def measured(*given: Any) -> T:
            taken, result = _seconds(work, *given)
            seconds.append(taken)
            return result

        return measured

    # A training step calls the method for the gradient, for the rates, and before and after the
    # optimizer's step, where the weights are copied and the update is constrained.
    run.parts = replace(
        parts,
        pull=parts.pull and timed(parts.pull),
        shares=parts.shares and timed(parts.shares),
    )
    stepper.begin, stepper.end = timed(stepper.begin), timed(stepper.end)  # type: ignore
    turn()
    return sum(seconds)


def _seconds(work: Callable[..., T], *arguments: Any) -> tuple[float, T]:
    """How long the work takes if nothing else is queued on the device, and what it returns."""
    bench_runs.wait()
    start = _now()
    result = work(*arguments)
    bench_runs.wait()
    return _now() - start, result


def _anchor(out: Path, parts: Sequence[str] | frozenset[str]) -> Path:
    return out / f"{'-'.join(sorted(parts))}.safetensors"


def _samples() -> int:
    return _SAMPLES_OF_GPU if devices.on_gpu() else _SAMPLES


def _now() -> float:
    return time.perf_counter() if devices.on_gpu() else time.process_time()


# --- costs ----------------------------------------------------------------------------------------


def _part_cost(found: _Measured) -> PartCost:
    return PartCost(found.seconds / _samples(), found.peak / 1e9, found.megabytes)


def _cost(found: _Measured | None, naive: _Measured, assumed: Peak | None) -> StepCost:
    if found is None:
        return StepCost()
    mfu = None
    if assumed is not None:
        # Operations that a step needs, over those that the device could have done in that time.
        mfu = min(found.flop, naive.flop) / (found.seconds * assumed.tflops * 1e12)
    return StepCost(
        step_s=found.seconds,
        step_time=found.seconds / naive.seconds,
        own_share=None if found.own is None else found.own / naive.seconds,
        peak_gb=found.peak / 1e9,
        peak_memory=found.peak / naive.peak,
        tflop=found.flop / 1e12,
        mfu=mfu,
    )
