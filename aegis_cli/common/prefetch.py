"""Prefetching: fetch the next items while earlier ones are being processed."""

from __future__ import annotations

import dataclasses
import os
import sys
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

import torch

from aegis_cli.common import devices, launch, memory, processes

Item = TypeVar("Item")
T = TypeVar("T")
DEPTH = 3  # items fetched ahead, so that one slow disk read does not stall a step
_MOST_WORKERS = 16  # by default: a batch of split images takes gigabytes
_asked: ContextVar[int | None] = ContextVar("workers", default=None)


def workers() -> int:
    """Number of threads that prepare batches for a GPU.

    It is what `using` asks for, else this process's share of the cores minus one, at most 16.
    """
    asked = _asked.get()
    if asked is not None:
        return asked
    cores = processes.threads_per_worker(launch.local_world_size())
    # A job of a cluster may run on some of the machine's cores only.
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else cores
    return min(max(1, min(cores, allowed) - 1), _MOST_WORKERS)


@contextmanager
def using(workers: int | None) -> Generator[None]:
    """Inside, this many threads prepare a GPU's batches; None: the default number."""
    before = _asked.set(workers)
    try:
        yield
    finally:
        _asked.reset(before)


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
    with ahead(make, items, min(count, DEPTH), count) as made:
        yield made


@contextmanager
def ahead(
    fetch: Callable[[Item], T], items: Iterable[Item], depth: int = DEPTH, workers: int = 1
) -> Generator[Iterator[T]]:
    """`map(fetch, items)`, up to `depth` calls ahead in separate threads.

    With more `workers` than `depth`, `depth` doubles each time that a result is not ready when it
    is requested, up to the number of workers or as far as the memory suffices. So many results wait
    in memory only if a few would not be enough.

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
        yield _results(pool, fetch, items, depth, workers)
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
    pool: ThreadPoolExecutor,
    fetch: Callable[[Item], T],
    items: Iterable[Item],
    depth: int,
    workers: int,
) -> Iterator[T]:
    waiting: deque[Future[T]] = deque()
    for item in items:
        waiting.append(pool.submit(fetch, item))
        if len(waiting) > depth:
            waited = not waiting[0].done()
            result = waiting.popleft().result()
            if waited and depth < workers:
                depth = min(2 * depth, workers, depth + _room_for(result))
            yield result
    while waiting:
        yield waiting.popleft().result()


def _room_for(result: object) -> int:
    """How many more such results may be made at the same time.

    Each takes up to twice its size while it is made, and half of the free memory stays free.
    """
    free, size = memory.free(torch.device("cpu")), _bytes(result)
    if free is None or size == 0:
        return sys.maxsize
    return free // launch.local_world_size() // (4 * size)


def _bytes(thing: object) -> int:
    """Bytes of the tensors in a result."""
    if isinstance(thing, torch.Tensor):
        return thing.nbytes
    if dataclasses.is_dataclass(thing):
        return sum(_bytes(getattr(thing, field.name)) for field in dataclasses.fields(thing))
    if isinstance(thing, Mapping):
        return sum(map(_bytes, thing.values()))
    if isinstance(thing, list | tuple):
        return sum(map(_bytes, thing))
    return 0
