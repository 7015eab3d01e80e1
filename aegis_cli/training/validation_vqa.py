"""What the VLM still knows during training: validation questions beside the validation loss.

They serve to choose checkpoints and learning rates, so their images are in neither an anchor nor a
probe, and their figures are no result. Nothing is trained on them.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from aegis_cli.common.events import Event, OnEvent
from aegis_cli.common.ranks import Ranks
from aegis_cli.data.vqa import knowledge, sets
from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.data.vqa.gate import passes
from aegis_cli.data.vqa.metrics import Graded, drop_interval, score
from aegis_cli.models.asking import ask
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.recipes import Recipe

_BEFORE = "VQA before training"  # the stage's name
_PREFIX = "vqa_"  # of its figures in a metrics line
_FIGURES = ("accuracy", "cross_entropy", "drop_points", "drop_low", "drop_high")
ToldOfSet = dict[str, Any]  # floats; `drop_interval` holds two


@dataclass(frozen=True)
class ValidationQuestions:
    """The questions of each set that the recipe probes.

    Attributes:
        before: the initial backbone's answers to each set; empty until it was asked.
        seconds: how long these answers took.
    """

    asked: tuple[VQASet, ...]
    batch_size: int
    before: tuple[list[Graded], ...] = ()
    seconds: float = 0.0

    def asked_before(
        self, backbone: Backbone, ranks: Ranks, on_event: OnEvent
    ) -> ValidationQuestions:
        """The same, with the answers of a backbone before training."""
        started = time.perf_counter()
        before = self._answers(backbone, ranks, on_event, _BEFORE)
        taken = time.perf_counter() - started
        return dataclasses.replace(self, before=before, seconds=taken)

    def warn_of_little_knowledge(self, recipe: Recipe, on_event: OnEvent) -> None:
        """Warn of sets that the backbone could hardly answer at the start: nothing can be lost."""
        model, prompt = recipe.backbone, recipe.probe.ask
        for then in self.before:
            known = score(then)
            knowledge.warn_if_little(
                known.accuracy, known.majority, model, prompt, _BEFORE, on_event
            )

    def figures(self, backbone: Backbone, ranks: Ranks, on_event: OnEvent) -> dict[str, float]:
        """The figures of the current backbone for a metrics line.

        Accuracies are in [0, 1], cross-entropies in nats per answer, and the drop and the ends of
        its 95 % interval in percentage points. The first set's figures have plain names, those of
        later sets end in the set's number. A frozen backbone is not asked again.
        """
        found: dict[str, float] = {}
        learns = any(p.requires_grad for p in backbone.parameters())
        now = self._answers(backbone, ranks, on_event, "VQA") if learns else self.before
        for number, (then, after) in enumerate(zip(self.before, now, strict=True), start=1):
            old, new = score(then), score(after)
            low, high = drop_interval(then, after)
            own = {
                "accuracy": new.accuracy,
                "cross_entropy": new.cross_entropy,
                "drop_points": 100 * (old.accuracy - new.accuracy),
                "drop_low": 100 * low,
                "drop_high": 100 * high,
            }
            found |= {_named(name, number): value for name, value in own.items()}
        return found

    def _answers(
        self, backbone: Backbone, ranks: Ranks, on_event: OnEvent, stage: str
    ) -> tuple[list[Graded], ...]:
        def named(event: Event) -> None:
            on_event(dataclasses.replace(event, stage=stage))

        return tuple(
            ask(backbone, questions, self.batch_size, named, ranks) for questions in self.asked
        )


def _named(figure: str, number: int) -> str:
    """The name in a metrics line of a figure of set `number`, counted from 1."""
    return f"{_PREFIX}{figure}" if number == 1 else f"{_PREFIX}{figure}_{number}"


def of_line(recipe: Recipe, line: Mapping[str, Any]) -> dict[str, ToldOfSet]:
    """The figures of each set in a metrics line, by the set's name in the recipe.

    They are `accuracy`, `cross_entropy`, `drop_points` and `drop_interval`, in the units of
    `ValidationQuestions.figures`. A set without figures in the line is left out.
    """
    found: dict[str, ToldOfSet] = {}
    for number, name in enumerate(recipe.probe.sets, start=1):
        told = {figure: line.get(_named(figure, number)) for figure in _FIGURES}
        if None in told.values():
            continue
        ends = [told.pop("drop_low"), told.pop("drop_high")]
        found[name] = {**told, "drop_interval": ends}
    return found


def past_limit(recipe: Recipe, asked: Mapping[str, ToldOfSet]) -> dict[str, ToldOfSet]:
    """The sets in the result of `of_line` whose drop exceeds what the recipe's gate allows."""
    limit, gate = recipe.probe.max_drop, recipe.probe.gate
    if limit is None:
        return {}
    found = {}
    for name, told in asked.items():
        if not passes(told["drop_points"], told["drop_interval"], limit, gate):
            found[name] = told
    return found


def is_lost(recipe: Recipe, told: ToldOfSet) -> bool:
    """Whether a set's drop as measured exceeds the limit, and not just its interval."""
    limit = recipe.probe.max_drop
    return limit is not None and not passes(told["drop_points"], None, limit)


def of_past_limit(recipe: Recipe, step: int, past: Mapping[str, ToldOfSet]) -> str:
    """A sentence on the set that is furthest past the recipe's limit.

    Args:
        past: what `past_limit` returned, of at least one set.
    """
    name, told = max(past.items(), key=lambda item: item[1]["drop_points"])
    low, high = told["drop_interval"]
    drop, limit = told["drop_points"], f"{recipe.probe.max_drop:g}"
    where = f"on validation questions of '{name}'"
    if is_lost(recipe, told):
        return (
            f"after step {step} {drop:.2f} points of VQA are lost ({low:.2f} to {high:.2f}) "
            f"{where}, where probe.max_drop allows {limit}"
        )
    return (
        f"after step {step} there are too few answers to tell whether more than {limit} points of "
        f"VQA are lost (probe.max_drop): the drop is {drop:.2f} {where}, with a 95 % interval of "
        f"{low:.2f} to {high:.2f}, whose upper end counts (probe.gate: {recipe.probe.gate}); raise "
        "probe.while_training"
    )


def chosen(recipe: Recipe, backbone: Backbone, on_event: OnEvent) -> ValidationQuestions | None:
    """The questions that a recipe's training asks; None if it asks none.

    Raises:
        AegisError: a set cannot be read, or the backbone cannot be asked a question.
    """
    probe, count = recipe.probe, recipe.probe.while_training
    if count is None:
        return None
    checks = [backbone.check_text]
    asked = []
    for one in probe.of_each_set():
        source = sets.read(one.only_set, one.skip_bad, on_event, one.ask)
        asked.append(source.choose("validation", count, one.seed, checks, on_event))
    return ValidationQuestions(tuple(asked), probe.batch_size)
