"""The rule that chooses a knob, and the bar."""

from __future__ import annotations

import dataclasses
import itertools
import random
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, get_type_hints

import pytest
from samples.studies import row

from aegis_cli.common.estimates import Estimate, estimate, t_quantile
from aegis_cli.recipes import PolicyVariant, Recipe, Train
from aegis_cli.studies.comparison import (
    POLICY_BAR,
    STREAM_BAR,
    Accuracies,
    Cost,
    PairResult,
    PolicyResult,
    StreamResult,
    open_loop_bar,
    task_results,
)
from aegis_cli.studies.figures import Divergence, PolicyFigures
from aegis_cli.studies.metrics import (
    Bar,
    Demand,
    Mean,
    bar,
    columns,
    deciding_decimals,
    lowest,
    over_seeds,
    points,
    ratio,
)
from aegis_cli.studies.tuning import POLICY_RULE, PolicyPoint, choose

# --- the rule ------------------------------------------------------------------------------------


def point(variant: str, success: float, accuracy: float, method: str = "lora") -> PolicyPoint:
    return PolicyPoint(
        variant, "naive" if variant.startswith("naive") else method, None, accuracy, 0.98, success
    )


def invented(seed: int, naive: bool = True) -> dict[str, list[PolicyPoint]]:
    draw = random.Random(seed)
    names = [*(["naive"] if naive else []), "a", "b", "c"]
    return {
        n: [
            point(n, draw.randrange(70, 101) / 100, draw.randrange(5) / 5)
            for _ in range(draw.randrange(1, 6))
        ]
        for n in names
    }


@pytest.mark.parametrize("seed", range(60))
def test_the_choice_is_the_most_accurate_of_the_able_else_the_most_able(seed: int) -> None:
    points = invented(seed, naive=seed % 3 > 0)
    everyone = [p for own in points.values() for p in own]
    best = max(round(100 * p.success) for p in (points.get("naive") or everyone))
    for variant, chosen in choose(POLICY_RULE, points, within=3).items():
        own = points[variant]
        able = [p for p in own if round(100 * p.success) >= best - 3]
        if able:
            assert own[chosen] in able
            assert (own[chosen].accuracy, own[chosen].success) == max(
                (p.accuracy, p.success) for p in able
            )
        else:
            assert own[chosen].success == max(p.success for p in own)
        assert chosen == own.index(own[chosen])  # among equals, the one listed first


@pytest.mark.parametrize("best", range(10, 101))
def test_the_border_itself_is_within(best: int) -> None:
    points = {
        "naive": [point("naive", best / 100, 0.5)],
        "a": [point("a", (best - 3) / 100, 0.9), point("a", best / 100, 0.1)],
    }
    assert choose(POLICY_RULE, points, within=3)["a"] == 0
    assert choose(POLICY_RULE, points, within=2.99)["a"] == 1


@pytest.mark.parametrize("seed", range(20))
def test_the_choice_does_not_depend_on_the_other_variants_but_naive(seed: int) -> None:
    points = invented(seed)
    whole = choose(POLICY_RULE, points, within=3)
    for variant in points:
        assert (
            choose(POLICY_RULE, {"naive": points["naive"], variant: points[variant]}, within=3)[
                variant
            ]
            == whole[variant]
        )


def test_with_no_margin_the_best_success_wins_and_with_all_the_best_accuracy() -> None:
    points = invented(7, naive=False)
    for variant, chosen in choose(POLICY_RULE, points, within=100).items():
        assert points[variant][chosen].accuracy == max(p.accuracy for p in points[variant])
    alone = {"naive": points["a"]}
    assert alone["naive"][choose(POLICY_RULE, alone, within=0)["naive"]].success == max(
        p.success for p in points["a"]
    )


@pytest.mark.parametrize("seed", range(20))
def test_a_value_that_diverged_is_chosen_only_where_all_did(seed: int) -> None:
    points = invented(seed)
    lost = PolicyPoint("a", "lora", None, None, None, None)
    longer = {**points, "a": [lost, *points["a"], lost], "none": [lost, lost]}
    before, after = choose(POLICY_RULE, points, within=3), choose(POLICY_RULE, longer, within=3)
    assert after == {**before, "a": before["a"] + 1, "none": 0}
    others = {name: own for name, own in points.items() if name != "naive"}
    assert choose(POLICY_RULE, {"naive": [lost], **others}, within=3)["naive"] == 0


