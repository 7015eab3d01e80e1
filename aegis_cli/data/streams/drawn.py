"""Drawn pictures of each kind: plain ones for pre-training, and differing ones for the stream."""

from __future__ import annotations

import math

import numpy as np

from aegis_cli.data.streams import masks
from aegis_cli.data.streams.names import DIGITS, DIRECTIONS, LETTERS, SHAPES, SIZE, TEXTURES
from aegis_cli.data.streams.photo import Photo, blurred, clouds, grey, ink, paint, two_tones

# The photo settings of pre-training pictures, and of each of the stream's tasks.
PLAIN = Photo(blur_px=(0.0, 0.9), noise=(0.0, 0.05), contrast=(0.6, 1.0))
CHALK = Photo(blur_px=(0.2, 0.6), noise=(0.03, 0.08))
MIXED = Photo(blur_px=(0.0, 0.5), noise=(0.02, 0.07), contrast=(0.6, 1.0))
DART = Photo(blur_px=(0.3, 1.0), noise=(0.02, 0.06), contrast=(0.6, 1.0), shade=(0.0, 0.5))
SCRATCHED = Photo(blur_px=(0.0, 0.8), noise=(0.02, 0.05), contrast=(0.7, 1.0))
WORN = Photo(blur_px=(0.0, 0.6), noise=(0.02, 0.05), contrast=(0.7, 1.0), shade=(0.0, 0.6))
_RAD = math.radians(1)
_SCRATCH = np.array([(-1, -0.02), (1, -0.02), (1, 0.02), (-1, 0.02)])  # in units of half its length

# The order of the random draws determines each picture: another order would make other pictures
# from the same seed, and require another `EDITION` of the cache.


def _center(rng: np.random.Generator, spread_px: float) -> np.ndarray:
    return SIZE / 2 + rng.uniform(-spread_px, spread_px, 2)


# --- shapes ---------------------------------------------------------------------------------------


def plain_shape(shape: int, color: int, rng: np.random.Generator) -> np.ndarray:
    """A filled shape or sometimes an outline, in one of the palette's colours, on a grey ground."""
    line = rng.uniform(0.2, 0.35) if rng.random() < 0.3 else None
    center, radius = _center(rng, 7), rng.uniform(9, 16)
    turned = rng.uniform(-15, 15) * _RAD
    mask = masks.shape(SHAPES[shape], center, radius, turned, line)
    return PLAIN.take(paint(mask, ink(color, rng), grey(rng, 0.05, 0.95)), rng)


def chalk_shape(shape: int, rng: np.random.Generator) -> np.ndarray:
    """A thin, worn chalk line on a smudged blackboard."""
    turned, line = rng.uniform(-30, 30) * _RAD, rng.uniform(0.13, 0.22)
    mask = masks.shape(SHAPES[shape], _center(rng, 6), rng.uniform(10, 18), turned, line)
    board = np.array([0.12, 0.25, 0.18]) + 0.4 * clouds(rng, 5)[..., None]
    worn = mask * (0.35 + 0.65 * clouds(rng, 14))
    return CHALK.take(paint(worn, grey(rng, 0.75, 0.95), board), rng)


# --- counts ---------------------------------------------------------------------------------------


def _spots(
    rng: np.random.Generator, count: int, radius_px: tuple[float, float]
) -> list[tuple[np.ndarray, float]]:
    """Centres and radii of discs that keep a distance from each other and from the border."""
    placed: list[tuple[np.ndarray, float]] = []
    while len(placed) < count:
        radius = rng.uniform(*radius_px)
        center = rng.uniform(radius + 1, SIZE - radius - 1, 2)
        # Touching discs could be counted as one.
        if all(np.hypot(*(center - c)) > 1.2 * (radius + r) for c, r in placed):
            placed.append((center, radius))
    return placed


def plain_count(count: int, color: int, rng: np.random.Generator) -> np.ndarray:
    """Discs of one colour on a grey ground."""
    picture = np.broadcast_to(grey(rng, 0.05, 0.95), (SIZE, SIZE, 3))
    color_of = ink(color, rng)
    for center, radius in _spots(rng, count + 1, (3.5, 6.0)):
        picture = paint(masks.shape("circle", center, radius), color_of, picture)
    return PLAIN.take(picture, rng)


