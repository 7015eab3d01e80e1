"""The appearance of a task: a plain dm-control domain with coloured discs, seen from above."""

from __future__ import annotations

import atexit
from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np

from aegis_cli.common import gl, interrupts
from aegis_cli.common.palette import RGB

gl.choose_backend()

import mujoco  # noqa: E402  (the backend is chosen when MuJoCo is imported)
from dm_control.mujoco import Physics  # noqa: E402

SIZE = 64  # pixels per side of a picture
SLOTS = 4  # discs in a model; an episode shows two or more of them
RADIUS_M = 0.035  # a disc's radius
_FOVY_DEG = 20.0  # a distant camera with a narrow field of view has almost no parallax
# The arm lies below the discs, the effector above them, and unused discs under the floor.
_DISC_Z, _TIP_Z, _STORED_Z = 0.03, 0.05, -1.0
SLOW_FLAGS = (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION)


def plain_xml(xml: bytes, *, tip: str, tip_radius_m: float, servo_gain: float) -> str:
    """Strip a dm_control.suite domain of decoration, and add discs and velocity servos.

    There are `SLOTS` discs, which are mocap bodies; servos replace the motors.

    A servo's force is servo_gain * (control - velocity): the control is a joint velocity. The
    integrator is implicit in velocity, so a stiff servo is stable at the domain's 20 ms time step.
    """
    root = ElementTree.fromstring(xml)
    world = _child(root, "worldbody")
    for child in list(world):
        if child.tag == "light" or child.get("name", "").startswith(("wall_", "target")):
            world.remove(child)
    for geom in root.iter("geom"):
        geom.attrib.pop("material", None)
    for geom in root.iterfind(f".//geom[@name='{tip}']"):
        geom.set("size", str(tip_radius_m))
        geom.set("pos", f"0 0 {_TIP_Z}")
    for motor in _child(root, "actuator"):
        motor.tag = "velocity"
        motor.set("kv", str(servo_gain))
    default = _child(root, "default")
    default.remove(_child(default, "motor"))
    _child(root, "option").set("integrator", "implicitfast")
    for i in range(SLOTS):
        body = ElementTree.SubElement(world, "body", name=f"disc{i}", mocap="true")
        ElementTree.SubElement(
            body, "geom", name=f"disc{i}", type="cylinder", size=f"{RADIUS_M} .0005"
        )
    visual = ElementTree.SubElement(root, "visual")
    ElementTree.SubElement(visual, "quality", offsamples="0")
    ElementTree.SubElement(visual, "global", fovy=str(_FOVY_DEG))
    return ElementTree.tostring(root, encoding="unicode")


def _child(parent: ElementTree.Element, tag: str) -> ElementTree.Element:
    """The first child with that tag, which every domain has."""
    found = parent.find(tag)
    assert found is not None
    return found


@dataclass(frozen=True)
class Look:
    """Irrelevant variation between episodes: greys, light, and the camera.

    The camera moves by about a pixel.
    """

    floor: np.ndarray  # [3], red, green and blue in [0, 1]
    body: np.ndarray  # [3], neutral and lighter than the floor
    light: float
    ambient: float  # fraction of the light
    shift_m: np.ndarray  # [2]
    zoom: float

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Look:
        """A random look whose body stands out from its floor."""
        brightness = rng.uniform(0.2, 0.55)
        return cls(
            floor=brightness + rng.uniform(-0.03, 0.03, size=3),
            body=np.full(3, brightness + rng.uniform(0.25, 0.4)),
            light=rng.uniform(0.85, 1.05),
            ambient=rng.uniform(0.3, 0.6),
            shift_m=rng.uniform(-0.006, 0.006, size=2),
            zoom=rng.uniform(0.97, 1.03),
        )


class Stage:
    """One compiled model and one rendering context, shared by every environment of a task."""

    def __init__(self, physics: Physics, tip: str, half_width_m: float) -> None:
        self.physics = physics
        self._model = physics.model.ptr
        self._tip = self._model.geom(tip).id
        self._floor = self._model.geom("ground").id
        self._discs = [self._model.geom(f"disc{i}").id for i in range(SLOTS)]
        self._half_width_m = half_width_m
        self._distance_m = half_width_m / np.tan(np.radians(_FOVY_DEG / 2))
        self._camera = mujoco.MjvCamera()
        self._camera.azimuth, self._camera.elevation = 90, -90  # x to the right, y up
        self._renderer: mujoco.Renderer | None = None

    def render(self, physics: Physics, look: Look, colors: Sequence[str]) -> np.ndarray:
        """Picture [64, 64, 3] uint8 of one environment's state.

        Args:
            colors: names of the discs' colours, in the order of the slots.
        """
        self._dress(look, colors)
        if self._renderer is None:
            self._renderer = self._open()
        self._renderer.update_scene(physics.data.ptr, self._camera)
        return self._renderer.render()

    def circle(self, look: Look, center: np.ndarray) -> tuple[float, float, float]:
        """Where a picture shows the disc at `center` [2] metres: centre (right, down) and radius.

        Both are fractions of the picture's side.
        """
        side_m = 2 * self._half_width_m * look.zoom
        right, up = (center - look.shift_m) / side_m
        return 0.5 + float(right), 0.5 - float(up), RADIUS_M / side_m

    def _open(self) -> mujoco.Renderer:
        with interrupts.deferred():  # a half-created context cannot be closed
            renderer = mujoco.Renderer(self._model, SIZE, SIZE)
            # Later, during interpreter shutdown, EGL is gone and closing raises.
            atexit.register(renderer.close)
        for flag in SLOW_FLAGS:
            renderer.scene.flags[flag] = False
        return renderer

    def _dress(self, look: Look, colors: Sequence[str]) -> None:
        """Write one environment's colours, light and camera to the shared model."""
        rgba = self._model.geom_rgba
        rgba[:, :3] = look.body
        rgba[self._floor, :3] = look.floor
        rgba[self._tip, :3] = 0.03
        for geom, color in zip(self._discs, colors, strict=False):
            rgba[geom, :3] = RGB[color]
        head = self._model.vis.headlight
        head.ambient[:] = look.light * look.ambient
        head.diffuse[:] = look.light * (1 - look.ambient)
        head.specular[:] = 0
        self._camera.lookat[:] = (*look.shift_m, _DISC_Z)
        self._camera.distance = self._distance_m * look.zoom


def lay_out(physics: Physics, centers: np.ndarray) -> None:
    """Put the discs at `centers` [n, 2] metres and store the other slots out of sight."""
    physics.data.mocap_pos[:] = (0, 0, _STORED_Z)
    physics.data.mocap_pos[: len(centers), :2] = centers
    physics.data.mocap_pos[: len(centers), 2] = _DISC_Z
