"""The effects that turn a drawing into a picture: paper, ink, light, blur and noise.

Pictures are [S, S, 3] in [0, 1].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aegis_cli.common.palette import COLORS, RGB
from aegis_cli.data.streams.names import SIZE

Span = tuple[float, float]


@dataclass(frozen=True)
class Photo:
    """Settings for taking a picture; each value is drawn from its span.

    Attributes:
        blur_px: standard deviation of the blur.
        noise: standard deviation of each value's noise.
        contrast: factor on the distance to mid grey.
        cast: the most by which the light's colour raises or lowers a channel.
        shade: how much darker one side is than the other.
    """

    blur_px: Span = (0.0, 0.0)
    noise: Span = (0.0, 0.02)
    contrast: Span = (0.9, 1.0)
    cast: float = 0.0
    shade: Span = (0.0, 0.0)

    def take(self, picture: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Apply these effects to a picture in [0, 1]; returns [S, S, 3] uint8."""
        # The noise comes last, so that nothing smooths it. Every effect draws, even if its span is
        # empty, so that changing a span does not affect the other effects' draws.
        picture = blurred(picture, rng.uniform(*self.blur_px))
        picture = 0.5 + (picture - 0.5) * rng.uniform(*self.contrast)
        picture = picture * (1 + rng.uniform(-self.cast, self.cast, 3))
        picture = picture * (1 - rng.uniform(*self.shade) * slope(rng)[..., None])
        picture = picture + rng.normal(0, rng.uniform(*self.noise), picture.shape)
        return to_bytes(picture)


def to_bytes(picture: np.ndarray) -> np.ndarray:
    """Colours [..., 3] in [0, 1] as uint8, clipped to that range."""
    return np.clip(np.rint(picture * 255), 0, 255).astype(np.uint8)


def slope(rng: np.random.Generator) -> np.ndarray:
    """A ramp from 0 to 1 across the picture in a random direction, [S, S]."""
    angle = rng.uniform(0, 2 * np.pi)
    at = np.linspace(-1, 1, SIZE)
    plane = np.cos(angle) * at[None, :] + np.sin(angle) * at[:, None]
    return (plane - plane.min()) / (plane.max() - plane.min())


def blurred(picture: np.ndarray, deviation_px: float) -> np.ndarray:
    """A Gaussian blur of the first two axes; the border is repeated."""
    if deviation_px < 0.2:
        return picture
    reach = int(3 * deviation_px + 1)  # three deviations cover 99.7 % of the weight
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation_px) ** 2)
    weights /= weights.sum()
    # A two-dimensional Gaussian is separable: two one-dimensional passes.
    for axis in (0, 1):
        border = [(0, 0)] * picture.ndim
        border[axis] = (reach, reach)
        padded = np.pad(picture, border, mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis)
        picture = windows @ weights
    return picture


def ink(color: int, rng: np.random.Generator) -> np.ndarray:
    """One of the palette's colours [3], slightly darker or lighter."""
    return np.clip(np.array(RGB[COLORS[color]]) * rng.uniform(0.85, 1.1), 0, 1)


def grey(rng: np.random.Generator, low: float, high: float) -> np.ndarray:
    """A nearly neutral colour [3]."""
    return np.clip(rng.uniform(low, high) + rng.uniform(-0.04, 0.04, 3), 0, 1)


def two_tones(rng: np.random.Generator, apart: float) -> tuple[np.ndarray, np.ndarray]:
    """Two colours [3] of any hue whose brightness differs by at least `apart`, in random order."""
    while True:
        first, second = rng.uniform(0, 1, (2, 3))
        if abs(first.mean() - second.mean()) >= apart:
            return first, second


def paint(mask: np.ndarray, color: np.ndarray, paper: np.ndarray) -> np.ndarray:
    """`color` where the mask [S, S] is 1 and `paper` where it is 0; each is [3] or a picture."""
    return mask[..., None] * color + (1 - mask[..., None]) * paper


def clouds(rng: np.random.Generator, cells: int) -> np.ndarray:
    """Smooth random greys [S, S] in [0, 1], about `cells` spots per side."""
    coarse = rng.uniform(0, 1, (cells + 1, cells + 1))
    at = np.linspace(0, cells, SIZE, endpoint=False)
    low = at.astype(int)
    part = at - low
    # Bilinear between the cells' corners: first over rows, then over columns.
    rows = coarse[low] * (1 - part)[:, None] + coarse[low + 1] * part[:, None]
    return rows[:, low] * (1 - part) + rows[:, low + 1] * part
