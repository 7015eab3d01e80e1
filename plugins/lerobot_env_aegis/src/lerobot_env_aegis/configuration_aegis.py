"""The settings of our simulated tasks in LeRobot."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from aegis_cli import sim
from aegis_cli.common.errors import AegisError
from aegis_cli.models.acting import DEFAULT, TARGET_COLORS
from lerobot_env_aegis.task_env import SIZE, AegisTask


@EnvConfig.register_subclass("aegis")
@dataclass
class AegisEnvConfig(EnvConfig):
    """One of our tasks, or a set of MetaWorld's whose tasks are evaluated separately.

    Attributes:
        task: reach, point, suite/DOMAIN-TASK or metaworld/TASK.
        fps: control rate; set by the task, so a new value has no effect.
        colors: colours of the targets, for tasks that have some: seen, held-out or all.
        camera: the task's camera that takes the picture; any other name renames the task's own
            camera; None: the task's own camera and name.
        episode_length: control steps; None: the task's own number.
    """

    task: str = "reach"
    colors: str = DEFAULT
    camera: str | None = None
    episode_length: int | None = None
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.colors not in TARGET_COLORS:
            expected = f"one of {', '.join(TARGET_COLORS)}"
            raise AegisError(f"colors '{self.colors}'", expected, f"--env.colors={DEFAULT}")
        if self.colors != DEFAULT and not sim.has_colors(self.task):
            raise AegisError(
                f"{self.colors} colours for '{self.task}'",
                "a task with coloured targets",
                "leave out --env.colors",
            )
        if sim.of_datasets(self.task) is not None:
            raise AegisError(
                f"task '{self.task}' for --env.type=aegis",
                "a task that LeRobot does not have itself",
                "--env.type=libero, whose --env.task is a suite such as libero_spatial",
            )
        spec = sim.make(self.task).spec
        self.fps = round(spec.control_hz)
        self.camera = self.camera or spec.camera
        self.features = {
            ACTION: PolicyFeature(FeatureType.ACTION, (len(spec.action_names),)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (len(spec.proprio_names),)),
            f"pixels/{self.camera}": PolicyFeature(FeatureType.VISUAL, (SIZE, SIZE, 3)),
        }
        self.features_map = {
            ACTION: ACTION,
            "agent_pos": OBS_STATE,
            f"pixels/{self.camera}": f"{OBS_IMAGES}.{self.camera}",
        }

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """The arguments of `AegisTask` besides the task's name."""
        return {
            "colors": self.colors,
            "camera": self.camera,
            "max_steps": self.episode_length,
        }

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """Environments of the task, or of each task of the set: {name: {number: environments}}."""
        several = use_async_envs and n_envs > 1
        kind = gym.vector.AsyncVectorEnv if several else gym.vector.SyncVectorEnv
        options: dict[str, Any] = {"context": "forkserver"} if several else {}
        found = {}
        for number, name in enumerate(sim.members(self.task)):
            make = partial(AegisTask, name, **self.gym_kwargs)
            found[number] = kind(
                [make] * n_envs, autoreset_mode=gym.vector.AutoresetMode.SAME_STEP, **options
            )
        return {self.task.replace("/", "-"): found}