def test_where_nothing_is_rolled_out_the_error_takes_the_place_of_success() -> None:
    """This includes errors above 1, the error of always predicting the mean action."""
    lost = PolicyPoint("a", "lora", None, 1.0, None, None)
    for seed in range(20):
        points = invented(seed)
        errors = {
            name: [replace(p, success=None, open_loop_error=1.5 - p.success) for p in own]
            for name, own in points.items()
        }
        assert choose(POLICY_RULE, errors, within=3) == choose(POLICY_RULE, points, within=3)
        errors["a"] = [lost, *errors["a"]]
        assert choose(POLICY_RULE, errors, within=1000)["a"] > 0


# --- the bar -------------------------------------------------------------------------------------

GOOD = (
    Estimate(0.02, (-0.06, 0.1), 5),
    Estimate(0.5, (-1, 2), 5),
    Estimate(1.5, (0.5, 2.5), 5),
    1.02,
)


def verdict(
    drop: Estimate | None,
    seen: Estimate | None,
    held_out: Estimate | None,
    step_time: float | None,
) -> Bar:
    """The bar of a result with these figures."""
    result = SimpleNamespace(
        drop_points=drop,
        seen_gain_points=seen,
        held_out_gain_points=held_out,
        step_time=step_time,
        questions=0.0,
        diverged=[],
    )
    return bar(POLICY_BAR, result)


@pytest.mark.parametrize(
    ("place", "value", "passed"),
    [
        (0, Estimate(0.0, (0.0, 0.0), 5), True),
        (0, Estimate(0.0, None, 1), None),
        (0, Estimate(-0.3, (-0.5, -0.1), 5), True),
        (0, Estimate(0.05, (0.01, 0.09), 5), True),
        (0, Estimate(0.05, (-1.0, 1.1), 5), False),
        (0, Estimate(0.05, (0.01, 0.09), 5, (-0.1, 0.2)), False),
        (0, Estimate(0.11, (0.1, 0.12), 5), False),
        (1, Estimate(3.0, (2, 4), 5), True),
        (1, Estimate(3.0, (-1.01, 7), 5), False),
        (1, Estimate(-0.5, (-0.9, -0.1), 5), True),
        (2, Estimate(0.0, (0, 0), 5), False),
        (2, Estimate(1.0, (-0.1, 2.1), 5), False),
        (2, Estimate(1.0, (0.1, 1.9), 5, (-0.2, 2.2)), False),
        (3, 0.6, True),
        (3, 1.021, False),
        (1, None, None),
        (2, None, None),
        (3, None, None),
    ],
)
def test_each_demand_of_the_bar_is_needed(
    place: int, value: Estimate | float | None, passed: bool | None
) -> None:
    assert verdict(*GOOD).passed is True
    figures = [*GOOD]
    figures[place] = value
    made = verdict(*figures)
    assert made.passed is passed and made.checks[place].passed is passed
    assert made.checks[place].value == (value.mean if isinstance(value, Estimate) else value)
    assert all(check.passed for i, check in enumerate(made.checks) if i != place)


def evaluated(error: float, hold: float | None = None, **changes: Any) -> PolicyFigures:
    """A policy that cannot be rolled out, evaluated on forty similar episodes."""
    spread = [0.001 * (i % 5 - 2) for i in range(40)]
    known: dict[str, Any] = {
        "open_loop_error": error,
        "hold_error": hold,
        "evaluated_episodes": tuple(f"1/{i}" for i in range(40)),
        "weight_per_episode": (1 / 40,) * 40,
        "error_per_episode": tuple(error + away for away in spread),
        "hold_per_episode": None if hold is None else tuple(hold + 2 * away for away in spread),
    }
    acted = dict.fromkeys(("success_seen", "success_held_out", "wrong_target"))
    frozen = {"drop_points": 0.0, "cross_entropy": 0.05}  # as before the training
    base = dataclasses.replace(row(Recipe(name="x")), **frozen, **acted)
    return dataclasses.replace(base, **{**known, **changes})


def judged_open_loop(
    naive: list[PolicyFigures], other: list[PolicyFigures], most: float = 0.02
) -> PolicyResult:
    rows: dict[str, dict[int, Any]] = {"naive": dict(enumerate(naive))}
    rows["other"] = dict(enumerate(other))
    variants = {"naive": PolicyVariant("naive"), "other": PolicyVariant("lora")}
    costs = {"other": Cost(1.0, 1.0)}
    return task_results("arm", rows, variants, {}, costs, frozenset(), most).results[1]


