"""The evaluation of a stream of robot tasks: each task's score, and questions to the backbone."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

from aegis_cli.common.events import Event, OnEvent, ignore
from aegis_cli.continual.held_out import HeldOut
from aegis_cli.data.vqa import sets
from aegis_cli.data.vqa.knowledge import warn_if_little
from aegis_cli.data.vqa.metrics import score
from aegis_cli.data.vqa.questions import majority_share
from aegis_cli.models.acting import longest_s, play
from aegis_cli.models.asking import ask
from aegis_cli.sim.contract import EVALUATION, VALIDATION
from aegis_cli.training.validation_time import expected_s

if TYPE_CHECKING:
    from aegis_cli.continual.robots import RobotStreamRun

Questions = sets.Scenes | sets.Listed


class RobotEvaluator(ABC):
    """Scores of tasks with the task told, and of questions with no task active.

    The questions are the same every time, and so are the episodes or frames of each task.

    Attributes:
        on_event: receives the progress events.
    """

    def __init__(self, run: RobotStreamRun, source: Questions, on_event: OnEvent = ignore) -> None:
        self._run, self.on_event = run, on_event
        count, check = run.recipe.probe.questions, run.model.backbone.check_text
        # Settings are chosen on different questions from those that are reported.
        part = "validation" if run.recipe.rollout.split == "validation" else "probe"
        seed = run.recipe.probe.seed
        self._asked = source.choose(part, count, seed, [check], on_event)

    @property
    def hold_errors(self) -> Sequence[float | None]:
        """Each task's error of holding the position; empty if success is measured."""
        return ()

    def intervals(self, done: int) -> list[list[float] | None]:
        """The interval of each error of tasks 0 to `done`, from the last measurement.

        It is empty if success is measured.
        """
        return []

    def row(self, done: int) -> list[float]:
        """The scores of tasks 0 to t = `done`, measured after learning them."""
        return [self.tried(i) for i in range(done + 1)]

    @abstractmethod
    def tried(self, task: int) -> float:
        """The present score of task `task`."""

    def tried_s(self, task: int) -> float:
        """Estimated seconds of `tried`, from its first parts."""
        return expected_s(self._heard_by(partial(self.tried, task)))

    def vqa_s(self) -> float:
        """Estimated seconds of `vqa`."""
        return expected_s(self._heard_by(self.vqa))

    def _heard_by(self, work: Callable[[], object]) -> Callable[[OnEvent], None]:
        """`work` as a function that sends its progress events to another receiver."""

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

    def warn_of_little_knowledge(self, accuracy: float) -> None:
        """Warn if the backbone, of this accuracy before the first task, can hardly lose any."""
        recipe, majority = self._run.recipe, majority_share(self._asked.questions)
        asked = recipe.probe.ask
        warn_if_little(accuracy, majority, recipe.backbone, asked, "train", self.on_event)

    def _named(self, task: str) -> OnEvent:
        """A receiver that adds the task's name to events and passes them on."""

        def passed_on(event: Event) -> None:
            self.on_event(dataclasses.replace(event, stage=f"{event.stage} {task}"))

        return passed_on


class ClosedLoopEvaluator(RobotEvaluator):
    """Lets policies act in simulated tasks."""

    def tried_s(self, task: int) -> float:
        """Estimated seconds of `tried` if no episode ends early."""
        acting, settings = self._run.acting(task), self._run.recipe.rollout
        return longest_s(acting, settings.episodes, settings.colors, self._split, settings.seed)

    @property
    def _split(self) -> int:
        named = {"evaluation": EVALUATION, "validation": VALIDATION}
        return named[self._run.recipe.rollout.split]

    def tried(self, task: int) -> float:
        """Success rate of task `task`, or its return as a share of the highest return."""
        acting, settings = self._run.acting(task), self._run.recipe.rollout
        found = play(
            acting,
            settings.episodes,
            settings.colors,
            self._split,
            on_event=self._named(acting.task),
            seed=settings.seed,
        )
        # A task of dm_control's suite has a return instead of a success.
        share = found.return_share if found.success is None else found.success
        assert share is not None
        return share


class HeldOutEvaluator(RobotEvaluator):
    """Lets policies predict at held-out frames of tasks without a simulator."""

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
        """The error of the actions predicted in task `task`."""
        self._run.activate(task)
        policy, on_event = self._run.policies[task].eval(), self._named(self._run.names[task])
        error, self._intervals[task] = self._frames[task].error(policy, on_event)
        return error

    def intervals(self, done: int) -> list[list[float] | None]:
        return [self._intervals[task] for task in range(done + 1)]
