"""How far a policy's actions are from held-out ones while it trains, beside the validation loss.

That loss is of single steps of the flow; this is of the actions that the whole flow ends with, in
a unit that can be read: 1 is the error of always predicting the training's mean. For a robot that
is not simulated there is no other figure while it trains. Nothing learns from it.
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
_SEED = 0  # of the flow's noise, as `aegis evaluate` has it unless it is told another one
# What a line of metrics calls the figures, and what a report of `aegis evaluate` does.
_FIGURES = {"action_error": "relative_error", "action_hold": "hold_error"}
_ENDS = ("action_error_low", "action_error_high")


@dataclass
class ValidationActions:
    """Held-out frames at which the policy predicts.

    Attributes:
        at: [N], numbers of the frames.
        training_std: [A], the standard deviations that errors are relative to.
        compiled: whether the policy's passes are compiled.
        seconds: that the predictions took the last time.
    """

    demos: Demonstrations
    at: Tensor
    training_std: np.ndarray
    batch_size: int
    compiled: bool = False
    seconds: float = math.inf

    def figures(self, policy: Policy, ranks: Ranks, on_event: OnEvent) -> dict[str, float]:
        """What a line of metrics says of the policy as it is now.

        An error is the mean squared error over the variance of the training's actions; the ends of
        its 95 % interval are by Student's t over episodes. The first process predicts, and the
        others wait: shared frames would have other noise than `aegis evaluate` draws.
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
    """What a line of metrics says of the actions, by the names in a report of `aegis evaluate`.

    That is `relative_error` with its `relative_interval`, and `hold_error` where actions are
    positions; nothing where no actions were predicted.
    """
    if "action_error" not in line:
        return {}
    found: dict[str, Any] = {own: line.get(name) for name, own in _FIGURES.items()}
    ends = [line.get(end) for end in _ENDS]
    return found | {"relative_interval": None if None in ends else ends}


def chosen(
    recipe: Recipe, policy: Policy, demos: Demonstrations, meta: PolicyMeta
) -> ValidationActions | None:
    """The frames at which a recipe's training predicts actions; None where it predicts none.

    Raises:
        AegisError: actions that never vary, so that no error is relative to anything.
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
    """At most so many frames, evenly spread over the held-out episodes."""
    at = demos.validation[spread.rows(len(demos.validation), most)]
    return ValidationActions(demos, at, training_std, batch_size, compiled)
