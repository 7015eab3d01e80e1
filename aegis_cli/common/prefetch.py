"""Prefetching: fetch the next items while earlier ones are being processed."""

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
DEPTH = 3  # items fetched ahead, so that one slow disk read does not stall a step
_MOST_WORKERS = 4  # as in LeRobot's loader; a batch of split images takes gigabytes


def workers() -> int:
    """Number of threads that prepare batches for a GPU: this process's cores minus one."""
    cores = processes.threads_per_worker(launch.local_world_size())
    return min(max(1, cores - 1), _MOST_WORKERS)


@contextmanager
def for_device(
    make: Callable[[Item], T], items: Iterable[Item], device: torch.device
) -> Generator[Iterator[T]]:
    """`map(make, items)`, where `make` prepares on the CPU what the device will process.

    For a GPU several threads call `make`, because a model's own processor can take longer for a
    batch than the GPU. For a CPU, which has no time to spare, the calls are made one by one.
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
    """`map(fetch, items)`, up to `depth` calls ahead in separate threads.

    A single worker makes the calls in order, so `fetch` may keep state; with several `workers` it
    may not. An exception is raised where its result would be. The threads end with the context.
    """
    threads = torch.get_num_threads()
    # One core each: if each had its own team of OpenMP threads, the cores would be oversubscribed,
    # and every parallel region of the main work would start and end more slowly (a training step on
    # two cores took 1.3 times as long).
    one_core = {"initializer": torch.set_num_threads, "initargs": (1,)}
    pool = ThreadPoolExecutor(workers, "prefetch", **one_core)
    try:
        yield _results(pool, fetch, items, depth)
    finally:
        pool.shutdown(cancel_futures=True)
        torch.set_num_threads(threads)  # the setting that threads started later inherit


def one_ahead(make: Callable[[Item], T], following: Callable[[Item], Item]) -> Callable[[Item], T]:
    """`make` with prefetching: the result for the following item is ready when it is requested.

    One thread makes all of them in order. It ends when the function is garbage-collected.

    Args:
        following: an item -> the one that will be requested after it, perhaps with others between.
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
