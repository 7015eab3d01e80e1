"""`aegis bench`: the cost of each part, as ratios of alternately measured times and of peak memory.

The ratios are those of this machine.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch

from aegis_cli import methods
from aegis_cli.anchors import measure, moments
from aegis_cli.common import devices, memory
from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.common.processes import WorkerPool
from aegis_cli.core.moments import Moments
from aegis_cli.data.vqa.questions import Question
from aegis_cli.evaluation import bench_runs
from aegis_cli.evaluation.bench_guard import GUARDED, GuardCost, MakeGuard, guard_cost
from aegis_cli.evaluation.bench_runs import NAIVE
from aegis_cli.models import backbones
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.recipes import Anchor, Recipe

_SAMPLES = 70  # questions of the anchor: a step's cost does not depend on their number
# Enough co-training questions that, as in a real run, other processes render them and hold
# OpenGL's memory.
_QUESTIONS = 2500
_MEMORY_TURNS = 3  # the optimizer's state exists from the second step on
T = TypeVar("T")


@dataclass(frozen=True)
class Cost:
    """A training step's time and its process's peak memory, as ratios to naive's.

    `step_s` is the time in seconds, on this machine.
    """

    step_time: float
    peak_memory: float
    step_s: float


@dataclass(frozen=True)
class BenchReport:
    """Medians of `repeats` rounds.

    Each round times every part, each step of a method right next to one of naive's, so that other
    load on the machine slows both equally.

    Attributes:
        anchor_throughput: throughput of measuring an anchor's moments, relative to that of a bare
            forward pass.
        step_time, peak_memory: each method's training step over naive's; step_s: its seconds.
        guard: None for a Hugging Face backbone, and if methods or keys were chosen.
    """

    anchor_throughput: float
    step_time: dict[str, float]
    peak_memory: dict[str, float]
    step_s: dict[str, float]
    guard: GuardCost | None
    batch_size: int
    repeats: int

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def run(
    backbone: str,
    batch_size: int = 32,
    repeats: int = 9,
    on_event: OnEvent = ignore,
    guard: MakeGuard | None = None,
    chosen: Sequence[str] = (),
    overrides: Sequence[str] = (),
) -> BenchReport:
    """Compare the anchor pass with a bare forward, and each method's training step with naive's.

    Each method runs with its defaults unless they are overridden.

    Args:
        guard: the guard's class, passed in since it is built on stages; timed on an embedded VLM.
        chosen: methods; empty: all. `naive` is always among them.
        overrides: `key=value` of the recipe, as for `--set`.

    Raises:
        AegisError: an unknown method or key, or a process that died.
    """
    shared = {
        "backbone": backbone,
        "train": {"batch_size": batch_size},
        "cotrain": {"questions": _QUESTIONS},
    }
    recipes = bench_runs.recipes_by_method(chosen, shared, overrides)
    batch_size = recipes[NAIVE].train.batch_size
    model = backbones.load(backbone).to(devices.pick())
    images, texts = bench_runs.images(batch_size), [bench_runs.INSTRUCTION] * batch_size
    passes = {
        "forward": lambda: _forward(model, images, texts),
        "anchor": lambda: _moments(model, images, texts),
    }
    taken = bench_runs.take_turns("bench anchor", passes, repeats, on_event)
    # One anchor for all methods, with every part that some method reads.
    needed = {part for name in recipes for part in methods.get(name).needs}
    settings = Anchor(
        samples=_SAMPLES, parts=tuple(sorted(needed)) or ("moments",), fisher_samples=7
    )
    with tempfile.TemporaryDirectory() as folder:
        measured = Path(folder) / "anchor.safetensors"
        measure.run(backbone, settings, measured, on_event)
        guarded = None
        plain = not chosen and not overrides
        if guard is not None and plain and backbones.locate(backbone).is_file():
            guarded = guard_cost(
                {name: recipes[name] for name in GUARDED}, measured, guard, on_event, repeats
            )
        costs = compare(recipes, measured, on_event, repeats)
    return BenchReport(
        anchor_throughput=taken["forward"] / taken["anchor"],
        step_time={name: cost.step_time for name, cost in costs.items()},
        peak_memory={name: cost.peak_memory for name, cost in costs.items()},
        step_s={name: cost.step_s for name, cost in costs.items()},
        guard=guarded,
        batch_size=batch_size,
        repeats=repeats,
    )


def compare(
    recipes: Mapping[str, Recipe], anchor: Path, on_event: OnEvent = ignore, repeats: int = 9
) -> dict[str, Cost]:
    """What training by each recipe costs, on random frames.

    Args:
        recipes: by name, including "naive"; `train.method` is the method that each stands for.
        anchor: file with the parts that the methods need.

    Raises:
        AegisError: a recipe and an anchor that do not fit together, or a process that died.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        for task in {recipe.task for recipe in recipes.values()}:
            bench_runs.save_demos(out, task)
        naive_s, ratios = _step_times(recipes, anchor, out, repeats, on_event)
        peaks: dict[str, int] = {}
        for done, (name, recipe) in enumerate(recipes.items(), start=1):
            peaks[name] = in_new_process(peak_memory, recipe, anchor, out)
            on_event(Progress("bench memory", done, len(recipes), "processes"))
    return {
        name: Cost(ratio, peaks[name] / peaks[NAIVE], ratio * naive_s)
        for name, ratio in ratios.items()
    }


# --- time -----------------------------------------------------------------------------------------


def _step_times(
    recipes: Mapping[str, Recipe], anchor: Path, out: Path, repeats: int, on_event: OnEvent
) -> tuple[float, dict[str, float]]:
    """Seconds of one of naive's training steps, and by recipe the ratio of its steps to that.

    This is a function of its own so that its models are freed before memory is measured.
    """
    steps = {name: bench_runs.stepper(recipe, anchor, out) for name, recipe in recipes.items()}
    naive = steps[NAIVE]
    # If naive is the only recipe, it is timed against itself.
    others = {name: one for name, one in steps.items() if name != NAIVE} or {NAIVE: naive}
    naive_s, ratios = bench_runs.beside("bench steps", naive, others, repeats, on_event)
    return naive_s, {name: 1.0 if name == NAIVE else ratios[name] for name in steps}


@torch.inference_mode()
def _forward(model: Backbone, images: torch.Tensor, texts: list[str]) -> object:
    return model.encode(model.prepare(images, texts))


def _moments(
    model: Backbone, images: torch.Tensor, texts: list[str]
) -> tuple[list[Moments], list[Moments]]:
    """What `aegis anchor` does with a batch to measure the moments."""
    questions = [Question("", text, "") for text in texts]
    return moments.measure(model, [(images.numpy(), questions)], len(texts))


# --- memory ---------------------------------------------------------------------------------------


def in_new_process(function: Callable[..., T], *arguments: Any) -> T:
    """Run a function in a new process; return what it returns, raise what it raises.

    Raises:
        AegisError: the process died.
    """
    fix = "free some memory, or use smaller batches"
    with WorkerPool(1, "a process that measures memory", fix) as pool:
        return pool.submit(function, *arguments).result()


def peak_memory(recipe: Recipe, anchor: Path, out: Path) -> int:
    """Peak memory of this process after a few steps in bytes, on the GPU if there is one.

    The peak never falls again, so each recipe needs a new process.
    """
    steps = bench_runs.stepper(recipe, anchor, out)
    for _ in range(_MEMORY_TURNS):
        steps.turn()
    return memory.peak(devices.pick())
