"""What is measured of a stream of robot tasks: how each is done, and what the backbone knows."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

from aegis_cli.common.events import Event, OnEvent, ignore
from aegis_cli.continual.held_out import HeldOut
from aegis_cli.data.vqa import sets
from aegis_cli.data.vqa.metrics import score
from aegis_cli.models.acting import longest_s, play
from aegis_cli.models.asking import ask
from aegis_cli.sim.contract import EVALUATION, VALIDATION
from aegis_cli.training.validation_time import expected_s

if TYPE_CHECKING:
    from aegis_cli.continual.robots import RobotStreamRun

Questions = sets.Scenes | sets.Listed


class RobotEvaluator(ABC):
    """How tasks are done with the task told, and questions with no task active.

    The questions are the same every time, and so is what a task is tried on.

    Attributes:
        on_event: hears of its progress.
    """

    def __init__(self, run: RobotStreamRun, source: Questions, on_event: OnEvent = ignore) -> None:
        self._run, self.on_event = run, on_event
        count, check = run.recipe.probe.questions, run.model.backbone.check_text
        # settings are chosen by other questions than those that figures are of
        part = "validation" if run.recipe.rollout.split == "validation" else "probe"
        seed = run.recipe.probe.seed
        self._asked = source.choose(part, count, seed, [check], on_event)

    @property
    def hold_errors(self) -> Sequence[float | None]:
        """Of each task the error of holding the position; none where a success is measured."""
        return ()

    def intervals(self, done: int) -> list[list[float] | None]:
        """Of each error of the tasks 0 to `done` its interval, as it was measured last.

        A success has none.
        """
        return []

    def row(self, done: int) -> list[float]:
        """What was measured after tasks 0 to t = `done`, of these alone."""
        return [self.tried(i) for i in range(done + 1)]

    @abstractmethod
    def tried(self, task: int) -> float:
        """How the task of that number is done now."""

    def tried_s(self, task: int) -> float:
        """About how many seconds `tried` takes, by its first parts."""
        return expected_s(self._heard_by(partial(self.tried, task)))

    def vqa_s(self) -> float:
        """About how many seconds `vqa` takes."""
        return expected_s(self._heard_by(self.vqa))

    def _heard_by(self, work: Callable[[], object]) -> Callable[[OnEvent], None]:
        """Some of its work, of whose progress somebody else hears."""

        def heard(on_event: OnEvent) -> None:
            before, self.on_event = self.on_event, on_event
            try:
                work()
            finally:
                self.on_event = before

        return heard

    def vqa(self) -> list[float]:
        """Accuracy and cross-entropy of the backbone with no task active."""
        self._run.activate(None)
        model, batch_size = self._run.model.backbone.eval(), self._run.recipe.probe.batch_size
        found = score(ask(model, self._asked, batch_size, self.on_event))
        return [found.accuracy, found.cross_entropy]

    def _named(self, task: str) -> OnEvent:
        """Events of a rollout, with the task's name."""

        def passed_on(event: Event) -> None:
            self.on_event(dataclasses.replace(event, stage=f"{event.stage} {task}"))

        return passed_on


class ClosedLoopEvaluator(RobotEvaluator):
    """Lets policies act in simulated tasks."""

    def tried_s(self, task: int) -> float:
        """About how many seconds `tried` takes if no episode ends early."""
        acting, settings = self._run.acting(task), self._run.recipe.rollout
        return longest_s(acting, settings.episodes, settings.colors, self._split, settings.seed)

    @property
    def _split(self) -> int:
        named = {"evaluation": EVALUATION, "validation": VALIDATION}
        return named[self._run.recipe.rollout.split]

    def tried(self, task: int) -> float:
        """Share of successes of the task of that number, or of the highest return."""
        acting, settings = self._run.acting(task), self._run.recipe.rollout
        found = play(
            acting,
            settings.episodes,
            settings.colors,
            self._split,
            on_event=self._named(acting.task),
            seed=settings.seed,
        )
        # A task of dm_control's suite has no success, but a return.
        share = found.return_share if found.success is None else found.success
        assert share is not None
        return share


class HeldOutEvaluator(RobotEvaluator):
    """Lets policies predict at held-out frames of tasks that no simulator has."""

    def __init__(self, run: RobotStreamRun, source: Questions, on_event: OnEvent = ignore) -> None:
        super().__init__(run, source, on_event)
        most, train = run.recipe.rollout.frames, run.recipe.train
        self._frames = [
            HeldOut(task, shown, most, train.batch_size, train.chunk)
            for task, shown in zip(run.names, run.demos, strict=True)
        ]
        self._intervals: dict[int, list[float] | None] = {}

    @property
    def hold_errors(self) -> Sequence[float | None]:
        return [frames.hold_error for frames in self._frames]

    def tried(self, task: int) -> float:
        """The error of the actions that are predicted in the task of that number."""
        self._run.activate(task)
        policy, on_event = self._run.policies[task].eval(), self._named(self._run.names[task])
        error, self._intervals[task] = self._frames[task].error(policy, on_event)
        return error

    def intervals(self, done: int) -> list[list[float] | None]:
        return [self._intervals[task] for task in range(done + 1)]
