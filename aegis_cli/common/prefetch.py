"""Fetch what comes next while what came before is worked on."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

from aegis_cli.common import devices, launch, processes

Item = TypeVar("Item")
T = TypeVar("T")
DEPTH = 3  # fetched ahead: one slow read from the disk does not stop a step
_MOST_WORKERS = 4  # as many as LeRobot's loader has; a batch of split images takes gigabytes


def workers() -> int:
    """Threads that prepare batches for a GPU: this process's share of the cores, but for one."""
    cores = processes.threads_per_worker(launch.local_world_size())
    return min(max(1, cores - 1), _MOST_WORKERS)


@contextmanager
def for_device(
    make: Callable[[Item], T], items: Iterable[Item], device: torch.device
) -> Generator[Iterator[T]]:
    """`map(make, items)`, where `make` prepares on the CPU what the device is to work on.

    For a GPU several threads call `make`, as a model's own processor can take longer for a batch
    than a GPU. A CPU has no time to spare, and takes one after the other.
    """
    if not devices.reading_stalls(device):
        yield map(make, items)
        return
    count = workers()
    with ahead(make, items, count, count) as made:
        yield made


@contextmanager
def ahead(
    fetch: Callable[[Item], T], items: Iterable[Item], depth: int = DEPTH, workers: int = 1
) -> Generator[Iterator[T]]:
    """`map(fetch, items)`, up to `depth` calls ahead in threads of their own.

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
        yield _results(pool, fetch, items, depth)
    finally:
        pool.shutdown(cancel_futures=True)
        torch.set_num_threads(threads)  # what threads that begin later take


def one_ahead(make: Callable[[Item], T], following: Callable[[Item], Item]) -> Callable[[Item], T]:
    """`make`, which has what follows an item ready when that is asked for.

    One thread makes all, one after the other. It is gone when nobody has the function any more.

    Args:
        following: the item that is asked for after this one, or after others between.
    """
    pool = ThreadPoolExecutor(1, "prefetch")
    waiting: dict[Item, Future[T]] = {}

    def call(item: Item) -> T:
        made = waiting.pop(item, None) or pool.submit(make, item)
        upcoming = following(item)
        waiting[upcoming] = pool.submit(make, upcoming)
        return made.result()

    return call


def _results(
    pool: ThreadPoolExecutor, fetch: Callable[[Item], T], items: Iterable[Item], depth: int
) -> Iterator[T]:
    waiting: deque[Future[T]] = deque()
    for item in items:
        waiting.append(pool.submit(fetch, item))
        if len(waiting) > depth:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()
