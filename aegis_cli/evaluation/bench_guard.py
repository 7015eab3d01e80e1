"""What the guard costs in a user's loop, timed against `aegis train` and a plain backward pass."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from aegis_cli.common import devices
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.evaluation import bench_runs
from aegis_cli.recipes import Recipe

GUARDED = ("aegis", "nullspace", "kfac")  # the methods that the guard has
# Makes an `aegis_cli.Guard` from model, anchor, layers and options.
MakeGuard = Callable[..., Any]


@dataclass(frozen=True)
class GuardCost:
    """What the guard costs in a plain loop over the embedded VLM, as ratios.

    `step_time` is a whole step of that loop over a step of `aegis train` with the same method.
    `backward` is `guard.backward` with the method `aegis` (two backward passes and a projection)
    over `loss.backward()`.
    """

    step_time: dict[str, float]
    backward: float


def guard_cost(
    recipes: Mapping[str, Recipe],
    anchor: Path,
    make: MakeGuard,
    on_event: OnEvent = ignore,
    repeats: int = 9,
) -> GuardCost:
    """Time the guard against training and against a plain backward pass, all in the same rounds.

    Args:
        recipes: by method, including `aegis`.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        parts: dict[str, Callable[[], object]] = {}
        before: dict[str, Callable[[], object]] = {}
        for name, recipe in recipes.items():
            bench_runs.save_demos(out, recipe.task)
            training = bench_runs.stepper(recipe, anchor, out)
            loop = _PlainLoop(recipe, anchor, out, make)
            parts[f"train {name}"] = training.turn
            parts[f"guard {name}"] = partial(loop.steps, training.in_turn)
            if name == "aegis":
                parts |= {"backward": loop.plain_backward, "guard.backward": loop.backward}
                # A backward pass frees its graph, so each follows a forward pass, which is untimed.
                before |= {"backward": loop.forward, "guard.backward": loop.forward}
        seconds = bench_runs.take_turns("bench guard", parts, repeats, on_event, before)
    return GuardCost(
        {name: seconds[f"guard {name}"] / seconds[f"train {name}"] for name in recipes},
        seconds["guard.backward"] / seconds["backward"],
    )


class _PlainLoop:
    """A user's loop with a guard, built from the parts of a training run, always on one batch."""

    def __init__(self, recipe: Recipe, anchor: Path, out: Path, make: MakeGuard) -> None:
        self._run, self._batch = bench_runs.begun(recipe, anchor, out)
        (self._optimizer,) = self._run.optimizers
        backbone, method = self._run.policy.backbone, self._run.method.name
        self._guard = make(
            backbone,
            anchor,
            "layers",
            method=method,
            vision="stem",
            **asdict(getattr(recipe, method)),
        )
        with torch.no_grad():
            seen = self._run.policy.encode(self._batch.images, self._batch.instructions)
        self._mask, self._image = seen.mask, seen.image

    def forward(self) -> None:
        """Clear the gradients and compute a loss."""
        settings, policy, batch = self._run.recipe.train, self._run.policy, self._batch
        # A plain backward pass leaves the watched pass unused, which the guard would refuse.
        self._guard.discard()
        self._optimizer.zero_grad()
        with devices.autocast(policy.backbone.device, settings.precision):
            with self._guard.watch(self._mask, self._image):
                encoding = policy.encode(batch.images, batch.instructions)
            generator = torch.Generator().manual_seed(0)
            self._loss = policy.flow_loss(batch, encoding, settings.flow_samples, generator)

    def plain_backward(self) -> None:
        self._loss.backward()

    def backward(self) -> None:
        self._guard.backward(self._loss)

    def steps(self, count: int) -> None:
        """Take `count` steps of the loop."""
        for _ in range(count):
            self.forward()
            self.backward()
            torch.nn.utils.clip_grad_norm_(self._run.learning, self._run.recipe.train.clip_norm)
            self._guard.step(self._optimizer)
