"""Paired differences between runs: of the same questions, episodes or recorded frames.

What is hard for one run is hard for another, which cancels in a difference of pairs. So its
interval is usually narrower than those of the two figures suggest. It is an interval over questions
or episodes, of one training each: it does not tell how far another seed would be away.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

from aegis_cli.common.estimates import t_quantile
from aegis_cli.evaluation.bootstrap import Units
from aegis_cli.evaluation.results import PlayedResult, Result
from aegis_cli.studies.metrics import Column

_ROUNDED = 1e-4  # relative difference of one figure as measured on two machines, at most


@dataclass(frozen=True)
class Difference:
    """A run's figure minus the reference's, with its 95 % interval; None from one episode."""

    mean: float
    interval: tuple[float, float] | None


@dataclass(frozen=True)
class PairedRun:
    """A run's differences from the reference; None where the two have no pairs.

    Points are percentage points. The differences of VQA and successes have the interval of
    `mean_loss_interval`, in which the questions about an image count as fewer, and those of
    open-loop errors Student's t over episodes.
    """

    run: str
    method: str
    vqa_points: Annotated[Difference | None, Column("VQA (points)", 2, signed=True)]
    success_seen_points: Annotated[
        Difference | None, Column("Success seen (points)", 1, signed=True)
    ]
    success_held_out_points: Annotated[
        Difference | None, Column("Success held-out (points)", 1, signed=True)
    ]
    open_loop_error: Annotated[Difference | None, Column("Open-loop error", 3, signed=True)]


class Measured(NamedTuple):
    """The results of a run that are compared.

    Attributes:
        asked: what identifies the questions of a probe, and the probe.
        played: its rollouts by their colours.
        evaluated: what identifies the frames of an open-loop evaluation, and the evaluation.
    """

    run: str
    method: str
    asked: tuple[Any, Result] | None
    played: Mapping[str | None, PlayedResult]
    evaluated: tuple[Any, Result] | None


def between(reference: Measured, other: Measured) -> PairedRun:
    """The differences of a run from the reference."""
    return PairedRun(
        run=other.run,
        method=other.method,
        vqa_points=_of_shares(_answers(reference, other)),
        success_seen_points=_of_shares(_episodes(reference, other, "seen")),
        success_held_out_points=_of_shares(_episodes(reference, other, "held-out")),
        open_loop_error=_of_errors(_errors(reference, other)),
    )


def episodes_of(played: PlayedResult) -> tuple[Any, ...]:
    """What identifies the episodes of a rollout of these colours."""
    return played.figures.get("task"), played.figures["episodes"], played.played.seed


# --- the pairs ------------------------------------------------------------------------------------


def _answers(reference: Measured, other: Measured) -> Units | None:
    """How many more answers about each image were correct than the reference's."""
    if reference.asked is None or other.asked is None or reference.asked[0] != other.asked[0]:
        return None
    theirs, own = reference.asked[1].figures, other.asked[1].figures
    then, now = (_per_image(one, "correct_per_image") for one in (theirs, own))
    if then is not None and now is not None:
        return now.minus(then)
    # Earlier versions kept only what was lost since before the training.
    then, now = (_per_image(one, "lost_per_image") for one in (theirs, own))
    if then is None or now is None or not _same_before(theirs, own):
        return None
    return then.minus(now)


def _per_image(figures: Mapping[str, Any], name: str) -> Units | None:
    """A probe's answers by image; None if it did not keep them."""
    values, counts, images = (figures.get(key) for key in (name, "questions_per_image", "images"))
    if not values or not counts or len(values) != len(counts):
        return None
    if sum(counts) != figures.get("questions"):
        return None
    import numpy as np

    names = None if images is None else tuple(images)
    return Units(np.array(values, np.float64), np.array(counts, np.float64), names=names)


