"""Learning rates as functions of the step: warm-up, each schedule's decay, and plans."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aegis_cli.recipes import Train
from aegis_cli.recipes.policy import CONSTANT, COSINE, LINEAR, SCHEDULES
from aegis_cli.training.schedule import rate_factor, rate_left, warmup_then_decay

shares = st.floats(0, 1)
schedules = st.sampled_from(SCHEDULES)
lengths, rises = st.integers(1, 60), st.integers(0, 70)


def factors(settings: Train) -> list[float]:
    return [rate_factor(step, settings) for step in range(settings.steps)]


@given(steps=lengths, warmup=rises, share=shares, schedule=schedules)
def test_it_rises_alike_and_then_never_again(
    steps: int, warmup: int, share: float, schedule: str
) -> None:
    settings = Train(steps=steps, warmup=warmup, final_lr_share=share, schedule=schedule)
    found = factors(settings)
    rise, rest = found[:warmup], found[warmup:]
    assert rise == [(step + 1) / warmup for step in range(min(warmup, steps))]
    assert all(before >= after for before, after in itertools.pairwise(rest))
    assert all(share * (1 - 1e-12) <= factor <= 1 + 1e-12 for factor in rest)
    left = [rate_left(step, settings) for step in range(steps)]
    assert left == [1.0] * len(rise) + rest


@given(steps=lengths, warmup=rises, share=shares)
def test_each_schedule_goes_on_as_it_says(steps: int, warmup: int, share: float) -> None:
    """The linear one is that of transformers' Trainer if the share is 0."""
    fall = max(1, steps - warmup)
    for step in range(warmup, steps):
        cosine, linear, constant = (
            warmup_then_decay(step, steps, warmup, share, schedule) for schedule in SCHEDULES
        )
        passed = (step - warmup) / fall
        # Bit for bit, since runs of earlier versions continue with it.
        assert cosine == share + (1 - share) * (1 + math.cos(math.pi * passed)) / 2
        assert linear == pytest.approx(share + (1 - share) * (steps - step) / fall)
        assert constant == 1


@pytest.mark.parametrize("schedule", [COSINE, LINEAR])
@given(steps=lengths, warmup=rises, share=shares)
def test_the_step_after_the_last_would_have_the_final_share(
    schedule: str, steps: int, warmup: int, share: float
) -> None:
    if warmup < steps:
        reached = warmup_then_decay(steps, steps, warmup, share, schedule)
        assert reached == pytest.approx(share)


@given(st.sets(lengths, min_size=1, max_size=4).map(sorted), rises, shares, schedules)
def test_a_run_made_longer_follows_each_plan(
    plans: list[int], warmup: int, share: float, schedule: str
) -> None:
    *earlier, last = plans
    keys = {"warmup": warmup, "final_lr_share": share, "schedule": schedule}
    longer = factors(Train(steps=last, extended_from=tuple(earlier) or None, **keys))
    begin = 0
    for steps in plans:
        assert longer[begin:steps] == factors(Train(steps=steps, **keys))[begin:]
        begin = steps
    if schedule == CONSTANT:
        assert longer == factors(Train(steps=last, **keys))


def test_no_warm_up_starts_at_the_peak() -> None:
    assert warmup_then_decay(0, 10, 0, 0.1) == 1
