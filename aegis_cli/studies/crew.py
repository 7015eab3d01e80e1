"""Cells of a study measured by several processes at once, each with its share of the cores."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import Queue
from pathlib import Path
from typing import Protocol, TypeVar

import torch

from aegis_cli.common import interrupts
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress
from aegis_cli.recipes import Recipe, StreamRecipe

_LISTEN_S = 0.2  # between looks at what the processes report
Found = TypeVar("Found")


@dataclass(frozen=True)
class Cell:
    """One training: its run folder below the study's, and whether it is measured on the validation
    split.
    """

    label: str
    recipe: Recipe | StreamRecipe
    validation: bool = False


class Bench(Protocol[Found]):
    """What measures cells, below one folder."""

    def outcome(
        self, label: str, recipe: Recipe | StreamRecipe, validation: bool = False
    ) -> Found: ...


Make = Callable[[Path, OnEvent], Bench[Found]]


def measure(
    make: Make[Found], folder: Path, cells: Sequence[Cell], workers: int, on_event: OnEvent
) -> Iterator[tuple[int, Found]]:
    """Measure cells with different labels, `workers` at a time; what they share has to be there.

    Args:
        make: called in each process; it travels there by name.

    Yields:
        the number of a cell and what it led to, as they finish.

    Raises:
        AegisError: what a stage finds wrong, or a process that died; the others are stopped, at a
            step to resume from.
    """
    spawn = multiprocessing.get_context(
        "spawn"
    )  # a forked child would inherit OpenGL's context and torch's threads
    reports: Queue[Progress] = spawn.Queue()
    threads = max(1, (os.cpu_count() or 1) // workers)
    pool = ProcessPoolExecutor(workers, spawn, _begin, (make, folder, reports, threads))
    with _stopped(pool):
        with interrupts.held():  # the first calls start the processes
            numbers = {pool.submit(_measured, cell): i for i, cell in enumerate(cells)}
        yield from _finished(numbers, reports, on_event)


def _finished(
    numbers: dict[Future[Found], int], reports: Queue[Progress], on_event: OnEvent
) -> Iterator[tuple[int, Found]]:
    waiting = set(numbers)
    while waiting:
        done, waiting = wait(waiting, _LISTEN_S, FIRST_COMPLETED)
        while not reports.empty():
            on_event(reports.get())
        for future in sorted(done, key=lambda f: numbers[f]):
            try:
                yield numbers[future], future.result()
            except BrokenProcessPool:
                fix = (
                    "free some memory or use fewer --workers, then run the same command "
                    "again: it goes on"
                )
                raise AegisError(
                    "a process of the study died", "processes that live", fix
                ) from None


@contextlib.contextmanager
def _stopped(pool: ProcessPoolExecutor) -> Iterator[None]:
    """Processes that are still at work when the block ends are stopped, not waited for."""
    before = set(multiprocessing.active_children())
    try:
        yield
    finally:
        for process in set(multiprocessing.active_children()) - before:
            process.terminate()
        pool.shutdown(cancel_futures=True)


# --- in a process of its own ----------------------------------------------------------------------

_bench: Bench


def _begin(make: Make, folder: Path, reports: Queue[Progress], threads: int) -> None:
    global _bench
    _bench = make(folder, reports.put)
    torch.set_num_threads(threads)


def _measured(cell: Cell) -> object:
    return _bench.outcome(cell.label, cell.recipe, cell.validation)
