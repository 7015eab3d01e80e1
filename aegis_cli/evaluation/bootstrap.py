"""The crossed bootstrap: an interval for figures that vary by seed and by what is asked.

A figure over seeds varies because training varies, and because the questions, images or episodes
are a random sample too. If all seeds are measured on the same images, an image's difficulty affects
every seed's figure, and an interval over seeds alone does not cover it.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from aegis_cli.common.estimates import LEVEL

if TYPE_CHECKING:  # tables of finished studies are shown without NumPy
    import numpy as np

RESAMPLES = 2000
_AT_ONCE = 250  # resamples held in memory together
FEW = 10  # with fewer images or episodes that differ from the others, resamples tell too little


@dataclass(frozen=True)
class Units:
    """What one seed was measured on: images with their questions, or episodes.

    Attributes:
        values: [N] float64, each unit's sum.
        counts: [N] float64, the number of questions or episodes in each sum.
        draw: seeds with the same draw were measured on the same units, in the same order.
        reach: how far two questions or episodes can be apart; None if unlimited.
        sure: whether no other outcome was possible, as for a model that has not moved.
        names: N names that identify units across draws; None if no other draw shares them.
    """

    values: np.ndarray
    counts: np.ndarray
    draw: int = 0
    reach: float | None = 100.0
    sure: bool = False
    names: tuple[str, ...] | None = None

    def minus(self, other: Units) -> Units | None:
        """The paired difference; None if the other was measured on other units."""
        import numpy as np

        same = self.draw == other.draw and self.names == other.names
        if not same or not np.array_equal(self.counts, other.counts):
            return None
        sure = self.sure and other.sure
        return replace(self, values=self.values - other.values, sure=sure)


def crossed_interval(seeds: Sequence[Units], seed: int = 0) -> tuple[float, float] | None:
    """95 % interval of the mean over seeds of each seed's mean over units.

    Seeds and units are drawn with replacement, independently of each other, and a unit once for all
    seeds that share it: the pigeonhole bootstrap (Owen 2007, The Annals of Applied Statistics
    1(2), 386-411), which is conservative. With few seeds a bootstrap is too narrow by the factor
    sqrt((S - 1) / S) (Hesterberg 2015, The American Statistician 69(4), section 3.1), so deviations
    from the mean are divided by it.

    If fewer than ten images or episodes differ from the others, resamples contain too few outcomes,
    and if none does, only one. The interval is then extended to contain the interval of two shares,
    of units that came out higher and of units that came out lower
    (`data.vqa.metrics.mean_loss_interval`). So the interval for one lost image is not narrower than
    the interval for none.

    Args:
        seeds: S seeds.
        seed: seed of the resampling; equal seeds give equal intervals.

    Returns:
        None for a single seed, which does not show how seeds vary.
    """
    import numpy as np

    count = len(seeds)
    if count < 2:
        return None
    mean = float(np.mean([one.values.sum() / one.counts.sum() for one in seeds]))
    if all(one.sure for one in seeds):
        return mean, mean
    rng = np.random.default_rng(seed)
    found = []
    for first in range(0, RESAMPLES, _AT_ONCE):
        resamples = min(_AT_ONCE, RESAMPLES - first)
        # Drawing S of S with replacement amounts to drawing how often each one occurs.
        drawn = rng.multinomial(count, np.full(count, 1 / count), size=resamples)  # [R, S]
        found.append((drawn * _resampled_means(seeds, resamples, rng)).sum(1) / count)
    # Divided by sqrt((S - 1) / S), the factor by which few seeds make a bootstrap too narrow.
    deviations = (np.concatenate(found) - mean) * math.sqrt(count / (count - 1))
    low, high = np.quantile(mean + deviations, ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    least, most = _of_few(seeds)
    return min(float(low), mean - least), max(float(high), mean + most)


def _of_few(seeds: Sequence[Units]) -> tuple[float, float]:
    """How far below and above the mean an interval of shares extends; 0 if many units differ.

    An image's questions share its difficulty, so they count as one observation; so do the
    observations of one image by several seeds. Shares are in units of `reach`, so without a `reach`
    there are none.
    """
    reach = seeds[0].reach
    if reach is None:
        return 0.0, 0.0
    import numpy as np

    from aegis_cli.data.vqa.metrics import mean_loss_interval  # loads torch

    each = [one.values / one.counts for one in seeds]
    outcomes, times = np.unique(np.concatenate(each), return_counts=True)
    common = float(outcomes[times.argmax()])  # the outcome of most units
    if any(np.count_nonzero(means != common) >= FEW for means in each):
        return 0.0, 0.0
    looks: dict[Hashable, list[float]] = {}
    for one, means in zip(seeds, each, strict=True):
        for unit, mean in zip(_units(one), means.tolist(), strict=True):
            looks.setdefault(unit, []).append(mean)
    if sum(any(mean != common for mean in own) for own in looks.values()) >= FEW:
        return 0.0, 0.0
    # How far each unit's mean over seeds is from the common outcome, as a share of `reach`.
    apart = np.array([sum(own) / len(own) - common for own in looks.values()]) / reach
    low, high = mean_loss_interval(apart.clip(-1, 1), range(len(apart)))
    middle = float(apart.clip(-1, 1).mean())
    return (middle - low) * reach, (high - middle) * reach


def _units(one: Units) -> list[Hashable]:
    """Keys that identify a seed's units: their names, or their places in its draw."""
    if one.names is not None:
        return list(one.names)
    return [(one.draw, place) for place in range(len(one.values))]


def _resampled_means(
    seeds: Sequence[Units], resamples: int, rng: np.random.Generator
) -> np.ndarray:
    """Each seed's mean in each resample of its units, [R, S]."""
    import numpy as np

    named = dict.fromkeys(name for one in seeds for name in one.names or ())
    column = {name: place for place, name in enumerate(named)}
    weights: dict[int | None, np.ndarray] = {}  # by draw; None: all named units
    means = []
    for one in seeds:
        known = one.draw if one.names is None else None
        # Drawn once for all seeds that share the units, since their difficulty affects each mean.
        if known not in weights:
            size = len(one.values) if one.names is None else len(column)
            weights[known] = rng.multinomial(size, np.full(size, 1 / size), size=resamples)
        weight = weights[known]  # [R, N], how often each unit was drawn
        if one.names is not None:
            weight = weight[:, [column[name] for name in one.names]]
            # A resample may contain none of a seed's few units; then all of them count.
            weight = np.where(weight.any(axis=1, keepdims=True), weight, 1)
        means.append((weight @ one.values) / (weight @ one.counts))
    return np.stack(means, 1)
