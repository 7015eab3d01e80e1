"""Embedded images."""

from __future__ import annotations

import io

import numpy as np

from aegis_cli.common.errors import AegisError
from aegis_cli.common.pictures import decoded
from aegis_cli.data.lerobot import layout


def to_png(frame: np.ndarray) -> bytes:
    """[H, W, 3] uint8 as PNG: lossless, equal pictures give equal bytes."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(frame).save(out, format="PNG")
    return out.getvalue()


def from_bytes(data: bytes | None, where: str) -> np.ndarray:
    """The picture [H, W, 3] uint8 in the bytes of an image file; `where` names it in errors.

    Raises:
        AegisError: there are no bytes, or they are no complete picture.
    """
    if not data:
        fix = "embed the images in the parquet files"
        raise AegisError(f"no bytes in {where}", "the bytes of an image file in every row", fix)
    try:
        return decoded(data)
    except ValueError as error:
        raise AegisError(
            f"{where} cannot be read as an image ({error})", "a PNG or JPEG", layout.AGAIN
        ) from error
