"""Recipes of studies: variants compared over tasks or streams and seeds, as frozen dataclasses."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

from aegis_cli.recipes.keys import (
    FOLDER_NAME,
    MADE,
    NOT_EMPTY,
    NOT_NEGATIVE,
    POSITIVE,
    SEED,
    Check,
    choice,
    key,
    section,
)
from aegis_cli.recipes.policy import METHODS, TASK
from aegis_cli.recipes.streams import LEARNERS, ROBOT_LEARNERS

# what a study may draw anew with every seed -> the recipe section with that seed
PER_SEED = {"demos": "demos", "anchor": "anchor", "questions": "probe", "episodes": "rollout"}
_NO_ANCHOR = [name for name in PER_SEED if name != "anchor"]
_SOME = Check("at least one", bool)
# Streams may also have tasks that are not simulated, measured by their open-loop error.
_SIMULATED = Check(f"simulated ones: {TASK.expected}", TASK.accepts, TASK.choices)


@section
class Variant:
    """A method with some keys of its own, and the knobs that are tuned, if any.

    A knob is a key and the values it is chosen among; several knobs are tried in all combinations.
    """

    method: str = key(choice(*METHODS), doc="Method of the variant.")
    set: dict[str, Any] = key(
        factory=dict, doc="Keys of its own: dotted recipe key -> value, e.g. train.steps: 900."
    )
    tune: dict[str, Any] = key(
        factory=dict,
        doc="Its knobs: dotted recipe key -> the list of values that it is chosen among. All "
        "combinations of several knobs are tried.",
    )

    @property
    def knob(self) -> str | None:
        """The knobs' keys, separated by commas; None without a knob."""
        return ", ".join(self.tune) or None

    @property
    def values(self) -> list[Any]:
        """The knob's values: [None] without a knob, one tuple per combination of several knobs."""
        if len(self.tune) <= 1:
            return next(iter(self.tune.values()), [None])
        return list(itertools.product(*self.tune.values()))

    def chosen(self, value: Any) -> dict[str, Any]:
        """The keys and values that one of `values` stands for."""
        values: Sequence[Any] = value if len(self.tune) > 1 else [value]
        return dict(zip(self.tune, values, strict=False))  # without a knob, [None] has no key


@section
class PolicyVariant(Variant):
    """A method with some keys of its own, the knobs that are tuned, and what it is held against.

    A knob is a key and the values it is chosen among; several knobs are tried in all combinations.
    """

    against: str | None = key(
        NOT_EMPTY,
        default=None,
        doc="Variant that its success, return, drop and costs are compared with, e.g. a naive of "
        "the same learning rate and optimizer. Null: the variant named naive.",
    )

    def is_plain(self, method: str) -> bool:
        """Whether the variant is this method, without a merge after the training."""
        return self.method == method and "merge.method" not in self.set


@section
class Tuning:
    """How each variant's knob is chosen; needed where a variant has one.

    Among the values whose validation success is near the best of `naive`, it is the one with the
    highest validation accuracy. Where nothing can be rolled out, the open-loop error takes the
    place of success, on episodes that the tuning's seed holds out and none of the seeds that are
    compared.
    """

    task: str = key(
        TASK, default="reach", doc="Task that the knobs are chosen on, in a study of tasks."
    )
    seed: int = key(
        SEED, default=1000, doc="Seed of the trainings; it is none of the seeds that are compared."
    )
    questions: int = key(MADE, default=1400, doc="Number of questions on validation scenes.")
    episodes: int = key(
        MADE, default=100, doc="Number of validation rollouts, with the colours of training."
    )
    within: float = key(
        NOT_NEGATIVE,
        default=3.0,
        doc="How far from the best success a value may be, in percentage points, or from the least "
        "open-loop error in hundredths.",
    )
    runs: int | None = key(
        POSITIVE,
        default=None,
        doc="Number of values that every tuned variant must be given, so that none has more trials "
        "than another. Null lets them differ.",
    )


