"""How a learner's knob is chosen: the same rule for every variant, on validation parts only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from aegis_cli.evaluation.estimates import ROUNDING


@dataclass(frozen=True)
class StreamPoint:
    """One value of a variant's knob (None: it has none) and what it led to.

    `last` is a share in [0, 1], on validation parts with the task told; None if the training
    diverged.
    """

    variant: str
    method: str
    value: Any
    last: float | None
    parameters: int | None
    chosen: bool = False


def choose(own: Sequence[StreamPoint], within: float) -> int:
    """Which of a variant's points it gets, by number.

    Of those whose Last is within `within` points of the variant's best, the one with the fewest
    final parameters; ties by Last, then the order written. One that diverged is chosen only where
    all did.
    """
    best = max(_last(point) for point in own)
    able = [
        i
        for i, point in enumerate(own)
        if _last(point) >= best - within / 100 - ROUNDING and point.last is not None
    ]
    return min(able, key=lambda i: (own[i].parameters, -own[i].last, i)) if able else 0


def _last(point: StreamPoint) -> float:
    return -1.0 if point.last is None else point.last
