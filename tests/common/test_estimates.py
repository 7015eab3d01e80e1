"""Means over seeds, and Student's t behind their intervals."""

from __future__ import annotations

import math
import random
import statistics

import pytest

from aegis_cli.common.estimates import Estimate, estimate, t_quantile


@pytest.mark.parametrize(
    ("freedom", "level", "value"),
    [
        (1, 0.95, 12.706205),
        (2, 0.95, 4.302653),
        (3, 0.95, 3.182446),
        (4, 0.95, 2.776445),
        (5, 0.95, 2.570582),
        (9, 0.95, 2.262157),
        (29, 0.95, 2.045230),
        (120, 0.95, 1.979930),
        (10_000, 0.95, 1.960201),
        (4, 0.99, 4.604095),
        (7, 0.5, 0.711142),
    ],
)
def test_quantiles_are_those_of_the_published_tables(
    freedom: int, level: float, value: float
) -> None:
    assert t_quantile(freedom, level) == pytest.approx(value, abs=1e-6)


@pytest.mark.parametrize("freedom", [1, 2, 3, 4, 8, 15])
def test_quantiles_hold_the_level_under_the_density(freedom: int) -> None:
    scale = math.exp(math.lgamma((freedom + 1) / 2) - math.lgamma(freedom / 2)) / math.sqrt(
        freedom * math.pi
    )
    edge, n = t_quantile(freedom), 20_000
    heights = [
        scale * (1 + ((i + 0.5) / n * edge) ** 2 / freedom) ** (-(freedom + 1) / 2)
        for i in range(n)
    ]
    assert 2 * edge * sum(heights) / n == pytest.approx(0.95, abs=1e-6)


@pytest.mark.parametrize("runs", [2, 3, 5])
def test_intervals_cover_the_truth_as_often_as_they_say(runs: int) -> None:
    draw, trials = random.Random(runs), 4000
    intervals = [estimate([draw.gauss(3, 2) for _ in range(runs)]).interval for _ in range(trials)]
    covered = sum(low <= 3 <= high for low, high in intervals) / trials
    assert abs(covered - 0.95) < 4 * math.sqrt(0.95 * 0.05 / trials)


def test_an_interval_follows_shift_and_scale() -> None:
    values = [0.3, 0.1, 0.4, 0.1, 0.5]
    low, high = estimate(values).interval
    shifted = estimate([7 - 3 * v for v in values])
    assert shifted.mean == pytest.approx(7 - 3 * statistics.fmean(values))
    assert shifted.interval == pytest.approx((7 - 3 * high, 7 - 3 * low))


def test_one_run_has_no_interval_and_equal_runs_have_a_point() -> None:
    assert estimate([0.25]) == Estimate(0.25, None, 1)
    assert estimate([0.25] * 3) == Estimate(0.25, (0.25, 0.25), 3)


def test_half_reaches_the_farther_end_of_both_intervals() -> None:
    assert Estimate(1.0, None, 1).half is None
    assert Estimate(1.0, (0.5, 1.5), 3).half == 0.5
    assert Estimate(1.0, (0.5, 1.5), 3, crossed=(0.8, 3.0)).half == 2.0
    assert Estimate(1.0, (0.5, 1.5), 3, crossed=(-2.0, 1.1)).half == 3.0
