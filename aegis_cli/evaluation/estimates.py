"""Means over seeds with Student's t-intervals: few runs, each a draw from one distribution."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

LEVEL = 0.95
ROUNDING = 1e-9  # what is exactly on the border is on its good side


@dataclass(frozen=True)
class Estimate:
    """Mean of `runs` values and the 95 % interval of the expectation; no interval from a single
    run.
    """

    mean: float
    interval: tuple[float, float] | None
    runs: int


def estimate(values: Sequence[float]) -> Estimate:
    """mean +- t(n - 1) s / sqrt(n), with s the sample's standard deviation (Student 1908)."""
    n, mean = len(values), statistics.fmean(values)
    if n == 1:
        return Estimate(mean, None, n)
    half = t_quantile(n - 1) * statistics.stdev(values) / math.sqrt(n)
    return Estimate(mean, (mean - half, mean + half), n)


def estimate_known(values: Sequence[float | None]) -> Estimate | None:
    """Of the values that are there; None where there is none."""
    known = [value for value in values if value is not None]
    return estimate(known) if known else None


@cache
def t_quantile(freedom: int, level: float = LEVEL) -> float:
    """The t for which P(|T| <= t) = `level` under Student's distribution, to machine precision, by
    bisection over t's angle.
    """
    low, high = 0.0, math.pi / 2
    while low < (middle := (low + high) / 2) < high:
        low, high = (middle, high) if _inside(middle, freedom) < level else (low, middle)
    return math.sqrt(freedom) * math.tan(high)


def _inside(angle: float, freedom: int) -> float:
    """P(|T| <= sqrt(freedom) tan(angle)): the finite series of Abramowitz and Stegun, 26.7.3 and
    26.7.4.
    """
    cosine, odd = math.cos(angle), freedom % 2
    term, total = 1.0, 0.0
    for k in range(freedom // 2):
        total += term
        term *= cosine**2 * (2 * k + 1 + odd) / (2 * k + 2 + odd)
    series = math.sin(angle) * total
    return 2 / math.pi * (angle + cosine * series) if odd else series
