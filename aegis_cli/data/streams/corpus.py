"""The pre-training corpus of the embedded dual encoder: plain pictures with captions.

They show the stream's kinds of things, but in another style: what a stream's task teaches is new.

Each picture shows one kind of thing with some attributes, and a caption states some of them. It is
true of every picture of its kind that has the stated attributes: all of those are its positives,
whichever picture it was written for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.data.streams import masks
from aegis_cli.data.streams.names import (
    COLORS,
    DIGITS,
    DIRECTIONS,
    DOMAINS,
    LETTERS,
    NUMBERS,
    SHAPES,
    SIZE,
    SOLIDS,
    TEXTURES,
)

OPENINGS = ("", "a photo of ", "a picture of ")
UNSAID = -1
ATTRIBUTES = 2  # the most that a picture has
SPLITS = {"train": 0, "validation": 1}  # one seed stream each
REPORT_EVERY = 1000
Painter = Callable[..., np.ndarray]


@dataclass(frozen=True)
class Kind:
    """One kind of picture.

    Attributes:
        attributes: the possible words of each attribute.
        phrases: possible captions: a phrase, and the attributes that fill its gaps, in order.
        weight: its share of the corpus.
    """

    attributes: tuple[tuple[str, ...], ...]
    phrases: tuple[tuple[str, tuple[int, ...]], ...]
    weight: float = 1.0


KINDS: dict[str, Kind] = {
    "solids": Kind((COLORS, SOLIDS), (("a {} object", (0,)), ("a {}", (1,)), ("a {} {}", (0, 1)))),
    "shapes": Kind((SHAPES, COLORS), (("a {}", (0,)), ("a {} {}", (1, 0)))),
    "counts": Kind((NUMBERS, COLORS), (("{} things", (0,)), ("{} {} things", (0, 1)))),
    "directions": Kind((DIRECTIONS,), (("an arrow pointing {}", (0,)),)),
    "letters": Kind((LETTERS,), (("the letter {}", (0,)),), 1.5),
    "digits": Kind((DIGITS,), (("the digit {}", (0,)),)),
    "textures": Kind((TEXTURES,), (("a {} pattern", (0,)),)),
    "targets": Kind(
        (COLORS, DIRECTIONS), (("the {} target", (0,)), ("a target {} of the middle", (1,)))
    ),
    "domains": Kind((DOMAINS,), (("the {} robot", (0,)),)),
}


@dataclass(frozen=True)
class Captions:
    """All possible captions, without an opening.

    Attributes:
        texts: N phrases with their gaps filled.
        says: [N, 1 + ATTRIBUTES] int64, the kind and the values of the stated attributes; `UNSAID`
            for attributes that are not stated.
    """

    texts: tuple[str, ...]
    says: np.ndarray


@dataclass(frozen=True)
class Corpus:
    """Pictures [N, S, S, 3] uint8 and their `facts` [N, 1 + ATTRIBUTES] int64.

    The facts are the kind and the values of its attributes.
    """

    images: np.ndarray
    facts: np.ndarray


def captions() -> Captions:
    """All captions, in a fixed order."""
    texts, stated = [], []
    for number, kind in enumerate(KINDS.values()):
        for text, says in _of_kind(number, kind):
            texts.append(text)
            stated.append(says)
    return Captions(tuple(texts), np.array(stated))


def _of_kind(number: int, kind: Kind) -> Iterator[tuple[str, list[int]]]:
    """Every caption of one kind, with its row of `Captions.says`."""
    for phrase, slots in kind.phrases:
        choices = [range(len(kind.attributes[slot])) for slot in slots]
        for values in product(*choices):
            says = [number, *[UNSAID] * ATTRIBUTES]
            words = []  # for the phrase's gaps, which may be in another order than the attributes
            for slot, value in zip(slots, values, strict=True):
                says[1 + slot] = value
                words.append(kind.attributes[slot][value])
            yield phrase.format(*words), says


def true_of(says: np.ndarray, facts: np.ndarray) -> np.ndarray:
    """Whether a caption is true of a picture: captions [N, A], pictures [B, A] -> [B, N] bool."""
    agrees = says[None] == facts[:, None]  # [B, N, A]
    # The kind is always stated, so no caption is true of another kind's picture.
    return (agrees | (says[None] == UNSAID)).all(-1)


def vocabulary() -> tuple[str, ...]:
    """All words of captions and openings, in alphabetical order."""
    texts = " ".join((*captions().texts, *OPENINGS))
    return tuple(sorted(set(texts.split())))


def render(seed: int, count: int, split: str = "train", on_event: OnEvent = ignore) -> Corpus:
    """Draw and render `count` pictures, with kinds drawn by weight and attributes uniformly.

    Raises:
        AegisError: Pillow lacks FreeType, or there is no OpenGL.
    """
    masks.need_freetype()  # before minutes of drawing
    paint, kinds = _painters(), list(KINDS.values())
    shares = np.array([kind.weight for kind in kinds])
    images = np.empty((count, SIZE, SIZE, 3), np.uint8)
    facts = np.full((count, 1 + ATTRIBUTES), UNSAID)
    for i in range(count):
        # One generator per picture: a picture does not depend on how many come before it.
        rng = np.random.default_rng([seed, SPLITS[split], i])
        number = rng.choice(len(kinds), p=shares / shares.sum())
        values = [int(rng.integers(len(words))) for words in kinds[number].attributes]
        facts[i, : 1 + len(values)] = number, *values  # with one attribute the last stays UNSAID
        images[i] = paint[number](*values, rng)
        if (i + 1) % REPORT_EVERY == 0 or i + 1 == count:
            on_event(Progress(f"{split} pictures", i + 1, count, "pictures"))
    return Corpus(images, facts)


def _painters() -> list[Painter]:
    """The painters in the order of KINDS; imported here, since they need OpenGL."""
    from aegis_cli.data.streams import drawn, rendered, robots

    by_name: dict[str, Painter] = {
        "solids": rendered.plain_solid,
        "shapes": drawn.plain_shape,
        "counts": drawn.plain_count,
        "directions": drawn.plain_direction,
        "letters": drawn.plain_letter,
        "digits": drawn.plain_digit,
        "textures": drawn.plain_texture,
        "targets": rendered.plain_target,
        "domains": robots.plain_domain,
    }
    return [by_name[name] for name in KINDS]
