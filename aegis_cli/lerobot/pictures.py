"""Embedded images, and pictures of one size out of pictures of any."""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np

from aegis_cli.errors import AegisError
from aegis_cli.lerobot import layout

FILTER = "bilinear, as wide as the reduction, black borders"  # how `fit` resizes, part of a frame cache's key


def to_png(frame: np.ndarray) -> bytes:
    """[H, W, 3] uint8 as PNG: lossless, equal pictures give equal bytes."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(frame).save(out, format="PNG")
    return out.getvalue()


def from_bytes(data: bytes | None, where: str) -> np.ndarray:
    """The picture [H, W, 3] uint8 in the bytes of an image file; `where` names it in errors.

    Raises:
        AegisError: no bytes, or none that are a whole picture.
    """
    from PIL import Image

    if not data:
        fix = "embed the images in the parquet files"
        raise AegisError(f"no bytes in {where}", "those of an image file in every row", fix)
    try:
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
    except (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error) as error:
        raise AegisError(f"{where} is damaged: {error}", "a PNG or JPEG", layout.AGAIN) from error


def fit(frame: np.ndarray, height: int, width: int) -> np.ndarray:
    """The whole picture in [height, width, 3], its sides' ratio kept, black where nothing is left to show.

    The filter is Pillow's bilinear one, which averages over as many pixels as one new pixel covers; a picture of
    that size already comes back as it is.
    """
    if frame.shape[:2] == (height, width):
        return frame
    from PIL import Image

    scale = min(height / frame.shape[0], width / frame.shape[1])
    inner = [max(1, round(side * scale)) for side in frame.shape[:2]]
    small = np.asarray(Image.fromarray(frame).resize((inner[1], inner[0]), Image.Resampling.BILINEAR))
    out = np.zeros((height, width, 3), np.uint8)
    top, left = (height - inner[0]) // 2, (width - inner[1]) // 2
    out[top : top + inner[0], left : left + inner[1]] = small
    return out
