"""What the JSON files beside a run must hold, for code that reads them back.

Optional keys were not written by an older version. Keys that are not named here are never read.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError

Number = Annotated[float, Field(allow_inf_nan=False)]  # an integer of 400 digits is infinite
Small = Annotated[int, Field(gt=-(2**31), lt=2**31)]  # so that a damaged file fills no memory
Interval = tuple[Number, Number] | None


@dataclass(frozen=True)
class Family:
    """A family of questions in a probe."""

    accuracy: Number
    questions: int
    majority: Number
    interval: Interval = None
    baseline_accuracy: Number | None = None


@dataclass(frozen=True)
class Layer:
    """A layer's drift."""

    layer: str
    w2: Number
    baseline_w2: Number | None = None


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

    accuracy: Number
    questions: int = 0
    interval: Interval = None
    cross_entropy: Number | None = None
    majority: Number | None = None
    baseline_accuracy: Number | None = None
    baseline_cross_entropy: Number | None = None
    drop_points: Number | None = None
    drop_interval: Interval = None
    families: dict[str, Family] | None = None
    layers: list[Layer] | None = None
    passed: bool | None = None
    soft_accuracy: Number | None = None
    soft_interval: Interval = None
    baseline_soft_accuracy: Number | None = None
    skipped: int = 0
    w2_between: str | None = None
    correct_per_image: list[Small] | None = None
    lost_per_image: list[Small] | None = None
    questions_per_image: list[Annotated[Small, Field(ge=1)]] | None = None
    images: list[str] | None = None
    wrong: list[WrongAnswer] | None = None
    settings: dict[str, Any] | None = None
    step: int | None = None


@dataclass(frozen=True)
class PartFigures:
    """Some of the episodes of a rollout, such as those of one task of a set."""

    success: Number | None = None
    interval: Interval = None
    episodes: int = 0


@dataclass(frozen=True)
class RolloutSettings:
    """The settings of `aegis rollout` that tell rollouts apart."""

    seed: int | None = None
    replan: int | None = None
    ensemble: Number | None = None
    delay: int | None = None
    guided: bool | None = None


@dataclass(frozen=True)
class RolloutFigures:
    """A rollout."""

    episodes: int
    task: str | None = None
    colors: str | None = None
    success: Number | None = None
    interval: Interval = None
    outcomes: Annotated[str, Field(pattern="^[01]*$")] | None = None
    wrong_target: Number | None = None
    final_distance_m: Number | None = None
    suites: dict[str, PartFigures] | None = None
    tasks: dict[str, PartFigures] | None = None
    target_colors: dict[str, PartFigures] | None = None
    instructions: dict[str, PartFigures] | None = None
    mean_return: Number | None = None
    return_interval: Interval = None
    return_share: Number | None = None
    action_change: Number | None = None
    episodes_per_s: Number | None = None
    video: str | None = None
    settings: RolloutSettings | None = None
    step: int | None = None


@dataclass(frozen=True)
class InstructionFigures:
    """One instruction of an open-loop evaluation."""

    instruction: str
    episodes: int
    frames: int
    relative_error: Number | None = None
    relative_interval: Interval = None
    hold_error: Number | None = None


@dataclass(frozen=True)
class EpisodeFigures:
    """One episode of an open-loop evaluation."""

    episode: int
    frames: int
    steps: Annotated[Small, Field(ge=1)]
    relative_error: Number | None = None
    hold_error: Number | None = None


@dataclass(frozen=True)
class OpenLoopFigures:
    """An open-loop evaluation."""

    data: str
    split: str
    episodes: list[int]
    trained_on: list[int]
    frames: int
    relative_error: Number | None = None
    relative_interval: Interval = None
    hold_error: Number | None = None
    instructions: list[InstructionFigures] | None = None
    episode_errors: list[EpisodeFigures] | None = None
    chunk: int | None = None
    fps: Number | None = None
    seed: int | None = None
    settings: dict[str, Any] | None = None
    step: int | None = None


@dataclass(frozen=True)
class TrainFigures:
    """The final figures of a training by `aegis run`."""

    method: str | None = None
    steps: int | None = None
    loss: Number | None = None
    validation_loss: Number | None = None
    energy_shed_mean: Number | None = None
    step_s: Number | None = None
    cameras: list[str] | None = None
    out: str | None = None
    validation_vqa: dict[str, dict[str, Number | list[Number]]] | None = None
    validation_rollout: dict[str, Number | Interval] | None = None
    validation_actions: dict[str, Number | Interval] | None = None


@dataclass(frozen=True)
class MergeFigures:
    """How `aegis run` merged the model that it trained."""

    method: str
    strength: Number
    damping: Number
    base: str
    kept: Number
    validation_loss: Number | None = None


Plain = dict[str, str | int | Number | bool | None]  # facts about a machine


def read(path: Path, kind: Any) -> dict[str, Any]:
    """The JSON object in a file, unchanged.

    Args:
        kind: one of this module's types.

    Raises:
        AegisError: a file that cannot be read, or a value of another type.
    """
    raw = files.load_json(path)
    try:
        # As JSON: a strict check then accepts a list for a tuple, which JSON does not have.
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
