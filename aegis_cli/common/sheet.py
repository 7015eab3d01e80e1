"""A contact sheet: pictures of episodes, each row of them under its caption."""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError

EPISODES = 8  # on a sheet
_TILE, _CAPTION = 192, 20  # pixels


def need_pillow() -> None:
    """Raise AegisError unless a sheet can be drawn; call it before the work."""
    if find_spec("PIL") is None:
        raise AegisError(
            "no pillow", "pillow, to draw the contact sheet", "pip install 'aegis-vla[media]'"
        )


def save(path: Path, shown: Sequence[tuple[str, Sequence[np.ndarray]]]) -> None:
    """Write a PNG: for each episode its caption over as many [H, W, 3] uint8 frames as the others
    have, two a row.
    """
    from PIL import Image, ImageDraw, ImageOps

    cell, line = max(len(frames) for _, frames in shown) * (_TILE + 4) + 16, _TILE + _CAPTION + 8
    sheet = Image.new("RGB", (2 * cell, line * math.ceil(len(shown) / 2)), "white")
    draw = ImageDraw.Draw(sheet)
    for i, (caption, frames) in enumerate(shown):
        x, y = i % 2 * cell, i // 2 * line
        draw.text((x + 4, y + 4), caption, fill="black")
        for k, frame in enumerate(frames):
            larger = max(frame.shape[:2]) > _TILE
            method = (
                Image.Resampling.BILINEAR if larger else Image.Resampling.NEAREST
            )  # whole pixels of a small picture
            tile = ImageOps.contain(Image.fromarray(frame), (_TILE, _TILE), method)
            sheet.paste(tile, (x + 4 + k * (_TILE + 4), y + _CAPTION))
    files.write_atomically(path, lambda file: sheet.save(file, format="PNG"))
