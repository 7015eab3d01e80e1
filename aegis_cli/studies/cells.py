"""The cells of a study: results are stored by key, and only new cells are measured.

Several processes can measure them at once.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass
from multiprocessing import Queue
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import torch

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, OnEvent, Progress
from aegis_cli.common.processes import SPAWN, WorkerPool, threads_per_worker
from aegis_cli.recipes import AnyStudy, Recipe, RobotStreamRecipe, StreamRecipe
from aegis_cli.studies.comparison import Cost, Findings, Report
from aegis_cli.studies.decoding import Misfit, decode
from aegis_cli.studies.figures import Divergence, Figures, Outcome
from aegis_cli.studies.tuning import Point, Rule

CELLS = "cells.json"
CLEARING = "clearing.json"  # names the measured cell whose run is just being removed
_LISTEN_S = 0.2  # seconds between polls for the processes' events
_FIX = "free some memory or use fewer --workers, then run the same command again: it resumes"
CellRecipe = Recipe | StreamRecipe | RobotStreamRecipe
R = TypeVar("R", bound=CellRecipe)  # of all cells of one study
Entry = TypeVar("Entry")


@dataclass(frozen=True)
class Cell(Generic[R]):
    """One training.

    Attributes:
        label: its run folder, relative to the study's folder.
        validation: whether it is measured on the validation split.
        judging: with `validation`, the seeds of the compared cells, whose held-out episodes must
            not be used for tuning.
    """

    label: str
    recipe: R
    validation: bool = False
    judging: tuple[int, ...] = ()


class CellRunner(Protocol[R]):
    """Trains and measures cells below one folder."""

    def key(self, cell: Cell[R]) -> str:
        """Digest of everything that affects the cell's result."""

    def measure(self, cell: Cell[R]) -> Outcome:
        """Train and measure a cell."""

    def clear(self, label: str) -> None:
        """Remove a measured cell's files that nobody reads; other processes may be at work."""

    def tidy(self, labels: Iterable[str]) -> None:
        """Remove the rest of cleared cells, once no process is at work any more."""

    def begin_anew(self) -> None:
        """Treat nothing in the folder as finished."""


MakeRunner = Callable[[Path, OnEvent], CellRunner[R]]


class StudyKind(Protocol[R]):
    """Policies on tasks, or learners on streams, of images or of robot tasks.

    Attributes:
        places: the tasks or streams that every variant is measured on.
        figures: the dataclass of a cell's result, unless it diverges.
        make_runner: called in each process; it is pickled by name.
        rule: how a knob's value is chosen.
        tunes_fixed: whether variants without a knob are measured together with the tuned ones.
    """

    places: Sequence[str]
    figures: type[Figures]
    make_runner: MakeRunner[R]
    rule: Rule
    tunes_fixed: bool

    @property
    def recipe(self) -> AnyStudy:
        """The study, with `variants`, `seeds`, `tuning` and `keep_runs`."""

    def cell(self, variant: str, place: str, seed: int, value: Any) -> R:
        """The recipe of a compared cell; `value` is the value of the variant's knob.

        Raises:
            AegisError: keys or values that are not a valid recipe.
        """

    def trial(self, variant: str, value: Any) -> R:
        """The recipe that evaluates a knob's value on the validation split."""

    def check(self, trials: Sequence[R]) -> None:
        """Raise AegisError for a study that cannot be run, before any work."""

    def prepare(self, runner: Any, cells: Sequence[Cell[R]], together: bool) -> None:
        """Check and create what cells share, before they are measured.

        Args:
            together: whether several processes measure them; these share only files.
        """

    def point(self, variant: str, value: Any, found: Any) -> Point:
        """The result of a knob's value."""

    def costs(self, store: CellStore[R], chosen: Mapping[str, Any]) -> Mapping[str, Cost]:
        """The compared variants' costs relative to naive, measured if `store` does not have them.

        If `store` delivers only known results, nothing is measured.
        """

    def report(self, findings: Findings, store: CellStore[R]) -> Report:
        """The table of the results so far."""


