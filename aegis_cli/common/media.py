"""Pictures for people to look at: contact sheets, and videos of episodes side by side."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from aegis_cli.common.errors import AegisError
from aegis_cli.common.files import check_writable, write_atomically

SHEET_EPISODES = 8  # on a contact sheet
CLIPS = 8  # in a video, side by side
FRAMES_PER_S = 10  # of a video
_HOLD_FRAMES = 10  # how long a video holds the last frames of the episodes

# pixels
_SHEET_TILE = 192
_CLIP_PICTURE, _BORDER = 256, 6
_CLIP_TILE = _CLIP_PICTURE + 2 * _BORDER
_CAPTION, _GAP, _BETWEEN_CELLS = 20, 4, 16
_SHEET_TEXT, _CLIP_TEXT = 10, 13
_RING_WIDTH, _SMOOTHING = 3, 4  # a ring is drawn `_SMOOTHING` times larger, then reduced

# Green and red that people with the most common colour blindness can tell apart by brightness.
UNDECIDED, SUCCESS, FAILURE = (150, 150, 150), (38, 166, 91), (200, 30, 45)


def check_video(path: Path) -> None:
    """Raise AegisError unless a video can be written to `path`; call it before the work."""
    check_writable(path)
    if path.suffix not in (".mp4", ".gif"):
        raise AegisError(
            f"--video {path}",
            "a file name that ends in .mp4 or .gif",
            f"--video {path.with_suffix('.gif')}",
        )


def check_sheet(path: Path) -> None:
    """Raise AegisError unless a contact sheet can be written to `path`; call it before the work."""
    check_writable(path)
    if path.suffix.lower() != ".png":
        raise AegisError(
            f"--plot {path}", "a file name ending in .png", f"--plot {path.with_suffix('.png')}"
        )


def save_sheet(path: Path, shown: Sequence[tuple[str, Sequence[np.ndarray]]]) -> None:
    """Write a PNG: each episode's frames [H, W, 3] uint8 in a row under its caption.

    Two episodes share a line.
    """
    sheet = tiled(shown, columns=2, tile=_SHEET_TILE, text=_SHEET_TEXT)
    write_atomically(path, lambda file: sheet.save(file, format="PNG"))


def tiled(
    cells: Sequence[tuple[str, Sequence[np.ndarray]]], columns: int, tile: int, text: int
) -> Any:
    """Cells of a caption over frames [H, W, 3] uint8 in one picture, `columns` cells per line.

    Each frame is fitted into `tile` x `tile` pixels, keeping its aspect ratio. With an even `tile`
    the sides of the picture are even, as H.264 requires. Captions are `text` pixels high.

    Returns:
        A Pillow image. Frame k of cell i begins `_CAPTION` pixels below the upper left corner of
        the cell and `_GAP` + k (`tile` + `_GAP`) to the right of it.
    """
    from PIL import Image, ImageDraw

    width = max(len(frames) for _, frames in cells) * (tile + _GAP) + _BETWEEN_CELLS
    height = _CAPTION + tile + 2 * _GAP
    sheet = Image.new("RGB", (columns * width, math.ceil(len(cells) / columns) * height), "white")
    draw = ImageDraw.Draw(sheet)
    # One font for all: otherwise captions in several languages would use two.
    draw.font = _font("".join(caption for caption, _ in cells), text)
    for i, (caption, frames) in enumerate(cells):
        x, y = i % columns * width, i // columns * height
        above = (_CAPTION - text) // 2 - 1
        draw.text((x + _GAP, y + above), _shortened(draw, caption, width - 2 * _GAP), fill="black")
        for k, frame in enumerate(frames):
            sheet.paste(_fitted(frame, tile), (x + _GAP + k * (tile + _GAP), y + _CAPTION))
    return sheet


def _font(text: str, size: int) -> Any:
    """Pillow's own font, or matplotlib's for characters beyond ASCII, which Pillow's lacks."""
    from PIL import ImageFont

    if text.isascii():
        return ImageFont.load_default(size)
    import matplotlib

    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf", size)


