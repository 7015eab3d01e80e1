"""Accuracy and cross-entropy of a backbone's answers, overall and per family."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.data.batch import Asked
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
        correct: whether the answer is the reference.
        cross_entropy: -log p(reference answer), nats.
        image: the image's number in the set.
        soft: VQA's soft accuracy; None if the reference is computed and not given by people.
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


def wilson_interval(successes: float, trials: float) -> tuple[float, float]:
    """95 % score interval of a proportion (Wilson 1927): valid near 0 and 1 too.

    Dependent trials count as fewer, so neither number has to be an integer.
    """
    share = successes / trials
    scale = 1 + Z_95**2 / trials
    middle = (share + Z_95**2 / (2 * trials)) / scale
    half = Z_95 * math.sqrt(share * (1 - share) / trials + Z_95**2 / (4 * trials**2)) / scale
    low, high = max(0.0, middle - half), min(1.0, middle + half)
    # Without rounding errors, both would be exactly these.
    return 0.0 if successes == 0 else low, 1.0 if successes == trials else high


def alike_interval(value: float, samples: int) -> Interval:
    """95 % interval of a mean in [0, 1] whose samples all have the same value.

    Their spread of 0 is not informative. The share of other values is at most Wilson's bound for a
    share that was never observed, and those values are taken to be as far away as possible.
    """
    _, share = wilson_interval(0, samples)
    return value - share * value, value + share * (1 - value)


def bootstrap_interval(values: Sequence[float], image_of: Sequence[int], seed: int = 0) -> Interval:
    """95 % percentile interval of a mean over questions (bootstrap, Efron 1979).

    Whole images are drawn with replacement. Questions about one image share its difficulty, so
    drawing questions would make the interval too narrow. If all images have the same mean, so do
    all draws: then the `alike_interval` of values in [0, 1] is used.
    """
    _, image = np.unique(np.asarray(image_of), return_inverse=True)
    # A draw of images only needs their sums and numbers of questions.
    sums, counts = np.bincount(image, np.asarray(values, np.float64)), np.bincount(image)
    if np.ptp(sums / counts) == 0:
        return alike_interval(float(sums[0] / counts[0]), len(sums))
    rng = np.random.default_rng(seed)
    means = np.empty(RESAMPLES)
    for i in range(RESAMPLES):
        drawn = rng.integers(len(sums), size=len(sums))
        means[i] = sums[drawn].sum() / counts[drawn].sum()
    low, high = np.quantile(means, (0.025, 0.975))
    return float(low), float(high)


def clustered_error(values: np.ndarray, cluster_of: Sequence[int]) -> tuple[float, int]:
    """Standard error of a mean whose samples come in clusters, and the number of clusters.

    It is that of a ratio of cluster totals (Cochran 1977, Sampling Techniques, section 6.3), from
    the difference of each cluster's sum to what its size predicts. For one cluster the error cannot
    be estimated: it is infinity.
    """
    _, cluster = np.unique(np.asarray(cluster_of), return_inverse=True)
    sums, sizes = np.bincount(cluster, values), np.bincount(cluster)  # of each cluster
    return ratio_error(sums, sizes, float(values.mean())), len(sums)


def ratio_error(sums: np.ndarray, sizes: np.ndarray, mean: float) -> float:
    """The standard error of `clustered_error`, from each cluster's sum and size."""
    count = len(sums)
    if count == 1:
        return math.inf
    apart = sums - sizes * mean
    of_total = math.sqrt(count / (count - 1) * float(np.square(apart).sum()))
    return of_total / float(sizes.sum())


def score(graded: Sequence[Graded]) -> Score:
    """The figures of some answered questions.

    The accuracy has Wilson's interval for the effective number of independent questions: those
    about one image share its difficulty.
    """
    hits, images = np.array([float(g.correct) for g in graded]), [g.image for g in graded]
    soft = [g.soft for g in graded if g.soft is not None]
    by_people = len(soft) == len(graded)
    correct, effect = float(hits.sum()), _design_effect(hits, images)
    return Score(
        accuracy=correct / len(graded),
        interval=wilson_interval(correct / effect, len(graded) / effect),
        cross_entropy=sum(g.cross_entropy for g in graded) / len(graded),
        questions=len(graded),
        majority=majority_share(g.question for g in graded),
        soft_accuracy=sum(soft) / len(soft) if by_people else None,
        soft_interval=bootstrap_interval(soft, images) if by_people else None,
    )