@section
class StudyRecipe:
    """Compares variants of methods over tasks and seeds, each at the best value of its knobs."""

    name: str = key(FOLDER_NAME, doc="Name of the study; it is written to runs/NAME.")
    seeds: tuple[int, ...] = key(SEED, doc="Seeds of the trainings that are compared.")
    variants: dict[str, PolicyVariant] = key(
        _SOME, doc="What is compared: a name for each variant."
    )
    tasks: tuple[str, ...] | None = key(
        TASK,
        default=None,
        later=True,
        doc="Tasks that variants are compared on. Null: the demonstrations that demos.path names, "
        "as of a robot that is not simulated here; tables and folders have their name.",
    )
    shared: dict[str, Any] = key(
        factory=dict, doc="Keys of a recipe of kind policy, for every training."
    )
    tuning: Tuning | None = None
    per_seed: tuple[str, ...] | None = key(
        choice(*PER_SEED),
        default=None,
        doc="What is drawn anew for every seed. What is not listed is the same for all seeds, so "
        "intervals say nothing about other draws of it.",
    )
    keep_runs: bool = key(
        default=False, doc="Keep the checkpoints of trainings that have been measured."
    )
    max_error_rise: float = key(
        NOT_NEGATIVE,
        default=0.02,
        later=True,
        shapes=False,
        doc="Where nothing can be rolled out: how far above naive's a variant's open-loop error "
        "may be to pass the bar, as a share of the actions' variance. One policy's error "
        "changed by as much on 16 episodes when its flow started from other noise.",
    )


@section
class StreamVariant(Variant):
    """A learner with some keys of its own, and the knobs that are tuned, if any."""

    method: str = key(choice(*LEARNERS), doc="Learner of the variant.")


@section
class Pairs:
    """Two streams of two tasks: the second should share experts in one, and not in the other."""

    a: str = key(
        NOT_EMPTY,
        doc="Stream whose second task should share: the same question about pictures that look "
        "different.",
    )
    b: str = key(
        NOT_EMPTY,
        doc="Stream whose second task must not share: the same pictures, and answers that "
        "contradict the first task's.",
    )


@section
class StreamTuning:
    """How each variant's knob is chosen; needed where a variant has one.

    Among the values whose validation Last is near its best, it is the one with the fewest final
    parameters.
    """

    stream: str = key(NOT_EMPTY, doc="Stream that the knobs are chosen on.")
    seed: int = key(
        SEED, default=1000, doc="Seed of the trainings; it is none of the seeds that are compared."
    )
    within: float = key(
        NOT_NEGATIVE,
        default=0.5,
        doc="How far from its best validation Last a value may be, in percentage points.",
    )


@section
class StreamStudyRecipe:
    """Compares learners over streams and seeds, each at the best value of its knobs."""

    name: str = key(FOLDER_NAME, doc="Name of the study; it is written to runs/NAME.")
    streams: tuple[str, ...] = key(NOT_EMPTY, doc="Streams that learners are compared on.")
    seeds: tuple[int, ...] = key(SEED, doc="Seeds of the trainings that are compared.")
    variants: dict[str, StreamVariant] = key(
        _SOME, doc="What is compared: a name for each variant."
    )
    pairs: Pairs | None = None
    shared: dict[str, Any] = key(
        factory=dict, doc="Keys of a recipe of kind stream, for every training."
    )
    tuning: StreamTuning | None = None
    keep_runs: bool = key(
        default=False, doc="Keep the run folders of streams that have been measured."
    )


@section
class RobotStreamVariant(Variant):
    """A learner with some keys of its own, and the knobs that are tuned, if any."""

    method: str = key(choice(*ROBOT_LEARNERS), doc="Learner of the variant.")


@section
class RobotStreamTuning:
    """How each variant's knob is chosen; needed where a variant has one.

    Among the values whose success on all tasks, on validation episodes after the last task, is near
    its best, it is the one with the highest VQA accuracy.
    """

    seed: int = key(
        SEED, default=1000, doc="Seed of the trainings; it is none of the seeds that are compared."
    )
    within: float = key(
        NOT_NEGATIVE,
        default=3.0,
        doc="How far from its best success a value may be, in percentage points.",
    )


@section
class RobotStreamStudyRecipe:
    """Compares learners over seeds on one stream of robot tasks, each at the best of its knobs."""

    name: str = key(FOLDER_NAME, doc="Name of the study; it is written to runs/NAME.")
    tasks: tuple[str, ...] = key(
        _SIMULATED, doc="Simulated tasks in the order in which they are learned."
    )
    seeds: tuple[int, ...] = key(SEED, doc="Seeds of the trainings that are compared.")
    variants: dict[str, RobotStreamVariant] = key(
        _SOME, doc="What is compared: a name for each variant."
    )
    shared: dict[str, Any] = key(
        factory=dict, doc="Keys of a recipe of kind robot-stream, for every training."
    )
    tuning: RobotStreamTuning | None = None
    per_seed: tuple[str, ...] | None = key(
        choice(*_NO_ANCHOR),
        default=None,
        doc="What is drawn anew for every seed. What is not listed is the same for all seeds, so "
        "intervals say nothing about other draws of it.",
    )
    keep_runs: bool = key(
        default=False, doc="Keep the run folders of streams that have been measured."
    )


AnyStudy = StudyRecipe | StreamStudyRecipe | RobotStreamStudyRecipe
