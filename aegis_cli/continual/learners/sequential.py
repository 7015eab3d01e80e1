"""Full fine-tuning, task after task."""

from __future__ import annotations

from aegis_cli.continual.learners.base import Learner, TaskContext


def begin(context: TaskContext) -> None:
    """Make every parameter trainable."""
    context.model.requires_grad_(True)


LEARNER = Learner(
    "sequential", "all weights, task after task", trains="model", shared=True, begin=begin
)
