"""Rendered pictures: solids on a floor, and targets beside a robot.

The scenes are those of the VLM's questions and of the robot tasks.
"""

from __future__ import annotations

import math

import numpy as np

from aegis_cli.common.palette import COLORS
from aegis_cli.data.streams.names import SIZE
from aegis_cli.data.streams.photo import Photo, to_bytes
from aegis_cli.data.vqa.scenes import renderer_of_thread
from aegis_cli.data.vqa.things import IMAGE_SIZE, SHAPES
from aegis_cli.sim import point, reach
from aegis_cli.sim.scene import Look, lay_out

_CROP_PX = 26  # side of the crop from a scene of 64 pixels
PLAIN = Photo(noise=(0.0, 0.03))
LAMPLIGHT = Photo(
    blur_px=(0.0, 0.7), noise=(0.02, 0.06), contrast=(0.4, 0.7), cast=0.34, shade=(0.2, 0.6)
)
NIGHT = Photo(
    blur_px=(0.0, 0.6), noise=(0.02, 0.06), contrast=(0.4, 0.7), cast=0.35, shade=(0.2, 0.6)
)


def _solid(rng: np.random.Generator, color: str, solid: str) -> np.ndarray:
    """The part of a scene around its single thing, enlarged: [S, S, 3] in [0, 1]."""
    scene = renderer_of_thread().render(rng, only=(color, solid))
    at = np.array([scene.things[0].x_px, scene.things[0].y_px])
    # Nearly centred, and never beyond the border.
    corner = np.clip(at - _CROP_PX / 2 + rng.uniform(-3, 3, 2), 0, IMAGE_SIZE - _CROP_PX)
    left, top = np.rint(corner).astype(int)
    return enlarged(scene.image[top : top + _CROP_PX, left : left + _CROP_PX] / 255)


def plain_solid(color: int, solid: int, rng: np.random.Generator) -> np.ndarray:
    """A solid of this kind and colour on a floor."""
    return PLAIN.take(_solid(rng, COLORS[color], SHAPES[solid]), rng)


def lamplit_solid(color: int, rng: np.random.Generator) -> np.ndarray:
    """A solid of this colour under a faint, coloured lamp."""
    solid = SHAPES[rng.integers(len(SHAPES))]
    return LAMPLIGHT.take(_solid(rng, COLORS[color], solid), rng)


def plain_target(color: int, direction: int, rng: np.random.Generator) -> np.ndarray:
    """The reacher and one coloured disc in `direction` from the middle."""
    return PLAIN.take(_reacher(color, direction, rng), rng)


def night_target(color: int, rng: np.random.Generator) -> np.ndarray:
    """The reacher in dim, coloured light, its disc anywhere."""
    return NIGHT.take(_reacher(color, int(rng.integers(8)), rng), rng)


def pad_place(direction: int, rng: np.random.Generator) -> np.ndarray:
    """The point mass and a pad in `direction` from the middle."""
    stage = point.stage()
    stage.physics.reset()  # the stage is shared: nothing of the previous picture may remain
    stage.physics.data.qpos[:] = rng.uniform(-0.25, 0.25, 2)
    distance = rng.uniform(0.09, 0.22)
    pad = _off_middle(direction, 16, distance, rng)
    lay_out(stage.physics, np.array([pad]))
    stage.physics.forward()
    frame = stage.render(stage.physics, Look.draw(rng), [COLORS[rng.integers(8)]])
    photo = Photo(blur_px=(0.3, 1.2), noise=(0.02, 0.06), contrast=(0.6, 0.9), shade=(0.0, 0.5))
    return photo.take(enlarged(frame / 255), rng)


def _reacher(color: int, direction: int, rng: np.random.Generator) -> np.ndarray:
    """The arm in any pose, and a disc in `direction` from the middle: [S, S, 3] in [0, 1]."""
    stage = reach.stage()
    stage.physics.reset()
    stage.physics.data.qpos[:] = rng.uniform(-math.pi, math.pi), rng.uniform(-2.5, 2.5)
    target = _off_middle(direction, 12, rng.uniform(0.11, 0.20), rng)
    lay_out(stage.physics, np.array([target]))
    stage.physics.forward()
    frame = stage.render(stage.physics, Look.draw(rng), [COLORS[color]])
    return enlarged(frame / 255)


def _off_middle(
    direction: int, off_deg: float, distance_m: float, rng: np.random.Generator
) -> np.ndarray:
    """A point [2] in metres in a direction from the middle, with a jitter of up to `off_deg`."""
    # Directions are 45 degrees apart; with less than half of that as jitter they stay distinct.
    angle = math.radians(direction * 45 + rng.uniform(-off_deg, off_deg))
    return distance_m * np.array([math.cos(angle), math.sin(angle)])


def enlarged(picture: np.ndarray) -> np.ndarray:
    """A square picture [s, s, 3] in [0, 1], resized bilinearly to [S, S, 3]."""
    from PIL import Image

    resized = Image.fromarray(to_bytes(picture)).resize((SIZE, SIZE), Image.Resampling.BILINEAR)
    return np.asarray(resized) / 255
