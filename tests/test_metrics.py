"""Grading: intervals against figures worked out by hand, and what a known answerer scores."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from aegis_cli.vqa.dataset import VQASet
from aegis_cli.vqa.metrics import Graded, by_family, grade, score, wilson_interval
from aegis_cli.vqa.questions import Question, majority_share


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [  # (p + z^2/2n -+ z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n), z = 1.96
        (0, 10, 0.0, 0.277533),
        (10, 10, 0.722467, 1.0),
        (5, 10, 0.236593, 0.763407),
        (90, 100, 0.825634, 0.944771),
        (4800, 5000, 0.954206, 0.965088),
    ],
)
def test_wilson_interval(successes: int, trials: int, low: float, high: float) -> None:
    assert wilson_interval(successes, trials) == pytest.approx((low, high), abs=2e-6)


def test_the_interval_is_symmetric_narrows_and_stays_inside() -> None:
    for n in (1, 3, 50, 5000):
        for k in range(0, n + 1, max(1, n // 7)):
            low, high = wilson_interval(k, n)
            assert 0 <= low <= k / n <= high <= 1
            assert wilson_interval(n - k, n) == pytest.approx((1 - high, 1 - low), abs=1e-12)
    widths = [np.diff(wilson_interval(n // 2, n))[0] for n in (10, 100, 1000)]
    assert widths[0] > 2 * widths[1] > 4 * widths[2]


def questions(family: str, answers: str) -> list[Question]:
    return [Question(family, f"{family} {i}", a) for i, a in enumerate(answers)]


def test_majority_share_is_taken_in_each_family() -> None:
    """Always a family's commonest answer: 3 of 4 and 2 of 4, although no answer is common over all."""
    assert majority_share(questions("a", "xxxy") + questions("b", "yyxz")) == 5 / 8
    assert majority_share(questions("a", "x")) == 1


def graded(family: str, correct: str, cross_entropy: float = 1.0) -> list[Graded]:
    return [Graded(Question(family, "q", c), c, c == "1", cross_entropy) for c in correct]


def test_score_and_families() -> None:
    rows = graded("where", "1100", 2.0) + graded("color", "1111", 0.5) + graded("where", "00", 2.0)
    total, families = score(rows), by_family(rows)
    assert (total.accuracy, total.questions, total.cross_entropy) == (0.6, 10, 1.4)
    assert total.interval == wilson_interval(6, 10) and total.majority == 0.8
    assert list(families) == ["where", "color"]
    assert (families["where"].accuracy, families["where"].questions) == (pytest.approx(1 / 3), 6)
    assert (families["color"].accuracy, families["color"].cross_entropy) == (1.0, 0.5)


class Answerer:
    """Reads the answer off the image's first pixel, and is surprised by as many nats as the text has words."""

    def __init__(self) -> None:
        self.asked: list[list[str]] = []

    def answer(self, images: Tensor, texts: list[str]) -> list[str]:
        assert images.dtype == torch.uint8 and images.shape == (len(texts), 64, 64, 3)
        self.asked.append(texts)
        return [f"x{i}" for i in images[:, 0, 0, 0].tolist()]

    def log_likelihood(self, images: Tensor, texts: list[str], answers: list[str]) -> Tensor:
        assert len(images) == len(texts) == len(answers) and all(a.startswith("x") for a in answers)
        return -torch.tensor([float(len(t.split())) for t in texts])


def test_grade_asks_each_question_of_its_image_once() -> None:
    images = np.zeros((3, 64, 64, 3), np.uint8)
    images[:, 0, 0, 0] = (0, 1, 2)
    image_of = np.array([0, 0, 1, 2, 2])
    asked = tuple(Question("where", f"q {i}" + " a" * i, a) for i, a in enumerate(("x0", "x1", "x1", "x2", "x2 y2")))
    model, events = Answerer(), []
    rows = grade(model.answer, model.log_likelihood, VQASet(images, image_of, asked), 2, events.append)
    assert [len(texts) for texts in model.asked] == [2, 2, 1]
    assert [g.question for g in rows] == list(asked)
    assert [g.said for g in rows] == ["x0", "x0", "x1", "x2", "x2"]
    assert [g.correct for g in rows] == [True, False, True, True, False]  # half an answer is wrong
    assert [g.cross_entropy for g in rows] == [2, 3, 4, 5, 6]
    assert score(rows).cross_entropy == 4 and math.isclose(score(rows).accuracy, 0.6)
    assert [(e.done, e.total) for e in events] == [(2, 5), (4, 5), (5, 5)]