LEVELS = (0.3, 0.4, 0.5)  # naive's error for each seed: the seeds hold out different episodes


@pytest.mark.parametrize(
    ("rises", "hold", "most", "passed"),
    [
        ((0.009, 0.01, 0.011), None, 0.02, [True, True]),
        ((0.009, 0.01, 0.011), None, 0.01, [False, True]),  # the upper end is above the limit
        ((0.0, 0.01, 0.02), None, 0.02, [False, True]),  # below it on average, but not certainly
        ((-0.2, -0.2, -0.21), None, 0.0, [True, True]),
        ((0.0, 0.001, 0.002), 0.3, 0.02, [True, False]),  # as good as naive, and as useless
        ((0.0, 0.001, 0.002), 0.9, 0.02, [True, True]),
        ((0.7, 0.6, 0.5), 1.5, 2.0, [True, False]),  # no better than always the mean action
    ],
)
def test_what_cannot_be_rolled_out_is_judged_by_its_error_beside_naives(
    rises: tuple[float, ...], hold: float | None, most: float, passed: list[bool]
) -> None:
    """Paired by seed, and judged by the worse end of the interval; success plays no part."""
    levels = zip(LEVELS, rises, strict=True)
    other = [evaluated(level + rise, hold) for level, rise in levels]
    result = judged_open_loop([evaluated(level, hold) for level in LEVELS], other, most)
    checks = result.bar.checks
    assert [check.passed for check in checks[1:3]] == passed
    assert result.open_loop_difference.mean == pytest.approx(sum(rises) / 3)
    assert not any("success" in check.name for check in checks)
    assert result.bar.passed is all(passed)


def test_errors_are_paired_by_episode_and_those_of_an_earlier_version_by_seed_alone() -> None:
    """The episodes differ by more than the two policies do."""
    hard = tuple(0.1 + 0.02 * i for i in range(40))
    naive = [evaluated(0.49, error_per_episode=hard) for _ in range(3)]
    # Each seed's mean rises by a little less or more, and within it one episode by much.
    raised = [(*hard[:-1], hard[-1] + rise) for rise in (0.3, 0.4, 0.5)]
    other = [evaluated(0.49 + (e[-1] - hard[-1]) / 40, error_per_episode=e) for e in raised]
    found = judged_open_loop(naive, other).open_loop_difference
    assert found.mean == pytest.approx(0.01)
    assert found.crossed is not None and found.crossed[1] > found.interval[1]
    assert judged_open_loop(naive, other).open_loop_error.crossed is not None
    old = [dataclasses.replace(one, error_per_episode=None) for one in other]
    assert judged_open_loop(naive, old).open_loop_difference.crossed is None


def test_one_bar_is_held_up_to_all_variants_of_a_task() -> None:
    """This includes a variant without any result, so that a table has one line per demand."""
    rows: dict[str, dict[int, Any]] = {"a": {0: Divergence(1)}, "b": {0: evaluated(0.5)}}
    variants = {"a": PolicyVariant("lora"), "b": PolicyVariant("ewc")}
    lost, kept = task_results("arm", rows, variants, {}, {}, frozenset()).results
    assert [c.name for c in lost.bar.checks] == [c.name for c in kept.bar.checks]
    assert lost.bar.passed is False and "open-loop error - naive's" in lost.bar.checks[1].name


@pytest.mark.parametrize(
    ("value", "demand", "decimals"),
    [
        (1.02, "<= 1.02 x naive", 2),
        (1.0199, "<= 1.02 x naive", 2),
        (1.0204, "<= 1.02 x naive", 4),
        (1.024, "<= 1.02 x naive", 3),
        (0.98, "<= 1.02 x naive", 2),
        (-1.004, ">= -1 point", 3),
        (0.0004, "> 0 points", 4),
        (-0.004, "< 0 of variance", 3),
        (0.0, "none", 2),
    ],
)
def test_a_value_is_shown_on_the_side_that_it_is_judged_on(
    value: float, demand: str, decimals: int
) -> None:
    assert deciding_decimals(value, demand, 2) == decimals


