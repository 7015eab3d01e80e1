"""Fetch what comes next while what came before is worked on."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

from aegis_cli.common import launch, processes

T = TypeVar("T")
DEPTH = 3  # fetched ahead: one slow read from the disk does not stop a step
_MOST_WORKERS = 8


def workers() -> int:
    """Threads that prepare batches for a GPU: this process's share of the cores, but for one."""
    cores = processes.threads_per_worker(launch.local_world_size())
    return min(max(1, cores - 1), _MOST_WORKERS)


@contextmanager
def ahead(
    fetch: Callable[[int], T], indices: Sequence[int], depth: int = DEPTH, workers: int = 1
) -> Iterator[Iterator[T]]:
    """`map(fetch, indices)`, up to `depth` calls ahead in threads of their own.

    One thread makes the calls one after the other, so that `fetch` may keep state; with several
    `workers` it may not. An exception comes out where its result would. The threads are gone when
    the context is left.
    """
    threads = torch.get_num_threads()
    # On one core each: with a team of OpenMP threads of its own, the cores have more threads than
    # they bear, and every parallel region of the work itself begins and ends more slowly (a
    # training step on two cores took 1.3 times as long).
    one_core = {"initializer": torch.set_num_threads, "initargs": (1,)}
    pool = ThreadPoolExecutor(workers, "prefetch", **one_core)
    try:
        yield _results(pool, fetch, indices, depth)
    finally:
        pool.shutdown(cancel_futures=True)
        torch.set_num_threads(threads)  # what threads that begin later take


def _results(
    pool: ThreadPoolExecutor, fetch: Callable[[int], T], indices: Sequence[int], depth: int
) -> Iterator[T]:
    waiting: deque[Future[T]] = deque()
    for index in indices:
        waiting.append(pool.submit(fetch, index))
        if len(waiting) > depth:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()
