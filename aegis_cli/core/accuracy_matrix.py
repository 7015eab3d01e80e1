"""What a stream of T tasks left: figures of R [T, T], R[t, i] the accuracy on task i after learning
tasks 0 to t.

Transfer, Average and Last are the field's (ZSCL, arXiv 2303.06628). Forgetting has several
definitions; here it is, over the tasks before the last, the mean of the best accuracy from the
task's own learning on, less the final one:

    Transfer   = mean over i >= 1 of mean over t < i of R[t, i]
    Average    = mean over t and i of R[t, i]
    Last       = mean over i of R[T-1, i]
    forgetting = mean over i < T-1 of (max over t >= i of R[t, i]) - R[T-1, i]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

Rows = Sequence[Sequence[float]]


@dataclass(frozen=True)
class StreamScores:
    """Shares in [0, 1]; a stream of one task has no transfer and no forgetting."""

    transfer: float | None
    average: float
    last: float
    forgetting: float | None


@dataclass(frozen=True)
class SeenScores:
    """Shares in [0, 1], over entries with t >= i alone: for tasks that cannot be tried before they
    are learned.
    """

    average: float
    last: float
    forgetting: float | None


def scores(rows: Rows) -> StreamScores:
    """The figures of a full matrix: T rows of T accuracies."""
    count = len(rows)
    ahead = [_mean([rows[t][i] for t in range(i)]) for i in range(1, count)]
    average = _mean([r for row in rows for r in row])
    return StreamScores(
        _mean(ahead) if ahead else None, average, _mean(rows[-1]), _forgetting(rows)
    )


def seen_scores(rows: Rows) -> SeenScores:
    """The figures of a triangle: row t has t + 1 entries, of the tasks learned so far."""
    return SeenScores(_mean([r for row in rows for r in row]), _mean(rows[-1]), _forgetting(rows))


def _forgetting(rows: Rows) -> float | None:
    count = len(rows)
    lost = [max(rows[t][i] for t in range(i, count)) - rows[-1][i] for i in range(count - 1)]
    return _mean(lost) if lost else None


def reuse_rate(masses: Sequence[Sequence[float]]) -> float | None:
    """Mean over tasks after the first, and over maps, of the routing mass on experts of earlier
    tasks.

    Args:
        masses: of each task, of each map, that mass in [0, 1]; None is the answer for a single task
            or without maps.
    """
    later = [mass for task in masses[1:] for mass in task]
    return _mean(later) if later else None


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)