def test_a_failed_demand_outweighs_one_that_was_not_measured() -> None:
    assert verdict(Estimate(9.0, (8, 10), 5), None, None, None).passed is False


def test_gains_are_paired_by_seed() -> None:
    """However much seeds differ, a variant two points better for each is two points better."""
    draw = random.Random(0)
    levels = {seed: draw.uniform(0.5, 0.9) for seed in range(5)}
    base = row(Recipe(name="x"))
    naive = {
        s: dataclasses.replace(base, success_seen=v, success_held_out=v) for s, v in levels.items()
    }
    other = {
        s: dataclasses.replace(
            base, success_seen=v + (0.0215 if s == 1 else 0.0195), success_held_out=None
        )
        for s, v in levels.items()
        if s != 3
    }
    variants = {"naive": PolicyVariant("naive"), "other": PolicyVariant("lora")}
    rows = {"naive": naive, "other": other}
    result = task_results(
        "reach", rows, variants, {}, {"other": Cost(1.2, 3.0)}, frozenset()
    ).results[1]
    assert result.seen_gain_points.mean == pytest.approx(2) and result.seen_gain_points.runs == 4
    half = t_quantile(3) * 0.1 / 2
    assert result.seen_gain_points.interval == pytest.approx((2 - half, 2 + half))
    assert result.held_out_gain_points is None and (result.step_time, result.peak_memory) == (
        1.2,
        3.0,
    )


def test_a_variant_is_compared_with_the_reference_that_it_names() -> None:
    """For example naive at another rate: gains and the drop's difference are relative to that."""
    base = row(Recipe(name="x"))
    success = {"naive": 0.9, "naive-low": 0.6, "aegis-low": 0.65, "aegis": 0.85}
    drops = {"naive": 20.0, "naive-low": 2.0, "aegis-low": 5.0, "aegis": 19.0}
    rows = {
        name: {
            seed: dataclasses.replace(
                base, success_seen=value + seed / 100, drop_points=drops[name]
            )
            for seed in range(2)
        }
        for name, value in success.items()
    }
    variants = {
        "naive": PolicyVariant("naive"),
        "naive-low": PolicyVariant("naive"),
        "aegis-low": PolicyVariant("aegis", against="naive-low"),
        "aegis": PolicyVariant("aegis"),
    }
    made = {
        r.variant: r for r in task_results("reach", rows, variants, {}, {}, frozenset()).results
    }
    assert made["naive"].seen_gain_points is None is made["naive"].drop_difference_points
    gains = {n: (r.seen_gain_points, r.drop_difference_points) for n, r in made.items()}
    del gains["naive"]
    means = {name: [e.mean for e in both] for name, both in gains.items()}
    assert means["naive-low"] == pytest.approx([-30, -18])
    assert means["aegis-low"] == pytest.approx([5, 3])
    assert means["aegis"] == pytest.approx([-5, -1])
    assert {n: r.against for n, r in made.items() if r.against} == {"aegis-low": "naive-low"}


def test_a_reference_without_a_cell_yet_leaves_no_difference() -> None:
    rows = {"aegis": {0: row(Recipe(name="x"))}, "naive": {0: row(Recipe(name="x"))}}
    variants = {
        "naive": PolicyVariant("naive"),
        "naive-low": PolicyVariant("naive"),
        "aegis": PolicyVariant("aegis", against="naive-low"),
    }
    found = task_results("reach", rows, variants, {}, {}, frozenset()).results[0]
    assert found.seen_gain_points is None and found.drop_difference_points is None


@pytest.mark.parametrize(
    ("method", "barred"),
    [("naive", False), ("cotrain", False), ("lora", True), ("stop-gradient", True)],
)
def test_only_methods_without_vqa_data_meet_the_bar(method: str, barred: bool) -> None:
    rows = {
        name: {0: row(Recipe(name="x", train=Train(method=m)))}
        for name, m in (("naive", "naive"), ("other", method))
    }
    variants = {"naive": PolicyVariant("naive"), "other": PolicyVariant(method)}
    ceilings = frozenset({"other"} if method == "cotrain" else ())
    naive, other = task_results("reach", rows, variants, {}, {}, ceilings).results
    assert naive.bar is None and (other.bar is not None) == barred


