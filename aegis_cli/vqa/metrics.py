"""Accuracy and cross-entropy of a backbone's answers, overall and a family."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from aegis_cli.events import OnEvent, Progress, ignore
from aegis_cli.vqa.dataset import VQASet
from aegis_cli.vqa.questions import Question, majority_share

Z_95 = 1.959964  # two-sided 95 % quantile of the normal distribution


@dataclass(frozen=True)
class Graded:
    """One answered question: was it right, and -log p(reference answer) in nats."""

    question: Question
    said: str
    correct: bool
    cross_entropy: float


@dataclass(frozen=True)
class Score:
    """Accuracy [0, 1] with its 95 % interval, mean cross-entropy (nats an answer), and the weak baseline."""

    accuracy: float
    interval: tuple[float, float]
    cross_entropy: float
    questions: int
    majority: float


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """95 % score interval of a proportion (Wilson 1927): sound near 0 and 1, unlike the normal one."""
    share = successes / trials
    scale = 1 + Z_95**2 / trials
    middle = (share + Z_95**2 / (2 * trials)) / scale
    half = Z_95 * math.sqrt(share * (1 - share) / trials + Z_95**2 / (4 * trials**2)) / scale
    return max(0.0, middle - half), min(1.0, middle + half)


def score(graded: Sequence[Graded]) -> Score:
    """Figures over some answered questions."""
    correct = sum(g.correct for g in graded)
    return Score(
        accuracy=correct / len(graded),
        interval=wilson_interval(correct, len(graded)),
        cross_entropy=sum(g.cross_entropy for g in graded) / len(graded),
        questions=len(graded),
        majority=majority_share(g.question for g in graded),
    )


def by_family(graded: Sequence[Graded]) -> dict[str, Score]:
    """One score a family, in the order in which the families first occur."""
    families: dict[str, list[Graded]] = {}
    for g in graded:
        families.setdefault(g.question.family, []).append(g)
    return {family: score(rows) for family, rows in families.items()}


def grade(
    answer: Callable[[Tensor, list[str]], list[str]],
    log_likelihood: Callable[[Tensor, list[str], list[str]], Tensor],
    questions: VQASet,
    batch_size: int,
    on_event: OnEvent = ignore,
) -> list[Graded]:
    """Ask every question of a set; an answer counts if it equals the reference word for word."""
    graded: list[Graded] = []
    for images, asked in questions.batches(batch_size):
        pictures, texts = torch.from_numpy(images), [q.text for q in asked]
        said = answer(pictures, texts)
        surprise = (-log_likelihood(pictures, texts, [q.answer for q in asked])).tolist()
        graded += [Graded(q, s, s == q.answer, c) for q, s, c in zip(asked, said, surprise, strict=True)]
        on_event(Progress("probe", len(graded), len(questions.questions), "questions"))
    return graded
