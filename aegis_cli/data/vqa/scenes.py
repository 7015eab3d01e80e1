"""Rendered scenes of coloured primitives, on which the embedded VLM is trained.

A scene is one to four cubes, balls and cylinders on a floor, seen by a camera anywhere between
oblique and straight down. Floor, light, object size and grey clutter vary, so that a robot's view
is not too different for a VLM trained on scenes. Objects are placed by their position in the
*image*, which makes every answer to "where is it" equally likely.
"""

from __future__ import annotations

import atexit
import math
import os
import threading
from dataclasses import dataclass

import numpy as np

from aegis_cli.common import gl, interrupts, palette

gl.choose_backend()
# At exit dm_control terminates the display that all contexts share. Exit handlers run last in,
# first out: it has to be imported before we register the closing of our contexts.
import dm_control.mujoco  # noqa: E402, F401
import mujoco  # noqa: E402  (the OpenGL backend has to be chosen before the first import)

from aegis_cli.data.vqa.things import IMAGE_SIZE, SHAPES, Scene, Thing  # noqa: E402

MAX_OBJECTS = 4
MAX_CLUTTER = 2
FIELD_OF_VIEW_DEG = 45.0

# One stream of seeds per split, so that no scene of one split can occur in another.
SPLITS: dict[str, int] = {"train": 0, "validation": 1, "probe": 2, "anchor": 3}

_GEOM_TYPE = {
    "cube": mujoco.mjtGeom.mjGEOM_BOX,
    "ball": mujoco.mjtGeom.mjGEOM_SPHERE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
}
# Image-plane focal length in pixels of a pinhole camera with this vertical field of view.
_FOCAL_PX = IMAGE_SIZE / 2 / math.tan(math.radians(FIELD_OF_VIEW_DEG) / 2)
_MARGIN_PX = 5.0
_SEPARATION = 1.25  # centres are at least this many summed radii apart in the image


def scene_rng(seed: int, split: str, index: int) -> np.random.Generator:
    """The generator of scene `index`: independent of every other scene and of every other split."""
    return np.random.default_rng(np.random.SeedSequence([seed, SPLITS[split], index]))


