"""What a study found: means over seeds with 95 % intervals, differences to naive by seed, and who
passes the bar.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from aegis_cli.evaluation.estimates import ROUNDING, Estimate, estimate_known
from aegis_cli.recipes import Variant
from aegis_cli.studies.row import Divergence, Row
from aegis_cli.studies.tuning import Point
from aegis_cli.studies.verdict import Bar, Check, check, verdict

NAIVE = "naive"  # the variant that the others are measured against
MOST_DROP, LEAST_SEEN, LEAST_HELD_OUT = 0.1, -1.0, 0.0  # points
MOST_STEP_TIME = 1.05  # times naive's


@dataclass(frozen=True)
class Cost:
    """Ratios to naive's training step."""

    step_time: float
    peak_memory: float


@dataclass(frozen=True)
class Result:
    """One variant on one task.

    Estimates are over seeds: shares in [0, 1], `_points` in percentage points, cross-entropy in
    nats; `_gain_points` are differences to naive of the same seed. Of a task measured by its
    return, `return_share` (1: the highest there is) takes the place of successes and
    `return_gain_points` of their gains. `diverged` are the seeds whose training did, which no
    estimate counts and which cost a variant the bar. `bar` is None for naive and for methods that
    train on VQA data.
    """

    variant: str
    method: str
    knob: str | None
    value: Any
    diverged: list[int]
    accuracy: Estimate | None
    drop_points: Estimate | None
    cross_entropy: Estimate | None
    success_seen: Estimate | None
    success_held_out: Estimate | None
    wrong_target: Estimate | None
    return_share: Estimate | None
    validation_loss: Estimate | None
    w2: Estimate | None
    energy_shed: Estimate | None
    leak: Estimate | None
    seen_gain_points: Estimate | None
    held_out_gain_points: Estimate | None
    return_gain_points: Estimate | None
    step_time: float | None
    peak_memory: float | None
    bar: Bar | None


@dataclass(frozen=True)
class TaskResults:
    """One task's table; the baseline is the backbone before training, unknown as long as every
    training diverged.
    """

    task: str
    baseline_accuracy: float | None
    baseline_cross_entropy: float | None
    majority_accuracy: float | None
    results: list[Result]


@dataclass(frozen=True)
class StudyReport:
    """A study so far, also written to `table.json`: `finished` of `cells` trainings have been
    measured.
    """

    name: str
    finished: int
    cells: int
    seeds: list[int]
    tasks: list[TaskResults]
    tuning_task: str | None
    within: float | None
    tuning: list[Point]
    out: str

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


_MEASURED = (
    "accuracy",
    "drop_points",
    "cross_entropy",
    "success_seen",
    "success_held_out",
    "wrong_target",
    "return_share",
    "validation_loss",
    "w2",
    "energy_shed",
    "leak",
)
Rows = Mapping[int, Row]  # by seed


def task_results(
    task: str,
    found: Mapping[str, Mapping[int, Row | Divergence]],
    variants: Mapping[str, Variant],
    values: Mapping[str, Any],
    costs: Mapping[str, Cost],
    ceilings: frozenset[str],
) -> TaskResults:
    """One task's table.

    Args:
        found: variant -> seed -> what its training led to; at least one seed a variant.
        values: variant -> what its knob is set to.
        costs: variant -> ratios to naive; empty where there is no naive.
        ceilings: methods that train on VQA data.
    """
    naive = _rows(found.get(NAIVE, {}))
    results = [
        _result(
            name,
            variants[name],
            values.get(name),
            own,
            naive,
            costs.get(name),
            variants[name].method in ceilings,
        )
        for name, own in found.items()
    ]
    any_row = next((row for own in found.values() for row in _rows(own).values()), None)
    baseline = ("baseline_accuracy", "baseline_cross_entropy", "majority_accuracy")
    return TaskResults(task, *(any_row and getattr(any_row, field) for field in baseline), results)


def _rows(found: Mapping[int, Row | Divergence]) -> Rows:
    return {seed: row for seed, row in found.items() if isinstance(row, Row)}


def _result(
    name: str,
    variant: Variant,
    value: Any,
    found: Mapping[int, Row | Divergence],
    naive: Rows,
    cost: Cost | None,
    ceiling: bool,
) -> Result:
    rows = _rows(found)
    diverged = sorted(found.keys() - rows.keys())
    means = {
        field: estimate_known([getattr(row, field) for row in rows.values()]) for field in _MEASURED
    }
    other = {} if name == NAIVE else naive
    seen, held_out = (_gain(rows, other, field) for field in ("success_seen", "success_held_out"))
    barred = not ceiling and variant.method != NAIVE
    returned = _gain(rows, other, "return_share")
    passed = bar(
        means["drop_points"],
        seen,
        held_out,
        None if cost is None else cost.step_time,
        bool(diverged),
    )
    return Result(
        variant=name,
        method=variant.method,
        knob=variant.knob,
        value=value,
        diverged=diverged,
        **means,
        seen_gain_points=seen,
        held_out_gain_points=held_out,
        return_gain_points=returned,
        step_time=None if cost is None else cost.step_time,
        peak_memory=None if cost is None else cost.peak_memory,
        bar=passed if barred else None,
    )


def _gain(rows: Rows, naive: Rows, field: str) -> Estimate | None:
    """100 (variant - naive), paired by seed: both began with the same expert and saw the same
    batches.
    """
    pairs = [
        (getattr(rows[s], field), getattr(naive[s], field))
        for s in sorted(rows.keys() & naive.keys())
    ]
    return estimate_known([None if a is None or b is None else 100 * (a - b) for a, b in pairs])


def bar(
    drop: Estimate | None,
    seen: Estimate | None,
    held_out: Estimate | None,
    step_time: float | None,
    diverged: bool = False,
) -> Bar:
    """Whether a method that trains on no VQA data is one to prefer to naive.

    It keeps VQA, learns as well, generalises better, and costs no more. A task measured by its
    return has no colours to generalise to, and so no verdict but by a check that fails. A drop is
    nil if it is exactly 0, or at most 0.1 points with an interval that reaches 0; the other demands
    are on means.
    """
    checks = [
        check("VQA drop", f"<= {MOST_DROP:g} points, interval to 0", drop, drop and _nil(drop)),
        check(
            "success seen - naive",
            f">= {LEAST_SEEN:g} point",
            seen,
            seen and seen.mean >= LEAST_SEEN - ROUNDING,
        ),
        check(
            "success held-out - naive",
            f"> {LEAST_HELD_OUT:g} points",
            held_out,
            held_out and held_out.mean > LEAST_HELD_OUT + ROUNDING,
        ),
        Check(
            "step time",
            f"<= {MOST_STEP_TIME:g} x naive",
            step_time,
            None,
            step_time and step_time <= MOST_STEP_TIME,
        ),
        Check(
            "VQA questions in training", "none", 0.0, None, True
        ),  # a method with some has no bar at all
    ]
    return verdict(checks, diverged)


def _nil(drop: Estimate) -> bool:
    return drop.mean == 0 or (
        drop.mean <= MOST_DROP + ROUNDING and drop.interval is not None and drop.interval[0] <= 0
    )
