"""Errors of a policy's actions on held-out frames during training, beside the validation loss.

That loss is taken at single steps of the flow; this is the error of the actions that the whole flow
produces, in a readable unit: 1 is the error of always predicting the training mean. For a robot
that is not simulated there is no other such figure during training. Nothing is trained on it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent
from aegis_cli.common.ranks import Ranks
from aegis_cli.data import spread
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.models.action_errors import ActionErrors, mean, predict, training_std
from aegis_cli.models.backbones.compiling import uncompiled
from aegis_cli.models.policy import Policy
from aegis_cli.models.policy_meta import PolicyMeta
from aegis_cli.recipes import Recipe

_STAGE = "actions"
_SEED = 0  # of the flow's noise, the default of `aegis evaluate`
# The figures' names in a metrics line -> in a report of `aegis evaluate`.
_FIGURES = {"action_error": "relative_error", "action_hold": "hold_error"}
_ENDS = ("action_error_low", "action_error_high")


@dataclass
class ValidationActions:
    """Held-out frames for which the policy predicts actions.

    Attributes:
        at: [N], numbers of the frames.
        training_std: [A], the standard deviations that errors are relative to.
        compiled: whether the policy's passes are compiled.
        seconds: seconds that the predictions took the last time.
    """

    demos: Demonstrations
    at: Tensor
    training_std: np.ndarray
    batch_size: int
    compiled: bool = False
    seconds: float = math.inf

    def figures(self, policy: Policy, ranks: Ranks, on_event: OnEvent) -> dict[str, float]:
        """The figures of the current policy for a metrics line.

        An error is the mean squared error over the variance of the training's actions; its 95 %
        interval is by Student's t over episodes. The first process predicts and the others wait: if
        frames were shared, the noise would differ from what `aegis evaluate` draws.
        """
        started = time.perf_counter()
        found = ranks.by_first(lambda: self._compared(policy, on_event))
        self.seconds = time.perf_counter() - started
        return found

    def _compared(self, policy: Policy, on_event: OnEvent) -> dict[str, float]:
        given = policy, self.demos, self.at, _SEED, self.batch_size, _STAGE, on_event
        with uncompiled(self.compiled):
            predicted = predict(*given)
        errors = ActionErrors.of(self.demos, self.at, predicted, self.training_std)
        own = {
            "action_error": mean(errors.relative, errors.valid),
            "action_hold": mean(errors.held, errors.valid),
        }
        found = {name: value for name, value in own.items() if value is not None}
        ends = errors.interval()
        return found if ends is None else found | dict(zip(_ENDS, ends, strict=True))


def of_line(line: Mapping[str, Any]) -> dict[str, Any]:
    """The action errors in a metrics line, by their names in a report of `aegis evaluate`.

    These are `relative_error` with its `relative_interval`, and `hold_error` if actions are
    positions; nothing if no actions were predicted.
    """
    if "action_error" not in line:
        return {}
    found: dict[str, Any] = {own: line.get(name) for name, own in _FIGURES.items()}
    ends = [line.get(end) for end in _ENDS]
    return found | {"relative_interval": None if None in ends else ends}


def chosen(
    recipe: Recipe, policy: Policy, demos: Demonstrations, meta: PolicyMeta
) -> ValidationActions | None:
    """The frames for which a recipe's training predicts actions; None if it predicts none.

    Raises:
        AegisError: the actions never vary, so errors cannot be relative.
    """
    count = recipe.train.validate_actions
    if count is None:
        return None
    std = training_std(policy, meta)
    if not std.any():
        raise AegisError(
            f"train.validate_actions: {count} with actions that never vary",
            "actions of which at least one varies",
            "delete train.validate_actions",
        )
    return held_out(demos, count, std, recipe.train.batch_size, recipe.train.compile)


def held_out(
    demos: Demonstrations,
    most: int,
    training_std: np.ndarray,
    batch_size: int,
    compiled: bool = False,
) -> ValidationActions:
    """At most `most` frames, spread evenly over the held-out episodes."""
    at = demos.validation[spread.rows(len(demos.validation), most)]
    return ValidationActions(demos, at, training_std, batch_size, compiled)
