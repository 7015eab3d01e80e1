"""Frames of dm-control's suite: each domain's robot in a random pose."""

from __future__ import annotations

import atexit
from functools import cache

import numpy as np

from aegis_cli.common import gl, interrupts
from aegis_cli.data.streams.names import DOMAINS, SIZE
from aegis_cli.data.streams.photo import Photo

gl.choose_backend()

import mujoco  # noqa: E402  (the backend is chosen when MuJoCo is imported)
from dm_control import suite  # noqa: E402
from dm_control.suite.utils import randomizers  # noqa: E402

from aegis_cli.sim.scene import SLOW_FLAGS  # noqa: E402

_TASK = {
    "acrobot": ("acrobot", "swingup"),
    "cartpole": ("cartpole", "balance"),
    "cheetah": ("cheetah", "run"),
    "cup": ("ball_in_cup", "catch"),
    "finger": ("finger", "spin"),
    "hopper": ("hopper", "stand"),
    "humanoid": ("humanoid", "stand"),
    "manipulator": ("manipulator", "bring_ball"),
    "pendulum": ("pendulum", "swingup"),
    "swimmer": ("swimmer", "swimmer6"),
}
_PLAIN = Photo(noise=(0.0, 0.04), cast=0.2)
_THERMAL = Photo(blur_px=(0.0, 0.8), noise=(0.02, 0.06), contrast=(0.6, 1.0))


class Robot:
    """One domain and its rendering context."""

    def __init__(self, domain: str) -> None:
        self._physics = suite.load(*_TASK[domain]).physics
        model = self._physics.model.ptr
        model.vis.quality.offsamples = 0
        model.vis.global_.offwidth = model.vis.global_.offheight = SIZE
        with interrupts.deferred():  # a half-created context cannot be closed
            self._renderer = mujoco.Renderer(model, SIZE, SIZE)
        for flag in SLOW_FLAGS:
            self._renderer.scene.flags[flag] = False
        atexit.register(self._renderer.close)  # while EGL still exists

    def frame(self, rng: np.random.Generator) -> np.ndarray:
        """The first camera's picture of a random pose, [S, S, 3] uint8."""
        self._physics.reset()
        # dm_control uses methods that only NumPy's legacy generators have.
        old = np.random.RandomState(rng.integers(2**31))
        randomizers.randomize_limited_and_rotational_joints(self._physics, old)
        self._physics.forward()
        self._renderer.update_scene(self._physics.data.ptr, camera=0)
        return self._renderer.render()


@cache
def _robot(domain: str) -> Robot:
    return Robot(domain)


def plain_domain(domain: int, rng: np.random.Generator) -> np.ndarray:
    """The robot as dm-control renders it, with its colours more or less faded."""
    frame = _robot(DOMAINS[domain]).frame(rng) / 255
    grey = frame.mean(-1, keepdims=True)
    return _PLAIN.take(grey + rng.uniform(0, 1) * (frame - grey), rng)


def thermal_domain(domain: int, rng: np.random.Generator) -> np.ndarray:
    """The robot as a thermal camera would show it.

    The picture has a ramp between two false colours, and may be inverted and mirrored.
    """
    heat = (_robot(DOMAINS[domain]).frame(rng) / 255).mean(-1)
    heat = (heat - heat.min()) / (heat.max() - heat.min())
    heat = heat if rng.random() < 0.5 else 1 - heat
    heat = heat if rng.random() < 0.5 else heat[:, ::-1]
    cold, hot = rng.uniform(0, 0.4, 3), rng.uniform(0.6, 1, 3)
    return _THERMAL.take(cold + (hot - cold) * heat[..., None], rng)
