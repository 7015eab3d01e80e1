"""`point`: drive dm-control's point mass onto the pad of the named colour."""

from __future__ import annotations

from functools import cache

import numpy as np

from aegis_cli.sim.contract import TaskSpec
from aegis_cli.sim.planar import CONTROL_HZ, PlanarTask
from aegis_cli.sim.scene import Stage, plain_xml

# After `scene`, which chooses the OpenGL backend.
from dm_control.suite import point_mass  # isort: skip

# Half the sides of the squares that starts and pads are drawn from; the walls are at 0.29.
_START_M = 0.25
_PAD_M = 0.22
_HALF_WIDTH_M = 0.275


@cache
def stage() -> Stage:
    """The stage shared by all point environments in this process."""
    xml, assets = point_mass.get_model_and_assets()
    plain = plain_xml(xml, tip="pointmass", tip_radius_m=0.016, servo_gain=20.0)
    return Stage(point_mass.Physics.from_xml_string(plain, assets), "pointmass", _HALF_WIDTH_M)


class Point(PlanarTask):
    """The point mass. Its action is a displacement (dx, dy) in image axes, 1 = 30 mm per step."""

    step_m = 0.03
    spec = TaskSpec(
        name="point",
        action_names=("dx", "dy"),
        proprio_names=("x_m", "y_m"),
        max_steps=40,
        control_hz=CONTROL_HZ,
        templates=(
            "move to the {color} pad",
            "drive the ball to the {color} pad",
            "move the point mass onto the {color} pad",
            "go to the {color} pad",
            "bring the ball to the {color} pad",
            "put the ball on the {color} pad",
        ),
    )

    def __init__(self) -> None:
        super().__init__(stage())

    def place_effector(self, rng: np.random.Generator) -> None:
        """Place the mass anywhere inside the walls."""
        self.physics.data.qpos[:] = rng.uniform(-_START_M, _START_M, size=2)

    def sample_center(self, rng: np.random.Generator) -> np.ndarray:
        """A centre [2] drawn uniformly from a square, metres."""
        return rng.uniform(-_PAD_M, _PAD_M, size=2)

    def tip(self) -> np.ndarray:
        """Position [2] of the mass, metres."""
        return self.physics.data.qpos.copy()

    def proprio(self) -> np.ndarray:
        """Position [2] of the mass, metres."""
        return self.tip()

    def servo(self, velocity: np.ndarray) -> np.ndarray:
        """The velocity [2] itself, m/s, because the joints are the axes of the plane."""
        return velocity
