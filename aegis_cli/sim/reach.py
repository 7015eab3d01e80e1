"""`reach`: move the fingertip of dm-control's two-link reacher to the disc of the named colour."""

from __future__ import annotations

from functools import cache

import numpy as np

from aegis_cli.sim.contract import TaskSpec
from aegis_cli.sim.planar import CONTROL_HZ, PlanarTask
from aegis_cli.sim.scene import Stage, plain_xml

from dm_control.suite import reacher  # isort: skip  (after scene, which chooses the OpenGL backend)

LINK_M = 0.12
KEEP_OUT_M = 0.065  # the folded arm is singular: the expert avoids this circle around the base
_TIP_M = (0.08, 0.22)  # range of the fingertip's distance to the base at the start
_TARGET_M = (0.09, 0.20)  # range of a target's distance to the base
_DAMPING_M = 0.02  # damps the least squares; matters when the arm is nearly folded or stretched
_HALF_WIDTH_M = 0.25


@cache
def stage() -> Stage:
    """The stage shared by all reach environments in this process."""
    xml, assets = reacher.get_model_and_assets()
    plain = plain_xml(xml, tip="finger", tip_radius_m=0.011, servo_gain=0.3)
    return Stage(reacher.Physics.from_xml_string(plain, assets), "finger", _HALF_WIDTH_M)


def around(tip: np.ndarray, goal: np.ndarray, keep_out_m: float = KEEP_OUT_M) -> np.ndarray:
    """The initial direction [2], length 1, of the shortest way around the base.

    The way from `tip` to `goal` is a straight line if that avoids the circle, otherwise the tangent
    on the goal's side. The two agree where the line touches the circle, so the direction is
    continuous except for goals exactly behind the base.

    Args:
        keep_out_m: radius of the circle around the base, metres.
    """
    gap, r = goal - tip, np.linalg.norm(tip)
    length = np.linalg.norm(gap)
    if length == 0:
        return gap
    nearest = tip + gap * np.clip(-(tip @ gap) / length**2, 0, 1)
    # A push may have moved the tip into the circle; it may leave in a straight line, hence r.
    if np.linalg.norm(nearest) >= min(keep_out_m, r) - 1e-9:
        return gap / length
    side = 1.0 if tip[0] * goal[1] - tip[1] * goal[0] >= 0 else -1.0
    sin = side * min(1.0, keep_out_m / r)
    cos = np.sqrt(1 - sin**2)
    x, y = -tip / r
    return np.array([cos * x + sin * y, cos * y - sin * x])


class Reach(PlanarTask):
    """The arm. Its action is the fingertip's displacement (dx, dy) in image axes, 1 = 25 mm."""

    step_m = 0.025
    spec = TaskSpec(
        name="reach",
        action_names=("dx", "dy"),
        proprio_names=(
            "sin_shoulder",
            "cos_shoulder",
            "sin_wrist",
            "cos_wrist",
            "tip_x_m",
            "tip_y_m",
        ),
        max_steps=40,
        control_hz=CONTROL_HZ,
        templates=(
            "move the finger to the {color} target",
            "touch the {color} target",
            "point to the {color} target",
            "go to the {color} target",
            "reach the {color} target",
            "bring the finger to the {color} target",
        ),
    )

    def __init__(self) -> None:
        super().__init__(stage())
        self._finger = self.physics.model.name2id("finger", "geom")

    def place_effector(self, rng: np.random.Generator) -> None:
        """Draw any shoulder angle, and a wrist bent either way.

        The range of the fingertip's distance avoids both singular poses, the folded and the
        stretched arm.
        """
        r = np.sqrt(rng.uniform(_TIP_M[0] ** 2, _TIP_M[1] ** 2))
        wrist = rng.choice([-1, 1]) * 2 * np.arccos(r / (2 * LINK_M))
        self.physics.data.qpos[:] = rng.uniform(-np.pi, np.pi), wrist

    def sample_center(self, rng: np.random.Generator) -> np.ndarray:
        """A centre [2] drawn uniformly from an annulus around the base, metres."""
        r = np.sqrt(rng.uniform(_TARGET_M[0] ** 2, _TARGET_M[1] ** 2))
        angle = rng.uniform(-np.pi, np.pi)
        return r * np.array([np.cos(angle), np.sin(angle)])

    def tip(self) -> np.ndarray:
        """Position [2] of the fingertip, metres."""
        return self.physics.data.geom_xpos[self._finger, :2].copy()

    def proprio(self) -> np.ndarray:
        """Sines and cosines of both joints and the fingertip in metres, [6]."""
        shoulder, wrist = self.physics.data.qpos
        angles = np.sin(shoulder), np.cos(shoulder), np.sin(wrist), np.cos(wrist)
        return np.array([*angles, *self.tip()])

    def servo(self, velocity: np.ndarray) -> np.ndarray:
        """Joint velocities [2], rad/s, by damped least squares: J^T (J J^T + c^2)^-1 v."""
        arms = self.tip() - self.physics.data.xanchor[:, :2]  # from the joint axes to the tip
        # A rotation about z moves the tip at right angles to the arm.
        jacobian = np.stack([-arms[:, 1], arms[:, 0]])
        damped = jacobian @ jacobian.T + _DAMPING_M**2 * np.eye(2)
        return jacobian.T @ np.linalg.solve(damped, velocity)

    def heading(self, tip: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """The expert's direction [2], around the base rather than across it."""
        return around(tip, goal)
