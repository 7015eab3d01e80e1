"""The embedded stream's tasks by name, so that recipes can list them without heavy imports."""

from __future__ import annotations

from dataclasses import dataclass

# Colours are those of palette.py and solids those of vqa/things.py, in the same order: a picture's
# label is an index into either.
COLORS = ("red", "green", "blue", "yellow", "orange", "purple", "cyan", "pink")
SOLIDS = ("cube", "ball", "cylinder")
SHAPES = ("circle", "square", "triangle", "star", "cross", "ring", "heart", "crescent")
NUMBERS = ("one", "two", "three", "four", "five", "six")
TEXTURES = ("striped", "checkered", "dotted", "gridded", "wavy", "ringed", "bricked", "speckled")
# Anticlockwise from the right, 45 degrees apart.
DIRECTIONS = ("right", "up right", "up", "up left", "left", "down left", "down", "down right")
LETTERS = ("a", "b", "c", "d", "e", "f", "g", "h", "k", "m", "n", "r", "s", "t", "w", "x")
DIGITS = ("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
DOMAINS = (
    "acrobot",
    "cartpole",
    "cheetah",
    "cup",
    "finger",
    "hopper",
    "humanoid",
    "manipulator",
    "pendulum",
    "swimmer",
)

# Pair B: the same pictures under other digits' names; no digit keeps its own name, because 2 i is
# never 9 modulo 10.
PERMUTED = tuple(DIGITS[(3 * i + 1) % 10] for i in range(10))


@dataclass(frozen=True)
class Words:
    """A task's classes in the order of its labels, and its templates.

    Training uses the first template.
    """

    classes: tuple[str, ...]
    templates: tuple[str, ...]


def _words(classes: tuple[str, ...], phrase: str) -> Words:
    openings = ("a photo of ", "a picture of ", "")
    return Words(classes, tuple(opening + phrase for opening in openings))


TASKS: dict[str, Words] = {
    "colors": _words(COLORS, "a {} object"),
    "counts": _words(NUMBERS, "{} things"),
    "digits": _words(DIGITS, "the digit {}"),
    "directions": _words(DIRECTIONS, "an arrow pointing {}"),
    "domains": _words(DOMAINS, "the {} robot"),
    "letters": _words(LETTERS, "the letter {}"),
    "places": _words(DIRECTIONS, "a target {} of the middle"),
    "shapes": _words(SHAPES, "a {}"),
    "targets": _words(COLORS, "the {} target"),
    "textures": _words(TEXTURES, "a {} pattern"),
    "digits-inverted": _words(DIGITS, "the digit {}"),
    "digits-permuted": _words(PERMUTED, "the digit {}"),
}

# A stream is its tasks in the order in which they are learned.
STREAMS: dict[str, tuple[str, ...]] = {
    "primer-1": (
        "colors",
        "counts",
        "digits",
        "directions",
        "domains",
        "letters",
        "places",
        "shapes",
        "targets",
        "textures",
    ),
    "primer-2": (
        "domains",
        "shapes",
        "letters",
        "targets",
        "textures",
        "digits",
        "places",
        "counts",
        "colors",
        "directions",
    ),
    "pair-inverted": ("digits", "digits-inverted"),
    "pair-permuted": ("digits", "digits-permuted"),
}

SIZE = 48  # pixels per side of the generated pictures
