"""Cells of a study measured by several processes at once, each with its share of the cores."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass
from multiprocessing import Queue
from pathlib import Path
from typing import Protocol, TypeVar

import torch

from aegis_cli.common.events import OnEvent, Progress
from aegis_cli.common.processes import SPAWN, WorkerPool, threads_per_worker
from aegis_cli.recipes import Recipe, StreamRecipe

_LISTEN_S = 0.2  # between looks at what the processes report
_FIX = "free some memory or use fewer --workers, then run the same command again: it goes on"
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
    reports: Queue[Progress] = SPAWN.Queue()
    arguments = (make, folder, reports, threads_per_worker(workers))
    with WorkerPool(workers, "a process of the study", _FIX, _begin, arguments) as pool:
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
            yield numbers[future], future.result()


# --- in a process of its own ----------------------------------------------------------------------

_bench: Bench


def _begin(make: Make, folder: Path, reports: Queue[Progress], threads: int) -> None:
    global _bench
    _bench = make(folder, reports.put)
    torch.set_num_threads(threads)


def _measured(cell: Cell) -> object:
    return _bench.outcome(cell.label, cell.recipe, cell.validation)
