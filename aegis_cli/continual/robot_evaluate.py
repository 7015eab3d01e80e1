"""What a stream's policy can do and what its backbone knows: closed loops with the task told,
questions with none active.
"""

from __future__ import annotations

import dataclasses

from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.continual.robots import RobotRun
from aegis_cli.data.vqa import sets
from aegis_cli.data.vqa.metrics import score
from aegis_cli.evaluation import probe, rollout
from aegis_cli.recipes import RobotStreamRecipe
from aegis_cli.sim.contract import EVALUATION, VALIDATION


def questions(recipe: RobotStreamRecipe, on_event: OnEvent = ignore) -> sets.Scenes | sets.Listed:
    """The recipe's question set.

    Raises:
        AegisError: it cannot be read.
    """
    return sets.read(recipe.probe.vqa, recipe.probe.skip_bad, on_event)


class Evaluator:
    """Of one run; the questions and the episodes are the same every time."""

    def __init__(
        self, run: RobotRun, source: sets.Scenes | sets.Listed, on_event: OnEvent = ignore
    ) -> None:
        self._run, self._on_event = run, on_event
        count, check = run.recipe.probe.questions, run.model.backbone.check_text
        # settings are chosen by questions, too, that no figure is of
        part = "validation" if run.recipe.rollout.split == "validation" else "probe"
        self._asked = source.choose(part, count, probe.PROBE_SEED, [check], on_event)

    def row(self, done: int) -> list[float]:
        """S[t, :] after tasks 0 to t = `done`, of these alone."""
        return [self.success(i) for i in range(done + 1)]

    def success(self, task: int) -> float:
        """Share of successes of the task of that number, or of the highest return."""
        run, settings = self._run, self._run.recipe.rollout
        run.activate(task)
        name, policy = run.names[task], run.policies[task].eval()
        split = {"evaluation": EVALUATION, "validation": VALIDATION}[settings.split]
        found = rollout.play(
            policy,
            name,
            settings.episodes,
            settings.colors,
            settings.replan,
            split,
            on_event=self._named(name),
        )
        share = found.return_share if found.success is None else found.success
        assert share is not None
        return share

    def vqa(self) -> list[float]:
        """Accuracy and cross-entropy of the backbone with no task active."""
        self._run.activate(None)
        model = self._run.model.backbone.eval()
        found = score(
            probe.ask(model, self._asked, self._run.recipe.probe.batch_size, self._on_event)
        )
        return [found.accuracy, found.cross_entropy]

    def _named(self, task: str) -> OnEvent:
        return lambda event: self._on_event(
            dataclasses.replace(event, stage=f"{event.stage} {task}")
        )