def drop_interval(before: Sequence[Graded], after: Sequence[Graded]) -> Interval:
    """95 % interval of the accuracy lost, from the differences of the same questions.

    Questions about one image share its difficulty, so they count as fewer: as the effective number
    of independent questions.
    """
    # Paired differences: a question's difficulty cancels, unlike in two separate accuracies.
    pairs = zip(before, after, strict=True)
    lost = np.array([float(b.correct) - float(a.correct) for b, a in pairs])
    return mean_loss_interval(lost, [g.image for g in after])


def mean_loss_interval(losses: np.ndarray, cluster_of: Sequence[int]) -> Interval:
    """95 % interval of a mean of losses, each in [-1, 1].

    The mean is the share lost minus the share won. Each has Wilson's interval, and their distances
    are combined as squares (MOVER: Zou & Donner 2008, Statistics in Medicine 27(10), 1693-1702),
    with the correlation of two shares of the same questions. So the interval has a width even if
    nothing changed. Losses between 0 and 1 vary less than the share that Wilson's interval assumes,
    so for them it is rather too wide.

    Args:
        losses: [N].
        cluster_of: N numbers; losses in one cluster are not independent.
    """
    count = len(losses) / _design_effect(losses, cluster_of)
    lost = float(losses.clip(min=0).mean())
    won = float((-losses).clip(min=0).mean())
    # Shares of the effective number of independent questions.
    least_lost, most_lost = wilson_interval(lost * count, count)
    least_won, most_won = wilson_interval(won * count, count)
    # A question that was lost cannot have been won, so the two shares are negatively correlated.
    alike = math.sqrt(lost * won / ((1 - lost) * (1 - won))) if lost < 1 and won < 1 else 0.0
    # The mean is lowest if little was lost and much was won, and vice versa.
    below = _together(lost - least_lost, most_won - won, alike)
    above = _together(most_lost - lost, won - least_won, alike)
    return lost - won - below, lost - won + above


def _together(a: float, b: float, alike: float) -> float:
    """The reach of the difference of two shares that reach a and b, with correlation -`alike`."""
    return math.sqrt(a * a + b * b + 2 * alike * a * b)


def _design_effect(values: np.ndarray, cluster_of: Sequence[int]) -> float:
    """The factor by which clusters increase the variance of a mean, at least 1 (Kish 1965).

    If all values are equal, it cannot be estimated, and is 1.
    """
    if np.ptp(values) == 0:
        return 1.0
    error, clusters = clustered_error(values, cluster_of)
    if clusters == 1:  # all questions are about one image: they count as one question
        return float(len(values))
    return max(1.0, error**2 * len(values) / float(values.var(ddof=1)))


def by_family(graded: Sequence[Graded]) -> dict[str, Score]:
    """One score per family, in the order in which the families first occur."""
    families: dict[str, list[Graded]] = {}
    for g in graded:
        families.setdefault(g.question.family, []).append(g)
    return {family: score(rows) for family, rows in families.items()}


def grade(
    answers: Callable[[Iterator[Asked]], Iterator[tuple[list[str], Tensor]]],
    questions: VQASet,
    batch_size: int,
    on_event: OnEvent = ignore,
    on_graded: Callable[[Sequence[Graded]], None] | None = None,
) -> list[Graded]:
    """Ask every question of a set, and grade the answers.

    For scenes an answer is correct if it equals the reference word for word.

    Args:
        answers: a function from batches of images with questions to the given answers and log
            p(reference answer) of each in nats, such as a backbone's own `answers`.
        on_graded: called with each batch's graded answers.
    """
    graded: list[Graded] = []
    on_event(Progress("probe", 0, len(questions.questions), "questions"))
    for said, likelihood in answers(_asked(questions, batch_size)):
        rows = slice(len(graded), len(graded) + len(said))
        # Answers arrive in the order of the questions, one batch at a time.
        surprise, numbers = (-likelihood).tolist(), questions.image_of[rows].tolist()
        for row in zip(questions.questions[rows], said, surprise, numbers, strict=True):
            graded.append(graded_answer(*row))
        if on_graded is not None:
            on_graded(graded[rows])
        on_event(Progress("probe", len(graded), len(questions.questions), "questions"))
    return graded


def _asked(questions: VQASet, batch_size: int) -> Iterator[Asked]:
    for images, asked in questions.batches(batch_size):
        yield tensors(images), [q.text for q in asked], [q.answer for q in asked]


def graded_answer(question: Question, said: str, cross_entropy: float, image: int) -> Graded:
    """Grade the answer to a question about the image of this number."""
    soft = soft_accuracy(said, question.answers) if question.answers else None
    return Graded(question, said, question.is_answered_by(said), cross_entropy, image, soft)


def prediction(graded: Graded, number: int) -> dict[str, Any]:
    """One line of `--predictions`; a question without an id is named by its number in the set."""
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
