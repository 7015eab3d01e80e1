"""What `aegis bench` times: steps of runs on random frames, alternating between runs."""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from aegis_cli import methods, recipes
from aegis_cli.common import artifacts, devices
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.data.batch import RobotBatch
from aegis_cli.recipes import Demos, Recipe
from aegis_cli.training import assemble, train
from aegis_cli.training.assemble import TrainingRun

INSTRUCTION = "move the finger to the red target"
_ACTIONS, _PROPRIO, _FRAMES = 2, 6, 64  # A, P, and frames per episode
NAIVE = "naive"  # the reference for the others


def recipes_by_method(
    chosen: Sequence[str], shared: Mapping[str, Any], overrides: Sequence[str]
) -> dict[str, Recipe]:
    """A recipe for each method in the order of tables, with its defaults unless overridden.

    Args:
        chosen: methods; empty: all. `naive` is always among them.
        shared: what all have in common, as in a recipe's file.
        overrides: `key=value` of the recipe, as for `--set`.

    Raises:
        AegisError: an unknown method or key, or a key that would make the methods equal.
    """
    for name in chosen:
        methods.get(name)
    found = {}
    for name in methods.METHODS:
        if chosen and name not in {NAIVE, *chosen}:
            continue
        train_keys = {**shared.get("train", {}), "method": name}
        found[name] = recipes.from_mapping({**shared, "name": name, "train": train_keys}, overrides)
        if found[name].train.method != name or found[name].backbone != shared["backbone"]:
            raise AegisError(
                "a key that the bench chooses itself",
                "no train.method and no backbone in --set",
                "give --methods for the methods, and --backbone or --shape for the backbone",
            )
    return found


def take_turns(
    stage: str,
    parts: Mapping[str, Callable[[], object]],
    repeats: int,
    on_event: OnEvent,
    before: Mapping[str, Callable[[], object]] = {},
) -> dict[str, float]:
    """Median seconds of each part over `repeats` rounds, after one warm-up round.

    What runs `before` a part is not timed.
    """
    times: dict[str, list[float]] = {name: [] for name in parts}
    for i in range(repeats + 1):
        for name, part in parts.items():
            if name in before:
                before[name]()
                wait()
            start = time.perf_counter()
            part()
            wait()  # when the call returns, a GPU's kernels are only queued
            times[name].append(time.perf_counter() - start)
        on_event(Progress(stage, i + 1, repeats + 1, "rounds"))
    return {name: statistics.median(taken[1:]) for name, taken in times.items()}


def wait() -> None:
    """Wait until the GPU has finished its queued work."""
    if devices.on_gpu():
        torch.cuda.synchronize()


def beside(
    stage: str,
    reference: Steps,
    others: Mapping[str, Steps],
    rounds: int,
    on_event: OnEvent,
) -> tuple[float, dict[str, float]]:
    """Seconds of one of the reference's steps, and the ratio of the others' steps to it.

    Each step of another run is timed right next to one of the reference's. A machine's speed drifts
    by a tenth within seconds, which would look like a difference if they were timed further apart.

    Args:
        others: by name. In a round each takes whole turns, and at least as many steps as the
            longest turn has, since the ratio of fewer steps varies more.

    Returns:
        Medians over `rounds` rounds, after one warm-up round.
    """
    # All take as many steps as the longest turn has, rounded up to whole turns of each.
    most = max(one.in_turn for one in others.values())
    ratios: dict[str, list[float]] = {name: [] for name in others}
    step_s: list[float] = []
    turns = [(done, name) for done in range(rounds + 1) for name in others]
    for number, (done, name) in enumerate(turns, 1):
        in_turn = others[name].in_turn
        count = math.ceil(most / in_turn) * in_turn
        own_s, reference_s = _alternating(others[name], reference, count)
        if done > 0:  # the first round warms up
            ratios[name].append(own_s / reference_s)
            step_s.append(reference_s / count)
        on_event(Progress(stage, number, len(turns), "turns"))
    medians = {name: statistics.median(found) for name, found in ratios.items()}
    return statistics.median(step_s), medians


