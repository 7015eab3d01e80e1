"""An SO-101 and its leader without hardware, as LeRobot's programs find a robot of a third party.

    PYTHONPATH=plugins/check lerobot-rollout --robot.type=miniature_follower \\
        --robot.discover_packages_path=lerobot_robot_miniature --robot.log=log.jsonl ...

The follower is at once where it is sent. Its log has a line for every observation and every action.
"""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

MOTORS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
START = (10.0, -20.0, 30.0, -40.0, 50.0, 5.0)  # degrees; the gripper in per cent


def picture(camera: str, number: int, height: int, width: int) -> np.ndarray:
    """What a camera shows at the observation of that number, [H, W, 3] uint8."""
    rng = np.random.default_rng([number, *camera.encode()])
    coarse = rng.integers(0, 256, (4, 4, 3), dtype=np.uint8)
    rows, columns = (np.arange(n) * 4 // n for n in (height, width))
    return np.ascontiguousarray(coarse[rows][:, columns])


@RobotConfig.register_subclass("miniature_follower")
@dataclass(kw_only=True)
class MiniatureFollowerConfig(RobotConfig):
    """Which motors and cameras it has, in their order, and where it writes what it did."""

    log: Path | None = None
    motors: list[str] | None = None
    views: list[str] | None = None
    height: int = 48
    width: int = 64


class MiniatureFollower(Robot):
    """LeRobot's interface of a robot; positions are those that were sent last."""

    config_class = MiniatureFollowerConfig
    name = "miniature_follower"

    def __init__(self, config: MiniatureFollowerConfig) -> None:
        super().__init__(config)
        self.config = config
        self._motors = [f"{name}.pos" for name in config.motors or MOTORS]
        self._views = ("front", "wrist") if config.views is None else tuple(config.views)
        begin = dict(zip((f"{name}.pos" for name in MOTORS), START, strict=True))
        self._at = {name: begin.get(name, 0.0) for name in self._motors}
        self.cameras = dict.fromkeys(self._views)  # LeRobot's recording counts them
        self._is_connected = False
        self._seen = 0

    @property
    def observation_features(self) -> dict[str, Any]:
        size = (self.config.height, self.config.width, 3)
        return {**dict.fromkeys(self._motors, float), **dict.fromkeys(self._views, size)}

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(self._motors, float)

    @property
    def is_connected(self) -> bool:
        return self._is_connected

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        self._is_connected = True
        self._write("connected")

    def disconnect(self) -> None:
        self._write("disconnected")
        self._is_connected = False

    def calibrate(self) -> None:
        """Nothing to calibrate."""

    def configure(self) -> None:
        """Nothing to configure."""

    def get_observation(self) -> dict[str, Any]:
        number, self._seen = self._seen, self._seen + 1
        self._write("observed", number=number, positions=self._at)
        size = self.config.height, self.config.width
        return {**self._at, **{name: picture(name, number, *size) for name in self._views}}

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        if unknown := set(action) - set(self._at):
            raise KeyError(f"no motors {sorted(unknown)}")
        self._at = {**self._at, **action}
        self._write("sent", action=action)
        return action

    def _write(self, what: str, **more: Any) -> None:
        if self.config.log is not None:
            with self.config.log.open("a", encoding="utf-8") as log:
                log.write(json.dumps({"what": what, "time": time.monotonic(), **more}) + "\n")


@TeleoperatorConfig.register_subclass("miniature_leader")
@dataclass(kw_only=True)
class MiniatureLeaderConfig(TeleoperatorConfig):
    """A leader arm that somebody moves."""


class MiniatureLeader(Teleoperator):
    """LeRobot's interface of a leader; each motor swings with a period of its own."""

    config_class = MiniatureLeaderConfig
    name = "miniature_leader"

    def __init__(self, config: MiniatureLeaderConfig) -> None:
        super().__init__(config)
        self._asked, self._is_connected = 0, False

    @property
    def action_features(self) -> dict[str, Any]:
        return {f"{name}.pos": float for name in MOTORS}

    @property
    def feedback_features(self) -> dict[str, Any]:
        return {}

    @property
    def is_connected(self) -> bool:
        return self._is_connected

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        self._is_connected = True

    def disconnect(self) -> None:
        self._is_connected = False

    def calibrate(self) -> None:
        """Nothing to calibrate."""

    def configure(self) -> None:
        """Nothing to configure."""

    def get_action(self) -> dict[str, float]:
        self._asked += 1
        places = enumerate(zip(MOTORS, START, strict=True))
        return {
            f"{name}.pos": start + 4 * math.sin(self._asked / (5 + number))
            for number, (name, start) in places
        }

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """It feels nothing."""
