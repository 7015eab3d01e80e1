"""What a rendered scene shows; unlike `scenes`, which renders it, this needs no simulator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

IMAGE_SIZE = 64
SHAPES: tuple[str, ...] = ("cube", "ball", "cylinder")


@dataclass(frozen=True)
class Thing:
    """One object: its colour, its shape, and its centre in the image (pixels, origin top left)."""

    color: str
    shape: str
    x_px: float
    y_px: float


@dataclass(frozen=True)
class Scene:
    """A picture [64, 64, 3] uint8 and the things in it."""

    image: np.ndarray
    things: tuple[Thing, ...]
