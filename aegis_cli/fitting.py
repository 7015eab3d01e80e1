"""Pictures of one size out of pictures of any, for questions and robot frames alike."""

from __future__ import annotations

import numpy as np

GREY = 128  # what a backbone that scales pixels to [-1, 1] reads as nothing
FILTER = "bilinear, as wide as the reduction, grey borders"


def fit(picture: np.ndarray, height: int, width: int) -> np.ndarray:
    """The whole picture [H, W, 3] uint8 in the middle of [height, width, 3], its sides' ratio kept, grey around it.

    The filter is Pillow's bilinear one, which averages over as many pixels as one new pixel covers; a picture of
    that size already comes back as it is.
    """
    if picture.shape[:2] == (height, width):
        return picture
    from PIL import Image

    scale = min(height / picture.shape[0], width / picture.shape[1])
    inner = [max(1, round(side * scale)) for side in picture.shape[:2]]
    small = np.asarray(Image.fromarray(picture).resize((inner[1], inner[0]), Image.Resampling.BILINEAR))
    out = np.full((height, width, 3), GREY, np.uint8)
    top, left = (height - inner[0]) // 2, (width - inner[1]) // 2
    out[top : top + inner[0], left : left + inner[1]] = small
    return out
