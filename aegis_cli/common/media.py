"""Episodes as one picture that moves: a grid of them, enlarged, each with its instruction."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from aegis_cli.common.errors import AegisError
from aegis_cli.common.files import check_writable, write_atomically

COLUMNS, ROWS = 4, 2
_TILE, _CAPTION, _GAP = 192, 18, 6  # pixels
FRAMES_PER_S = 10


def check(path: Path) -> None:
    """Raise AegisError unless a video can be written to `path`; call it before the work."""
    check_writable(path)
    if path.suffix not in (".mp4", ".gif"):
        raise AegisError(
            f"--video {path}",
            "a file name that ends in .mp4 or .gif",
            f"--video {path.with_suffix('.gif')}",
        )
    module = {".mp4": "av", ".gif": "PIL"}[path.suffix]
    if find_spec(module) is None or find_spec("PIL") is None:
        raise AegisError(
            f"no package '{module}'",
            "the packages that write videos",
            "pip install 'aegis-vla[media]'",
        )


def save(episodes: Sequence[Sequence[np.ndarray]], captions: Sequence[str], path: Path) -> None:
    """The first episodes (lists of [64, 64, 3] uint8 frames) side by side; a finished one holds its
    last frame.
    """
    shown = list(zip(episodes, captions, strict=True))[: COLUMNS * ROWS]
    length = max(len(frames) for frames, _ in shown)
    pictures = [
        _grid([(frames[min(t, len(frames) - 1)], text) for frames, text in shown])
        for t in range(length)
    ]
    encode = _write_gif if path.suffix == ".gif" else _write_mp4
    write_atomically(path, lambda file: encode(pictures, file))


def _grid(tiles: Sequence[tuple[np.ndarray, str]]) -> Any:
    from PIL import Image, ImageDraw

    columns = min(COLUMNS, len(tiles))
    rows = -(-len(tiles) // columns)
    width, height = columns * (_TILE + _GAP), rows * (_TILE + _CAPTION + _GAP)
    sheet = Image.new(
        "RGB", (width + width % 2, height + height % 2), "white"
    )  # H.264 wants even sides
    draw = ImageDraw.Draw(sheet)
    for i, (frame, text) in enumerate(tiles):
        x, y = i % columns * (_TILE + _GAP), i // columns * (_TILE + _CAPTION + _GAP)
        draw.text((x + 2, y + 3), text, fill="black")
        sheet.paste(
            Image.fromarray(frame).resize((_TILE, _TILE), Image.Resampling.NEAREST),
            (x, y + _CAPTION),
        )
    return sheet


def _write_gif(pictures: Sequence[Any], file: BinaryIO) -> None:
    first, *rest = pictures
    first.save(
        file, format="GIF", save_all=True, append_images=rest, duration=1000 // FRAMES_PER_S, loop=0
    )


def _write_mp4(pictures: Sequence[Any], file: BinaryIO) -> None:
    import av

    with av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=FRAMES_PER_S)
        stream.width, stream.height = pictures[0].size
        stream.pix_fmt = "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_image(picture)))
        container.mux(stream.encode())