def _alternating(first: Steps, second: Steps, count: int) -> tuple[float, float]:
    """Seconds of `count` steps of each of two runs, taken in the order a b, b a, a b and so on.

    So neither is always the first of a pair, and a steady drift cancels. On a GPU, whose clock is
    steady, each takes all its steps in one go, since training does not wait for each step.
    """
    at_once = count if devices.on_gpu() else 1
    both, taken_s = (first, second), [0.0, 0.0]
    for pair in range(count // at_once):
        for which in (0, 1) if pair % 2 == 0 else (1, 0):
            start = time.perf_counter()
            for _ in range(at_once):
                both[which].one()
            wait()
            taken_s[which] += time.perf_counter() - start
    return taken_s[0], taken_s[1]


class Steps:
    """The steps of a training run, as `aegis train` takes them, all on one batch.

    Attributes:
        in_turn: number of steps in a turn: as many as share one constraint of the update and one
            anchor gradient, so that every turn pays for one of each.
    """

    def __init__(self, run: TrainingRun, batch: RobotBatch) -> None:
        self._run, self._batch = run, batch
        self._taken, self._window = 0, train.Window()
        self.in_turn = math.lcm(run.parts.every, run.parts.refresh)

    def one(self) -> None:
        """Take a step; the last step of a turn reads the turn's figures."""
        train.update(self._run, self._taken, self._batch, self._window)
        self._taken += 1
        if self._taken % self.in_turn == 0:
            train.read_figures(self._run, self._window)

    def turn(self) -> None:
        """Take the steps of one turn."""
        for _ in range(self.in_turn):
            self.one()


def stepper(recipe: Recipe, anchor: Path, out: Path) -> Steps:
    """The steps of a run by a recipe."""
    return Steps(*begun(recipe, anchor, out))


def begun(recipe: Recipe, anchor: Path | None, out: Path) -> tuple[TrainingRun, RobotBatch]:
    """A run before its first step, and a batch of noise for it, whatever data the recipe names."""
    recipe = dataclasses.replace(unmoved(recipe), demos=Demos())
    run = assemble.build(
        recipe,
        methods.get(recipe.train.method),
        demos_file(out, recipe.task),
        anchor,
        out / "run",
        ignore,
    )
    run.policy.train()
    # Frames repeat if a batch is larger than the episode: only their number affects the cost.
    rows = torch.arange(recipe.train.batch_size) % len(run.demos.train)
    frames, device = run.demos.train[rows], run.policy.backbone.device
    batch = run.demos.batch(frames, recipe.train.chunk)
    if devices.reading_stalls(device):
        # In training it is on the GPU before the step begins.
        batch = train.prepared(run, batch, frames, 0).with_prepared_on(device)
    return run, batch


def unmoved(recipe: Recipe) -> Recipe:
    """The recipe with learning rates of 0, whose steps take the same time.

    With a study's own rates, a variant that diverges would have no costs.
    """
    still = dataclasses.replace(recipe.train, backbone_lr=0.0, expert_lr=0.0)
    return dataclasses.replace(recipe, train=still)


def images(count: int) -> torch.Tensor:
    """Images of noise, [count, 64, 64, 3] uint8."""
    generator = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, (count, 64, 64, 3), dtype=torch.uint8, generator=generator)


def demos_file(out: Path, task: str) -> Path:
    return out / f"{task.replace('/', '-')}.safetensors"


def save_demos(out: Path, task: str) -> None:
    """Two episodes of noise, one to train on and one to hold out.

    What the frames show does not change the cost.
    """
    generator, count = torch.Generator().manual_seed(0), 2 * _FRAMES
    artifacts.save(
        demos_file(out, task),
        "demos",
        {
            "frames": images(count),
            "proprio": torch.randn(count, _PROPRIO, generator=generator),
            "actions": torch.randn(count, _ACTIONS, generator=generator),
            "episode_starts": torch.arange(3) * _FRAMES,
            "instruction": torch.zeros(2, dtype=torch.int64),
            "target_color": torch.zeros(2, dtype=torch.int64),
        },
        meta={
            "task": task,
            "instructions": [INSTRUCTION],
            "colors": ["red"],
            "control_hz": 1,
            "action_names": [f"action {i}" for i in range(_ACTIONS)],
            "proprio_names": [f"proprio {i}" for i in range(_PROPRIO)],
        },
    )
