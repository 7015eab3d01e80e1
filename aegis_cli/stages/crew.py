"""Cells of a study measured by several processes at once, each with its share of the cores."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cache
from multiprocessing import Queue
from pathlib import Path

import torch

from aegis_cli import interrupts
from aegis_cli.errors import AegisError
from aegis_cli.events import OnEvent, Progress
from aegis_cli.recipe import Recipe
from aegis_cli.stages.job import Job
from aegis_cli.stages.row import Divergence, Row

_LISTEN_S = 0.2  # between looks at what the processes report


@dataclass(frozen=True)
class Cell:
    """One training: its run folder below the study's, and whether it is measured on the validation split."""

    label: str
    recipe: Recipe
    validation: bool = False


def measure(folder: Path, cells: Sequence[Cell], workers: int, on_event: OnEvent) -> Iterator[tuple[int, Row | Divergence]]:
    """Measure cells with different labels, `workers` at a time; what they share has to be there.

    Yields:
        the number of a cell and what it led to, as they finish.

    Raises:
        AegisError: what a stage finds wrong, or a process that died; the others are stopped, at a step to resume from.
    """
    spawn = multiprocessing.get_context("spawn")  # a forked child would inherit OpenGL's context and torch's threads
    reports: Queue[Progress] = spawn.Queue()
    threads = max(1, (os.cpu_count() or 1) // workers)
    pool = ProcessPoolExecutor(workers, spawn, initializer=_begin, initargs=(reports, threads))
    with _stopped(pool):
        with interrupts.held():  # the first calls start the processes
            numbers = {pool.submit(_measured, folder, cell): i for i, cell in enumerate(cells)}
        yield from _finished(numbers, reports, on_event)


def _finished(
    numbers: dict[Future[Row | Divergence], int], reports: Queue[Progress], on_event: OnEvent
) -> Iterator[tuple[int, Row | Divergence]]:
    waiting = set(numbers)
    while waiting:
        done, waiting = wait(waiting, _LISTEN_S, FIRST_COMPLETED)
        while not reports.empty():
            on_event(reports.get())
        for future in sorted(done, key=lambda f: numbers[f]):
            try:
                yield numbers[future], future.result()
            except BrokenProcessPool:
                fix = "free some memory or use fewer --workers, then run the same command again: it goes on"
                raise AegisError("a process of the study died", "processes that live", fix) from None


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

_reports: Queue[Progress]


def _begin(reports: Queue[Progress], threads: int) -> None:
    global _reports
    _reports = reports
    torch.set_num_threads(threads)


def _measured(folder: Path, cell: Cell) -> Row | Divergence:
    return _job(folder).outcome(cell.label, cell.recipe, cell.validation)


@cache
def _job(folder: Path) -> Job:
    return Job(folder, _report)


def _report(event: Progress) -> None:
    _reports.put(event)
