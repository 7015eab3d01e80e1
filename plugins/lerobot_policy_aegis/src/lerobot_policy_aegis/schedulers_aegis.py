"""The learning-rate schedule of `aegis train`, for `lerobot-train`."""

from __future__ import annotations

import logging
from dataclasses import dataclass

from lerobot.optim import LRSchedulerConfig
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from aegis_cli.training.schedule import warmup_then_decay


@LRSchedulerConfig.register_subclass("aegis")
@dataclass
class AegisSchedulerConfig(LRSchedulerConfig):
    """A warm-up, then a cosine decay to a fraction of the peak at the end of training.

    LeRobot's own cosine shortens the warm-up if training is shorter than planned: 100 steps of
    30,000 become 5 of 1,500.

    Attributes:
        num_warmup_steps: steps over which the learning rates rise; never shortened.
        num_decay_steps: step at which the decay ends; None: the end of training.
        final_lr_share: fraction of the peak rates at the end of the decay.
    """

    num_warmup_steps: int = 100
    num_decay_steps: int | None = None
    final_lr_share: float = 0.1

    def build(self, optimizer: Optimizer, num_training_steps: int) -> LambdaLR:
        """The schedule for an optimizer whose groups have their peak rates as learning rates."""
        steps = self.num_decay_steps or num_training_steps
        if self.num_warmup_steps >= num_training_steps:
            logging.getLogger(__name__).warning(
                "The learning rates rise over %d steps, and the training has %d: they never fall. "
                "Lower --policy.warmup_steps (or --scheduler.num_warmup_steps).",
                self.num_warmup_steps,
                num_training_steps,
            )

        def factor(step: int) -> float:
            return warmup_then_decay(step, steps, self.num_warmup_steps, self.final_lr_share)

        return LambdaLR(optimizer, factor)
