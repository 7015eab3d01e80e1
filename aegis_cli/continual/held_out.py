"""Evaluation of tasks without a simulator: the error of actions at frames of held-out episodes.

The error is that of `aegis evaluate` and `train.validate_actions`, on the same frames after every
task. It takes the place of the success rate.
"""

from __future__ import annotations

import numpy as np
import torch

from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent
from aegis_cli.common.ranks import Ranks
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.models.action_errors import ActionErrors, mean
from aegis_cli.models.policy import Policy
from aegis_cli.training import validation_actions


class HeldOut:
    """Held-out frames of one task, at which a policy predicts.

    Attributes:
        hold_error: the error of repeating the current position; None if actions are not positions.
    """

    def __init__(
        self, task: str, demos: Demonstrations, most: int, batch_size: int, chunk: int
    ) -> None:
        """Choose the frames.

        Args:
            most: the maximum number of frames, evenly spread.
            chunk: the number of actions predicted at each frame.

        Raises:
            AegisError: the actions never vary, so there is no variance to divide errors by.
        """
        std = np.array(demos.action_std)
        if not std.any():
            raise AegisError(
                f"demonstrations of '{task}' whose actions never vary",
                "actions of which at least one varies, to measure errors by",
                "choose the actions by demos.action, or give other demonstrations",
            )
        self._frames = validation_actions.held_out(demos, most, std, batch_size)
        # The error of holding the position does not depend on the prediction.
        anything = torch.zeros(len(self._frames.at), chunk, len(std))
        errors = ActionErrors.of(demos, self._frames.at, anything, std)
        self.hold_error = mean(errors.held, errors.valid)

    def error(self, policy: Policy, on_event: OnEvent) -> tuple[float, list[float] | None]:
        """The policy's mean squared error, divided by the variance of the training actions.

        Returns:
            The error, and its 95 % interval by Student's t over episodes (None for one episode).
        """
        found = validation_actions.of_line(self._frames.figures(policy, Ranks(), on_event))
        return found["relative_error"], found["relative_interval"]
