"""Wrong answers with their images: a few of each family, as PNG that any viewer reads."""

from __future__ import annotations

import base64
import io

import numpy as np
from PIL import Image

from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.data.vqa.metrics import Graded
from aegis_cli.data.vqa.questions import Question
from aegis_cli.evaluation import wrong_answers


def graded(families: str) -> list[Graded]:
    """One wrong answer for each letter, and a right one for each capital letter."""
    return [
        Graded(Question(letter.lower(), f"q{i}", "a"), "b", letter.isupper(), 1.0, image=i)
        for i, letter in enumerate(families)
    ]


def asked(count: int, side: int = 4) -> VQASet:
    """Questions about this many images; the n-th is of the grey n."""
    images = np.arange(count, dtype=np.uint8)[:, None, None, None] + np.zeros((1, side, side, 3))
    return VQASet(images.astype(np.uint8), np.arange(count), ())


def pixels(example: dict[str, str]) -> np.ndarray:
    with Image.open(io.BytesIO(base64.b64decode(example["png"]))) as image:
        return np.asarray(image)


def test_each_family_has_its_turn_and_right_answers_have_none() -> None:
    found = wrong_answers.examples(graded("aaaBbC"), asked(6), None)
    assert [(one["family"], one["question"]) for one in found] == [
        ("a", "q0"),
        ("b", "q4"),
        ("a", "q1"),
        ("a", "q2"),
    ]
    assert [int(pixels(one)[0, 0, 0]) for one in found] == [0, 4, 1, 2]


def test_there_are_never_many() -> None:
    assert len(wrong_answers.examples(graded("a" * 99), asked(99), None)) == wrong_answers.MOST
    assert wrong_answers.examples(graded("AB"), asked(2), None) == []


def test_a_png_holds_the_very_pixels() -> None:
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    assert (pixels({"png": wrong_answers.encoded(image)}) == image).all()


def test_a_large_image_is_kept_small() -> None:
    found = wrong_answers.examples(graded("a"), asked(1, side=200), None)
    assert pixels(found[0]).shape == (67, 67, 3)
