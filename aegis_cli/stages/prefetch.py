"""Fetch what comes next while what came before is worked on."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")
DEPTH = 3  # fetched ahead: one slow read from the disk does not stop a step


@contextmanager
def ahead(fetch: Callable[[int], T], indices: Sequence[int]) -> Iterator[Iterator[T]]:
    """`map(fetch, indices)`, up to `DEPTH` calls ahead in one thread, which is gone when the context is left.

    The calls are made one after the other, so that `fetch` may keep state. An exception comes out where its result would.
    """
    pool = ThreadPoolExecutor(1, "prefetch")
    try:
        yield _results(pool, fetch, indices)
    finally:
        pool.shutdown(cancel_futures=True)


def _results(pool: ThreadPoolExecutor, fetch: Callable[[int], T], indices: Sequence[int]) -> Iterator[T]:
    waiting: deque[Future[T]] = deque()
    for index in indices:
        waiting.append(pool.submit(fetch, index))
        if len(waiting) > DEPTH:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()
