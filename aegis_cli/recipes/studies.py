"""Studies' recipes: variants compared over tasks or streams and seeds, as frozen dataclasses."""

from __future__ import annotations

from typing import Any

from aegis_cli.recipes.keys import (
    FOLDER_NAME,
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
from aegis_cli.recipes.streams import LEARNERS

_SOME = Check("at least one", bool)


@section
class Variant:
    """A method with some keys of its own, and at most one knob.

    The knob is a key and the values it is chosen among.
    """

    method: str = key(choice(*METHODS), doc="Method, or learner, of the variant.")
    set: dict[str, Any] = key(
        factory=dict, doc="Keys of its own: dotted recipe key -> value, e.g. lora.rank: 8."
    )
    tune: dict[str, Any] = key(
        factory=dict,
        doc="Its knob: one dotted recipe key -> the list of values that it is chosen among.",
    )

    @property
    def knob(self) -> str | None:
        return next(iter(self.tune), None)

    @property
    def values(self) -> list[Any]:
        """What the knob may be; [None] without one."""
        return next(iter(self.tune.values()), [None])


@section
class Tuning:
    """How each variant's knob is chosen.

    Among the values whose validation success is near the best of `naive`, it is the one with the
    highest validation accuracy.
    """

    task: str = key(TASK, "reach", doc="Task that the knobs are chosen on.")
    seed: int = key(
        SEED, 1000, doc="Seed of the trainings; it is none of the seeds that are compared."
    )
    questions: int = key(POSITIVE, 1400, doc="Number of questions on validation scenes.")
    episodes: int = key(
        POSITIVE, 100, doc="Number of validation rollouts, with the colours of training."
    )
    within: float = key(
        NOT_NEGATIVE, 3.0, doc="How far from the best success a value may be, in percentage points."
    )


@section
class StudyRecipe:
    """Compares variants of methods over tasks and seeds, each at its best value of one knob."""

    name: str = key(FOLDER_NAME, doc="Name of the study; it is written to runs/NAME.")
    tasks: tuple[str, ...] = key(TASK, doc="Tasks that variants are compared on.")
    seeds: tuple[int, ...] = key(SEED, doc="Seeds of the trainings that are compared.")
    variants: dict[str, Variant] = key(_SOME, doc="What is compared: a name for each variant.")
    shared: dict[str, Any] = key(
        factory=dict, doc="Keys of a recipe of kind policy, for every training."
    )
    tuning: Tuning | None = None
    keep_runs: bool = key(
        default=False, doc="Keep the checkpoints of trainings that have been measured."
    )


@section
class StreamVariant(Variant):
    """A learner with some keys of its own, and at most one knob."""

    method: str = key(choice(*LEARNERS), doc="Learner of the variant.")


@section
class Pairs:
    """Two streams of two tasks: in one the second should share the first's experts, in one not."""

    a: str = key(
        NOT_EMPTY,
        doc="Stream whose second task should share: the same question about pictures that look "
        "otherwise.",
    )
    b: str = key(
        NOT_EMPTY,
        doc="Stream whose second task must not share: the same pictures, and answers that "
        "contradict the first task's.",
    )


@section
class StreamTuning:
    """How each variant's knob is chosen.

    Among the values whose validation Last is near its best, it is the one with the fewest final
    parameters.
    """

    stream: str = key(NOT_EMPTY, doc="Stream that the knobs are chosen on.")
    seed: int = key(
        SEED, 1000, doc="Seed of the trainings; it is none of the seeds that are compared."
    )
    within: float = key(
        NOT_NEGATIVE,
        0.5,
        doc="How far from its best validation Last a value may be, in percentage points.",
    )


@section
class StreamStudyRecipe:
    """Compares learners over streams and seeds, each at its best value of one knob."""

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
