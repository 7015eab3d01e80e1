"""Runs of streams as cells of a study: started, resumed if they are still the same, cleared."""

from __future__ import annotations

import contextlib
import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Generic, TypeVar

from aegis_cli.common import files
from aegis_cli.common.errors import Diverged
from aegis_cli.common.events import OnEvent
from aegis_cli.continual import train
from aegis_cli.recipes import RobotStreamRecipe, StreamRecipe
from aegis_cli.studies.cells import Cell
from aegis_cli.studies.figures import Divergence, RobotStreamFigures, StreamFigures
from aegis_cli.training import folder as run_folder

S = TypeVar("S", bound=StreamRecipe | RobotStreamRecipe)  # the recipes of one study
_BEGUN = ".begun"  # suffix of the note beside a run that a study has started


class StreamRuns(ABC, Generic[S]):
    """Learns cells; a label is a run's path relative to the folder, such as `primer-1/igsp/0`.

    A note beside each run holds the key that it was started with.
    """

    def __init__(self, folder: Path, on_event: OnEvent) -> None:
        self.folder, self.on_event = folder, on_event

    @abstractmethod
    def key(self, cell: Cell[S]) -> str:
        """Digest of everything that affects the figures."""

    @abstractmethod
    def learned(self, cell: Cell[S]) -> S:
        """The recipe that is learned, measured on validation parts if the cell is for tuning."""

    @abstractmethod
    def figures(self, report: Any) -> StreamFigures | RobotStreamFigures:
        """The figures of a learned stream that a study compares."""

    def begin_anew(self) -> None:
        """Let every stream be learned again, but remember that a study started its run."""
        for note in self.folder.rglob(f"*{_BEGUN}"):
            files.write_text(note, "")

    def measure(self, cell: Cell[S]) -> StreamFigures | RobotStreamFigures | Divergence:
        """Learn the stream; one that diverges is a result too."""
        out, key = self.folder / cell.label, self.key(cell)
        recipe = self.learned(cell)
        begun = _note(out).exists()
        same = begun and _note(out).read_text(encoding="utf-8") == key
        if not same or _named_otherwise(out, recipe):
            run_folder.clear(out, ours=begun)
            files.make_folder(out.parent)
            files.write_text(_note(out), key)  # before the start, so that a killed run is known

        def named(event: Any) -> None:
            self.on_event(dataclasses.replace(event, stage=f"{cell.label}/{event.stage}"))

        try:
            return self.figures(train.run(recipe, out, resume=True, on_event=named))
        except Diverged as end:
            return Divergence(end.good_steps)

    def clear(self, label: str) -> None:
        """Remove a run and its note; a run with files of the user is moved aside instead.

        The enclosing folder stays until `tidy`, because another process may be about to start a
        run there.
        """
        out = self.folder / label
        run_folder.clear(out, ours=True)
        _note(out).unlink(missing_ok=True)

    def tidy(self, labels: Iterable[str]) -> None:
        """Remove the folders that are empty once the cells of these labels are measured."""
        for label in labels:
            with contextlib.suppress(OSError):  # it holds other runs, or is gone
                # From the innermost folder outwards, up to but not including the study's folder.
                for folder in (self.folder / label).parents[: len(Path(label).parts) - 1]:
                    folder.rmdir()


def _named_otherwise(out: Path, recipe: StreamRecipe | RobotStreamRecipe) -> bool:
    """Whether a run cannot be resumed although its key is the same.

    Its recipe has the path of its encoder or backbone, which is not part of the key.
    """
    return (out / "recipe.yaml").exists() and not run_folder.goes_on(out, recipe)


def _note(out: Path) -> Path:
    return out.with_name(f"{out.name}{_BEGUN}")
