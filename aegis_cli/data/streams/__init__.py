"""Streams of classification tasks: images, labels and the words for them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.data.streams.names import STREAMS

if TYPE_CHECKING:  # a recipe may import the names without torch
    from aegis_cli.data.streams.contract import StreamTask


def load(
    name: str, image_size: int, cache: Path, on_event: OnEvent = ignore
) -> tuple[StreamTask, ...]:
    """The tasks of a stream in order; pictures missing in `cache` are made and stored there.

    Args:
        name: one of `names.STREAMS`.
        image_size: side in pixels of the returned images.
        cache: a folder, which is created if missing.

    Raises:
        AegisError: there is no such stream, a package for its pictures is missing, or pictures are
            missing and the cache cannot be written.
    """
    from aegis_cli.data.streams import embedded  # loads torch

    tasks = _tasks(name)
    if not all(embedded.file(cache, task).exists() for task in tasks):
        _make_cache(cache)  # before minutes of drawing
    return tuple(embedded.task(task, image_size, cache, on_event) for task in tasks)


def _make_cache(folder: Path) -> None:
    """Create the folder of pictures, or raise an error that says how to choose another."""
    try:
        files.make_folder(folder)
        files.check_writable(folder / "pictures")
    except AegisError as error:
        fix = "set AEGIS_CACHE to a folder that can be written"
        raise AegisError(error.found, "a cache of a stream's pictures", fix) from error


def edition(name: str) -> list[dict[str, object]]:
    """The settings that determine a stream's pictures and words, as plain JSON, per task.

    Nothing is drawn or read.

    Raises:
        AegisError: there is no such stream.
    """
    from aegis_cli.data.streams import embedded

    return [embedded.meta(task) for task in _tasks(name)]


def _tasks(name: str) -> tuple[str, ...]:
    """The names of a stream's tasks, in the order in which they are learned."""
    if name not in STREAMS:
        raise AegisError(f"no stream '{name}'", f"one of {', '.join(STREAMS)}", "check the name")
    return STREAMS[name]
