"""How a variant's knob is chosen: the same rule for every variant, on validation scenes and
episodes only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from aegis_cli.evaluation.estimates import ROUNDING


@dataclass(frozen=True)
class Point:
    """One value of a variant's knob (None: it has none) and what it led to on the validation split;
    shares in [0, 1].

    `success` is on seen colours, or, of a task measured by its return, its share of the highest
    return; None if the
    training diverged: what cannot be rolled out is never tuned.
    """

    variant: str
    method: str
    value: Any
    accuracy: float | None
    baseline_accuracy: float | None
    success: float | None
    chosen: bool = False


def choose(points: Mapping[str, Sequence[Point]], within: float) -> dict[str, int]:
    """Which of its points each variant gets, by number.

    Among a variant's values whose success is within `within` points of the best naive value's (of
    the best value of all, if no variant is naive), the one with the highest VQA accuracy; ties by
    success, then the order written. If none is within, the one with the highest success; ties by
    accuracy, then the order written. A value that diverged has less than no success.
    """
    everyone = [point for own in points.values() for point in own]
    best = max(_success(p) for p in ([p for p in everyone if p.method == "naive"] or everyone))
    least = best - within / 100 - ROUNDING
    return {variant: _best(own, max(least, 0)) for variant, own in points.items()}


def _success(point: Point) -> float:
    return -1.0 if point.success is None else point.success


def _best(own: Sequence[Point], least: float) -> int:
    able = [i for i, point in enumerate(own) if _success(point) >= least]
    if able:
        return max(able, key=lambda i: (own[i].accuracy or 0.0, _success(own[i]), -i))
    return max(range(len(own)), key=lambda i: (_success(own[i]), own[i].accuracy or 0.0, -i))
