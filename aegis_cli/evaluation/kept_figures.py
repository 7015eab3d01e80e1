"""What the JSON files beside a run must hold, for those who read them back.

Keys that are missing were not written by an older version, and keys that are not named here are
read by nobody.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError

Interval = tuple[float, float] | None


@dataclass(frozen=True)
class Family:
    """A family of questions in a probe."""

    accuracy: float
    questions: int
    majority: float
    interval: Interval = None
    baseline_accuracy: float | None = None


@dataclass(frozen=True)
class Layer:
    """A layer's drift."""

    layer: str
    w2: float


@dataclass(frozen=True)
class WrongAnswer:
    """A wrong answer with its image."""

    family: str
    question: str
    said: str
    reference: str
    png: str


@dataclass(frozen=True)
class ProbeFigures:
    """A probe."""

    accuracy: float
    questions: int = 0
    interval: Interval = None
    cross_entropy: float | None = None
    majority: float | None = None
    baseline_accuracy: float | None = None
    baseline_cross_entropy: float | None = None
    drop_points: float | None = None
    drop_interval: Interval = None
    families: dict[str, Family] | None = None
    layers: list[Layer] | None = None
    passed: bool | None = None
    soft_accuracy: float | None = None
    soft_interval: Interval = None
    baseline_soft_accuracy: float | None = None
    skipped: int = 0
    w2_between: str | None = None
    wrong: list[WrongAnswer] | None = None
    settings: dict[str, Any] | None = None
    step: int | None = None


@dataclass(frozen=True)
class TaskFigures:
    """One task of a set in a rollout."""

    success: float | None = None
    interval: Interval = None
    episodes: int = 0


@dataclass(frozen=True)
class RolloutFigures:
    """A rollout."""

    episodes: int
    task: str | None = None
    colors: str | None = None
    success: float | None = None
    interval: Interval = None
    outcomes: str | None = None
    wrong_target: float | None = None
    final_distance_m: float | None = None
    tasks: dict[str, TaskFigures] | None = None
    mean_return: float | None = None
    return_interval: Interval = None
    return_share: float | None = None
    episodes_per_s: float | None = None
    video: str | None = None
    settings: dict[str, Any] | None = None
    step: int | None = None


@dataclass(frozen=True)
class TrainFigures:
    """What a training of `aegis run` ended with."""

    method: str | None = None
    steps: int | None = None
    loss: float | None = None
    validation_loss: float | None = None
    energy_shed_mean: float | None = None
    leak: float | None = None
    step_s: float | None = None
    cameras: list[str] | None = None
    out: str | None = None


Plain = dict[str, str | int | float | bool | None]  # of a machine


def read(path: Path, kind: Any) -> dict[str, Any]:
    """The JSON object of a file, as it lies there.

    Args:
        kind: one of this module's.

    Raises:
        AegisError: a file that cannot be read, or something in it of another type.
    """
    raw = files.load_json(path)
    try:
        _adapter(kind).validate_json(files.canonical(raw), strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "all of it"
        raise _damaged(path, f"{where}: {first['msg']}, not {first['input']!r:.40}") from None
    except ValueError as error:
        raise _damaged(path, str(error)) from None
    found: dict[str, Any] = raw
    return found


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def _damaged(path: Path, why: str) -> AegisError:
    return AegisError(
        f"'{path}' is damaged: {why}",
        "the figures as Aegis wrote them",
        "bring back a copy of it, or delete it and measure again",
    )
