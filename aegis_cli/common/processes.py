"""Work that several processes share out among themselves."""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import TypeVar

from aegis_cli.common import interrupts
from aegis_cli.common.errors import AegisError

Item = TypeVar("Item")
Result = TypeVar("Result")
# chunks a worker that are computed or wait for whoever takes the results: else these pile up in
# memory
_AHEAD = 2


@contextmanager
def mapped(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    workers: int,
    name: str,
    fix: str,
    chunk: int = 1,
) -> Iterator[Iterator[Result]]:
    """`map(work, items)`, over `workers` processes if more than one; stops early when left.

    Args:
        name, fix: the work's, and what to do, for the error of a process that dies.
        chunk: items that a process takes at a time.
    """
    if workers == 1:
        yield map(work, items)
        return
    # spawn: a forked child would inherit this process's OpenGL context and torch's threads
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"))
    try:
        yield _results(pool, work, items, chunk, _AHEAD * workers)
    except BrokenProcessPool:
        raise AegisError(f"a {name} process died", f"{workers} processes that live", fix) from None
    finally:
        pool.shutdown(cancel_futures=True)


def _results(
    pool: ProcessPoolExecutor,
    work: Callable[[Item], Result],
    items: Sequence[Item],
    chunk: int,
    ahead: int,
) -> Iterator[Result]:
    """In the order of the items, whose chunks are handed out as the results are taken."""
    waiting: deque[Future[list[Result]]] = deque()
    for start in range(0, len(items), chunk):
        with interrupts.held():  # a call may start a worker
            waiting.append(pool.submit(_each, work, items[start : start + chunk]))
        if len(waiting) == ahead:
            yield from waiting.popleft().result()
    while waiting:
        yield from waiting.popleft().result()


def _each(work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    return [work(item) for item in items]
