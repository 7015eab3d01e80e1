"""What a stream is made of, by the names in its recipe: a dual encoder, and tasks in order."""

from __future__ import annotations

from collections.abc import Sequence

from aegis_cli import backbones, streams
from aegis_cli.backbones.dual import DualEncoder
from aegis_cli.errors import AegisError
from aegis_cli.events import OnEvent, ignore
from aegis_cli.lerobot import frames
from aegis_cli.recipe import StreamRecipe
from aegis_cli.streams.contract import StreamTask


def encoder(name: str) -> DualEncoder:
    """A dual encoder by name or folder.

    Raises:
        AegisError: there is none.
    """
    return backbones.load_dual(name)


def tasks(recipe: StreamRecipe, image_size: int, on_event: OnEvent = ignore) -> tuple[StreamTask, ...]:
    """The recipe's tasks in its order; images that are made are kept with the other caches.

    Raises:
        AegisError: no such stream or task, or images that cannot be read or made.
    """
    cache = frames.cache_folder().with_name("streams")
    return ordered(streams.load(recipe.stream, image_size, cache, on_event=on_event), recipe.order)


def ordered(found: Sequence[StreamTask], order: Sequence[str] | None) -> tuple[StreamTask, ...]:
    """The tasks that `order` names, as it has them; None: all, as they are."""
    if order is None:
        return tuple(found)
    named = {task.name: task for task in found}
    if unknown := [name for name in order if name not in named]:
        expected = f"tasks of the stream: {', '.join(named)}"
        raise AegisError(f"order: {', '.join(unknown)}", expected, "correct 'order', or delete it")
    return tuple(named[name] for name in order)
