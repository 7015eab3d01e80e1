"""Shapes as coverage masks per pixel, drawn three times as large and averaged."""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from aegis_cli.common.errors import AegisError
from aegis_cli.data.streams.names import SIZE

if TYPE_CHECKING:
    from PIL import ImageFont

FINER = 3  # supersampling factor per side
_CANVAS = SIZE * FINER
Points = np.ndarray  # [n, 2], x to the right and y down, the shape within [-1, 1]


def need_freetype() -> None:
    """Raise AegisError unless Pillow has FreeType, which its scalable font needs."""
    from PIL import features

    if not features.check("freetype2"):
        raise AegisError(
            "a pillow without FreeType, which the stream's pictures are drawn with",
            "pillow >= 10.1 with FreeType, as in its wheels",
            "pip install --force-reinstall pillow",
        )


def polygons(*layers: tuple[Points, bool]) -> np.ndarray:
    """Polygons in pixels as a mask [S, S] in [0, 1].

    In order, each is painted (True) or cut out (False).
    """
    from PIL import Image, ImageDraw

    canvas = Image.new("L", (_CANVAS, _CANVAS))
    draw = ImageDraw.Draw(canvas)
    for points, solid in layers:
        draw.polygon([tuple(p) for p in (points * FINER).tolist()], fill=255 if solid else 0)
    return shrink(np.asarray(canvas) / 255)


def shrink(fine: np.ndarray) -> np.ndarray:
    """The means [S, S] of the blocks of a mask [S * FINER, S * FINER]."""
    return fine.reshape(SIZE, FINER, SIZE, FINER).mean((1, 3))