def _shortened(draw: Any, text: str, width: int) -> str:
    """The text, truncated if it would reach into the next cell."""
    if draw.textlength(text) <= width:
        return text
    while text and draw.textlength(text + "...") > width:
        text = text[:-1]
    return text + "..."


def _fitted(frame: np.ndarray, side: int) -> Any:
    from PIL import Image, ImageOps

    # A small picture is enlarged pixel by pixel, because that is what a policy sees.
    larger = max(frame.shape[:2]) > side
    method = Image.Resampling.BILINEAR if larger else Image.Resampling.NEAREST
    return ImageOps.contain(Image.fromarray(frame), (side, side), method)


# --- videos ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Moment:
    """A frame [H, W, 3] uint8, the note written on it, and whether the episode has succeeded.

    The outcome is None while it is open, and always None if nothing succeeds or fails.
    """

    frame: np.ndarray
    note: str
    outcome: bool | None = None


@dataclass(frozen=True)
class Clip:
    """An episode as a video shows it.

    Attributes:
        caption: text above it.
        moments: `FRAMES_PER_S` per second.
        ring: centre (right, down) and radius of the object to ring, as fractions of the frame's
            side; None for no ring.
    """

    caption: str
    moments: Sequence[Moment]
    ring: tuple[float, float, float] | None = None


def save_video(clips: Sequence[Clip], path: Path) -> None:
    """Write the first `CLIPS` clips side by side, as H.264 or GIF depending on the path's suffix.

    A finished clip holds its last frame. The border of each is grey until its outcome is known,
    then green for a success and red for a failure.
    """
    pictures = list(_pictures(clips[:CLIPS]))
    encode = _write_gif if path.suffix == ".gif" else _write_mp4
    write_atomically(path, lambda file: encode(pictures, file))


def _pictures(clips: Sequence[Clip]) -> Iterator[Any]:
    columns = len(clips) if len(clips) <= 4 else math.ceil(len(clips) / 2)
    rings = [_ring(clip.ring) for clip in clips]
    first = [clip.moments[0] for clip in clips]
    # Each clip's last moment with its tile, which is redrawn only when the moment changes.
    drawn = [(m, _framed(m, ring)) for m, ring in zip(first, rings, strict=True)]
    for t in range(max(len(clip.moments) for clip in clips) + _HOLD_FRAMES):
        for i, clip in enumerate(clips):
            moment = clip.moments[min(t, len(clip.moments) - 1)]
            if drawn[i][0] is not moment:
                drawn[i] = (moment, _framed(moment, rings[i]))
        cells = [(clip.caption, [tile]) for clip, (_, tile) in zip(clips, drawn, strict=True)]
        yield tiled(cells, columns, _CLIP_TILE, _CLIP_TEXT)


def _framed(moment: Moment, ring: Any) -> np.ndarray:
    """The frame enlarged, with its ring, its note and its border."""
    from PIL import Image, ImageDraw

    picture = _fitted(moment.frame, _CLIP_PICTURE)
    if ring is not None:
        picture.paste(ring, (0, 0), ring)
    color = {None: UNDECIDED, True: SUCCESS, False: FAILURE}[moment.outcome]
    tile = Image.new("RGB", (_CLIP_TILE, _CLIP_TILE), color)
    left, top = (_CLIP_TILE - picture.width) // 2, (_CLIP_TILE - picture.height) // 2
    tile.paste(picture, (left, top))
    draw, font = ImageDraw.Draw(tile), _font(moment.note, _CLIP_TEXT)
    # The note is on a patch in the border's colour, so that it is legible on any picture.
    _, _, right, bottom = draw.textbbox((0, 0), moment.note, font=font)
    corner = (left + right + 12, top + bottom + 9)
    draw.rounded_rectangle((left - _BORDER, top - _BORDER, *corner), 5, fill=color)
    draw.text((left + 5, top + 2), moment.note, fill="white", font=font)
    return np.asarray(tile)