@dataclass(frozen=True)
class _Camera:
    """A free camera: `position` [3] in metres, and unit axes right, up, forward [3] each."""

    lookat: np.ndarray
    azimuth_deg: float
    elevation_deg: float
    distance: float

    @property
    def axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The unit vectors [3] to its right, up and forward."""
        a, e = math.radians(self.azimuth_deg), math.radians(self.elevation_deg)
        forward = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
        up = np.array([-math.sin(e) * math.cos(a), -math.sin(e) * math.sin(a), math.cos(e)])
        return np.cross(forward, up), up, forward

    @property
    def position(self) -> np.ndarray:
        """Its position [3], in metres."""
        return self.lookat - self.distance * self.axes[2]

    def depth(self, point: np.ndarray) -> float:
        """The depth of a world point [3] along the optical axis, in metres."""
        return float((point - self.position) @ self.axes[2])

    def floor_point(self, x_px: float, y_px: float) -> np.ndarray:
        """The point of the floor (z = 0) seen at a pixel."""
        right, up, forward = self.axes
        half = IMAGE_SIZE / 2
        # Pixel rows count downwards, but `up` points upwards.
        ray = forward + right * (x_px - half) / _FOCAL_PX + up * (half - y_px) / _FOCAL_PX
        # Follow the ray, which points downwards, until the height is 0.
        return self.position - ray * self.position[2] / ray[2]


def _model_xml() -> str:
    # Mocap bodies, because a geom fixed to the world keeps its compiled pose, whatever is written
    # to `geom_pos`. Unused bodies are placed below the floor, where no camera sees them.
    bodies = ""
    for kind, geom, count in (("thing", "box", MAX_OBJECTS), ("clutter", "capsule", MAX_CLUTTER)):
        for i in range(count):
            bodies += (
                f'<body name="{kind}{i}" mocap="true" pos="0 0 -9">'
                f'<geom name="{kind}{i}" type="{geom}" size=".05 .05 .05" contype="0" '
                'conaffinity="0"/></body>'
            )
    return f"""
    <mujoco>
      <visual>
        <global fovy="{FIELD_OF_VIEW_DEG}" offwidth="{IMAGE_SIZE}" offheight="{IMAGE_SIZE}"/>
        <quality offsamples="0" shadowsize="0"/>
        <map znear="0.01" zfar="50"/>
      </visual>
      <asset>
        <texture name="checker" type="2d" builtin="checker" rgb1="1 1 1" rgb2=".7 .7 .7"
             width="128" height="128"/>
        <material name="flat" rgba="1 1 1 1" specular="0"/>
        <material name="checker" texture="checker" texrepeat="4 4" texuniform="true" specular="0"/>
      </asset>
      <worldbody>
        <light name="sun" directional="true" castshadow="false" pos="0 0 3" dir="0 0 -1"/>
        <geom name="floor" type="plane" size="10 10 .1" material="flat"
          contype="0" conaffinity="0"/>
        {bodies}
      </worldbody>
    </mujoco>"""


class SceneRenderer:
    """One compiled model and one OpenGL context, reused for every scene.

    Each scene sets everything it shows, so none depends on earlier ones.
    """

    def __init__(self) -> None:
        self._model = mujoco.MjModel.from_xml_string(_model_xml())
        self._data = mujoco.MjData(self._model)
        with interrupts.deferred():  # a half-created context cannot be closed
            self._renderer = mujoco.Renderer(self._model, IMAGE_SIZE, IMAGE_SIZE)
        for flag in (
            mujoco.mjtRndFlag.mjRND_SHADOW,
            mujoco.mjtRndFlag.mjRND_REFLECTION,
            mujoco.mjtRndFlag.mjRND_HAZE,
        ):
            self._renderer.scene.flags[flag] = 0
        self._floor = self._model.geom("floor").id
        self._materials = [self._model.material(name).id for name in ("flat", "checker")]

    def render(self, rng: np.random.Generator, only: tuple[str, str] | None = None) -> Scene:
        """Draw one scene from `rng` and render it.

        Args:
            only: a colour and a shape; the scene then has a single thing with these.
        """
        camera = _draw_camera(rng)
        self._set_light(rng)
        self._set_floor(rng)
        self._set_clutter(rng, camera)
        things = self._set_things(rng, camera, only)
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._renderer.update_scene(self._data, _mujoco_camera(camera))
        return Scene(self._renderer.render(), things)

    def close(self) -> None:
        """Release the OpenGL context."""
        self._renderer.close()

    def _set_light(self, rng: np.random.Generator) -> None:
        head = self._model.vis.headlight
        head.ambient[:] = rng.uniform(0.2, 0.4)
        head.diffuse[:] = rng.uniform(0.3, 0.5)  # headlight shades a ball, not a flat top
        head.specular[:] = 0
        sun = self._model.light("sun")
        sun.dir[:] = [*rng.uniform(-0.8, 0.8, 2), -1.0]
        sun.diffuse[:] = rng.uniform(0.2, 0.5)

    def _set_floor(self, rng: np.random.Generator) -> None:
        self._model.geom_matid[self._floor] = rng.choice(self._materials)
        brightness = rng.uniform(0.1, 0.9)
        tint = brightness * (1 + rng.uniform(-0.08, 0.08, 3))
        self._model.geom_rgba[self._floor, :3] = np.clip(tint, 0, 1)

    def _place(
        self, name: str, position: np.ndarray, rng: np.random.Generator, flat: bool = True
    ) -> None:
        """Put a body's centre at a position [3], with a random rotation about the vertical axis."""
        body = self._model.body(name).mocapid[0]
        self._data.mocap_pos[body] = position
        # A quaternion uses half the rotation angle; half a circle is enough for these shapes.
        half_turn = rng.uniform(0, math.pi) / 2
        quat = np.array([math.cos(half_turn), 0, 0, math.sin(half_turn)])
        if not flat:  # lying: first rotate the capsule's axis from z into the floor plane
            lying = np.array([math.sqrt(0.5), math.sqrt(0.5), 0, 0])
            mujoco.mju_mulQuat(quat, quat.copy(), lying)
        self._data.mocap_quat[body] = quat

    def _set_clutter(self, rng: np.random.Generator, camera: _Camera) -> None:
        count = rng.integers(0, MAX_CLUTTER + 1)
        for i in range(MAX_CLUTTER):
            name = f"clutter{i}"
            if i >= count:
                self._place(name, np.array([0.0, 0.0, -9.0]), rng)
                continue
            x_px, y_px = rng.uniform(0, IMAGE_SIZE, 2)
            metres_per_px = camera.distance / _FOCAL_PX  # at the centre of the picture
            geom = self._model.geom(name).id
            radius = metres_per_px * rng.uniform(0.7, 1.8)
            self._model.geom_size[geom, :2] = radius, metres_per_px * rng.uniform(4, 16)
            brightness = rng.uniform(0.2, 0.85)
            self._model.geom_rgba[geom, :3] = brightness * (1 + rng.uniform(-0.05, 0.05, 3))
            self._place(name, camera.floor_point(x_px, y_px) + [0, 0, radius], rng, flat=False)

    def _set_things(
        self, rng: np.random.Generator, camera: _Camera, only: tuple[str, str] | None
    ) -> tuple[Thing, ...]:
        count = int(rng.integers(1, MAX_OBJECTS + 1)) if only is None else 1
        colors = _draw_kinds(rng, palette.COLORS, count) if only is None else [only[0]]
        shapes = _draw_kinds(rng, SHAPES, count) if only is None else [only[1]]
        placed: list[tuple[float, float, float]] = []
        things = []
        for i in range(MAX_OBJECTS):
            if i >= count:  # otherwise it would stay where the previous scene put it
                self._place(f"thing{i}", np.array([0.0, 0.0, -9.0]), rng)
                continue
            x_px, y_px, radius_px = _draw_free_place(rng, placed)
            placed.append((x_px, y_px, radius_px))
            things.append(
                self._put_thing(i, colors[i], shapes[i], x_px, y_px, radius_px, camera, rng)
            )
        return tuple(things)

    def _put_thing(
        self,
        i: int,
        color: str,
        shape: str,
        x_px: float,
        y_px: float,
        radius_px: float,
        camera: _Camera,
        rng: np.random.Generator,
    ) -> Thing:
        """Give body `i` its shape, size and colour, and let its centre project to a pixel."""
        floor = camera.floor_point(x_px, y_px)
        radius = radius_px * camera.depth(floor) / _FOCAL_PX  # in metres
        half_height = radius * (rng.uniform(0.5, 1.2) if shape == "cylinder" else 1.0)
        # A cube's face then covers about the same area as a ball.
        side = radius * 0.85 if shape == "cube" else radius
        geom = self._model.geom(f"thing{i}").id
        self._model.geom_type[geom] = _GEOM_TYPE[shape]
        self._model.geom_size[geom] = side, half_height if shape == "cylinder" else side, side
        self._model.geom_rbound[geom] = 2 * radius  # the compiled bound is for another size
        tone = np.array(palette.RGB[color]) * rng.uniform(0.85, 1.1)
        self._model.geom_rgba[geom, :3] = np.clip(tone, 0, 1)
        height = half_height if shape == "cylinder" else side
        # The body's *centre* projects to the drawn pixel, whatever its height.
        centre = _lift(camera, x_px, y_px, height)
        self._place(f"thing{i}", centre, rng)
        return Thing(color, shape, x_px, y_px)


