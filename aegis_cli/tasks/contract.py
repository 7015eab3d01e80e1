"""What every task promises, and how an episode's random numbers follow from a seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

# Streams keep the episodes of one seed apart: no evaluation scene is ever a demonstration's.
DEMOS, EVALUATION, VALIDATION = 0, 1, 2


def episode_rng(seed: int, stream: int, i: int) -> np.random.Generator:
    """Episode `i`'s generator: depends on these three numbers only, so workers may share the episodes out."""
    return np.random.default_rng(np.random.SeedSequence([seed, stream, i]))


@dataclass(frozen=True)
class TaskSpec:
    """The fixed facts of a task: P = len(proprio_names), A = len(action_names)."""

    name: str
    action_names: tuple[str, ...]
    proprio_names: tuple[str, ...]
    max_steps: int
    control_hz: float
    templates: tuple[str, ...]  # each holds one "{color}"


@dataclass(frozen=True)
class Observation:
    """What a policy may see; nothing but the image and the words tells where to go."""

    image: np.ndarray  # [64, 64, 3] uint8, x to the right, y up
    proprio: np.ndarray  # [P] float32, positions only
    instruction: str


@dataclass(frozen=True)
class Step:
    """Outcome of one control step; the episode is over when `done`."""

    observation: Observation
    success: bool
    wrong_target: bool
    done: bool


class TaskEnv(Protocol):
    """One episode at a time of one task."""

    spec: TaskSpec
    target_color: str

    def reset(self, rng: np.random.Generator, target_colors: Sequence[str]) -> Observation:
        """Begin an episode at rest; the target's colour is one of `target_colors`, distractors have any other."""

    def step(self, action: np.ndarray) -> Step:
        """Apply `action` [A], clipped to [-1, 1], for one control step."""

    def expert_action(self) -> np.ndarray:
        """The scripted expert's action [A] float32 here: a pure function of the effector and its target."""

    def distance(self) -> float:
        """Metres from the effector to the centre of the true target."""
