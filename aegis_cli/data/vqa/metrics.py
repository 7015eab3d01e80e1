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


def wilson_interval(successes: float, trials: float) -> tuple[float, float]:
    """95 % score interval of a proportion (Wilson 1927): sound near 0 and 1 too.

    Trials that are not independent count as fewer, so that neither number has to be whole.
    """
    share = successes / trials
    scale = 1 + Z_95**2 / trials
    middle = (share + Z_95**2 / (2 * trials)) / scale
    half = Z_95 * math.sqrt(share * (1 - share) / trials + Z_95**2 / (4 * trials**2)) / scale
    low, high = max(0.0, middle - half), min(1.0, middle + half)
    # Both sums end there but for rounding.
    return 0.0 if successes == 0 else low, 1.0 if successes == trials else high


def alike_interval(value: float, samples: int) -> Interval:
    """95 % interval of a mean in [0, 1] whose samples all have one value.

    Their spread is then 0 and says nothing. The share of samples with another value is at most
    Wilson's bound for a share that was never seen, and these lie as far away as there is room.
    """
    _, share = wilson_interval(0, samples)
    return value - share * value, value + share * (1 - value)


def bootstrap_interval(values: Sequence[float], image_of: Sequence[int], seed: int = 0) -> Interval:
    """95 % percentile interval of a mean over questions (bootstrap, Efron 1979).

    Whole images are drawn with replacement. Questions about one image share its difficulty, so that
    drawing questions would make the interval too narrow. Where all images have one mean, no draw
    has another: then it is the `alike_interval` of values in [0, 1].
    """
    _, image = np.unique(np.asarray(image_of), return_inverse=True)
    # A draw of images needs no more of them than their sums and numbers of questions.
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

    It is that of a ratio of cluster totals (Cochran 1977, Sampling Techniques, section 6.3): how
    far each cluster's sum is from what its size lets expect. One cluster has no error that could be
    told: infinity.
    """
    _, cluster = np.unique(np.asarray(cluster_of), return_inverse=True)
    sums, sizes = np.bincount(cluster, values), np.bincount(cluster)  # of each cluster
    count = len(sums)
    if count == 1:
        return math.inf, 1
    apart = sums - sizes * values.mean()
    of_total = math.sqrt(count / (count - 1) * float(np.square(apart).sum()))
    return of_total / len(values), count


def score(graded: Sequence[Graded]) -> Score:
    """Figures over some answered questions.

    The accuracy has Wilson's interval of as many questions as would tell as much if they were
    independent: those about one image share its difficulty.
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

    Questions about one image share its difficulty, so they count as fewer: as many as would tell as
    much if they were independent.
    """
    # Differences of pairs: how hard a question is cancels, which two accuracies apart would not.
    pairs = zip(before, after, strict=True)
    lost = np.array([float(b.correct) - float(a.correct) for b, a in pairs])
    return mean_loss_interval(lost, [g.image for g in after])


def mean_loss_interval(losses: np.ndarray, cluster_of: Sequence[int]) -> Interval:
    """95 % interval of a mean of losses, each in [-1, 1].

    The mean is what was lost less what was won. Each has Wilson's interval, and the ends of both
    are put together by squares (MOVER: Zou & Donner 2008, Statistics in Medicine 27(10),
    1693-1702), with the correlation of two shares of the same questions. So no change at all is no
    certainty. Losses of less than 1 vary less than the share that Wilson's interval takes their
    mean for, so that it is rather too wide for them.

    Args:
        losses: [N].
        cluster_of: N numbers; losses in one cluster are not independent.
    """
    count = len(losses) / _design_effect(losses, cluster_of)
    lost = float(losses.clip(min=0).mean())
    won = float((-losses).clip(min=0).mean())
    # Shares of as many questions as would tell as much if they were independent.
    least_lost, most_lost = wilson_interval(lost * count, count)
    least_won, most_won = wilson_interval(won * count, count)
    # A question that was lost cannot have been won: of two shares, one is small where the other is
    # large.
    alike = math.sqrt(lost * won / ((1 - lost) * (1 - won))) if lost < 1 and won < 1 else 0.0
    # The mean is least where little was lost and much was won, and the other way round.
    below = _together(lost - least_lost, most_won - won, alike)
    above = _together(most_lost - lost, won - least_won, alike)
    return lost - won - below, lost - won + above


def _together(a: float, b: float, alike: float) -> float:
    """How far the difference of two shares reaches that reach a and b, correlated by -`alike`."""
    return math.sqrt(a * a + b * b + 2 * alike * a * b)


def _design_effect(values: np.ndarray, cluster_of: Sequence[int]) -> float:
    """How many times larger clusters make the variance of a mean, at least 1 (Kish 1965).

    Where all values are the same, they do not tell, and it is 1.
    """
    if np.ptp(values) == 0:
        return 1.0
    error, clusters = clustered_error(values, cluster_of)
    if clusters == 1:  # all that is known is of one image: it counts as one question
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

    For scenes an answer counts if it equals the reference word for word.

    Args:
        answers: what is said to batches of images with questions, and log p(reference answer) of
            each in nats, as a backbone's own `answers` tells.
        on_graded: is given each batch's graded answers when they have come.
    """
    graded: list[Graded] = []
    on_event(Progress("probe", 0, len(questions.questions), "questions"))
    for said, likelihood in answers(_asked(questions, batch_size)):
        rows = slice(len(graded), len(graded) + len(said))
        # Answers come in the questions' order, and a batch of them at a time.
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
    """What was said to a question about an image of this number, graded."""
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