_of_thread = threading.local()


def renderer_of_thread() -> SceneRenderer:
    """The calling thread's renderer.

    Creating an OpenGL context takes a tenth of a second. A context cannot be current in two
    threads, nor be used in a process forked after its creation.
    """
    if getattr(_of_thread, "process", None) != os.getpid():
        renderer = SceneRenderer()
        atexit.register(renderer.close)  # while EGL still exists
        _of_thread.renderer, _of_thread.process = renderer, os.getpid()
    return _of_thread.renderer


def _lift(camera: _Camera, x_px: float, y_px: float, height: float) -> np.ndarray:
    """The point at `height` above the floor that projects to a pixel."""
    floor, eye = camera.floor_point(x_px, y_px), camera.position
    return floor + (eye - floor) * height / eye[2]


def _draw_camera(rng: np.random.Generator) -> _Camera:
    """A camera looking near the centre of the scene; about a third of them from nearly above."""
    overhead = rng.random() < 0.35
    return _Camera(
        lookat=np.array([*rng.uniform(-0.3, 0.3, 2), 0.0]),
        azimuth_deg=float(90 if overhead and rng.random() < 0.5 else rng.uniform(0, 360)),
        elevation_deg=float(-rng.uniform(84, 90) if overhead else -rng.uniform(38, 84)),
        distance=float(rng.uniform(0.7, 2.0)),
    )


def _mujoco_camera(camera: _Camera) -> mujoco.MjvCamera:
    free = mujoco.MjvCamera()
    free.type = mujoco.mjtCamera.mjCAMERA_FREE
    free.lookat[:] = camera.lookat
    free.azimuth, free.elevation = camera.azimuth_deg, camera.elevation_deg
    free.distance = camera.distance
    return free


def _draw_kinds(rng: np.random.Generator, kinds: tuple[str, ...], count: int) -> list[str]:
    """`count` kinds, some of them repeated, so that counts of a kind take every value."""
    drawn: list[str] = []
    for _ in range(count):
        repeat = drawn and rng.random() < 0.3
        drawn.append(str(rng.choice(drawn if repeat else kinds)))
    return drawn


def _draw_free_place(
    rng: np.random.Generator, placed: list[tuple[float, float, float]]
) -> tuple[float, float, float]:
    """A centre and radius in pixels that keep clear of the things already placed."""
    while True:
        radius = rng.uniform(4.2, 7.2)
        x, y = rng.uniform(_MARGIN_PX, IMAGE_SIZE - _MARGIN_PX, 2)
        if all(math.hypot(x - px, y - py) > _SEPARATION * (radius + pr) for px, py, pr in placed):
            return float(x), float(y), float(radius)
