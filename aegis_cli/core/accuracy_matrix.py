"""Figures of a stream's accuracy matrix: transfer, average, last and forgetting.

R [T, T] holds the accuracy R[t, i] on task i after learning tasks 0 to t. Transfer, Average and
Last are defined as in ZSCL (arXiv 2303.06628). Forgetting has several definitions in the field.
Here it is the best accuracy since the task was learned minus the final one, averaged over all tasks
but the last:

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
    """Figures of a full matrix, as fractions in [0, 1].

    A stream of one task has no transfer and no forgetting: both are None.
    """

    transfer: float | None
    average: float
    last: float
    forgetting: float | None


@dataclass(frozen=True)
class SeenScores:
    """Figures for tasks that cannot be evaluated before they are learned.

    They are fractions in [0, 1], or errors, and use only the entries with t >= i.
    """

    average: float
    last: float
    forgetting: float | None


def scores(rows: Rows) -> StreamScores:
    """The figures of a full matrix: T rows of T accuracies."""
    before_learning = []
    for i in range(1, len(rows)):
        # Above the diagonal of column i, task i is evaluated before it is learned.
        before_learning.append(_mean([rows[t][i] for t in range(i)]))
    # The mean of the columns' means, not of all entries: otherwise later tasks would weigh more,
    # because more entries of their columns are above the diagonal.
    transfer = _mean(before_learning) if before_learning else None
    average = _mean([accuracy for row in rows for accuracy in row])
    return StreamScores(transfer, average, _mean(rows[-1]), _forgetting(rows))


def seen_scores(rows: Rows) -> SeenScores:
    """The figures of a triangle: row t has t + 1 entries, of the tasks learned so far."""
    average = _mean([accuracy for row in rows for accuracy in row])
    return SeenScores(average, _mean(rows[-1]), _forgetting(rows))


def seen_error_scores(rows: Rows) -> SeenScores:
    """The figures of a triangle of errors, where lower is better.

    Forgetting is how much the errors have grown: the final one minus the smallest since the task
    was learned.
    """
    found = seen_scores([[-error for error in row] for row in rows])
    return SeenScores(-found.average, -found.last, found.forgetting)


def _forgetting(rows: Rows) -> float | None:
    count = len(rows)
    lost = []
    for i in range(count - 1):  # nothing was learned after the last task
        # Rows before i are left out: task i was not learned yet, and a triangle has no such entry.
        best = max(rows[t][i] for t in range(i, count))
        lost.append(best - rows[-1][i])
    return _mean(lost) if lost else None


def reuse_rate(masses: Sequence[Sequence[float]]) -> float | None:
    """Mean routing mass on experts of earlier tasks, over maps and over tasks after the first.

    Args:
        masses: the routing mass on earlier tasks' experts, in [0, 1], per task and per map.

    Returns:
        The mean; None for a single task, or without maps.
    """
    # The first task has no earlier experts to reuse.
    later = [mass for task in masses[1:] for mass in task]
    return _mean(later) if later else None


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)
