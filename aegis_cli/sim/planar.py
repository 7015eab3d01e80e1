"""One episode of a planar task: scene layout, control steps, and when it ends.

A subclass provides the effector.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar

import numpy as np

from aegis_cli.common.errors import AegisError
from aegis_cli.common.palette import COLORS
from aegis_cli.sim.contract import Observation, Step, TaskSpec, checked
from aegis_cli.sim.scene import RADIUS_M, SLOTS, Look, Stage, lay_out

SUBSTEPS = 5  # physics steps of 20 ms in a control step
CONTROL_HZ = 10.0
HOLD_STEPS = 3  # control steps of rest on a disc that count as choosing it
_APART_M = 2 * RADIUS_M + 0.015  # minimum distance between disc centres
_CLEAR_M = 0.09  # minimum distance from the effector's start to any disc's centre

Sampler = Callable[[np.random.Generator], np.ndarray]


def place_discs(
    rng: np.random.Generator, count: int, start: np.ndarray, sample: Sampler
) -> np.ndarray:
    """Centres [count, 2] from `sample`, apart from each other and from `start` [2]; metres."""
    while True:  # a layout that leaves no room for the rest is discarded completely, so this ends
        centers: list[np.ndarray] = []
        for _ in range(50):
            center = sample(rng)
            clear = np.linalg.norm(center - start) > _CLEAR_M
            if clear and all(np.linalg.norm(center - other) > _APART_M for other in centers):
                centers.append(center)
            if len(centers) == count:
                return rng.permutation(np.array(centers))


class PlanarTask(ABC):
    """A `contract.TaskEnv` whose effector moves in the plane; disc 0 is the true target."""

    spec: ClassVar[TaskSpec]
    step_m: ClassVar[float]  # displacement of a full action in one control step
    slow_m: ClassVar[float] = 0.05  # the expert slows down within this distance

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self.physics = stage.physics.copy(share_model=True)
        self.target_color = ""

    @abstractmethod
    def place_effector(self, rng: np.random.Generator) -> None:
        """Write a random feasible position to `self.physics`."""

    @abstractmethod
    def sample_center(self, rng: np.random.Generator) -> np.ndarray:
        """A random disc centre [2] that the effector can reach, metres."""

    @abstractmethod
    def tip(self) -> np.ndarray:
        """The effector's centre [2], metres."""

    @abstractmethod
    def proprio(self) -> np.ndarray:
        """Positions [P] of the effector."""

    @abstractmethod
    def servo(self, velocity: np.ndarray) -> np.ndarray:
        """Joint velocities that move the effector at `velocity` [2] m/s."""

    def heading(self, tip: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """The expert's direction [2], length 1, from `tip` to `goal`."""
        return _unit(goal - tip)

    def reset(self, rng: np.random.Generator, target_colors: Sequence[str]) -> Observation:
        """See `contract.TaskEnv`."""
        unknown = [c for c in target_colors if c not in COLORS]
        if unknown or not target_colors:
            raise AegisError(
                f"target colours {list(target_colors)}",
                f"some of: {', '.join(COLORS)}",
                "name colours of the palette",
            )
        self.physics.reset()
        self.place_effector(rng)
        self.physics.forward()
        count = int(rng.integers(2, SLOTS + 1))
        self.centers = place_discs(rng, count, self.tip(), self.sample_center)
        lay_out(self.physics, self.centers)
        self.physics.forward()
        self._name(rng, target_colors)
        self._look = Look.draw(rng)
        self._steps, self._held, self._on = 0, 0, None
        return self.observe()

    def _name(self, rng: np.random.Generator, target_colors: Sequence[str]) -> None:
        """Draw distinct colours for the discs, and the instruction that names the target's."""
        self.target_color = str(rng.choice(list(target_colors)))
        others = [c for c in COLORS if c != self.target_color]
        distractors = rng.choice(others, size=len(self.centers) - 1, replace=False)
        self.colors = (self.target_color, *map(str, distractors))
        template = str(rng.choice(list(self.spec.templates)))
        self._instruction = template.format(color=self.target_color)

    def observe(self) -> Observation:
        """The observation of the current state."""
        image = self._stage.render(self.physics, self._look, self.colors)
        return Observation(image, self.proprio().astype(np.float32), self._instruction)

    def step(self, action: np.ndarray, look: bool = True) -> Step:
        """See `contract.TaskEnv`."""
        before = self.tip()
        velocity = checked(action, len(self.spec.action_names)) * self.step_m * CONTROL_HZ
        for _ in range(SUBSTEPS):
            self.physics.set_control(self.servo(velocity))
            self.physics.step()
        self._steps += 1
        self._count_rest(float(np.linalg.norm(self.tip() - before)))
        success = self._chosen(0)
        wrong = self._held >= HOLD_STEPS and not success
        done = success or wrong or self._steps >= self.spec.max_steps
        return Step(self.observe() if look else None, success, wrong, done)

    def _count_rest(self, moved_m: float) -> None:
        """Count the consecutive steps that rest on one disc.

        Only steps slower than half of full speed count: passing over a disc is not choosing it.
        """
        gaps = np.linalg.norm(self.centers - self.tip(), axis=1)
        slow = moved_m < self.step_m / 2
        on = int(gaps.argmin()) if gaps.min() < RADIUS_M and slow else None
        if on is None:
            self._held = 0
        else:
            self._held = self._held + 1 if on == self._on else 1
        self._on = on

    def _chosen(self, disc: int) -> bool:
        return self._held >= HOLD_STEPS and self._on == disc

    def expert_action(self) -> np.ndarray:
        """Full speed along `heading`, slowing linearly with the distance near the target."""
        tip = self.tip()
        speed = min(1.0, self.distance() / self.slow_m)
        return (speed * self.heading(tip, self.centers[0])).astype(np.float32)

    def distance(self) -> float:
        """Metres from the effector to the true target's centre."""
        return float(np.linalg.norm(self.centers[0] - self.tip()))

    def target_circle(self) -> tuple[float, float, float]:
        """See `contract.TaskEnv`."""
        return self._stage.circle(self._look, self.centers[0])


def _unit(vector: np.ndarray) -> np.ndarray:
    """The vector scaled to length 1; zero stays zero, as the effector may be at its goal."""
    length = np.linalg.norm(vector)
    return vector / length if length > 0 else np.zeros_like(vector)
