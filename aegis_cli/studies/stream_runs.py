"""Runs of streams as cells of a study: begun, gone on with if they are still the same, cleared."""

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

S = TypeVar("S", bound=StreamRecipe | RobotStreamRecipe)  # of all streams of one study
_BEGUN = ".begun"  # ends the name of the note beside a run that a study has started


class StreamRuns(ABC, Generic[S]):
    """Learns cells; a label is a run's place below the folder: `primer-1/igsp/0`.

    Beside a run lies a note of what it was begun with.
    """

    def __init__(self, folder: Path, on_event: OnEvent) -> None:
        self.folder, self.on_event = folder, on_event

    @abstractmethod
    def key(self, cell: Cell[S]) -> str:
        """Digest of all that shapes the figures."""

    @abstractmethod
    def learned(self, cell: Cell[S]) -> S:
        """The recipe that is learned, on validation parts if the cell is of the tuning."""

    @abstractmethod
    def figures(self, report: Any) -> StreamFigures | RobotStreamFigures:
        """The figures of a learned stream that studies compare."""

    def begin_anew(self) -> None:
        """Let every stream be learned again; that a study began its run is remembered."""
        for note in self.folder.rglob(f"*{_BEGUN}"):
            files.write_text(note, "")

    def measure(self, cell: Cell[S]) -> StreamFigures | RobotStreamFigures | Divergence:
        """Learn the stream. One that diverges is a finding."""
        out, key = self.folder / cell.label, self.key(cell)
        recipe = self.learned(cell)
        begun = _note(out).exists()
        same = begun and _note(out).read_text(encoding="utf-8") == key
        if not same or _named_otherwise(out, recipe):
            run_folder.clear(out, ours=begun)
            files.make_folder(out.parent)
            files.write_text(_note(out), key)  # before the run begins: by it a killed one is ours

        def named(event: Any) -> None:
            self.on_event(dataclasses.replace(event, stage=f"{cell.label}/{event.stage}"))

        try:
            return self.figures(train.run(recipe, out, resume=True, on_event=named))
        except Diverged as end:
            return Divergence(end.good_steps)

    def clear(self, label: str) -> None:
        """Remove a run and its note; one with somebody's own files is moved beside it.

        The folder that they lay in stays until `tidy`, for another process may be about to begin
        its run there.
        """
        out = self.folder / label
        run_folder.clear(out, ours=True)
        _note(out).unlink(missing_ok=True)

    def tidy(self, labels: Iterable[str]) -> None:
        """Remove the folders that are empty once the cells of these labels are measured."""
        for label in labels:
            with contextlib.suppress(OSError):  # other runs are there, or it is gone
                # From the innermost folder outwards, and none that holds the study itself.
                for folder in (self.folder / label).parents[: len(Path(label).parts) - 1]:
                    folder.rmdir()


def _named_otherwise(out: Path, recipe: StreamRecipe | RobotStreamRecipe) -> bool:
    """Whether a run of the same key cannot go on all the same.

    Its recipe tells where its encoder, or backbone, lay, the key does not.
    """
    return (out / "recipe.yaml").exists() and not run_folder.goes_on(out, recipe)


def _note(out: Path) -> Path:
    return out.with_name(f"{out.name}{_BEGUN}")
