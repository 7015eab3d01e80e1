"""What became of one cell of a run or study."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """One cell, that is one training and what it led to.

    Shares in [0, 1], `drop_points` in percentage points, cross-entropy in nats, W2^2 as a mean over
    layers; `wrong_target` is of the seen colours. The baseline is the backbone before training,
    asked the same questions.
    """

    method: str
    accuracy: float
    drop_points: float
    drop_interval: tuple[float, float]
    cross_entropy: float
    success_seen: float | None
    success_held_out: float | None
    wrong_target: float | None
    w2: float | None
    energy_shed: float | None
    leak: float | None
    step_s: float
    step_time_ratio: float | None
    validation_loss: float
    baseline_accuracy: float
    baseline_cross_entropy: float
    majority_accuracy: float
    return_share: float | None = (
        None  # instead of successes, of a task measured by its return: 1 is the highest there is
    )


@dataclass(frozen=True)
class Divergence:
    """A training that met a number that is not finite, after so many good steps; nothing of it is
    measured.
    """

    good_steps: int
