"""A limit on the accuracy that a model may lose, and whether a drop is within it."""

from __future__ import annotations

from collections.abc import Sequence

from aegis_cli.common.limits import ROUNDING

MEAN, UPPER = "mean", "upper"  # which figure of a drop a gate limits


def passes(
    drop_points: float, interval: Sequence[float] | None, max_drop: float, gate: str = MEAN
) -> bool:
    """Whether a drop passes a gate; a drop exactly at the limit does.

    Args:
        drop_points, max_drop: percentage points.
        interval: the ends of the drop's 95 % interval; without one the drop itself is used.
        gate: MEAN for the drop as measured, or UPPER for the upper end of its interval.
    """
    limited = drop_points if gate == MEAN or interval is None else interval[1]
    return limited <= max_drop + ROUNDING