@pytest.mark.parametrize("order", list(itertools.permutations(range(3)))[:3])
def test_a_mean_leaves_out_what_a_method_does_not_have(order: tuple[int, ...]) -> None:
    base = row(Recipe(name="x", train=Train(method="aegis")))
    sheds = [0.1, 0.2, None]
    rows = {"a": {i: dataclasses.replace(base, energy_shed=sheds[i]) for i in order}}
    result = task_results(
        "reach", rows, {"a": PolicyVariant("aegis")}, {}, {}, frozenset()
    ).results[0]
    assert (
        result.energy_shed.mean == pytest.approx(0.15)
        and result.energy_shed.runs == 2
        and result.accuracy.runs == 3
    )


# --- trainings that diverged ---------------------------------------------------------------------


@pytest.mark.parametrize(("lost", "passed"), [(0.03, None), (3.0, False), (0.0, None)])
def test_seeds_that_came_out_alike_do_not_tell_how_seeds_vary(
    lost: float, passed: bool | None
) -> None:
    """Unless the backbone has not moved: then no answer could have changed."""
    base = dataclasses.replace(row(Recipe(name="x")), drop_points=lost, cross_entropy=0.2)
    variants = {"naive": PolicyVariant("naive"), "other": PolicyVariant("lora")}
    rows = {name: dict.fromkeys(range(2), base) for name in variants}
    result = task_results("reach", rows, variants, {}, {}, frozenset()).results[1]
    assert result.drop_points.ends is None and result.drop_points.half is None
    assert result.bar.checks[0].passed is passed
    still = dataclasses.replace(base, cross_entropy=base.baseline_cross_entropy)
    rows = {name: dict.fromkeys(range(2), still) for name in variants}
    result = task_results("reach", rows, variants, {}, {}, frozenset()).results[1]
    assert result.drop_points.ends == pytest.approx((lost, lost))


def test_a_share_at_which_all_seeds_came_out_alike_has_no_interval() -> None:
    """If none of a few episodes ended at another target, it is not certain that none would."""
    base = dataclasses.replace(row(Recipe(name="x")), wrong_target=0.0, cross_entropy=0.2)
    variants = {"naive": PolicyVariant("naive")}
    alike = {"naive": dict.fromkeys(range(3), base)}
    result = task_results("reach", alike, variants, {}, {}, frozenset()).results[0]
    assert result.wrong_target.mean == 0 and result.wrong_target.interval is None
    assert result.accuracy.runs == 3 and result.accuracy.interval is None
    unlike = {"naive": {**alike["naive"], 2: dataclasses.replace(base, wrong_target=0.02)}}
    result = task_results("reach", unlike, variants, {}, {}, frozenset()).results[0]
    assert result.wrong_target.interval is not None and result.wrong_target.crossed is None
    still = dataclasses.replace(base, cross_entropy=base.baseline_cross_entropy)
    alike = {"naive": dict.fromkeys(range(3), still)}
    result = task_results("reach", alike, variants, {}, {}, frozenset()).results[0]
    assert result.accuracy.interval == pytest.approx((base.accuracy, base.accuracy))


