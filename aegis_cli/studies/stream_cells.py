"""Streams learned below one folder, each at a label; one that was interrupted goes on, if it is
still the same.
"""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
from pathlib import Path
from typing import Any

from aegis_cli import recipes
from aegis_cli.common import files
from aegis_cli.common.errors import Diverged
from aegis_cli.common.events import OnEvent
from aegis_cli.continual import images, learners, train
from aegis_cli.recipes import TEST, VALIDATION, StreamRecipe
from aegis_cli.studies import stream_row
from aegis_cli.studies.row import Divergence
from aegis_cli.studies.stream_row import StreamRow
from aegis_cli.training import folder as run_folder
from aegis_cli.training.up_to_date import digest


class StreamJob:
    """A label is a run's place below the folder: `primer-1/igsp/0`. Beside it lies a note of what
    it was begun with.
    """

    def __init__(self, folder: Path, on_event: OnEvent) -> None:
        self.folder, self.on_event = folder, on_event
        self._fingerprints: dict[str, str] = {}
        self._image_sets: dict[tuple[Any, ...], str] = {}

    def key(self, recipe: StreamRecipe, validation: bool) -> str:
        """Digest of all that shapes a row; not of the run's label, or of where encoder and images
        lie.
        """
        if recipe.encoder not in self._fingerprints:
            self._fingerprints[recipe.encoder] = images.encoder(recipe.encoder).fingerprint()
        which = (recipe.stream, recipe.path, recipe.order)
        if which not in self._image_sets:
            self._image_sets[which] = images.image_set(recipe)
        return row_key(
            recipe, self._fingerprints[recipe.encoder], self._image_sets[which], validation
        )

    def outcome(
        self, label: str, recipe: StreamRecipe, validation: bool = False
    ) -> StreamRow | Divergence:
        """Learn the stream; with `validation`, its figures are of the validation parts. One that
        diverges is a finding.
        """
        out, key = self.folder / label, self.key(recipe, validation)
        recipe = dataclasses.replace(recipe, split=VALIDATION if validation else TEST)
        begun = _note(out).exists()
        if (
            not begun
            or _note(out).read_text(encoding="utf-8") != key
            or _named_otherwise(out, recipe)
        ):
            run_folder.clear(out, ours=begun)
            files.make_folder(out.parent)
            files.write_text(_note(out), key)

        def named(event: Any) -> None:
            self.on_event(dataclasses.replace(event, stage=f"{label}/{event.stage}"))

        try:
            return stream_row.row(train.run(recipe, out, resume=True, on_event=named))
        except Diverged as end:
            return Divergence(end.good_steps)

    def remove(self, label: str) -> None:
        """A run, its note, and the folders that are empty then."""
        out = self.folder / label
        shutil.rmtree(out, ignore_errors=True)
        _note(out).unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # other runs are there
            for folder in out.parents[: len(Path(label).parts) - 1]:
                folder.rmdir()


def row_key(recipe: StreamRecipe, fingerprint: str, image_set: str, validation: bool) -> str:
    """Digest of a stream's settings; options at their defaults are left out, so that one that a
    later change brings makes no finished cell stale.

    Args:
        fingerprint: of the encoder that the recipe names.
        image_set: digest of the images that it names.
    """
    method = recipe.train.method
    sections = {"train": recipe.train, method: getattr(recipe, method.replace("-", "_"), None)}
    if not learners.get(method).shared:  # one state for all tasks need not know which it is asked
        sections["inference"] = recipe.inference
    changed = {
        name: recipes.changed(section) for name, section in sections.items() if section is not None
    }
    shaping: dict[str, Any] = {
        "stream": recipe.stream,
        "order": recipe.order,
        "method": method,
        "validation": validation,
    }
    if learners.get(method).trains != "nothing":  # else every seed is the same
        shaping["seed"] = recipe.seed
    return digest({**changed, **shaping, "encoder": fingerprint, "images": image_set})


def _named_otherwise(out: Path, recipe: StreamRecipe) -> bool:
    """Whether a run of the same key cannot go on all the same: its recipe tells where the encoder
    lay, the key does not.
    """
    return (out / "recipe.yaml").exists() and not run_folder.goes_on(out, recipe)


def _note(out: Path) -> Path:
    return out.with_name(f"{out.name}.begun")
