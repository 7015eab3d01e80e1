"""Studies' recipes: variants compared over tasks or streams and seeds, as frozen dataclasses."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from aegis_cli.recipes.policy import (
    FOLDER_NAME,
    METHODS,
    NOT_EMPTY,
    NOT_NEGATIVE,
    POSITIVE,
    SEED,
    TASK,
    choice,
)
from aegis_cli.recipes.streams import LEARNERS
from aegis_cli.recipes.strict_yaml import Check, key

_SOME = Check("at least one", bool)


@dataclass(frozen=True)
class Variant:
    """A method with some keys of its own, and at most one knob: a key and the values it is chosen
    among.
    """

    method: str = key(choice(*METHODS))
    set: dict[str, Any] = field(default_factory=dict)  # dotted recipe key -> value
    tune: dict[str, Any] = field(default_factory=dict)  # one dotted recipe key -> list of values

    @property
    def knob(self) -> str | None:
        return next(iter(self.tune), None)

    @property
    def values(self) -> list[Any]:
        """What the knob may be; [None] without one."""
        return next(iter(self.tune.values()), [None])


@dataclass(frozen=True)
class Tuning:
    """How each variant's knob is chosen, by the rule of `studies/tuning.py`."""

    task: str = key(TASK, "reach")
    seed: int = key(SEED, 1000)  # of the training; never one of the study's seeds
    questions: int = key(POSITIVE, 1400)  # on validation scenes
    episodes: int = key(POSITIVE, 100)  # validation rollouts, seen colours
    within: float = key(NOT_NEGATIVE, 3.0)  # points of success


@dataclass(frozen=True)
class StudyRecipe:
    """What `aegis run` reads to compare variants over tasks and seeds; `studies.load` reads and
    checks it.
    """

    name: str = key(FOLDER_NAME)
    tasks: tuple[str, ...] = key(TASK)
    seeds: tuple[int, ...] = key(SEED)
    variants: dict[str, Variant] = key(_SOME)
    shared: dict[str, Any] = field(default_factory=dict)  # a recipe's keys, for every run
    tuning: Tuning | None = None
    keep_runs: bool = False  # the checkpoints of runs that have been measured


@dataclass(frozen=True)
class StreamVariant(Variant):
    """A learner with some keys of its own, and at most one knob."""

    method: str = key(choice(*LEARNERS))


@dataclass(frozen=True)
class Pairs:
    """Streams of two tasks, of which it is known whether the second should share what the first
    brought.
    """

    # It should: the same question about pictures that look otherwise.
    a: str = key(NOT_EMPTY)
    # It must not: the same pictures, and answers that contradict the first task's.
    b: str = key(NOT_EMPTY)


@dataclass(frozen=True)
class StreamTuning:
    """How each variant's knob is chosen, by the rule of `studies/tuning.py`."""

    stream: str = key(NOT_EMPTY)
    seed: int = key(SEED, 1000)  # of the training; never one of the study's seeds
    within: float = key(NOT_NEGATIVE, 0.5)  # points of validation Last


@dataclass(frozen=True)
class StreamStudyRecipe:
    """What `aegis run` reads to compare learners over streams and seeds; `studies.load` reads and
    checks it.
    """

    name: str = key(FOLDER_NAME)
    streams: tuple[str, ...] = key(NOT_EMPTY)
    seeds: tuple[int, ...] = key(SEED)
    variants: dict[str, StreamVariant] = key(_SOME)
    pairs: Pairs | None = None
    shared: dict[str, Any] = field(default_factory=dict)  # a stream recipe's keys, for every run
    tuning: StreamTuning | None = None
    keep_runs: bool = False  # the run folders of streams that have been measured