class CellStore(Generic[R]):
    """A study's folder, its finished cells, and the runner that measures the others.

    Attributes:
        cells: the content of `cells.json`, by key.
        done: number of cells that have been delivered, of `total`.
        known_only: whether only finished cells are delivered, and nothing is measured.
    """

    def __init__(
        self,
        kind: StudyKind[R],
        folder: Path,
        on_event: OnEvent,
        workers: int = 1,
        known_only: bool = False,
    ) -> None:
        """Read the finished cells."""
        files.make_folder(folder)
        self.kind = kind
        self.folder = folder
        self.on_event = on_event
        self.workers = workers
        self.known_only = known_only
        self.runner = kind.make_runner(folder, on_event)
        self.cells = _load(folder / CELLS)
        self.done = self.total = 0

    def finish_clearing(self) -> None:
        """Remove what a killed process has left of a measured cell's run.

        Raises:
            AegisError: the note about it is damaged.
        """
        note = self.folder / CLEARING
        if not note.exists():
            return
        key, label = _noted(note)
        if key in self.cells:  # otherwise it is measured again and needs its files
            self.runner.clear(label)
        note.unlink()

    def begin_anew(self) -> None:
        """Forget every finished cell, here and in the folder."""
        self.cells.clear()
        (self.folder / CELLS).unlink(missing_ok=True)
        self.runner.begin_anew()

    def count_known(self, cells: Sequence[Cell[R]]) -> int:
        """How many of the cells are finished; `measured` delivers these first."""
        return sum(self.runner.key(cell) in self.cells for cell in cells)

    def measured(self, cells: Sequence[Cell[R]]) -> Generator[tuple[Cell[R], Outcome]]:
        """The cells and their results: known ones first, then the others as they are measured.

        Equal cells are measured once.
        """
        keys = {cell.label: self.runner.key(cell) for cell in cells}
        todo: dict[str, Cell[R]] = {}  # the first of equal cells, measured for all of them
        for cell in cells:
            if keys[cell.label] in self.cells:
                yield cell, self._deliver(keys[cell.label])
            else:
                todo.setdefault(keys[cell.label], cell)
        if not todo or self.known_only:
            return
        waiting = [cell for cell in cells if keys[cell.label] in todo]
        together = self.workers > 1 and len(todo) > 1
        self.kind.prepare(self.runner, list(todo.values()), together)
        # If the caller stops, this is closed at once, which ends the workers without waiting.
        with contextlib.closing(self._measure(list(todo.values()), together)) as found:
            for first, figures in found:
                key = keys[first.label]
                if self.kind.recipe.keep_runs:
                    self.keep(key, figures)
                else:
                    self._keep_and_clear(key, figures, first.label)
                for cell in waiting:
                    if keys[cell.label] == key:
                        yield cell, self._deliver(key)

    def tidy(self, cells: Iterable[Cell[R]]) -> None:
        """Remove what is left of these cells' cleared runs; all of them are measured."""
        if not self.known_only and not self.kind.recipe.keep_runs:
            self.runner.tidy(cell.label for cell in cells)

    def _measure(self, cells: list[Cell[R]], together: bool) -> Generator[tuple[Cell[R], Outcome]]:
        """Results of cells as they finish, measured here or by several processes."""
        if not together:
            for cell in cells:
                yield cell, self.runner.measure(cell)
            return
        make = self.kind.make_runner
        yield from _measure_together(make, self.folder, cells, self.workers, self.on_event)

    def _deliver(self, key: str) -> Outcome:
        self.done += 1
        self.on_event(Progress("study", self.done, self.total, "cells"))
        entry = self.cells[key]
        diverged = isinstance(entry, dict) and "good_steps" in entry  # no figures have that key
        return self.known(key, Divergence if diverged else self.kind.figures)

    def keep(self, key: str, found: Any) -> None:
        """Store a result, which is a dataclass, in the file at once."""
        self.cells[key] = dataclasses.asdict(found)
        files.write_text(self.folder / CELLS, files.canonical(self.cells) + "\n")

    def _keep_and_clear(self, key: str, found: Outcome, label: str) -> None:
        """Store a result, and remove the run.

        If the process is killed meanwhile, its note tells the next process to remove the rest.
        """
        # The order matters: the figures are stored before the run is removed, and the note exists
        # as long as parts of the run may be left.
        note = self.folder / CLEARING
        files.save_json(note, {"cell": key, "run": label})
        self.keep(key, found)
        self.runner.clear(label)
        note.unlink()

    def known(self, key: str, kind: type[Entry]) -> Entry:
        """A finished entry.

        Raises:
            AegisError: the entry is not in the format of this version.
        """
        try:
            return decode(kind, self.cells[key])
        except Misfit as misfit:
            assert dataclasses.is_dataclass(kind)
            names = sorted(f.name for f in dataclasses.fields(kind))
            raise AegisError(
                f"an entry of '{self.folder / CELLS}' that is no {kind.__name__} of this version: "
                f"{misfit}",
                f"the keys {', '.join(names)}",
                f"delete the entry {key}, or the file",
            ) from None


