"""Work that several processes share out among themselves."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import TypeVar

from aegis_cli import interrupts
from aegis_cli.errors import AegisError

Item = TypeVar("Item")
Result = TypeVar("Result")


@contextmanager
def mapped(
    work: Callable[[Item], Result], items: Sequence[Item], workers: int, name: str, fix: str, chunk: int = 1
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
        with interrupts.held():  # the first calls start the workers
            results = pool.map(work, items, chunksize=chunk)
        yield results
    except BrokenProcessPool:
        raise AegisError(f"a {name} process died", f"{workers} processes that live", fix) from None
    finally:
        pool.shutdown(cancel_futures=True)
