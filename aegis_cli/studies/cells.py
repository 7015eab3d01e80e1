"""A study at work: what its cells led to is kept in one file by key, and only those that are not
there are measured.
"""

from __future__ import annotations

import contextlib
import dataclasses
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress
from aegis_cli.studies import crew
from aegis_cli.studies.crew import Cell
from aegis_cli.studies.row import Divergence

CELLS = "cells.json"
Entry = TypeVar("Entry")
Row = TypeVar("Row")


class Desk(ABC, Generic[Row]):
    """A study's folder, its finished cells, and the bench that measures the others.

    Attributes:
        kind: the dataclass of what a cell leads to, unless it diverges.
    """

    kind: type[Row]

    def __init__(
        self,
        make: crew.Make[Row | Divergence],
        folder: Path,
        on_event: OnEvent,
        workers: int,
        keep_runs: bool,
    ) -> None:
        files.make_folder(folder)
        self.make, self.folder, self.on_event, self.workers, self.keep_runs = (
            make,
            folder,
            on_event,
            workers,
            keep_runs,
        )
        self.bench = make(folder, on_event)
        self.cells = _load(folder / CELLS)
        self.done = self.total = 0

    @abstractmethod
    def key(self, cell: Cell) -> str:
        """Digest of all that shapes what the cell leads to."""

    @abstractmethod
    def prepare(self, cells: Sequence[Cell], together: bool) -> None:
        """Before these are measured; if `together`, by several processes, which do not meet."""

    @abstractmethod
    def clear(self, label: str) -> None:
        """Remove what a finished cell leaves and nobody reads."""

    def rows(self, cells: Sequence[Cell]) -> Iterator[tuple[Cell, Row | Divergence]]:
        """What the cells led to: those that are known, then the others as they are measured; equal
        ones once.
        """
        keys = {cell.label: self.key(cell) for cell in cells}
        todo: dict[str, Cell] = {}
        for cell in cells:
            if keys[cell.label] in self.cells:
                yield cell, self._told(keys[cell.label])
            else:
                todo.setdefault(keys[cell.label], cell)
        waiting = [cell for cell in cells if keys[cell.label] in todo]
        with contextlib.closing(self._measured(list(todo.values()))) as measured:
            for first, found in measured:
                key = keys[first.label]
                self.keep(key, found)
                if not self.keep_runs:
                    self.clear(first.label)
                for cell in waiting:
                    if keys[cell.label] == key:
                        yield cell, self._told(key)

    def _measured(self, cells: list[Cell]) -> Iterator[tuple[Cell, Row | Divergence]]:
        """Train and measure cells, by several processes if there are to be some."""
        together = self.workers > 1 and len(cells) > 1
        if cells:
            self.prepare(cells, together)
        if not together:
            for cell in cells:
                yield cell, self.bench.outcome(cell.label, cell.recipe, cell.validation)
            return
        with contextlib.closing(
            crew.measure(self.make, self.folder, cells, self.workers, self.on_event)
        ) as finished:
            for number, found in finished:
                yield cells[number], found

    def _told(self, key: str) -> Row | Divergence:
        self.done += 1
        self.on_event(Progress("study", self.done, self.total, "cells"))
        entry = self.cells[key]
        return self.known(
            key, Divergence if isinstance(entry, dict) and "good_steps" in entry else self.kind
        )

    def keep(self, key: str, found: Any) -> None:
        """Store what was found, a dataclass, at once."""
        self.cells[key] = dataclasses.asdict(found)
        files.write_text(self.folder / CELLS, files.canonical(self.cells) + "\n")

    def known(self, key: str, kind: type[Entry]) -> Entry:
        """A finished entry.

        Raises:
            AegisError: something else than what this version writes.
        """
        entry, names = self.cells[key], {f.name for f in dataclasses.fields(kind)}
        needed = {f.name for f in dataclasses.fields(kind) if f.default is dataclasses.MISSING}
        if not isinstance(entry, dict) or not needed <= entry.keys() <= names:
            problem = (
                f"an entry of '{self.folder / CELLS}' that is no {kind.__name__.lower()} "
                "of this version"
            )
            raise AegisError(
                problem,
                f"the keys {', '.join(sorted(names))}",
                f"delete the entry {key}, or the file",
            )
        return kind(**{name: tuple(v) if isinstance(v, list) else v for name, v in entry.items()})


def _load(path: Path) -> dict[str, Any]:
    cells = files.load_json(path) if path.exists() else {}
    if not isinstance(cells, dict):
        raise AegisError(
            f"'{path}' holds no cells",
            "a mapping of digests to rows",
            "delete it, or bring the file of a study",
        )
    return cells


def slug(value: Any) -> str:
    """A folder's name for a knob's value."""
    return "fixed" if value is None else re.sub(r"[^\w.+-]+", "_", str(value)).strip("_")
