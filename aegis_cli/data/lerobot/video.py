"""Frames out of mp4 files, by their times."""

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
        times: seconds, rising.
        tolerance: seconds that a frame may be off its time.

    Raises:
        AegisError: no file, a damaged one, or one without a frame at a time.
    """
    with _reading(path), _open(path) as container:
        yield from _closest(container, path, times, tolerance)


class Reader:
    """Frames of many videos in any order, of which the last few that were read stay open.

    Not for several threads at once.
    """

    def __init__(self) -> None:
        self._containers: dict[Path, Any] = {}

    def frame(self, path: Path, time: float, tolerance: float) -> np.ndarray:
        """The frame [H, W, 3] uint8 closest to `time`, in seconds; see `read` for the rest."""
        with _reading(path):
            container = self._containers.pop(path, None) or self._opened(path)
            self._containers[path] = container  # the last one in the order
            if len(self._containers) > _KEPT_OPEN:
                longest_unread = next(iter(self._containers))
                self._containers.pop(longest_unread).close()
            return next(_closest(container, path, (time,), tolerance))

    @staticmethod
    def _opened(path: Path) -> Any:
        container = _open(path)
        for stream in container.streams.video:
            stream.thread_count = 1  # a team for each open video would be more than the cores bear
        return container


def _open(path: Path) -> Any:
    import av

    files.refuse_special(path)
    return av.open(str(path))


@contextmanager
def _reading(path: Path) -> Generator[None]:
    """Raise AegisError for a video that is missing or damaged."""
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
    """The frames [H, W, 3] uint8 at rising times; see `read`.

    The video is decoded once, from front to back: of all its frames no more than two are held.
    """
    if not container.streams.video:
        raise AegisError(f"no video in '{path}'", "a file with a video stream", layout.AGAIN)
    decoded = _decoded(container, times[0], tolerance)
    before = after = next(decoded, None)  # the frames on both sides of a time, each with its own
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
    """Times and frames from one at `first`, or before it, on.

    A seek leads to a key frame. Of an open group of pictures (HEVC's usual ones) those that are
    shown before their key frame refer to the group before, and are lost where decoding begins with
    it: then further back.
    """
    stream, back = container.streams.video[0], tolerance
    while True:
        start = max(0, round((first - back) / stream.time_base) - 1)  # a frame's room for rounding
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
    """The frames from where the container stands, with their times in seconds."""
    for frame in container.decode(stream):
        if frame.pts is not None:  # one that has none belongs to no time
            yield float(frame.pts * stream.time_base), frame
