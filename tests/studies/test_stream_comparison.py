"""A study of streams, on hand-written rows.

The tests cover intervals, ratios, the rule that chooses a knob, and the bar.
"""

from __future__ import annotations

import random
from typing import Any

import pytest
from samples.stream_studies import row

from aegis_cli.common.estimates import Estimate
from aegis_cli.recipes import Pairs, StreamVariant
from aegis_cli.studies.comparison import StreamResult, stream_results
from aegis_cli.studies.figures import Divergence
from aegis_cli.studies.tuning import STREAM_RULE, StreamPoint, choose

PAIRS = Pairs("a", "b")
T_1 = 12.706204736432095  # Student's t, 95 %, one degree of freedom
VARIANTS = {
    name: StreamVariant(method)
    for name, method in (("zero-shot",) * 2, ("isolated-lora",) * 2, ("mine", "igsp"))
}
RUNS = [(stream, seed) for stream in ("one", "two") for seed in (0, 1)]
SIZE = "final parameters"  # the demand's name
UNSEEDED, FROZEN = {"zero-shot"}, {"isolated-lora"}  # methods
LASTS = [0.79, 0.81, 0.80, 0.84]  # of mine; the isolated LoRA's are 0.80


def found(
    pairs: dict[str, Any] | None = None, **mine: Any
) -> dict[str, dict[tuple[str, int], Any]]:
    """Hand-written rows; `mine` changes all of my main rows, `pairs` those of both pairs."""
    rows = {
        run: row(last=last, average=0.7, parameters=400, **mine)
        for run, last in zip(RUNS, LASTS, strict=True)
    }
    if "last" in mine:
        rows = dict.fromkeys(RUNS, row(**mine))
    both = {
        (stream, seed): row(**{"added": (300, 30), **(pairs or {})})
        for stream in ("a", "b")
        for seed in (0, 1)
    }
    alone = dict.fromkeys([*RUNS, *both], row(last=0.80, average=0.7, parameters=1000, reuse=None))
    zero = dict.fromkeys(
        RUNS,
        row(transfer=0.5, inferred_transfer=0.5, parameters=0, trained_phase1=None, added=(0, 0)),
    )
    return {"zero-shot": zero, "isolated-lora": alone, "mine": rows | both}


def steady(pairs: dict[str, Any] | None = None) -> dict[str, dict[tuple[str, int], Any]]:
    """The same rows without noise between my seeds, so that the bar is passed."""
    rows = found(pairs)
    rows["mine"] |= dict.fromkeys(RUNS, row(last=0.81, average=0.7, parameters=400))
    return rows


def mine(rows: dict[str, dict[tuple[str, int], Any]], pairs: Pairs | None = PAIRS) -> StreamResult:
    return stream_results(rows, VARIANTS, {"mine": 3}, pairs, UNSEEDED, FROZEN)[-1]


def close(estimate: Estimate, mean: float, half: float | None) -> None:
    assert estimate.mean == pytest.approx(mean)
    assert estimate.interval == (
        None if half is None else pytest.approx((mean - half, mean + half))
    )


def test_a_seeds_figure_is_the_mean_over_its_streams_and_intervals_are_over_seeds() -> None:
    """Streams are named, not drawn at random, so they do not count as more runs."""
    made = mine(found())
    half = T_1 * (0.825 - 0.795) / 2  # seed 0 has 0.79 and 0.80, seed 1 has 0.81 and 0.84
    close(made.told.last, 0.81, half)
    close(made.last_gain_points, 1.0, 100 * half)
    close(made.average_gain_points, 0.0, 0.0)
    close(made.parameters_ratio, 0.4, 0.0)
    close(made.transfer_gain_points, 0.0, 0.0)
    assert (
        made.told.last.runs == made.pair_a.added.runs == 2
    )  # pairs do not count in the main figures
    close(made.pair_a.added, 0.1, 0.0)
    close(made.pair_a.new_experts, 0.5, 0.0)
    close(made.pair_a.reuse, 0.5, 0.0)
    assert (made.variant, made.method, made.value, made.diverged) == ("mine", "igsp", 3, [])


def test_what_learns_nothing_has_no_interval_and_is_compared_with_each_seed() -> None:
    """Two streams, one figure, however many seeds share the cell."""
    rows = found()
    rows["zero-shot"] = {
        run: row(transfer=t, last=t, first_change=0.0)
        for run, t in zip(RUNS, (0.4, 0.4, 0.6, 0.6), strict=True)
    }
    rows["zero-shot"] |= dict.fromkeys([("a", 0), ("a", 1)], row(added=(300, 30)))
    zero, _, made = stream_results(rows, VARIANTS, {}, PAIRS, UNSEEDED, FROZEN)
    for estimate in (zero.told.last, zero.inferred.transfer):
        close(estimate, 0.5, None)
    assert zero.parameters.runs == zero.transfer_gain_points.runs == zero.pair_a.added.runs == 1
    assert zero.pair_a.added.interval is None and zero.pair_a.first_change_points.runs == 1
    assert (made.transfer_gain_points.runs, made.told.last.runs) == (
        2,
        2,
    )  # of learners whose seeds differ
    assert (
        zero.last_gain_points.runs == zero.pair_a.second_gain_points.runs == 2
    )  # the isolated LoRA's seeds differ


