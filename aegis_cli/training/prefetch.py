"""Fetch what comes next while what came before is worked on."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

T = TypeVar("T")
DEPTH = 3  # fetched ahead: one slow read from the disk does not stop a step


def depth(device: torch.device) -> int:
    """How many batches of a policy's training are fetched ahead.

    For a GPU they are sent there as the model reads them, where each takes up to gigabytes.
    """
    return DEPTH if device.type == "cpu" else 1


@contextmanager
def ahead(
    fetch: Callable[[int], T], indices: Sequence[int], depth: int = DEPTH
) -> Iterator[Iterator[T]]:
    """`map(fetch, indices)`, up to `depth` calls ahead in one thread.

    The calls are made one after the other, so that `fetch` may keep state. An exception comes out
    where its result would. The thread is gone when the context is left.
    """
    threads = torch.get_num_threads()
    # On one core: with a team of OpenMP threads of its own, the cores have more threads than they
    # bear, and every parallel region of the work itself begins and ends more slowly (a training
    # step on two cores took 1.3 times as long).
    pool = ThreadPoolExecutor(1, "prefetch", initializer=torch.set_num_threads, initargs=(1,))
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
