"""Frames out of and into mp4 files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from aegis_cli.common.errors import AegisError
from aegis_cli.data.lerobot import layout

# A key frame every second one, as LeRobot writes them: whoever wants one frame decodes at most two.
# One thread: equal frames give equal bytes, whatever the machine.
_H264 = {"g": "2", "crf": "18", "bf": "0", "threads": "1"}


def read(path: Path, times: Sequence[float], tolerance: float) -> Iterator[np.ndarray]:
    """The frames [H, W, 3] uint8 of a video that are closest to `times`.

    Args:
        times: seconds, rising.
        tolerance: seconds that a frame may be off its time.

    Raises:
        AegisError: no file, a damaged one, or one without a frame at a time.
    """
    import av

    try:
        with av.open(str(path)) as container:
            yield from _closest(container, path, times, tolerance)
    except FileNotFoundError as error:
        raise AegisError(
            f"no file '{path}'", "every file that the dataset's meta folder names", layout.AGAIN
        ) from error
    except (av.FFmpegError, OSError) as error:
        raise AegisError(
            f"'{path}' is damaged: {error.strerror or error}", "an mp4 file", layout.AGAIN
        ) from error


def _closest(
    container: Any, path: Path, times: Sequence[float], tolerance: float
) -> Iterator[np.ndarray]:
    if not container.streams.video:
        raise AegisError(f"no video in '{path}'", "a file with a video stream", layout.AGAIN)
    decoded = _decoded(container, times[0], tolerance)
    before = after = next(decoded, None)
    for time in times:
        while after is not None and after[0] < time:
            before, after = after, next(decoded, None)
        found = min(
            (f for f in (before, after) if f is not None),
            key=lambda f: abs(f[0] - time),
            default=None,
        )
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
        decoded = (
            (float(f.pts * stream.time_base), f)
            for f in container.decode(stream)
            if f.pts is not None
        )
        begun = next(decoded, None)
        if begun is None or begun[0] <= first + tolerance or start == 0:
            break
        back = max(1.0, 2 * back)
    if begun is not None:
        yield begun
        yield from decoded


class Encoder:
    """An H.264 mp4 file that grows by episodes; sides must be even."""

    def __init__(self, path: Path, fps: float) -> None:
        import av

        self._container = av.open(str(path), "w", format="mp4")
        self._rate, self._stream, self._frames, self._bytes = _rational(fps), None, 0, 0

    def write(self, frames: np.ndarray) -> None:
        """Append frames [T, H, W, 3] uint8; the first is a key frame."""
        import av

        if self._stream is None:
            self._stream = self._container.add_stream("libx264", rate=self._rate, options=_H264)
            self._stream.height, self._stream.width, self._stream.pix_fmt = (
                *frames.shape[1:3],
                "yuv420p",
            )
        for i, frame in enumerate(frames):
            picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
            picture.pts, picture.time_base, self._frames = (
                self._frames,
                1 / self._rate,
                self._frames + 1,
            )
            picture.pict_type = (
                av.video.frame.PictureType.I if i == 0 else av.video.frame.PictureType.NONE
            )
            self._mux(picture)

    def size(self) -> int:
        """Bytes of the frames that the encoder has let go of; it keeps some dozens back."""
        return self._bytes

    def close(self) -> None:
        if self._stream is not None:
            self._mux(None)
        self._container.close()

    def _mux(self, picture: Any) -> None:
        for packet in self._stream.encode(picture):
            self._bytes += packet.size
            self._container.mux(packet)


def _rational(fps: float) -> Fraction:
    return Fraction(fps).limit_denominator(1_000_000)
