"""How long a validation takes, estimated in a dry run from its first passes."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from functools import partial

from aegis_cli.common.events import Event, OnEvent, Progress
from aegis_cli.common.ranks import ALONE, Ranks
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.policy import Policy
from aegis_cli.training import train
from aegis_cli.training.assemble import TrainingRun
from aegis_cli.training.validation_actions import ValidationActions
from aegis_cli.training.validation_vqa import ValidationQuestions

_STAGE = "dry run (validation)"


class _Enough(Exception):
    """Raised once two parts of the work are done.

    Attributes:
        seconds: the estimate for all of it.
    """

    def __init__(self, seconds: float) -> None:
        super().__init__(seconds)
        self.seconds = seconds


def expected_s(work: Callable[[OnEvent], object]) -> float:
    """About how many seconds some work takes, from the second part whose progress it reports.

    The first part includes one-time work. After the second, an exception raised in the event
    handler ends the work.
    """
    told: list[tuple[int, float]] = []  # (parts done, time)

    def heard(event: Event) -> None:
        if not isinstance(event, Progress) or event.done == 0:
            return
        told.append((event.done, time.perf_counter()))
        if len(told) == 2:
            (before, then), (done, now) = told
            raise _Enough((now - then) / (done - before) * event.total)

    started = time.perf_counter()
    try:
        work(heard)
    except _Enough as end:
        return end.seconds
    return time.perf_counter() - started


def measured(run: TrainingRun, on_event: OnEvent) -> dict[str, float]:
    """About how many seconds each part of a validation takes: the loss and what is asked for.

    With several processes the first one asks, acts and predicts; questions are divided among all
    that have whole weights.
    """
    masters = run.masters
    parts = {"loss": (masters.rounded, partial(_loss_s, run))}
    # A frozen backbone is not asked again.
    if run.questions is not None and any(p.requires_grad for p in run.policy.backbone.parameters()):
        asking = partial(_questions_s, run.questions, run.shown.backbone)
        parts["questions"] = masters.as_written, partial(run.by_whole, asking)
    if run.episodes is not None:
        acting = partial(run.by_whole, run.episodes.longest_s)
        parts["episodes"] = masters.as_written, acting
    if run.actions is not None:
        predicting = partial(_actions_s, run.actions, run.shown)
        parts["actions"] = masters.as_written, partial(run.by_whole, predicting)
    found: dict[str, float] = {}
    run.policy.eval()
    run.shown.eval()
    on_event(Progress(_STAGE, 0, len(parts), "parts"))
    for name, (seen, measure) in parts.items():
        with seen():
            found[name] = measure()
        on_event(Progress(_STAGE, len(found), len(parts), "parts"))
    return found


def _loss_s(run: TrainingRun) -> float:
    given = run.policy, run.demos, run.recipe.train, train.validation_noise(run.recipe.seed)
    return expected_s(partial(train.validation_loss, *given, run.ranks))


def _questions_s(questions: ValidationQuestions, backbone: Backbone, ranks: Ranks) -> float:
    def asking() -> float:
        seconds = 0.0
        for one in questions.asked:
            alone = dataclasses.replace(questions, asked=(one,))
            seconds += expected_s(partial(alone.asked_before, backbone, ALONE))
        return seconds

    return ranks.by_first(asking) / ranks.count


def _actions_s(actions: ValidationActions, policy: Policy, ranks: Ranks) -> float:
    return ranks.by_first(lambda: expected_s(partial(actions.figures, policy, ALONE)))
