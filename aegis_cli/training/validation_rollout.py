"""How well the policy acts during training: validation episodes beside the validation loss.

They serve to choose checkpoints and learning rates, so they are neither demonstrations nor
evaluation episodes, and their figures are no result. Nothing is trained on them.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from aegis_cli import sim
from aegis_cli.common import gl
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, OnEvent
from aegis_cli.common.ranks import Ranks
from aegis_cli.models.acting import DEFAULT, PLACING, Acting, RolloutReport, longest_s, play
from aegis_cli.models.backbones.compiling import uncompiled
from aegis_cli.models.policy import Policy
from aegis_cli.models.policy_meta import PolicyMeta
from aegis_cli.recipes import Recipe
from aegis_cli.sim.contract import VALIDATION
from aegis_cli.training import checkpoint

_STAGE = "rollout"
_PREFIX = "rollout_"  # of its figures in a metrics line
# A task's possible measures -> the report's field with its interval.
_INTERVALS = {"success": "interval", "mean_return": "return_interval"}
_ENDS = (f"{_PREFIX}low", f"{_PREFIX}high")


@dataclass
class ValidationEpisodes:
    """The episodes that the policy acts in.

    Attributes:
        acting: the policy in training, ready to act with its current weights.
        count: number of episodes, from episode 0 on.
        compiled: whether its passes are compiled.
        seconds: that they took last time.
    """

    acting: Acting
    count: int
    seed: int
    compiled: bool = False
    seconds: float = math.inf

    def figures(self, ranks: Ranks, on_event: OnEvent) -> dict[str, float]:
        """The figures of the current policy for a metrics line.

        Success is in [0, 1], a return is in the task's rewards, and so are the ends of the 95 %
        interval, which a single episode's return does not have. The first process acts and the
        others wait: if episodes were shared, the noise would differ from what `aegis rollout`
        draws.
        """
        started = time.perf_counter()
        report = ranks.by_first(lambda: self._played(on_event))
        self.seconds = time.perf_counter() - started
        return _line(report)

    def longest_s(self, ranks: Ranks) -> float:
        """About how many seconds they take if none ends early."""
        return ranks.by_first(self._longest_s)

    def _played(self, on_event: OnEvent) -> RolloutReport:
        def named(event: Event) -> None:
            placing = event.stage == PLACING
            on_event(event if placing else dataclasses.replace(event, stage=_STAGE))

        # Episodes end one by one, and each remaining number would be another shape to compile.
        with uncompiled(self.compiled):
            return play(
                self.acting, self.count, DEFAULT, VALIDATION, on_event=named, seed=self.seed
            )

    def _longest_s(self) -> float:
        with uncompiled(self.compiled):
            return longest_s(self.acting, self.count, DEFAULT, VALIDATION, self.seed)


def _line(report: RolloutReport) -> dict[str, float]:
    """The figures of a report by their names in a metrics line."""
    found: dict[str, float] = {}
    for measure, interval in _INTERVALS.items():
        value, ends = getattr(report, measure), getattr(report, interval)
        if value is not None:
            found[_PREFIX + measure] = value
            found |= {} if ends is None else dict(zip(_ENDS, ends, strict=True))
    return found


def of_line(line: Mapping[str, Any]) -> dict[str, Any]:
    """The episodes' figures in a metrics line, by their names in a report of `aegis rollout`.

    These are `success` with its `interval`, or `mean_return` with its `return_interval`; nothing if
    no episodes were played.
    """
    found: dict[str, Any] = {}
    for measure, interval in _INTERVALS.items():
        value = line.get(_PREFIX + measure)
        if value is not None:
            ends = [line.get(end) for end in _ENDS]
            found = {measure: value, interval: None if None in ends else ends}
    return found


def chosen(
    recipe: Recipe, policy: Policy, meta: PolicyMeta, ranks: Ranks
) -> ValidationEpisodes | None:
    """The episodes that a recipe's training plays; None if it plays none.

    Args:
        meta: the metadata that a user of the policy needs, such as its task.

    Raises:
        AegisError: the demonstrations are of no simulated task, the task is not installed, or there
            is no OpenGL.
    """
    count, task = recipe.rollout.while_training, meta["task"]
    if count is None:
        return None
    if task is None:
        raise AegisError(
            f"rollout.while_training: {count} with demonstrations of no simulated task",
            "demonstrations of a task in which the policy can act",
            "delete rollout.while_training; --set train.validate_actions=500 shows how far the "
            "policy's actions are from held-out ones; or name the suite as the recipe's task, if "
            "they are LIBERO's",
        )
    cameras = checkpoint.cameras_of(meta, task)
    if ranks.first:  # the others never act
        gl.check()
        sim.make(task, seen_by=cameras)
    acting = Acting(
        policy, task, meta["replan"], cameras, meta.get("ensemble"), checkpoint.sizes_of(meta)
    )
    return ValidationEpisodes(acting, count, recipe.rollout.seed, recipe.train.compile)