def place(points: Points, center: np.ndarray, radius: float, angle_rad: float) -> Points:
    """Rotate (anticlockwise as seen), scale and move points, in pixels."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return points @ np.array([[c, -s], [s, c]]) * radius + center


def shape(
    name: str, center: np.ndarray, radius: float, angle_rad: float = 0.0, line: float | None = None
) -> np.ndarray:
    """One of `names.SHAPES`, filled, or as an outline with a width of `line` times the radius."""
    outer = OUTLINES[name]()
    # Each layer covers a part of the previous one: filled, cut out, filled again.
    layers = [(place(outer, center, radius, angle_rad), True)]
    if name == "ring":
        layers.append((place(outer * 0.55, center, radius, angle_rad), False))
        if line is not None:  # two thin circles instead of a broad one
            layers.insert(1, (place(outer * (1 - line), center, radius, angle_rad), False))
            layers.insert(2, (place(outer * (0.55 + line), center, radius, angle_rad), True))
    elif line is not None:
        layers.append((place(inset(outer, line), center, radius, angle_rad), False))
    return polygons(*layers)


def inset(points: Points, width: float) -> Points:
    """Move a closed outline inwards by `width`.

    Each corner moves along the mean of its sides' normals.
    """
    normal_before = _normals(points - np.roll(points, 1, 0))
    normal_after = _normals(np.roll(points, -1, 0) - points)
    middle = normal_before + normal_after
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-9)
    # The bound limits sharp corners, which would otherwise move too far.
    cosine = np.maximum((middle * normal_before).sum(1, keepdims=True), 0.4)
    # The shoelace formula gives twice the area, whose sign shows the orientation, and so on which
    # side of the outline the inside is.
    x, y = points[:, 0], points[:, 1]
    area = float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())
    return points + middle * width / cosine * (1 if area > 0 else -1)


def _normals(sides: np.ndarray) -> np.ndarray:
    """Each side [n, 2] rotated by 90 degrees, at length 1."""
    lengths = np.linalg.norm(sides, axis=1, keepdims=True)
    return np.stack([-sides[:, 1], sides[:, 0]], 1) / (lengths + 1e-9)


def _circle() -> Points:
    return _regular(48, 0.0)  # more corners than can be seen


def _regular(corners: int, first_rad: float) -> Points:
    """A regular polygon of radius 1, with the first corner at this angle from the x axis."""
    t = first_rad + np.linspace(0, 2 * np.pi, corners, endpoint=False)
    return np.stack([np.cos(t), np.sin(t)], 1)


def _star() -> Points:
    points = _regular(10, -np.pi / 2)
    points[1::2] *= 0.42  # every other corner is pulled inwards
    return points


def _cross() -> Points:
    a, b = 0.95, 0.32  # half of an arm's length, and half of its width
    quarter = np.array([(-b, -a), (b, -a), (b, -b)])
    turns = [
        np.array([[1, 0], [0, 1]]),
        np.array([[0, 1], [-1, 0]]),
        np.array([[-1, 0], [0, -1]]),
        np.array([[0, -1], [1, 0]]),
    ]
    return np.concatenate([quarter @ turn for turn in turns])


def _heart() -> Points:
    t = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    # The usual heart curve; the last line centres it and scales it to [-1, 1].
    x = 16 * np.sin(t) ** 3
    y = -(13 * np.cos(t) - 5 * np.cos(2 * t) - 2 * np.cos(3 * t) - np.cos(4 * t))
    return np.stack([x, y - 2], 1) / 16.5


def _crescent() -> Points:
    """A disc minus a smaller one that protrudes on the right."""
    tip_rad, middle = 0.75, 0.55  # angle of a tip, and centre of the smaller disc
    outer = np.linspace(tip_rad, 2 * np.pi - tip_rad, 40)
    back = np.stack([np.cos(outer), np.sin(outer)], 1)
    tip = np.array([np.cos(tip_rad), np.sin(tip_rad)])
    radius = float(np.hypot(tip[0] - middle, tip[1]))
    half = math.atan2(tip[1], tip[0] - middle)
    inner = np.linspace(2 * np.pi - half, half, 30)
    bite = np.stack([middle + radius * np.cos(inner), radius * np.sin(inner)], 1)
    # Both arcs end in the tips, which the outline contains once.
    return np.concatenate([back, bite[1:-1]]) + [0.15, 0]


OUTLINES = {
    "circle": _circle,
    "square": lambda: _regular(4, np.pi / 4),
    "triangle": lambda: _regular(3, -np.pi / 2),
    "star": _star,
    "cross": _cross,
    "ring": _circle,
    "heart": _heart,
    "crescent": _crescent,
}

ARROW: Points = np.array(
    [(-1, -0.22), (0.1, -0.22), (0.1, -0.7), (1, 0), (0.1, 0.7), (0.1, 0.22), (-1, 0.22)]
)
DART: Points = np.array([(-0.8, -0.62), (1, 0), (-0.8, 0.62), (-0.35, 0)])


def glyph(
    character: str, height_px: float, center: np.ndarray, angle_rad: float = 0.0, slant: float = 0.0
) -> np.ndarray:
    """A character of Pillow's own font, `height_px` tall, rotated anticlockwise, slanted right."""
    from PIL import Image, ImageDraw

    letter = Image.new("L", (_CANVAS, _CANVAS))
    font = _font(_CANVAS * 3 // 4)
    ImageDraw.Draw(letter).text(
        (_CANVAS / 2, _CANVAS / 2), character, fill=255, font=font, anchor="mm"
    )
    box = letter.getbbox()
    assert box is not None
    left, top, right, bottom = box
    scale = (bottom - top) / (height_px * FINER)
    c, s = math.cos(angle_rad) * scale, math.sin(angle_rad) * scale
    # PIL needs the source of each pixel of the result. So this is the inverse: undo the rotation,
    # then the slant.
    back = np.array([[1, slant], [0, 1]]) @ np.array([[c, -s], [s, c]])
    # The centre of the drawn pixels goes to `center`, not the font's own centre.
    start = np.array([(left + right) / 2, (top + bottom) / 2]) - back @ (center * FINER)
    numbers = (back[0, 0], back[0, 1], start[0], back[1, 0], back[1, 1], start[1])
    turned = letter.transform(
        (_CANVAS, _CANVAS), Image.Transform.AFFINE, numbers, Image.Resampling.BILINEAR
    )
    return shrink(np.asarray(turned) / 255)


@cache
def _font(size_px: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    from PIL import ImageFont

    return ImageFont.load_default(size=size_px)


def texture(name: str, rng: np.random.Generator, period_px: float, angle_rad: float) -> np.ndarray:
    """One of `names.TEXTURES` over the whole picture, at a random phase -> [S, S] in [0, 1]."""
    at = (np.arange(_CANVAS) + 0.5) / FINER - SIZE / 2  # pixels from the picture's centre
    x, y = np.meshgrid(at, at)
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    turn = 2 * np.pi / period_px
    # The phases of each pixel along the pattern's own axes, in radians.
    u = turn * (c * x - s * y) + rng.uniform(0, 6.28)
    v = turn * (s * x + c * y) + rng.uniform(0, 6.28)
    return shrink(_PATTERNS[name](u, v, rng).astype(np.float64))


def _rings(u: np.ndarray, v: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Rings about a point near the picture's centre, whatever the phase."""
    at = _CANVAS // 2
    middle = np.array([u[at, at], v[at, at]]) + rng.uniform(-2, 2, 2)
    return np.sin(np.hypot(u - middle[0], v - middle[1])) > 0


def _bricks(u: np.ndarray, v: np.ndarray, _: np.random.Generator) -> np.ndarray:
    row = np.floor(v / np.pi)
    # Every other row is shifted by half a brick.
    along = (u / 2 + row * np.pi / 2) % np.pi
    return (v % np.pi > 0.6) & (along > 0.35)


def _speckles(u: np.ndarray, v: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Blots at random places."""
    found = np.zeros(u.shape, bool)
    reach = u.max() - u.min()  # the same for v, because the picture is square
    across, down = rng.uniform(0, 1, (2, 40))
    radii = rng.uniform(0.5, 1.5, 40)
    for a, b, radius in zip(across, down, radii, strict=True):
        found |= np.hypot(u - u.min() - a * reach, v - v.min() - b * reach) < radius
    return found


_PATTERNS = {
    "striped": lambda u, v, _: np.sin(u) > 0,
    "checkered": lambda u, v, _: np.sin(u) * np.sin(v) > 0,
    "dotted": lambda u, v, _: np.cos(u) + np.cos(v) > 0.9,
    "gridded": lambda u, v, _: (np.cos(u) > 0.85) | (np.cos(v) > 0.85),
    "wavy": lambda u, v, _: np.sin(u + 1.6 * np.sin(0.8 * v)) > 0,
    "ringed": _rings,
    "bricked": _bricks,
    "speckled": _speckles,
}
