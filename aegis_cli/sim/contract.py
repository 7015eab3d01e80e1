"""The interface of every task, and how an episode's random numbers follow from a seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from aegis_cli.common.errors import AegisError

SUITE = "suite/"  # prefix of the names of dm_control suite tasks
METAWORLD = "metaworld/"  # prefix of MetaWorld's tasks
LIBERO = "libero/"  # prefix of LIBERO's tasks
TOP = "top"  # the camera of our own tasks, and our name for the suite's
# Streams keep the episodes of one seed apart: no evaluation scene ever appears in a demonstration.
DEMOS, EVALUATION, VALIDATION = 0, 1, 2


def episode_rng(seed: int, stream: int, i: int) -> np.random.Generator:
    """The random generator of episode `i`.

    It depends only on these three numbers, so episodes may be distributed over workers.
    """
    return np.random.default_rng(np.random.SeedSequence([seed, stream, i]))


@dataclass(frozen=True)
class TaskSpec:
    """The fixed facts of a task: P = len(proprio_names), A = len(action_names).

    Attributes:
        templates: instruction texts, each with one "{color}" if the task has coloured targets.
        measure: how an episode is judged. `success` is whether the coloured target was reached, or
            the benchmark's own verdict. `return` is the sum of its rewards, each at most 1; such a
            task has no colours, and its episodes neither succeed nor fail.
        camera: name of the default camera.
        said_hz: a rate that data sets of the task state instead of its own; None if there is none.
    """

    name: str
    action_names: tuple[str, ...]
    proprio_names: tuple[str, ...]
    max_steps: int
    control_hz: float
    templates: tuple[str, ...]
    measure: Literal["success", "return"] = "success"
    camera: str = TOP
    said_hz: float | None = None


@dataclass(frozen=True)
class Observation:
    """What a policy may see; only images and words tell where to go.

    Pictures are 64 pixels wide and high, those of LIBERO 256.

    Attributes:
        more: pictures of further requested cameras, in order.
    """

    image: np.ndarray  # [H, W, 3] uint8; in our own tasks, x points to the right and y up
    proprio: np.ndarray  # [P] float32; in our own tasks, only positions
    instruction: str
    more: tuple[np.ndarray, ...] = ()  # each [H, W, 3] uint8


@dataclass(frozen=True)
class Step:
    """Outcome of one control step; the episode is over when `done`.

    `observation` is None for a step without a look.

    `success` is None for a task measured by its return, `reward` for one measured by success.
    Without coloured targets `wrong_target` is None.
    """

    observation: Observation | None
    success: bool | None
    wrong_target: bool | None
    done: bool
    reward: float | None = None


class TaskEnv(Protocol):
    """One episode at a time of one task."""

    spec: TaskSpec
    target_color: str | None  # None without coloured targets

    def reset(self, rng: np.random.Generator, target_colors: Sequence[str]) -> Observation:
        """Begin an episode; a coloured target's colour is one of `target_colors`."""

    def step(self, action: np.ndarray, look: bool = True) -> Step:
        """Apply `action` [A], clipped to [-1, 1], for one control step.

        Args:
            look: whether to return an observation. Rendering a picture takes longer than a step.
        """

    def expert_action(self) -> np.ndarray:
        """The expert's action [A] float32 in this state; repeated calls return the same."""

    def distance(self) -> float | None:
        """Metres from the effector to the true target's centre; None without coloured targets."""

    def target_circle(self) -> tuple[float, float, float] | None:
        """Where the picture shows the true target: its centre (right, down) and radius.

        Both are fractions of the picture's side. None without coloured targets.
        """


def checked(action: np.ndarray, size: int) -> np.ndarray:
    """The action [size] clipped to [-1, 1].

    Raises:
        AegisError: it has another shape, or values that are not finite.
    """
    action = np.asarray(action, dtype=np.float64)
    if action.shape != (size,) or not np.isfinite(action).all():
        raise AegisError(
            f"action {action.tolist()}",
            f"{size} finite numbers",
            "use a checkpoint of an earlier, finite step",
        )
    return np.clip(action, -1.0, 1.0)