def mixed_count(count: int, rng: np.random.Generator) -> np.ndarray:
    """Things of any shape and colour, some of them hollow, on a cloudy ground."""
    brightness = rng.uniform(0.25, 0.75)
    cloudy = brightness + 0.4 * (clouds(rng, 4)[..., None] - 0.5)
    picture = np.clip(cloudy + rng.uniform(-0.1, 0.1, 3), 0, 1)
    for center, radius in _spots(rng, count + 1, (4.0, 7.5)):
        line = rng.uniform(0.3, 0.45) if rng.random() < 0.5 else None
        name = SHAPES[rng.choice([1, 2, 3, 4])]  # no circles, which plain counts use
        mask = masks.shape(name, center, radius, rng.uniform(0, 2 * np.pi), line)
        picture = paint(mask, ink(int(rng.integers(8)), rng), picture)
    return MIXED.take(picture, rng)


# --- directions -----------------------------------------------------------------------------------


def plain_direction(direction: int, rng: np.random.Generator) -> np.ndarray:
    """An arrow."""
    return _pointer(masks.ARROW, direction, 8, PLAIN, rng)


def dart_direction(direction: int, rng: np.random.Generator) -> np.ndarray:
    """A dart on a cloudy ground, blurred."""
    return _pointer(masks.DART, direction, 14, DART, rng)


def _pointer(
    outline: np.ndarray, direction: int, off_deg: float, photo: Photo, rng: np.random.Generator
) -> np.ndarray:
    # Directions are 45 degrees apart; with less than half of that as jitter they stay distinct.
    angle = (direction * 360 / len(DIRECTIONS) + rng.uniform(-off_deg, off_deg)) * _RAD
    placed = masks.place(outline, _center(rng, 6), rng.uniform(10, 17), angle)
    mask = masks.polygons((placed, True))
    color, paper = two_tones(rng, 0.3)
    return photo.take(paint(mask, color, paper), rng)


# --- letters and digits ---------------------------------------------------------------------------


def plain_letter(letter: int, rng: np.random.Generator) -> np.ndarray:
    """A letter, upright or nearly so, thin or bold, in any two colours."""
    return _plain_glyph(LETTERS[letter].upper(), rng)


def plain_digit(digit: int, rng: np.random.Generator) -> np.ndarray:
    """A digit, drawn like the letters."""
    return _plain_glyph(str(digit % len(DIGITS)), rng)


def _plain_glyph(character: str, rng: np.random.Generator) -> np.ndarray:
    turned, slant = rng.uniform(-12, 12) * _RAD, rng.uniform(-0.2, 0.2)
    mask = masks.glyph(character, rng.uniform(20, 36), _center(rng, 5), turned, slant)
    if rng.random() < 0.5:
        # Blurring, amplifying and clipping make the strokes bold.
        mask = np.clip(2.5 * blurred(mask, rng.uniform(1, 2)), 0, 1)
    color, paper = two_tones(rng, 0.3)
    return PLAIN.take(paint(mask, color, paper), rng)


def scratched_letter(letter: int, rng: np.random.Generator) -> np.ndarray:
    """A rotated, slanted and blurred letter on a cloudy ground, with a scratch in its colour."""
    turned, slant = rng.uniform(-18, 18) * _RAD, rng.uniform(-0.4, 0.4)
    mask = masks.glyph(LETTERS[letter].upper(), rng.uniform(22, 34), _center(rng, 5), turned, slant)
    color, paper = two_tones(rng, 0.25)
    cloudy = paper + 0.3 * (clouds(rng, 4)[..., None] - 0.5)
    scratch = masks.place(_SCRATCH, _center(rng, 12), 40, rng.uniform(0, np.pi))
    mask = np.maximum(mask, masks.polygons((scratch, True)))
    return SCRATCHED.take(paint(mask, color, cloudy), rng)


# --- textures -------------------------------------------------------------------------------------


def plain_texture(texture: int, rng: np.random.Generator) -> np.ndarray:
    """A texture at any angle, over the whole picture."""
    mask = masks.texture(TEXTURES[texture], rng, rng.uniform(8, 14), rng.uniform(0, 2 * np.pi))
    color, paper = two_tones(rng, 0.25)
    return PLAIN.take(paint(mask, color, paper), rng)


def worn_texture(texture: int, rng: np.random.Generator) -> np.ndarray:
    """A texture on a disc before a grey ground, with one side in the shade."""
    mask = masks.texture(TEXTURES[texture], rng, rng.uniform(9, 14), rng.uniform(0, 2 * np.pi))
    color, paper = two_tones(rng, 0.25)
    disc = masks.shape("circle", _center(rng, 2), rng.uniform(19, 23))
    picture = paint(disc, paint(mask, color, paper), grey(rng, 0.1, 0.9))
    return WORN.take(picture, rng)