def _same_before(theirs: Mapping[str, Any], own: Mapping[str, Any]) -> bool:
    """Whether two probes have compared with the same answers, as of one backbone.

    Losses from other answers than these tell nothing about the answers after training.
    """
    if own.get("baseline_accuracy") != theirs.get("baseline_accuracy"):
        return False
    # Two models that answer equally many questions correctly differ in their cross-entropies.
    return _alike(own.get("baseline_cross_entropy"), theirs.get("baseline_cross_entropy"))


def _episodes(reference: Measured, other: Measured, colors: str) -> Units | None:
    """The success in each episode minus the reference's."""
    theirs, own = _rollout(reference, colors), _rollout(other, colors)
    if theirs is None or own is None or episodes_of(theirs) != episodes_of(own):
        return None
    then, now = _successes(theirs), _successes(own)
    return None if then is None or now is None else now.minus(then)


def _rollout(of: Measured, colors: str) -> PlayedResult | None:
    """A task without colours has a single rollout, which takes the place of the seen ones."""
    return of.played.get(colors, of.played.get(None) if colors == "seen" else None)


def _successes(played: PlayedResult) -> Units | None:
    outcomes = played.figures.get("outcomes")
    if not outcomes or len(outcomes) != played.figures["episodes"]:
        return None
    import numpy as np

    return Units(np.array([float(one) for one in outcomes]), np.ones(len(outcomes)))


def _errors(reference: Measured, other: Measured) -> Units | None:
    """The open-loop error in each episode minus the reference's."""
    if reference.evaluated is None or other.evaluated is None:
        return None
    (frames, theirs), (own_frames, own) = reference.evaluated, other.evaluated
    then, now = _by_episode(theirs), _by_episode(own)
    if frames != own_frames or then is None or now is None:
        return None
    # Errors are relative to the variance in training. On the same frames, holding the position has
    # the same error only if that is the same, as it is with the same demonstrations.
    held = (theirs.figures.get("hold_error"), own.figures.get("hold_error"))
    return now.minus(then) if _alike(*held) or held == (None, None) else None


def _alike(one: float | None, other: float | None) -> bool:
    """Whether two figures are equal but for rounding on two machines."""
    return one is not None and other is not None and math.isclose(one, other, rel_tol=_ROUNDED)


def _by_episode(evaluated: Result) -> Units | None:
    """The sum of the errors over the steps of each episode; None from an earlier version."""
    each = evaluated.figures.get("episode_errors")
    if not each or any(one["relative_error"] is None for one in each):
        return None
    import numpy as np

    steps = np.array([one["steps"] for one in each], np.float64)
    errors = np.array([one["relative_error"] for one in each], np.float64)
    names = tuple(str(one["episode"]) for one in each)
    return Units(steps * errors, steps, reach=None, names=names)


# --- their intervals ------------------------------------------------------------------------------


def _of_shares(gained: Units | None) -> Difference | None:
    """The difference of two shares of correct answers or successes, in points."""
    if gained is None:
        return None
    import numpy as np

    from aegis_cli.data.vqa.metrics import mean_loss_interval  # loads torch

    # An image's difference is known, but not in which of its questions. It is taken to be in as few
    # as possible; the interval's width follows from the images' sums alone.
    counts = gained.counts.astype(int)
    image_of = np.repeat(np.arange(len(counts)), counts)
    place = np.arange(len(image_of)) - np.repeat(counts.cumsum() - counts, counts)
    more = gained.values[image_of]
    each = np.sign(more) * (place < np.abs(more))
    low, high = mean_loss_interval(each, image_of.tolist())
    return Difference(100 * float(each.mean()), (100 * low, 100 * high))


def _of_errors(more: Units | None) -> Difference | None:
    """The difference of two mean errors over steps, by Student's t over episodes."""
    if more is None:
        return None
    from aegis_cli.data.vqa.metrics import ratio_error

    mean, episodes = float(more.values.sum() / more.counts.sum()), len(more.values)
    if episodes == 1:
        return Difference(mean, None)
    half = t_quantile(episodes - 1) * ratio_error(more.values, more.counts, mean)
    return Difference(mean, (mean - half, mean + half))
