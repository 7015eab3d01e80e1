"""A task's environments, in this process or distributed over several that run in parallel."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from aegis_cli import sim
from aegis_cli.common.processes import WorkerPool
from aegis_cli.sim.contract import Observation, Step, TaskEnv, TaskSpec

Item = TypeVar("Item")


@dataclass(frozen=True)
class Wanted:
    """A requested environment: the arguments of `sim.make`."""

    task: str
    number: int
    seen_by: tuple[str, ...] = ()
    published: bool = False

    def made(self) -> TaskEnv:
        """A new environment in this process."""
        return sim.make(
            self.task, number=self.number, seen_by=self.seen_by, published=self.published
        )


class Simulators:
    """Creates a task's environments; returned by `opened`.

    An environment behaves the same in any process.

    Args:
        pools: pools of one simulating process each; empty to use only this process.
        threads: a pool with one thread for each environment that acts.
    """

    def __init__(self, pools: Sequence[WorkerPool], threads: ThreadPoolExecutor) -> None:
        self._pools, self._threads = pools, threads
        self._turns = itertools.count()

    def make(self, wanted: Wanted) -> TaskEnv:
        """A new environment; the processes take turns."""
        turn = next(self._turns)
        if not self._pools:
            return wanted.made()
        return _Elsewhere(self._pools[turn % len(self._pools)], turn, wanted)

    def each(
        self,
        act: Callable[[Item], object],
        items: Iterable[Item],
        told: Callable[[int], object] = lambda _: None,
    ) -> None:
        """Call `act` with each item, in parallel if there are several processes.

        Args:
            told: called in this thread with the number of items that are done, in order.
        """
        results = self._threads.map(act, items) if self._pools else map(act, items)
        for done, _ in enumerate(results, 1):
            told(done)


@contextmanager
def opened(workers: int, at_once: int) -> Generator[Simulators]:
    """Simulators for the length of a `with` block.

    Args:
        workers: number of simulating processes; 1: only this process.
        at_once: number of environments that act at the same time.

    Raises:
        AegisError: at the end of the block, if a process died in it.
    """
    fix = "there may be too little memory for it: see free -h, and ulimit -v"
    # An environment stays in one process, so each process is a pool of its own.
    several = range(workers) if workers > 1 else ()
    pools = [WorkerPool(1, "a simulating process", fix) for _ in several]
    # A thread for each environment, which mostly waits for its process: no process is idle while
    # one of its environments has something to do.
    with ThreadPoolExecutor(at_once) as threads, ExitStack() as processes:
        for pool in pools:
            processes.enter_context(pool)
        yield Simulators(pools, threads)


class _Elsewhere:
    """A `contract.TaskEnv` in another process, where it is stored under a key."""

    def __init__(self, pool: WorkerPool, key: int, wanted: Wanted) -> None:
        self._pool, self._key = pool, key
        self.spec: TaskSpec
        self.spec = pool.submit(_make, key, wanted).result()
        self.target_color: str | None = None

    def reset(self, rng: np.random.Generator, target_colors: Sequence[str]) -> Observation:
        seen, self.target_color = self._pool.submit(
            _reset, self._key, rng, tuple(target_colors)
        ).result()
        return seen

    def step(self, action: np.ndarray, look: bool = True) -> Step:
        return self._call("step", action, look)

    def expert_action(self) -> np.ndarray:
        return self._call("expert_action")

    def distance(self) -> float | None:
        return self._call("distance")

    def target_circle(self) -> tuple[float, float, float] | None:
        return self._call("target_circle")

    def _call(self, name: str, *arguments: Any) -> Any:
        return self._pool.submit(_call, self._key, name, *arguments).result()


# --- in a process ---------------------------------------------------------------------------------

_HERE: dict[int, TaskEnv] = {}


def _make(key: int, wanted: Wanted) -> TaskSpec:
    _HERE[key] = wanted.made()
    return _HERE[key].spec


def _reset(
    key: int, rng: np.random.Generator, target_colors: Sequence[str]
) -> tuple[Observation, str | None]:
    seen = _HERE[key].reset(rng, target_colors)
    return seen, _HERE[key].target_color


def _call(key: int, name: str, *arguments: Any) -> Any:
    return getattr(_HERE[key], name)(*arguments)
