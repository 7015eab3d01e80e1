"""Scenes with their questions, and a second, independent reading of what a question asks."""

from __future__ import annotations

import math
import re

import pytest

from aegis_cli.common.palette import COLORS
from aegis_cli.data.vqa.dataset import TRAINING_MIX
from aegis_cli.data.vqa.questions import GRID, Balancer, Question, vocabulary
from aegis_cli.data.vqa.scenes import SceneRenderer, scene_rng
from aegis_cli.data.vqa.things import IMAGE_SIZE, SHAPES, Scene, Thing
from aegis_cli.models.backbones.tokenizer import SPECIAL

SCENES = 300
WORDS = (*SPECIAL, *vocabulary())
CELL_PX = IMAGE_SIZE // GRID
NOUNS = r"(?:object|thing|target|pad)s?"
THING = "(?P<thing>.+?)"
FORMS = {
    "color": rf"(?:what color is|which color does|what is the color of) the {THING}(?: have)?",
    "shape": rf"(?:what shape is|which shape does|what is the shape of) the {THING}(?: have)?",
    "count": rf"(?:how many|count the) {NOUNS}(?: are there| do you see)?",
    "count-kind": rf"(?:how many|count the) {THING}(?: are there| do you see)?",
    "exists": rf"(?:is there|do you see) a {THING}",
    "side": rf"is the {THING} left or right of the (?P<other>.+)",
    "where": rf"(?:where is|point to|find|locate|go to|move to|touch|reach) the {THING}",
}


@pytest.fixture(scope="session")
def scenes() -> list[tuple[Scene, list[Question]]]:
    """Scenes, each with questions of every family in the proportions of pre-training."""
    renderer, balancer, made = SceneRenderer(), Balancer(), []
    for index in range(SCENES):
        rng = scene_rng(0, "train", index)
        scene = renderer.render(rng)
        made.append(
            (
                scene,
                [
                    q
                    for family, n in TRAINING_MIX.items()
                    for q in balancer.choose(scene, family, n, rng)
                ],
            )
        )
    renderer.close()
    return made


def cell_of(thing: Thing) -> str:
    return f"x{math.floor(thing.x_px / CELL_PX)} y{math.floor(thing.y_px / CELL_PX)}"


def called(name: str, things: tuple[Thing, ...]) -> list[Thing]:
    """The things to which a noun phrase may refer: 'red cubes', 'blue pad', 'object at x3 y5'."""
    name, _, cell = name.partition(" at ")
    words = [word if word in COLORS else word.removesuffix("s") for word in name.split()]
    assert words and all(w in COLORS or w in SHAPES or re.fullmatch(NOUNS, w) for w in words), name
    wanted = {w for w in words if w in COLORS or w in SHAPES}
    return [t for t in things if wanted <= {t.color, t.shape} and (not cell or cell_of(t) == cell)]


def only(name: str, things: tuple[Thing, ...]) -> Thing:
    found = called(name, things)
    assert len(found) == 1, f"'{name}' means {len(found)} of {things}"
    return found[0]


def truth(question: Question, things: tuple[Thing, ...]) -> str:
    """The answer to the question's words for these things.

    It fails if a name does not refer to exactly one of them.
    """
    match = re.fullmatch(FORMS[question.family], question.text)
    assert match, question
    name = match.groupdict().get("thing", "things")
    number = ("zero", "one", "two", "three", "four")[len(called(name, things))]
    answers = {
        "color": lambda: only(name, things).color,
        "shape": lambda: only(name, things).shape,
        "count": lambda: number,
        "count-kind": lambda: number,
        "exists": lambda: "no" if number == "zero" else "yes",
        "side": lambda: (
            "left" if only(name, things).x_px < only(match["other"], things).x_px else "right"
        ),
        "where": lambda: cell_of(only(name, things)),
    }
    return answers[question.family]()