def test_differences_are_of_the_same_stream_and_seed() -> None:
    rows = found()
    rows["isolated-lora"] = {("two", 1): row(last=0.74, parameters=800)}
    made = mine(rows)
    close(made.last_gain_points, 10.0, None)
    close(made.parameters_ratio, 0.5, None)


def test_what_a_learner_does_not_have_is_left_out() -> None:
    zero, isolated, _ = stream_results(found(), VARIANTS, {}, PAIRS, UNSEEDED, FROZEN)
    assert (
        zero.trained_phase1 is None and isolated.reuse is None and zero.bar is isolated.bar is None
    )
    assert zero.pair_a.added is None and zero.pair_a.worst_change_points is None
    rows = found({"added": (0, 5), "new_experts": (0, 0)})
    assert mine(rows).pair_b.added is None and mine(rows).pair_b.new_experts is None
    assert mine(found(), pairs=None).pair_a is None


@pytest.mark.parametrize(
    ("changes", "pairs", "failed"),
    [
        ({}, {}, []),
        ({"last": 0.80}, {}, []),  # equal
        ({"last": 0.795}, {}, []),  # the margin
        ({"last": 0.7949}, {}, ["Last - isolated LoRA's"]),
        ({"average": 0.695}, {}, []),
        ({"average": 0.6949}, {}, ["Average - isolated LoRA's"]),
        ({"average": 0.71}, {}, []),
        ({"parameters": 500}, {}, []),
        ({"parameters": 501}, {}, [SIZE]),
        ({"forgetting": 1e-6}, {}, ["forgetting, task told"]),
        ({"inferred_forgetting": 0.3}, {}, []),
        ({}, {"added": (300, 30)}, []),
        ({}, {"added": (300, 31)}, ["pair A adds"]),
        ({}, {"first_change": 0.01}, []),
        ({}, {"first_change": -1e-6}, ["pair B, first task"]),
        ({}, {"own": (0.0, 0.9)}, []),
        (
            {},
            {"own": (0.9, 0.79)},
            ["pair A, second - isolated LoRA's", "pair B, second - isolated LoRA's"],
        ),
        ({"transfer": 0.495, "inferred_transfer": 0.495}, {}, []),
        ({"transfer": 0.494, "inferred_transfer": 0.5}, {}, ["Transfer - zero-shot's, told"]),
        ({"inferred_transfer": 0.494}, {}, ["Transfer - zero-shot's, inferred"]),
        ({"transfer": 0.9, "inferred_transfer": 0.9}, {}, []),  # better is not worse
        (
            {"parameters": 900, "forgetting": 0.1},
            {"first_change": -0.5},
            [SIZE, "forgetting, task told", "pair B, first task"],
        ),
    ],
)
def test_each_demand_of_the_bar_has_its_border(
    changes: dict[str, Any], pairs: dict[str, Any], failed: list[str]
) -> None:
    rows = steady(pairs)
    rows["mine"] |= {run: row(**{**vars(rows["mine"][run]), **changes}) for run in RUNS}
    bar = mine(rows).bar
    assert [check.name for check in bar.checks if check.passed is False] == failed
    assert bar.passed is (not failed) and len(bar.checks) == 10


def test_a_pairs_second_task_is_compared_seed_by_seed_and_judged_by_the_worse_end() -> None:
    rows = steady()
    assert mine(rows).bar.passed is True
    rows["isolated-lora"]["a", 0] = row(own=(0.1, 0.6))
    rows["mine"]["a", 0] = row(own=(0.9, 0.61), added=(300, 30))
    rows["mine"]["a", 1] = row(own=(0.9, 0.77), added=(300, 30))  # of 0.8
    made = mine(rows)
    deviation = 2**0.5 * 2
    close(made.pair_a.second_gain_points, -1.0, T_1 * deviation / 2**0.5)
    close(made.pair_b.second_gain_points, 0.0, 0.0)
    failed = [check.name for check in made.bar.checks if check.passed is False]
    assert failed == ["pair A, second - isolated LoRA's"]
    del rows["isolated-lora"]["a", 0], rows["isolated-lora"]["a", 1]
    assert mine(rows).pair_a.second_gain_points is None and mine(rows).bar.passed is None


