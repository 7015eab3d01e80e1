"""Means over seeds with Student's t-intervals, for few runs drawn from one distribution."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

LEVEL = 0.95  # probability that an interval contains the expectation


@dataclass(frozen=True)
class Estimate:
    """Mean of `runs` values with the 95 % interval of their expectation.

    A single run has no interval: `interval` is None. `crossed` is the interval of the crossed
    bootstrap over runs and over the items they were measured on (`bootstrap.crossed_interval`), if
    known.
    """

    mean: float
    interval: tuple[float, float] | None
    runs: int
    crossed: tuple[float, float] | None = None

    @property
    def ends(self) -> tuple[float, float] | None:
        """The lower end of the lower interval and the upper end of the higher one.

        A claim based on these holds by both intervals.
        """
        known = [interval for interval in (self.interval, self.crossed) if interval is not None]
        if not known:
            return None
        return min(low for low, _ in known), max(high for _, high in known)

    @property
    def half(self) -> float | None:
        """Distance of the mean from the farther end; None without an interval."""
        if self.ends is None:
            return None
        low, high = self.ends
        return max(self.mean - low, high - self.mean)


def estimate(values: Sequence[float]) -> Estimate:
    """The mean of n values and its interval, mean +- t(n - 1) s / sqrt(n) (Student, 1908).

    Here s is the sample standard deviation, with the divisor n - 1.
    """
    n, mean = len(values), statistics.fmean(values)
    if n == 1:
        return Estimate(mean, None, n)
    half = t_quantile(n - 1) * statistics.stdev(values) / math.sqrt(n)
    return Estimate(mean, (mean - half, mean + half), n)


@cache
def t_quantile(freedom: int, level: float = LEVEL) -> float:
    """The t for which P(|T| <= t) = `level`, with T of Student's distribution.

    Args:
        freedom: degrees of freedom, at least 1.
        level: probability between the two equal tails, between 0 and 1.
    """
    from scipy.special import stdtrit  # slow to load, and only tables of several seeds need it

    both_sides = (1 + level) / 2  # stdtrit inverts P(T <= t), which includes the lower tail
    return float(stdtrit(freedom, both_sides))