def _load(path: Path) -> dict[str, Any]:
    """The content of a folder's `cells.json`; empty if there is none."""
    cells = files.load_json(path) if path.exists() else {}
    if not isinstance(cells, dict):
        raise AegisError(
            f"'{path}' holds no cells",
            "a mapping of digests to figures",
            "delete it, or bring back a study's own file",
        )
    return cells


def _noted(note: Path) -> tuple[str, str]:
    """The key and the label of a cell whose run was being removed."""
    try:
        left = files.load_json(note)
        key, label = left["cell"], left["run"]
        if not isinstance(key, str) or not isinstance(label, str):
            raise TypeError("a name that is no text")
        # This path is removed, so a damaged note must not point outside the study's folder.
        if Path(label).is_absolute() or not {".", ".."}.isdisjoint(label.split("/")):
            raise ValueError(f"'{label}' is no run of the study")
    except (TypeError, KeyError, ValueError) as error:
        raise AegisError(
            f"'{note}' is damaged: {error}",
            "which measured cell's run was being removed",
            f"rm '{note}', then remove the checkpoints of the measured cells by hand",
        ) from error
    return key, label


# --- several processes ----------------------------------------------------------------------------


def _measure_together(
    make: MakeRunner[R],
    folder: Path,
    cells: Sequence[Cell[R]],
    workers: int,
    on_event: OnEvent,
) -> Generator[tuple[Cell[R], Outcome]]:
    """Measure cells, `workers` at a time, each with its share of the cores.

    Raises:
        AegisError: a stage raised it, or a process died; the other processes are stopped at a
            step to resume from.
    """
    reports: Queue[Event] = SPAWN.Queue()  # progress events from the processes to this one
    arguments = (make, folder, reports, threads_per_worker(workers))
    with WorkerPool(workers, "a process of the study", _FIX, _begin, arguments) as pool:
        numbers = {pool.submit(_measure_here, cell): i for i, cell in enumerate(cells)}
        for number, found in _finished(numbers, reports, on_event):
            yield cells[number], found


def _finished(
    numbers: dict[Future[Outcome], int], reports: Queue[Event], on_event: OnEvent
) -> Iterator[tuple[int, Outcome]]:
    """The numbers and results of the cells as they finish; passes on events meanwhile."""
    waiting = set(numbers)
    while waiting:
        # With a timeout, since events arrive while no cell finishes.
        done, waiting = wait(waiting, _LISTEN_S, FIRST_COMPLETED)
        while not reports.empty():
            on_event(reports.get())
        # `done` is a set, so its order differs between runs.
        for future in sorted(done, key=lambda f: numbers[f]):
            yield numbers[future], future.result()  # re-raises an error of the process


_runner: CellRunner[Any]  # one in each worker process


def _begin(make: MakeRunner[R], folder: Path, reports: Queue[Event], threads: int) -> None:
    global _runner
    _runner = make(folder, reports.put)
    torch.set_num_threads(threads)  # otherwise each process would use all cores


def _measure_here(cell: Cell[R]) -> Outcome:
    return _runner.measure(cell)
