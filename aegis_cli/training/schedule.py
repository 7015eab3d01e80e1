"""Learning rates and data order as pure functions of the step, so that nothing has to be saved."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from aegis_cli.recipes import Train
from aegis_cli.recipes.policy import CONSTANT, COSINE, LINEAR


def warmup_then_decay(
    step: int, steps: int, warmup: int, final_share: float, schedule: str = COSINE
) -> float:
    """The factor on the peak learning rate at `step`, from 0.

    It rises linearly over `warmup` steps, then falls to `final_share`, which the step after the
    last would have.

    Args:
        schedule: one of SCHEDULES: along a cosine, along a line, or not at all.
    """
    if step < warmup:
        return (step + 1) / warmup  # at a rate of 0 the first step would be lost
    if schedule == CONSTANT:
        return 1.0
    progress = min(1.0, (step - warmup) / max(1, steps - warmup))
    left = 1 - progress if schedule == LINEAR else (1 + math.cos(math.pi * progress)) / 2
    return final_share + (1 - final_share) * left


def rate_factor(step: int, settings: Train) -> float:
    """The factor on a training's peak learning rates at `step`, by the plan of that step."""
    # The first plan that the step is still within: what was planned later changes nothing before.
    planned = next((steps for steps in settings.plans if step < steps), settings.steps)
    share, schedule = settings.final_lr_share, settings.schedule
    return warmup_then_decay(step, planned, settings.warmup, share, schedule)


def rate_left(step: int, settings: Train) -> float:
    """What is left of the peak learning rate at `step`: 1 until it is reached."""
    return 1.0 if step < settings.warmup else rate_factor(step, settings)


def moving_steps(steps: int, backbone_until: float) -> int:
    """How many of the steps move the backbone, at least one; in those after it stands still."""
    return max(1, round(backbone_until * steps))


class BatchOrder:
    """Shuffled epochs of `size` rows, dealt `batch` at a time.

    Rows that an epoch leaves over begin the next batch.
    """

    def __init__(
        self, size: int, batch: int, seed: int, shares: Sequence[tuple[int, int]] = ()
    ) -> None:
        """Deal each row once an epoch, or let sets that the rows consist of have shares of it.

        Args:
            shares: of each set, whose rows follow each other, how many it has and how many of an
                epoch's rows are of it; both add up to `size`. Empty: each row comes once.
        """
        self._size, self._batch, self._seed = size, batch, seed
        self._shares = tuple(shares)
        self._epochs: dict[int, np.ndarray] = {}

    def rows(self, step: int) -> np.ndarray:
        """Row indices [batch] int64 of a step."""
        # Epochs follow each other without a gap in one endless sequence, which is cut in batches.
        place = np.arange(step * self._batch, (step + 1) * self._batch)
        epochs, offsets = (place // self._size).tolist(), (place % self._size).tolist()
        # Only the orders of the epochs at hand are kept: one, or those that this batch is cut from.
        # They are replaced whole, for several threads may ask at once.
        known, orders = self._epochs, {}
        for epoch in set(epochs):
            orders[epoch] = known[epoch] if epoch in known else self._shuffle(epoch)
        self._epochs = orders
        return np.array([orders[e][o] for e, o in zip(epochs, offsets, strict=True)])

    def _shuffle(self, epoch: int) -> np.ndarray:
        # A generator of its own for each epoch: a resumed run starts in the middle of any.
        places = np.random.default_rng([self._seed, epoch]).permutation(self._size)
        return self._drawn(epoch)[places] if self._shares else places

    def _drawn(self, epoch: int) -> np.ndarray:
        """The rows of an epoch in their order, of each set as many as its share is.

        A set deals its own shuffled rounds, of which an epoch takes up where the last one ended: so
        its rows come equally often, but for one time, whatever the share.
        """
        first, found = 0, list[np.ndarray]()
        for number, (size, count) in enumerate(self._shares, start=1):
            # The epoch has the set's draws `begin` to `end`, of all that it ever deals. A round is
            # `size` of them, so that they lie in one round or in several.
            begin, end = epoch * count, (epoch + 1) * count
            rounds = range(begin // size, -(-end // size))  # -(-a // b) rounds up
            for each in rounds:
                # The number keeps this generator apart from an epoch's. It starts at 1, because
                # NumPy fills seeds up with zeros: [s, e, 0] would be the generator of [s, e].
                order = np.random.default_rng([self._seed, each, number]).permutation(size)
                start = each * size
                found.append(first + order[max(0, begin - start) : end - start])
            first += size
        # Sorted, so that shares by which each row comes once give the order of no shares at all.
        return np.sort(np.concatenate(found))
