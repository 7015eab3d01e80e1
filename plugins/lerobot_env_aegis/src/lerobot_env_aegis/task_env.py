"""One of our tasks as a Gymnasium environment."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from aegis_cli import sim
from aegis_cli.models.acting import EVALUATION_SEED, TARGET_COLORS
from aegis_cli.sim.contract import EVALUATION, Observation, episode_rng

SIZE = 64  # pixels per side of a picture


class AegisTask(gym.Env):
    """One task. The episode with seed n is episode n of `aegis rollout`.

    Observations are {"pixels": {camera: [64, 64, 3] uint8}, "agent_pos": [P] float32}, actions are
    [A] in [-1, 1]. The reward is that of the task, or 1 at success. `info["is_success"]` is the
    task's own verdict; for a task measured by its return it is always False.

    Attributes:
        task: name of the task.
        task_description: the instruction of this episode.
    """

    def __init__(self, task: str, colors: str, camera: str, max_steps: int | None = None) -> None:
        """Create the task with its camera of that name, or with its own camera under that name."""
        seen_by = (camera,) if camera in sim.cameras(task) else ()
        self._env = sim.make(task, seen_by=seen_by)
        spec = self._env.spec
        self.task, self.task_description = task, spec.templates[0]
        self._colors, self._camera = TARGET_COLORS[colors], camera
        self._max_episode_steps = max_steps or spec.max_steps  # LeRobot asks for it by this name
        self.render_mode = "rgb_array"
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": round(spec.control_hz)}
        picture = gym.spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)
        positions = gym.spaces.Box(-np.inf, np.inf, (len(spec.proprio_names),), np.float32)
        self.observation_space = gym.spaces.Dict(
            {"pixels": gym.spaces.Dict({camera: picture}), "agent_pos": positions}
        )
        self.action_space = gym.spaces.Box(-1, 1, (len(spec.action_names),), np.float32)
        self._seen: Observation | None = None
        self._steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin episode `seed`; without a seed, one that is determined by the previous seeds."""
        super().reset(seed=seed)
        number = seed if seed is not None else int(self.np_random.integers(2**31))
        rng = episode_rng(EVALUATION_SEED, EVALUATION, number)
        self._seen, self._steps = self._env.reset(rng, self._colors), 0
        self.task_description = self._seen.instruction
        return self._observation(), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Take one control step with the action, clipped to [-1, 1]."""
        step = self._env.step(action)
        self._steps += 1
        self._seen = step.observation or self._seen
        success = bool(step.success)
        reward = float(success) if step.reward is None else float(step.reward)
        over = step.done or self._steps >= self._max_episode_steps
        terminated = over and success
        return (
            self._observation(),
            reward,
            terminated,
            over and not terminated,
            {"is_success": success},
        )

    def render(self) -> np.ndarray:
        """The last picture [64, 64, 3] uint8."""
        assert self._seen is not None
        return self._seen.image

    def _observation(self) -> dict[str, Any]:
        assert self._seen is not None
        pixels = {self._camera: self._seen.image}
        return {"pixels": pixels, "agent_pos": self._seen.proprio.astype(np.float32)}
