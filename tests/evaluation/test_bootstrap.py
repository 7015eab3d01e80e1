"""The crossed bootstrap: its limits, what an interval over seeds would miss, and its coverage."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from aegis_cli.common.estimates import estimate
from aegis_cli.data.vqa.metrics import wilson_interval
from aegis_cli.evaluation import bootstrap
from aegis_cli.evaluation.bootstrap import FEW, Units, crossed_interval


def drawn(
    rng: np.random.Generator, seeds: int, units: int, own: float, shared: float, noise: float
) -> list[Units]:
    """Seeds measured on the same units, whose difficulty varies by `shared`; the mean is 0."""
    difficulty = shared * rng.standard_normal(units)
    made = []
    for _ in range(seeds):
        level = own * rng.standard_normal()
        values = level + difficulty + noise * rng.standard_normal(units)
        made.append(Units(values, np.ones(units)))
    return made


def test_units_that_are_all_alike_are_no_certainty_unless_nothing_else_could_come_out() -> None:
    """Wilson's bound for what was never seen, over the images that differ between the seeds.

    Four questions about an image count as one observation.
    """
    alike = [Units(np.full(7, 2.0), np.full(7, 4.0), draw, reach=1.0) for draw in (0, 0, 1)]
    bound = wilson_interval(0, 2 * 7)[1]
    assert crossed_interval(alike) == pytest.approx((0.5 - bound, 0.5 + bound))
    still = [replace(one, sure=True) for one in alike]
    assert crossed_interval(still) == pytest.approx((0.5, 0.5))
    pair = still[0].minus(still[1])
    assert pair is not None and pair.sure
    mixed = still[0].minus(alike[1])
    assert mixed is not None and not mixed.sure


def named(rng: np.random.Generator, seeds: int, asked: int, pool: int) -> list[Units]:
    """Seeds that each ask about some images of a file; the images differ in difficulty."""
    hard = rng.normal(size=pool)
    found = []
    for seed in range(seeds):
        chosen = rng.permutation(pool)[:asked]
        values = 4 * (hard[chosen] + 0.1 * rng.normal(size=asked))
        names = tuple(f"image {i}" for i in chosen)
        found.append(Units(values, np.full(asked, 4.0), seed, names=names))
    return found


def test_images_that_seeds_share_are_drawn_once() -> None:
    """In any order: five observations of the same images are hardly more than one."""
    shared = named(np.random.default_rng(0), seeds=5, asked=40, pool=40)
    apart = [replace(one, names=None) for one in shared]
    one_draw = []
    for one in shared:
        order = np.argsort(one.names)
        one_draw.append(replace(one, values=one.values[order], draw=0, names=None))
    widths = [np.ptp(crossed_interval(seeds)) for seeds in (shared, apart, one_draw)]
    assert widths[0] > 1.5 * widths[1] and widths[0] == pytest.approx(widths[2], rel=0.1)


def test_names_that_no_seeds_share_are_those_of_draws_of_their_own() -> None:
    rng = np.random.default_rng(1)
    apart = [
        Units(rng.normal(size=50), np.ones(50), seed, names=tuple(f"{seed} {i}" for i in range(50)))
        for seed in range(4)
    ]
    plain = [replace(one, names=None) for one in apart]
    widths = [np.ptp(crossed_interval(seeds)) for seeds in (apart, plain)]
    assert widths[0] == pytest.approx(widths[1], rel=0.15)


@cache
def interval_of_shared_losses(lost: int) -> tuple[float, float]:
    """Three seeds lose one of four questions about each of the same `lost` images of 500."""
    values = np.where(np.arange(500) < lost, 100.0, 0.0)
    found = crossed_interval([Units(values, np.full(500, 4.0))] * 3)
    assert found is not None
    return found


@pytest.mark.parametrize("lost", range(1, 10))
def test_few_losses_are_told_no_more_sharply_than_none(lost: int) -> None:
    low, high = interval_of_shared_losses(lost)
    none = interval_of_shared_losses(0)[1]
    assert high > none
    mean = 100 * lost / (4 * 500)
    assert low <= mean - none / 4 and high >= mean


@pytest.mark.parametrize("share", (0.001, 0.004, 0.008))
def test_rare_losses_that_all_seeds_share_are_within_the_interval(share: float) -> None:
    """Summed over the number of lost images among 500, which is binomial."""
    within = 0.0
    for lost in range(20):
        low, high = interval_of_shared_losses(lost)
        if low <= 100 * share / 4 <= high:
            within += math.comb(500, lost) * share**lost * (1 - share) ** (500 - lost)
    assert within >= 0.95


@pytest.mark.parametrize(
    ("lost", "as_few"), [(3, True), (FEW - 1, True), (FEW, False), (60, False)]
)
def test_of_many_losses_the_resamples_alone_tell(
    lost: int, as_few: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = np.where(np.arange(500) < lost, 100.0, 0.0)
    seeds = [Units(values, np.full(500, 4.0))] * 3
    found = crossed_interval(seeds)
    monkeypatch.setattr(bootstrap, "FEW", 0)
    assert (crossed_interval(seeds) != found) is as_few


def test_other_images_are_no_pair() -> None:
    one, other = (Units(np.ones(3), np.ones(3), 0, names=names) for names in ("abc", "abd"))
    assert one.minus(other) is None and one.minus(one) is not None


def test_few_images_that_a_resample_may_miss_still_have_an_interval() -> None:
    seeds = named(np.random.default_rng(2), seeds=3, asked=2, pool=6)
    assert all(math.isfinite(end) for end in crossed_interval(seeds))


def test_images_that_several_seeds_were_asked_about_are_one_look() -> None:
    names = tuple("abcdefg")
    alike = [Units(np.full(7, 2.0), np.full(7, 4.0), draw, 1.0, names=names) for draw in range(3)]
    bound = wilson_interval(0, 7)[1]
    assert crossed_interval(alike) == pytest.approx((0.5 - bound, 0.5 + bound))


def test_one_seed_has_no_interval() -> None:
    assert crossed_interval([Units(np.arange(5.0), np.ones(5))]) is None


@pytest.mark.parametrize("case", range(5))
def test_equal_arguments_give_equal_intervals_that_hold_the_mean(case: int) -> None:
    rng = np.random.default_rng(case)
    seeds = drawn(rng, seeds=4, units=30, own=1, shared=1, noise=1)
    low, high = crossed_interval(seeds)
    assert (low, high) == crossed_interval(seeds)
    assert low <= np.mean([one.values.mean() for one in seeds]) <= high


def test_the_units_that_seeds_share_widen_it_and_an_interval_over_seeds_does_not_see_them() -> None:
    rng = np.random.default_rng(0)
    seeds = drawn(rng, seeds=5, units=40, own=0.0, shared=1.0, noise=0.01)
    low, high = crossed_interval(seeds)
    by_seed = estimate([float(one.values.mean()) for one in seeds]).interval
    assert high - low > 10 * (by_seed[1] - by_seed[0])
    # Units that each seed has for itself average out over the seeds.
    fresh = [Units(one.values, one.counts, draw) for draw, one in enumerate(seeds)]
    assert np.ptp(crossed_interval(fresh)) < 0.8 * (high - low)


def test_it_covers_the_truth_about_as_often_as_it_says() -> None:
    """For five seeds and shared images; it is conservative, so it covers more than 90 %."""
    rng, held = np.random.default_rng(1), 0
    for _ in range(100):
        low, high = crossed_interval(drawn(rng, seeds=5, units=25, own=0.3, shared=1.0, noise=1.0))
        held += low <= 0 <= high
    assert 90 <= held <= 100


def test_a_paired_difference_needs_the_same_units() -> None:
    one, other = Units(np.arange(3.0), np.ones(3)), Units(np.ones(3), np.ones(3))
    assert one.minus(other).values.tolist() == [-1, 0, 1]
    assert one.minus(Units(np.ones(3), np.ones(3), draw=1)) is None
    assert one.minus(Units(np.ones(3), np.full(3, 2.0))) is None
    assert one.minus(Units(np.ones(4), np.ones(4))) is None
