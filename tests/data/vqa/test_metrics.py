"""Grading: intervals against hand-computed values, and the scores of a known answerer."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor

from aegis_cli.data.batch import Asked
from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.data.vqa.metrics import (
    Graded,
    bootstrap_interval,
    by_family,
    clustered_error,
    drop_interval,
    grade,
    prediction,
    score,
    wilson_interval,
)
from aegis_cli.data.vqa.questions import Question, majority_share


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
        assert wilson_interval(0, n)[0] == 0 and wilson_interval(n, n)[1] == 1
    widths = [np.diff(wilson_interval(n // 2, n))[0] for n in (10, 100, 1000)]
    assert widths[0] > 2 * widths[1] > 4 * widths[2]


def questions(family: str, answers: str) -> list[Question]:
    return [Question(family, f"{family} {i}", a) for i, a in enumerate(answers)]


def test_majority_share_is_taken_in_each_family() -> None:
    """The baseline gives a family's most common answer: 3 of 4 and 2 of 4 are right.

    No answer is the most common over all.
    """
    assert majority_share(questions("a", "xxxy") + questions("b", "yyxz")) == 5 / 8
    assert majority_share(questions("a", "x")) == 1


def graded(family: str, correct: str, cross_entropy: float = 1.0) -> list[Graded]:
    """Answers to one question about each of this many images."""
    return [
        Graded(Question(family, "q", c), c, c == "1", cross_entropy, image)
        for image, c in enumerate(correct)
    ]


@pytest.mark.parametrize("copies", [1, 2, 5])
def test_an_accuracys_interval_counts_an_image_once_whose_questions_end_alike(copies: int) -> None:
    rng = np.random.default_rng(copies)
    ends = "".join(rng.choice(["0", "1", "1"], 200))
    rows = [row for row in graded("where", ends) for _ in range(copies)]
    effect = (200 * copies - 1) / 199  # that many copies, up to the degrees of freedom
    hits = ends.count("1") * copies
    wanted = wilson_interval(hits / effect, 200 * copies / effect)
    assert score(rows).interval == pytest.approx(wanted, abs=1e-9)
    low, high = wilson_interval(ends.count("1"), 200)
    assert score(rows).interval == pytest.approx((low, high), abs=1e-3)


def test_score_and_families() -> None:
    rows = graded("where", "1100", 2.0) + graded("color", "1111", 0.5) + graded("where", "00", 2.0)
    total, families = score(rows), by_family(rows)
    assert (total.accuracy, total.questions, total.cross_entropy) == (0.6, 10, 1.4)
    assert total.interval == wilson_interval(6, 10) and total.majority == 0.8
    assert list(families) == ["where", "color"]
    assert (families["where"].accuracy, families["where"].questions) == (pytest.approx(1 / 3), 6)
    assert (families["color"].accuracy, families["color"].cross_entropy) == (1.0, 0.5)


class Answerer:
    """Reads the answer from the image's first pixel.

    Its surprise in nats is the number of words in the text.
    """

    def __init__(self) -> None:
        self.asked: list[list[str]] = []

    def answer(self, images: Tensor, texts: list[str]) -> list[str]:
        assert images.dtype == torch.uint8 and images.shape == (len(texts), 64, 64, 3)
        self.asked.append(texts)
        return [f"x{i}" for i in images[:, 0, 0, 0].tolist()]

    def answers(self, batches: Iterator[Asked]) -> Iterator[tuple[list[str], Tensor]]:
        for images, texts, answers in batches:
            yield self.answer(images, texts), self.log_likelihood(images, texts, answers)

    def log_likelihood(self, images: Tensor, texts: list[str], answers: list[str]) -> Tensor:
        assert len(images) == len(texts) == len(answers) and all(a.startswith("x") for a in answers)
        return -torch.tensor([float(len(t.split())) for t in texts])


def test_grade_asks_each_question_of_its_image_once() -> None:
    images = np.zeros((3, 64, 64, 3), np.uint8)
    images[:, 0, 0, 0] = (0, 1, 2)
    image_of = np.array([0, 0, 1, 2, 2])
    asked = tuple(
        Question("where", f"q {i}" + " a" * i, a)
        for i, a in enumerate(("x0", "x1", "x1", "x2", "x2 y2"))
    )
    model, events = Answerer(), []
    rows = grade(model.answers, VQASet(images, image_of, asked), 2, events.append)
    assert [len(texts) for texts in model.asked] == [2, 2, 1]
    assert [g.question for g in rows] == list(asked)
    assert [g.said for g in rows] == ["x0", "x0", "x1", "x2", "x2"]
    assert [g.correct for g in rows] == [True, False, True, True, False]  # half an answer is wrong
    assert [g.cross_entropy for g in rows] == [2, 3, 4, 5, 6]
    assert score(rows).cross_entropy == 4 and math.isclose(score(rows).accuracy, 0.6)
    assert [(e.done, e.total) for e in events] == [(0, 5), (2, 5), (4, 5), (5, 5)]


# --- answers by people ---------------------------------------------------------------------------


def test_the_bootstraps_width_is_that_of_the_normal_interval() -> None:
    """With one question per image and many images, the percentiles are at 1.96 deviations."""
    values = np.random.default_rng(0).random(4000).tolist()
    low, high = bootstrap_interval(values, range(4000))
    half = 1.96 * np.std(values) / math.sqrt(4000)
    assert (low, high) == pytest.approx(
        (np.mean(values) - half, np.mean(values) + half), abs=0.1 * half
    )
    assert bootstrap_interval(values, range(4000)) == (low, high)  # the same draws each time
    assert bootstrap_interval(values, range(4000), seed=1) != (low, high)


@pytest.mark.parametrize("copies", [2, 5])
def test_asking_an_image_again_adds_no_certainty(copies: int) -> None:
    hits = (np.random.default_rng(1).random(60) < 0.7).astype(float)
    alone = bootstrap_interval(hits.tolist(), range(60))
    assert (
        bootstrap_interval(
            np.repeat(hits, copies).tolist(), np.repeat(np.arange(60), copies).tolist()
        )
        == alone
    )
    as_if_unrelated = bootstrap_interval(np.repeat(hits, copies).tolist(), range(60 * copies))
    assert np.diff(as_if_unrelated) < 0.8 * np.diff(alone)


def test_images_of_many_questions_weigh_more() -> None:
    """Nine questions about one image are always right, one each about nine other images is not."""
    values, image_of = [1.0] * 9 + [0.0] * 9, [0] * 9 + list(range(1, 10))
    low, high = bootstrap_interval(values, image_of)
    assert low == 0 and 0.6 < high < 0.9  # 0 without the image; with it three or four times


def by_people(hits: str, image_of: range | list[int], said: str = "red") -> list[Graded]:
    question = Question("other", "q", "red", ("red", "red", "blue"), "id 1")
    return [
        Graded(question, said, c == "1", 1.0, image, 0.5 * (c == "1"))
        for c, image in zip(hits, image_of, strict=True)
    ]


def test_a_score_of_peoples_answers() -> None:
    rows = by_people("1101", [0, 0, 1, 1])
    total = score(rows)
    assert (total.accuracy, total.soft_accuracy) == (0.75, 0.375)
    assert total.interval == wilson_interval(3, 4)  # as unlike as questions about different images
    alike = score(by_people("1100", [0, 0, 1, 1]))
    assert alike.interval == pytest.approx(wilson_interval(2 / 3, 4 / 3))
    assert total.soft_interval == (0.25, 0.5)
    computed = score(graded("color", "1101"))
    assert (
        computed.soft_accuracy is None
        and computed.soft_interval is None
        and computed.interval == wilson_interval(3, 4)
    )


def test_the_drop_of_peoples_answers_is_paired_by_question_and_drawn_by_image() -> None:
    image_of = [i // 2 for i in range(40)]
    after, before = by_people("10" * 20, image_of), by_people("11" * 20, image_of)
    # Each image loses one of its two questions: they count as independent.
    share, bound = wilson_interval(20, 40), wilson_interval(0, 40)[1]
    low, high = drop_interval(before, after)
    assert (0.5 - low) ** 2 == pytest.approx((0.5 - share[0]) ** 2 + bound**2)
    assert high == pytest.approx(share[1])
    assert drop_interval(after, after) == pytest.approx((-bound, bound))
    # Every second image loses both of its questions, which count as one.
    spread = drop_interval(before, by_people("1100" * 10, image_of))
    assert spread[0] < low and spread[1] > high
    effect = 39 / 19
    assert spread[1] == pytest.approx(wilson_interval(20 / effect, 40 / effect)[1])


@pytest.mark.parametrize("count", [1, 20, 400, 2000])
def test_an_answer_more_that_is_lost_never_makes_the_drop_smaller(count: int) -> None:
    before = graded("color", "1" * count)
    ends = []
    for lost in range(min(count, 60) + 1):
        ends.append(drop_interval(before, graded("color", "0" * lost + "1" * (count - lost))))
        assert ends[-1][1] >= wilson_interval(lost, count)[1] - 1e-12
    assert all(high < higher for (_, high), (_, higher) in pairwise(ends))
    assert all(low <= lower for (low, _), (lower, _) in pairwise(ends))


def test_the_drops_interval_holds_the_truth_as_often_as_it_says() -> None:
    """A thousand sets of 2,000 questions, of which 0.3 % are lost."""
    drawn = np.random.default_rng(0).binomial(2000, 0.003, size=1000)
    before = graded("color", "1" * 2000)
    high = {}
    for lost in np.unique(drawn).tolist():
        high[lost] = drop_interval(before, graded("color", "0" * lost + "1" * (2000 - lost)))[1]
    missed = sum(high[lost] < 0.003 for lost in drawn.tolist())
    assert missed < 40  # nominally 25


def test_the_error_of_clusters_is_that_of_their_means_where_they_are_of_one_size() -> None:
    values = np.random.default_rng(0).normal(size=(12, 5)) + np.arange(12)[:, None]
    error, clusters = clustered_error(values.ravel(), np.repeat(np.arange(12), 5).tolist())
    means = values.mean(1)
    assert clusters == 12 and error == pytest.approx(means.std(ddof=1) / 12**0.5)
    assert clustered_error(values.ravel(), [7] * 60) == (math.inf, 1)


def test_the_majority_is_of_answers_as_they_are_compared() -> None:
    answers = ("Two", "2", "the two", "three")
    assert majority_share([Question("number", "q", a, (a,)) for a in answers]) == 0.75
    assert majority_share(questions("number", answers)) == 0.25


@pytest.mark.parametrize(
    ("said", "right"), [("Two.", True), ("2", True), ("the two", True), ("twos", False)]
)
def test_people_are_not_held_to_the_letter(said: str, right: bool) -> None:
    assert Question("number", "q", "two", ("two", "2")).is_answered_by(said) is right
    assert not Question("number", "q", "two").is_answered_by(said)


def test_a_line_of_predictions() -> None:
    line = prediction(by_people("1", [3])[0], 7)
    assert line == {
        "id": "id 1",
        "question": "q",
        "said": "red",
        "reference": "red",
        "answers": ["red", "red", "blue"],
        "correct": True,
        "soft_accuracy": 0.5,
        "cross_entropy": 1.0,
    }
    scene = prediction(graded("where", "0", math.inf)[0], 7)
    assert (scene["id"], scene["answers"], scene["soft_accuracy"], scene["cross_entropy"]) == (
        7,
        ["0"],
        None,
        None,
    )


@pytest.mark.parametrize("images", [1, 8, 500])
def test_answers_that_are_all_alike_are_no_certainty(images: int) -> None:
    """The bootstrap of a single value is a point, and so is the normal interval.

    Wilson's interval is not, and is wide for one image.
    """
    right, wrong = by_people("1" * images, range(images)), by_people("0" * images, range(images))
    assert score(right).interval == pytest.approx(wilson_interval(images, images))
    assert score(wrong).interval == pytest.approx(wilson_interval(0, images))
    bound = wilson_interval(0, images)[1]
    for before, after in (
        (right, right),
        (graded("color", "1" * images), graded("color", "1" * images)),
    ):
        assert drop_interval(before, after) == pytest.approx((-bound, bound))
    for before, after in (
        (right, wrong),
        (graded("color", "1" * images), graded("color", "0" * images)),
    ):
        assert drop_interval(before, after) == pytest.approx((1 - 2**0.5 * bound, 1))