def test_a_lora_of_half_the_rank_is_the_control_of_the_same_size() -> None:
    assert mine(found()).half_gain_points is None
    rows = {"isolated-lora-half": dict.fromkeys(RUNS, row(last=0.79)), **found()}
    variants = VARIANTS | {"isolated-lora-half": StreamVariant("isolated-lora")}
    made = stream_results(rows, variants, {}, PAIRS, UNSEEDED, FROZEN)
    close(made[-1].half_gain_points, 2.0, 100 * T_1 * (0.825 - 0.795) / 2)
    assert made[0].bar is not None  # it has to pass too


def test_noise_between_seeds_does_not_help() -> None:
    """Its mean is higher, but the interval extends far below 0, so nothing is shown."""
    rows = steady()
    assert mine(rows).bar.passed is True
    noisy = zip(RUNS, (0.70, 0.99, 0.75, 0.99), strict=True)
    rows["mine"] |= {run: row(last=last, average=0.7, parameters=400) for run, last in noisy}
    made = mine(rows)
    assert made.last_gain_points.mean > 1 and made.last_gain_points.interval[0] < -0.5
    assert made.bar.passed is False


def test_what_a_frozen_learner_cannot_fail_is_marked() -> None:
    variants = {**VARIANTS, "mine": StreamVariant("igsp")}
    free, frozen = (
        stream_results(steady(), variants, {}, PAIRS, UNSEEDED, names)[-1].bar
        for names in (set(), {"igsp"})
    )
    assert not any(check.by_design for check in free.checks)
    marked = [check.name for check in frozen.checks if check.by_design]
    assert marked == ["forgetting, task told", "pair B, first task", "Transfer - zero-shot's, told"]


def test_a_loss_in_one_run_is_not_made_up_for_by_another() -> None:
    rows = found()
    rows["mine"]["b", 0] = row(added=(300, 30), first_change=-0.01)
    rows["mine"]["b", 1] = row(added=(300, 30), first_change=0.05)
    made = mine(rows)
    assert (
        made.pair_b.first_change_points.mean > 0
        and made.pair_b.worst_change_points == -1
        and made.bar.passed is False
    )


def test_what_was_not_measured_leaves_the_bar_open_and_a_divergence_fails_it() -> None:
    assert mine(steady(), pairs=None).bar.passed is None
    rows = steady()
    rows["mine"] |= dict.fromkeys(RUNS, row(last=0.81, average=0.7, forgetting=None))
    assert mine(rows).bar.passed is None
    rows = steady()
    del rows["isolated-lora"]
    bar = mine(rows).bar
    left_open = [check.name for check in bar.checks if check.passed is None]
    learned = [f"pair {letter}, second - isolated LoRA's" for letter in "AB"]
    assert bar.passed is None and left_open == [
        "Last - isolated LoRA's",
        "Average - isolated LoRA's",
        SIZE,
        *learned,
    ]
    rows = steady()
    rows["mine"]["a", 1] = Divergence(3)
    made = mine(rows)
    assert made.diverged == ["a 1"] and made.bar.passed is False and made.pair_a.added.runs == 1
    assert not any(check.passed is False for check in made.bar.checks)


# --- the rule ------------------------------------------------------------------------------------


def point(last: float | None, parameters: int | None) -> StreamPoint:
    return StreamPoint("x", "igsp", None, last, parameters)


@pytest.mark.parametrize(
    ("points", "within", "best"),
    [
        ([(0.80, 9), (0.90, 9), (0.85, 9)], 5, 1),  # equally many: the highest Last
        ([(0.80, 3), (0.90, 9), (0.85, 5)], 5, 2),  # the border is within
        ([(0.80, 3), (0.90, 9), (0.85, 5)], 4.9, 1),
        ([(0.80, 3), (0.90, 9), (0.85, 5)], 10, 0),
        ([(0.90, 9), (0.90, 9)], 1, 0),
        ([(None, None), (0.10, 9)], 1, 1),
        ([(None, None), (None, None)], 1, 0),
    ],
)
def test_the_fewest_parameters_within_reach_of_the_best(
    points: list[tuple[Any, Any]], within: float, best: int
) -> None:
    assert choose(STREAM_RULE, {"x": [point(*p) for p in points]}, within) == {"x": best}


@pytest.mark.parametrize("seed", range(40))
def test_no_able_value_has_fewer_parameters_than_the_chosen(seed: int) -> None:
    draw = random.Random(seed)
    own = [
        point(draw.randrange(70, 90) / 100, draw.randrange(1, 5))
        for _ in range(draw.randrange(1, 7))
    ]
    within = 3
    chosen = own[choose(STREAM_RULE, {"x": own}, within)["x"]]
    able = [p for p in own if round(100 * p.last) >= round(100 * max(p.last for p in own)) - within]
    assert chosen in able and all(
        (chosen.parameters, -chosen.last) <= (p.parameters, -p.last) for p in able
    )
