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
    """The factor on the peak learning rate at `step`, counted from 0.

    It rises linearly over `warmup` steps, then falls to `final_share`, which is reached at the step
    after the last one.

    Args:
        schedule: one of SCHEDULES: it falls along a cosine, linearly, or not at all.
    """
    if step < warmup:
        return (step + 1) / warmup  # a first step with rate 0 would do nothing
    if schedule == CONSTANT:
        return 1.0
    progress = min(1.0, (step - warmup) / max(1, steps - warmup))
    left = 1 - progress if schedule == LINEAR else (1 + math.cos(math.pi * progress)) / 2
    return final_share + (1 - final_share) * left


def rate_factor(step: int, settings: Train) -> float:
    """The factor on a run's peak learning rates at `step`, by the plan that covers the step."""
    # The first plan that still includes the step: later plans do not change earlier steps.
    planned = next((steps for steps in settings.plans if step < steps), settings.steps)
    share, schedule = settings.final_lr_share, settings.schedule
    return warmup_then_decay(step, planned, settings.warmup, share, schedule)


def rate_left(step: int, settings: Train) -> float:
    """The share of the peak learning rate at `step`: 1 during the warmup."""
    return 1.0 if step < settings.warmup else rate_factor(step, settings)


def moving_steps(steps: int, backbone_until: float) -> int:
    """How many of the steps, at least one, update the backbone; it is frozen in later steps."""
    return max(1, round(backbone_until * steps))


class BatchOrder:
    """Shuffled epochs of `size` rows, dealt `batch` at a time.

    Rows left over at the end of an epoch begin the next batch.
    """

    def __init__(
        self, size: int, batch: int, seed: int, shares: Sequence[tuple[int, int]] = ()
    ) -> None:
        """Deal each row once per epoch, or give each set of rows a share of the epoch.

        Args:
            shares: for each set, whose rows are consecutive, its number of rows and how many of an
                epoch's rows come from it; each of the two adds up to `size`. Empty: each row comes
                once.
        """
        self._size, self._batch, self._seed = size, batch, seed
        self._shares = tuple(shares)
        self._epochs: dict[int, np.ndarray] = {}

    def rows(self, step: int) -> np.ndarray:
        """Row indices [batch] int64 of a step."""
        # Epochs follow each other in one endless sequence, which is cut into batches.
        place = np.arange(step * self._batch, (step + 1) * self._batch)
        epochs, offsets = (place // self._size).tolist(), (place % self._size).tolist()
        # Only the orders of the epochs that this batch is cut from are kept. The dict is replaced
        # as a whole, since several threads may ask at once.
        known, orders = self._epochs, {}
        for epoch in set(epochs):
            orders[epoch] = known[epoch] if epoch in known else self._shuffle(epoch)
        self._epochs = orders
        return np.array([orders[e][o] for e, o in zip(epochs, offsets, strict=True)])

    def _shuffle(self, epoch: int) -> np.ndarray:
        # Each epoch has its own generator: a resumed run may start in the middle of any.
        places = np.random.default_rng([self._seed, epoch]).permutation(self._size)
        return self._drawn(epoch)[places] if self._shares else places

    def _drawn(self, epoch: int) -> np.ndarray:
        """The sorted rows of an epoch, from each set as many as its share.

        A set is dealt in shuffled rounds, and an epoch continues where the last one ended: so the
        counts of its rows never differ by more than one, whatever the share.
        """
        first, found = 0, list[np.ndarray]()
        for number, (size, count) in enumerate(self._shares, start=1):
            # The epoch takes the draws `begin` to `end` of the set's endless sequence. A round has
            # `size` draws, so these lie in one round or in several.
            begin, end = epoch * count, (epoch + 1) * count
            rounds = range(begin // size, -(-end // size))  # -(-a // b) rounds up
            for each in rounds:
                # The number distinguishes this generator from an epoch's. It starts at 1, because
                # NumPy pads seeds with zeros: [s, e, 0] would be the generator of [s, e].
                order = np.random.default_rng([self._seed, each, number]).permutation(size)
                start = each * size
                found.append(first + order[max(0, begin - start) : end - start])
            first += size
        # Sorted, so that shares with which each row comes once give the same order as no shares.
        return np.sort(np.concatenate(found))