def test_the_baseline_is_a_mean_over_the_questions_that_seeds_were_asked() -> None:
    base = row(Recipe(name="x"))
    own = {
        s: dataclasses.replace(base, probe_seed=s // 2, baseline_accuracy=0.9 + 0.04 * (s // 2))
        for s in range(3)
    }
    table = task_results("reach", {"naive": own}, {"naive": PolicyVariant("naive")}, {}, {}, ())
    assert table.baseline_accuracy == pytest.approx(0.92)


def test_differences_across_versions_of_the_code_are_counted() -> None:
    base = dataclasses.replace(row(Recipe(name="x")), code="0.1.0 a")
    later = dataclasses.replace(base, code="0.1.0 b")
    variants = {"naive": PolicyVariant("naive"), "other": PolicyVariant("lora")}
    rows = {"naive": {0: base, 1: base, 2: base}, "other": {0: base, 1: later}}
    table = task_results("reach", rows, variants, {}, {}, frozenset())
    assert (table.compared, table.across_versions) == (2, 1)


def test_costs_are_over_the_variant_that_one_is_held_against() -> None:
    variants = {
        "naive": PolicyVariant("naive"),
        "large": PolicyVariant("naive", against="naive"),
        "other": PolicyVariant("aegis", against="large"),
        "lost": PolicyVariant("aegis", against="nowhere"),
    }
    rows = {name: {0: row(Recipe(name="x"))} for name in variants}
    costs = {"naive": Cost(1.0, 1.0), "large": Cost(10.0, 4.0), "other": Cost(15.0, 5.0)}
    costs["lost"] = Cost(2.0, 2.0)
    found = {
        r.variant: (r.step_time, r.peak_memory)
        for r in task_results("reach", rows, variants, {}, costs, frozenset()).results
    }
    assert found["large"] == (10.0, 4.0) and found["other"] == pytest.approx((1.5, 1.25))
    assert found["lost"] == (None, None)


def test_a_merged_policy_has_a_verdict() -> None:
    merged = PolicyVariant("naive", set={"merge.method": "linear"})
    variants = {"naive": PolicyVariant("naive"), "merged": merged}
    rows = {name: {0: row(Recipe(name="x"))} for name in variants}
    one, other = task_results("reach", rows, variants, {}, {}, frozenset()).results
    assert one.bar is None and other.bar is not None


def test_a_seed_that_diverged_counts_in_no_estimate_and_costs_the_bar() -> None:
    """The others are as good as possible, so nothing else fails."""
    base = dataclasses.replace(row(Recipe(name="x")), success_seen=0.8, success_held_out=0.8)
    variants, costs = (
        {"naive": PolicyVariant("naive"), "other": PolicyVariant("lora")},
        {"other": Cost(1.0, 1.0)},
    )
    whole: dict[str, dict[int, Any]] = {"naive": {}, "other": {}}
    for s in range(3):
        little = 1e-4 * s
        naive = dataclasses.replace(base, drop_points=little)
        better = {"success_seen": 0.81 + little, "success_held_out": 0.9 + little}
        whole["naive"][s], whole["other"][s] = naive, dataclasses.replace(naive, **better)
    result = task_results("reach", whole, variants, {}, costs, frozenset()).results[1]
    assert result.bar.passed is True and result.diverged == []
    cut = {**whole, "other": {**whole["other"], 1: Divergence(12)}}
    result = task_results("reach", cut, variants, {}, costs, frozenset()).results[1]
    assert result.bar.passed is False and all(check.passed for check in result.bar.checks)
    assert result.diverged == [1] and result.accuracy.runs == result.seen_gain_points.runs == 2


def test_a_variant_of_which_nothing_is_left_has_no_figures() -> None:
    rows = {"a": {0: Divergence(1), 1: Divergence(2)}, "b": {0: row(Recipe(name="x"))}}
    table = task_results(
        "reach", rows, {"a": PolicyVariant("lora"), "b": PolicyVariant("ewc")}, {}, {}, frozenset()
    )
    assert (
        table.results[0].accuracy is None
        and table.results[0].diverged == [0, 1]
        and table.baseline_accuracy == 0.98
    )
    alone = task_results(
        "reach", {"a": rows["a"]}, {"a": PolicyVariant("lora")}, {}, {}, frozenset()
    )
    assert alone.baseline_accuracy is None


# --- declarations --------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [PolicyResult, StreamResult, Accuracies, PairResult])
def test_every_mean_of_a_result_is_declared_once(kind: type) -> None:
    """A figure without a declaration would be neither measured nor shown."""
    hints = get_type_hints(kind)
    means = {name for name, hint in hints.items() if hint == Mean}
    declared = columns(kind)
    assert means and means <= declared.keys()
    headers = [column.header for column in declared.values()]
    assert len(set(headers)) == len(headers)


@pytest.mark.parametrize("demands", [POLICY_BAR, open_loop_bar(0.02), STREAM_BAR])
def test_every_demand_is_of_a_figure_that_a_result_has(demands: tuple[Demand, ...]) -> None:
    kind = StreamResult if demands is STREAM_BAR else PolicyResult
    for demand in demands:
        first, _, rest = demand.of.partition(".")
        assert hasattr(kind, first) or first in get_type_hints(kind)
        assert not rest or rest in columns(PairResult)


def test_a_seeds_value_is_the_mean_over_its_places_and_no_values_have_no_summary() -> None:
    values = {("one", 0): 2.0, ("one", 1): 4.0, ("two", 0): 6.0, ("two", 1): 8.0}
    assert over_seeds(values) == estimate([4.0, 6.0])
    assert over_seeds({}) is None and lowest({}) is None and lowest(values) == 2.0
    assert ratio(1.0, 0.0) is None and points(0.5, 0.25) == 25.0
