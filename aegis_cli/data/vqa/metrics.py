"""Accuracy and cross-entropy of a backbone's answers, overall and per family."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.data.vqa.answers import soft_accuracy
from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.data.vqa.images import tensors
from aegis_cli.data.vqa.questions import Question, majority_share

Z_95 = 1.959964  # two-sided 95 % quantile of the normal distribution
RESAMPLES = 2000
Interval = tuple[float, float]


@dataclass(frozen=True)
class Graded:
    """One answered question.

    Attributes:
        correct: whether it is the reference answer.
        cross_entropy: -log p(reference answer), nats.
        image: the image's number in the set.
        soft: VQA's soft accuracy; None where the answer is computed and not what people said.
    """

    question: Question
    said: str
    correct: bool
    cross_entropy: float
    image: int = 0
    soft: float | None = None


@dataclass(frozen=True)
class Score:
    """Accuracy in [0, 1] with its 95 % interval, cross-entropy in nats per answer, and a baseline.

    The soft accuracy is None unless people answered all the questions.
    """

    accuracy: float
    interval: Interval
    cross_entropy: float
    questions: int
    majority: float
    soft_accuracy: float | None = None
    soft_interval: Interval | None = None


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """95 % score interval of a proportion (Wilson 1927): sound near 0 and 1 too."""
    share = successes / trials
    scale = 1 + Z_95**2 / trials
    middle = (share + Z_95**2 / (2 * trials)) / scale
    half = Z_95 * math.sqrt(share * (1 - share) / trials + Z_95**2 / (4 * trials**2)) / scale
    return max(0.0, middle - half), min(1.0, middle + half)


def alike_interval(value: float, samples: int, least: float = 0.0) -> Interval:
    """95 % interval of a mean in [least, 1] whose samples all have one value.

    Their spread is then 0 and says nothing. The share of samples with another value is at most
    Wilson's bound for a share that was never seen, and these lie as far away as there is room.
    """
    share = wilson_interval(0, samples)[1]
    return value - share * (value - least), value + share * (1 - value)


def bootstrap_interval(
    values: Sequence[float], image_of: Sequence[int], seed: int = 0, least: float = 0.0
) -> Interval:
    """95 % percentile interval of a mean over questions (bootstrap, Efron 1979).

    Whole images are drawn with replacement. Questions about one image share its difficulty, so that
    drawing questions would make the interval too narrow. Where all images have one mean, no draw
    has another: then it is the `alike_interval` of values in [least, 1].
    """
    _, image = np.unique(np.asarray(image_of), return_inverse=True)
    # A draw of images needs no more of them than their sums and numbers of questions.
    sums, counts = np.bincount(image, np.asarray(values, np.float64)), np.bincount(image)
    if np.ptp(sums / counts) == 0:
        return alike_interval(float(sums[0] / counts[0]), len(sums), least)
    rng = np.random.default_rng(seed)
    means = np.empty(RESAMPLES)
    for i in range(RESAMPLES):
        drawn = rng.integers(len(sums), size=len(sums))
        means[i] = sums[drawn].sum() / counts[drawn].sum()
    low, high = np.quantile(means, (0.025, 0.975))
    return float(low), float(high)


def score(graded: Sequence[Graded]) -> Score:
    """Figures over some answered questions: Wilson's interval for scenes, else the bootstrap's."""
    hits, images = [float(g.correct) for g in graded], [g.image for g in graded]
    soft = [g.soft for g in graded if g.soft is not None]
    correct = sum(g.correct for g in graded)
    by_people = len(soft) == len(graded)
    if by_people:
        interval = bootstrap_interval(hits, images)
    else:
        interval = wilson_interval(correct, len(graded))
    return Score(
        accuracy=correct / len(graded),
        interval=interval,
        cross_entropy=sum(g.cross_entropy for g in graded) / len(graded),
        questions=len(graded),
        majority=majority_share(g.question for g in graded),
        soft_accuracy=sum(soft) / len(soft) if by_people else None,
        soft_interval=bootstrap_interval(soft, images) if by_people else None,
    )


def drop_interval(before: Sequence[Graded], after: Sequence[Graded]) -> Interval:
    """95 % interval of the accuracy lost, from the differences of the same questions.

    It is the normal one for scenes, else the bootstrap's.
    """
    # Differences of pairs: how hard a question is cancels, which two accuracies apart would not.
    pairs = zip(before, after, strict=True)
    lost = np.array([float(b.correct) - float(a.correct) for b, a in pairs])
    if all(g.soft is not None for g in after):
        return bootstrap_interval(lost.tolist(), [g.image for g in after], least=-1.0)
    if np.ptp(lost) == 0:
        return alike_interval(float(lost[0]), len(lost), least=-1.0)
    mean, half = float(lost.mean()), Z_95 * float(lost.std()) / len(lost) ** 0.5
    return mean - half, mean + half


def by_family(graded: Sequence[Graded]) -> dict[str, Score]:
    """One score per family, in the order in which the families first occur."""
    families: dict[str, list[Graded]] = {}
    for g in graded:
        families.setdefault(g.question.family, []).append(g)
    return {family: score(rows) for family, rows in families.items()}


def grade(
    answer: Callable[[Tensor | list[Tensor], list[str]], list[str]],
    log_likelihood: Callable[[Tensor | list[Tensor], list[str], list[str]], Tensor],
    questions: VQASet,
    batch_size: int,
    on_event: OnEvent = ignore,
) -> list[Graded]:
    """Ask every question of a set, and grade the answers.

    For scenes an answer counts if it equals the reference word for word.
    """
    graded: list[Graded] = []
    for images, asked in questions.batches(batch_size):
        pictures, texts = tensors(images), [q.text for q in asked]
        said = answer(pictures, texts)
        surprise = (-log_likelihood(pictures, texts, [q.answer for q in asked])).tolist()
        numbers = questions.image_of[len(graded) : len(graded) + len(asked)].tolist()
        graded += [_graded(*row) for row in zip(asked, said, surprise, numbers, strict=True)]
        on_event(Progress("probe", len(graded), len(questions.questions), "questions"))
    return graded


def _graded(question: Question, said: str, cross_entropy: float, image: int) -> Graded:
    soft = soft_accuracy(said, question.answers) if question.answers else None
    return Graded(question, said, question.is_answered_by(said), cross_entropy, image, soft)


def prediction(graded: Graded, number: int) -> dict[str, Any]:
    """One line of `--predictions`; a question without a name goes by its number in the set."""
    asked = graded.question
    return {
        "id": number if asked.id is None else asked.id,
        "question": asked.text,
        "said": graded.said,
        "reference": asked.answer,
        "answers": list(asked.answers or (asked.answer,)),
        "correct": graded.correct,
        "soft_accuracy": graded.soft,
        "cross_entropy": graded.cross_entropy if math.isfinite(graded.cross_entropy) else None,
    }