def _ring(circle: tuple[float, float, float] | None) -> Any:
    """A transparent image [`_CLIP_PICTURE`, `_CLIP_PICTURE`, RGBA] of a white, dark-edged ring."""
    if circle is None:
        return None
    from PIL import Image, ImageDraw

    side = _CLIP_PICTURE * _SMOOTHING
    drawn = Image.new("RGBA", (side, side), (0, 0, 0, 0))
    draw = ImageDraw.Draw(drawn)
    x, y, radius = (side * value for value in circle)
    inner = radius + 2 * _RING_WIDTH * _SMOOTHING  # does not cover the target itself
    for margin, color in ((1, (20, 20, 20, 255)), (0, (255, 255, 255, 255))):
        edge, width = inner + margin * _SMOOTHING, (_RING_WIDTH + 2 * margin) * _SMOOTHING
        reach = edge + _RING_WIDTH * _SMOOTHING
        box = (x - reach, y - reach, x + reach, y + reach)
        draw.ellipse(box, outline=color, width=width)
    return drawn.resize((_CLIP_PICTURE, _CLIP_PICTURE), Image.Resampling.LANCZOS)


def as_gif(path: Path) -> tuple[bytes, int, int]:
    """A video from `save_video` as an animated GIF, with its width and height in pixels."""
    from PIL import Image

    if path.suffix == ".gif":
        with Image.open(path) as shown:
            return path.read_bytes(), *shown.size
    import av

    with av.open(str(path)) as container:
        pictures = [frame.to_image() for frame in container.decode(video=0)]
    file = io.BytesIO()
    _write_gif(pictures, file)
    return file.getvalue(), *pictures[0].size


def _write_gif(pictures: Sequence[Any], file: BinaryIO) -> None:
    first, *rest = pictures
    first.save(
        file, format="GIF", save_all=True, append_images=rest, duration=1000 // FRAMES_PER_S, loop=0
    )


def _write_mp4(pictures: Sequence[Any], file: BinaryIO) -> None:
    writer = Mp4Writer(file, FRAMES_PER_S, keyframe_every=FRAMES_PER_S)
    try:
        writer.write([np.asarray(picture) for picture in pictures])
    finally:
        writer.close()


class Mp4Writer:
    """An H.264 mp4 file that is written frame by frame; the sides of frames must be even.

    One thread encodes, so that the pictures do not depend on how many cores a machine has.

    Args:
        target: a path, or a file that is open for writing.
        fps: frames per second.
        keyframe_every: the largest distance between key frames.
    """

    def __init__(self, target: Path | BinaryIO, fps: float, keyframe_every: int) -> None:
        import av

        opened = str(target) if isinstance(target, Path) else target
        self._container = av.open(opened, "w", format="mp4")
        self._rate = Fraction(fps).limit_denominator(1_000_000)
        # Without frames that depend on later ones ("bf"), so that frames come out in order.
        self._options = {"g": str(keyframe_every), "crf": "18", "bf": "0", "threads": "1"}
        self._stream: Any = None
        self._frames = self._bytes = 0
        self._failed = False  # after a failed first write, FFmpeg would use freed memory

    def write(self, frames: Sequence[np.ndarray] | np.ndarray) -> None:
        """Append T frames [H, W, 3] uint8; the first is a key frame."""
        import av

        if self._stream is None:
            self._stream = self._opened(*frames[0].shape[:2])
        kinds = av.video.frame.PictureType
        for i, frame in enumerate(frames):
            picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
            picture.pts, picture.time_base = self._frames, 1 / self._rate
            picture.pict_type = kinds.I if i == 0 else kinds.NONE
            self._frames += 1
            self._mux(picture)

    def _opened(self, height: int, width: int) -> Any:
        stream = self._container.add_stream("libx264", rate=self._rate, options=self._options)
        stream.height, stream.width, stream.pix_fmt = height, width, "yuv420p"
        return stream

    def size(self) -> int:
        """Bytes of the frames that the encoder has released; it holds back a few dozen."""
        return self._bytes

    def close(self) -> None:
        """Write the frames that the encoder holds back, and end the file.

        After a failed write nothing more is written.
        """
        if self._stream is not None and not self._failed:
            self._mux(None)
        self._container.close()

    def _mux(self, picture: Any) -> None:
        for packet in self._stream.encode(picture):
            self._bytes += packet.size
            try:
                self._container.mux(packet)
            except BaseException:
                self._failed = True
                raise
