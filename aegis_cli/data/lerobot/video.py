"""Frames of mp4 files, by time."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError
from aegis_cli.data.lerobot import layout

_KEPT_OPEN = 16  # videos that a reader keeps open


def read(path: Path, times: Sequence[float], tolerance: float) -> Iterator[np.ndarray]:
    """The frames [H, W, 3] uint8 of a video that are closest to `times`.

    Args:
        times: in seconds, ascending.
        tolerance: how many seconds a frame may differ from its time.

    Raises:
        AegisError: the file is missing or damaged, or has no frame at one of the times.
    """
    with _reading(path), _open(path) as container:
        yield from _closest(container, path, times, tolerance)


class Reader:
    """Frames of many videos in any order; the most recently read videos stay open.

    Not thread-safe.
    """

    def __init__(self) -> None:
        self._containers: dict[Path, Any] = {}

    def frame(self, path: Path, time: float, tolerance: float) -> np.ndarray:
        """The frame [H, W, 3] uint8 closest to `time`, in seconds; see `read` for the rest."""
        with _reading(path):
            container = self._containers.pop(path, None) or self._opened(path)
            self._containers[path] = container  # now the most recent
            if len(self._containers) > _KEPT_OPEN:
                longest_unread = next(iter(self._containers))
                self._containers.pop(longest_unread).close()
            return next(_closest(container, path, (time,), tolerance))

    @staticmethod
    def _opened(path: Path) -> Any:
        container = _open(path)
        for stream in container.streams.video:
            stream.thread_count = 1  # several threads per open video would overload the cores
        return container


def _open(path: Path) -> Any:
    import av

    files.refuse_special(path)
    return av.open(str(path))


@contextmanager
def _reading(path: Path) -> Generator[None]:
    """Raise AegisError for a missing or damaged video."""
    import av

    try:
        yield
    except FileNotFoundError as error:
        raise AegisError(
            f"no file '{path}'", "every file that the dataset's meta folder names", layout.AGAIN
        ) from error
    except (av.FFmpegError, OSError) as error:
        files.refuse_pointer(path)
        raise AegisError(
            f"'{path}' is damaged: {error.strerror or error}", "an mp4 file", layout.AGAIN
        ) from error


def _closest(
    container: Any, path: Path, times: Sequence[float], tolerance: float
) -> Iterator[np.ndarray]:
    """The frames [H, W, 3] uint8 at ascending times; see `read`.

    The video is decoded once, from front to back; at most two of its frames are held.
    """
    if not container.streams.video:
        raise AegisError(f"no video in '{path}'", "a file with a video stream", layout.AGAIN)
    decoded = _decoded(container, times[0], tolerance)
    before = after = next(decoded, None)  # the (time, frame) pairs before and after a time
    for time in times:
        while after is not None and after[0] < time:
            before, after = after, next(decoded, None)
        both = [each for each in (before, after) if each is not None]
        found = min(both, key=lambda each: abs(each[0] - time), default=None)
        if found is None or abs(found[0] - time) > tolerance:
            nearest = "it has none" if found is None else f"the closest is at {found[0]:.3f} s"
            raise AegisError(
                f"no frame at {time:.3f} s in '{path}': {nearest}",
                f"one within {tolerance:.3f} s",
                layout.AGAIN,
            )
        yield found[1].to_ndarray(format="rgb24")


def _decoded(container: Any, first: float, tolerance: float) -> Iterator[tuple[float, Any]]:
    """Times and frames, starting at or before `first`.

    A seek leads to a key frame. In an open group of pictures (usual in HEVC), frames shown before
    their key frame refer to the previous group, and are lost if decoding starts at that key frame:
    then seek further back.
    """
    stream, back = container.streams.video[0], tolerance
    while True:
        start = max(0, round((first - back) / stream.time_base) - 1)  # one tick for rounding
        container.seek(start, stream=stream)
        decoded = _timed(container, stream)
        begun = next(decoded, None)
        if begun is None or begun[0] <= first + tolerance or start == 0:
            break
        back = max(1.0, 2 * back)
    if begun is not None:
        yield begun
        yield from decoded


def _timed(container: Any, stream: Any) -> Iterator[tuple[float, Any]]:
    """The frames from the container's current position on, with their times in seconds."""
    for frame in container.decode(stream):
        if frame.pts is not None:  # a frame without pts has no time
            yield float(frame.pts * stream.time_base), frame
