"""What a stream is made of, by the names in its recipe: a dual encoder, and tasks in order."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.data import streams
from aegis_cli.data.lerobot import frames
from aegis_cli.data.streams import folders, mtil
from aegis_cli.data.streams.contract import StreamTask
from aegis_cli.models import backbones
from aegis_cli.models.backbones.dual import DualEncoder
from aegis_cli.recipes import StreamRecipe


def encoder(name: str) -> DualEncoder:
    """A dual encoder by name or folder.

    Raises:
        AegisError: there is none.
    """
    return backbones.load_dual(name)


def tasks(
    recipe: StreamRecipe, image_size: int, on_event: OnEvent = ignore
) -> tuple[StreamTask, ...]:
    """The recipe's tasks in its order; images that are made are kept with the other caches, those
    of folders stay there.

    Raises:
        AegisError: no such stream or task, or images that cannot be read or made.
    """
    if recipe.path is not None:
        return tuple(_of_folders(Path(recipe.path), recipe, image_size))
    cache = frames.cache_folder().with_name("streams")
    return ordered(streams.load(recipe.stream, image_size, cache, on_event=on_event), recipe.order)


def image_set(recipe: StreamRecipe) -> str:
    """Digest of what tells whether images and words are those of an earlier look, wherever they
    lie.

    Raises:
        AegisError: no such stream or task, or files that cannot be read.
    """
    if recipe.path is None:
        found: Any = streams.edition(recipe.stream)
    else:
        found = {name: folders.contents(Path(recipe.path) / name) for name in _folders(recipe)}
    return hashlib.sha256(files.canonical(found).encode()).hexdigest()


def _of_folders(root: Path, recipe: StreamRecipe, image_size: int) -> Iterator[StreamTask]:
    known = mtil.STREAMS.get(recipe.stream, ())
    for name in _folders(recipe):
        template = mtil.TEMPLATES.get(name, folders.TEMPLATE) if known else folders.TEMPLATE
        yield folders.load(root, name, image_size, (template,))


def _folders(recipe: StreamRecipe) -> tuple[str, ...]:
    """The tasks below `path` by name."""
    if not (names := recipe.order or mtil.STREAMS.get(recipe.stream, ())):
        raise AegisError(
            f"the stream '{recipe.stream}' of the folders in '{recipe.path}', and no 'order'",
            f"{' or '.join(mtil.STREAMS)}, or the tasks by name",
            "set 'order' to the names of the folders, as they are to be learned",
        )
    return names


def on_validation(found: Sequence[StreamTask]) -> tuple[StreamTask, ...]:
    """The tasks with their validation parts in place of the test parts, which then
    nobody can see.
    """
    return tuple(dataclasses.replace(task, test=task.validation) for task in found)


def ordered(found: Sequence[StreamTask], order: Sequence[str] | None) -> tuple[StreamTask, ...]:
    """The tasks that `order` names, as it has them; None: all, as they are."""
    if order is None:
        return tuple(found)
    named = {task.name: task for task in found}
    if unknown := [name for name in order if name not in named]:
        expected = f"tasks of the stream: {', '.join(named)}"
        raise AegisError(f"order: {', '.join(unknown)}", expected, "correct 'order', or delete it")
    return tuple(named[name] for name in order)
