"""Which recorded episodes become demonstrations: the successes, or those of highest return."""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from aegis_cli.common import media
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress
from aegis_cli.common.processes import mapped
from aegis_cli.sim.recording import RecordedEpisode

# The share of the episodes, those with the lowest return, that is dropped by default.
DROP_BELOW = 0.25
_QUANTILES = {"min": 0.0, "q25": 0.25, "median": 0.5, "q75": 0.75, "max": 1.0}
_FIX = "free some memory, or ask for fewer episodes"


@dataclass
class Seen:
    """What was recorded so far.

    `attempts` and `returns` cover every episode; `frames`, `kept_returns` and the `first` few only
    the kept ones. `failures` counts the failures of each task of a set.
    """

    attempts: int = 0
    frames: int = 0
    returns: list[float] = field(default_factory=list)
    kept_returns: list[float] = field(default_factory=list)
    first: list[RecordedEpisode] = field(default_factory=list)
    failures: Counter[str] = field(default_factory=Counter)

    @property
    def success(self) -> float:
        """Share of the attempts that did not fail."""
        return (self.attempts - self.failures.total()) / self.attempts

    def keep(self, episode: RecordedEpisode) -> RecordedEpisode:
        """Count an episode as kept, and return it."""
        self.frames += len(episode.actions)
        if len(self.first) < media.SHEET_EPISODES:  # more would hold all pictures in memory
            self.first.append(episode)
        if episode.total_reward is not None:
            self.kept_returns.append(episode.total_reward)
        return episode


def shares(tasks: Sequence[str], episodes: int) -> dict[str, int]:
    """How many episodes each task of a set gets when they take turns."""
    return {task: len(range(turn, episodes, len(tasks))) for turn, task in enumerate(tasks)}


def successes(
    record: partial[RecordedEpisode],
    episodes: int,
    workers: int,
    seen: Seen,
    on_event: OnEvent,
    tasks: Sequence[str],
) -> Generator[RecordedEpisode, None, None]:
    """The first `episodes` successes in the order of their numbers, divided among `tasks`.

    Failures of a task are replaced by later numbers, so that every task gets its share in the end.

    Raises:
        AegisError: the expert keeps failing.
    """
    left = shares(tasks, episodes)
    # An expert may fail half of the time, and a few episodes even more often by chance.
    limit = 2 * episodes + 20 * len(tasks)
    with mapped(record, range(limit), workers, "a recording process", _FIX, chunk=4) as results:
        for number, episode in enumerate(results):
            task = tasks[number % len(tasks)]
            seen.attempts = number + 1
            if not episode.success:
                seen.failures[task] += 1
            elif left[task]:  # otherwise the task already has its share
                left[task] -= 1
                kept = episodes - sum(left.values())
                figures = {"success": seen.success}
                on_event(Progress("demos", kept, episodes, "episodes", figures))
                yield seen.keep(episode)
                if kept == episodes:
                    return
    lacking = ", ".join(task for task, count in left.items() if count)
    raise AegisError(
        f"the expert succeeded in {episodes - sum(left.values())} of {limit} episodes",
        f"{episodes} successes; there are too few of {lacking}",
        "lower --noise",
    )


def attempts(episodes: int, drop_below: float) -> int:
    """How many episodes to record so that `episodes` are left after dropping that share."""
    exact = episodes / (1 - drop_below)
    return math.ceil(exact - 1e-9)  # 3 / (1 - 0.25) is 4, whatever a float says


def best(
    record: partial[RecordedEpisode],
    episodes: int,
    total: int,
    workers: int,
    seen: Seen,
    on_event: OnEvent,
) -> Generator[RecordedEpisode, None, None]:
    """The `episodes` highest returns among the first `total` episodes, in order of their numbers.

    Among equal returns the earlier ones are kept. No more than `episodes` + 1 episodes are held in
    memory.
    """
    # A heap: the lowest return comes first, and among equal ones the highest number.
    kept: list[tuple[float, int, RecordedEpisode]] = []
    with mapped(record, range(total), workers, "a recording process", _FIX) as results:
        for number, episode in enumerate(results):
            seen.attempts = number + 1
            assert episode.total_reward is not None
            seen.returns.append(float(episode.total_reward))
            heapq.heappush(kept, (seen.returns[-1], -number, episode))
            if len(kept) > episodes:
                heapq.heappop(kept)  # the worst so far
            figures = {"return": float(np.mean(seen.returns))}
            on_event(Progress("demos", seen.attempts, total, "episodes", figures))
    kept.sort(key=lambda entry: entry[1])  # numbers are negative: the first one is the last entry
    while kept:  # popped, so that episodes are freed once they are written
        yield seen.keep(kept.pop()[2])


def summary(returns: list[float]) -> dict[str, float] | None:
    """Mean and quantiles of the returns; None if there are none."""
    if not returns:
        return None
    found = {"mean": float(np.mean(returns))}
    for name, share in _QUANTILES.items():
        found[name] = float(np.quantile(returns, share))
    return found
