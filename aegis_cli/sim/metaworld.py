"""`metaworld/<task>`: the benchmark's original tasks; its scripted policies are the experts."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from aegis_cli.common.errors import AegisError
from aegis_cli.sim import metaworld_table as table
from aegis_cli.sim.coarse import coarse
from aegis_cli.sim.contract import METAWORLD, Observation, Step, checked
from aegis_cli.sim.screen import Screen

import mujoco  # isort: skip  (after screen, which chooses the OpenGL backend)

try:
    from metaworld.env_dict import ENV_CLS_MAP
    from metaworld.policies import ENV_POLICY_MAP
except ImportError as error:
    raise AegisError(
        f"no package '{error.name}'",
        "MetaWorld, which its tasks need",
        "pip install 'aegis-vla[metaworld]'",
    ) from error

# The camera position in metres that is usual for visual policies on MetaWorld (Seo et al. 2022,
# arXiv 2206.14244; LeRobot): nearer to the table than the benchmark's own.
_CAMERA_M = (0.75, 0.075, 0.7)
# The benchmark's own values for the weld between the hand and the body that actions move: anchor,
# position, quaternion and torque scale. From MuJoCo 3.17 on there is a twelfth value, which is 0
# for a weld with explicit values.
_WELD = (0, 0, 0, 0, 0, 0, -1, 0, 0, 0, 5)
# The robot's meshes have 70,000 faces, so rendering takes nearly all the time of a step. A pixel
# covers 15 mm of the table. Objects have fewer faces and are drawn as they are.
_CELL_M, _LEAST_FACES = 0.01, 2000
_VERSION = "-v3"  # suffix of the benchmark's names

# All that the benchmark modifies in a model: positions [bodies, 3] and [sites, 3], in metres.
Places = tuple[np.ndarray, np.ndarray]


class MetaWorldTask:
    """A `contract.TaskEnv` without target colours: one of the benchmark's tasks.

    Objects and goals are placed anew in each episode. An episode ends with success as the benchmark
    defines it. Proprioception is the position of the hand and the opening of the gripper, the first
    four of the benchmark's observations; only the expert is told where the objects are.

    Args:
        number: number of the episode, by which the tasks of a set take turns.
        seen_by: the benchmark's cameras that take pictures; empty for the usual one.
    """

    target_color = None

    def __init__(self, name: str, number: int = 0, seen_by: Sequence[str] = ()) -> None:
        tasks = table.members(name)
        task = tasks[number % len(tasks)]
        self.spec = table.spec(name)
        self._sentences = table.sentences(task)
        self._env = _environment(task)
        self._stage = _stage(self._env.model_name)
        self._seen_by = tuple(seen_by) or (self.spec.camera,)
        self._places = self._stage.initial
        self._policy = ENV_POLICY_MAP[_published(task)]()

    def reset(self, rng: np.random.Generator, target_colors: Sequence[str]) -> Observation:
        """See `contract.TaskEnv`; there are no colours."""
        self._env.seed(int(rng.integers(2**31)))
        # The benchmark lets the hand come to rest before it places the objects anew. It must not
        # touch those of the previous episode.
        _put(self._env.model, self._stage.initial)
        self._env.reset()
        self._places = _places(self._env.model)
        # Without this, the benchmark would report the objects' previous positions.
        mujoco.mj_forward(self._env.model, self._env.data)
        self._state = self._env._get_obs()
        self._steps = 0
        self._instruction = str(rng.choice(list(self._sentences)))
        return self._observe()

    def _observe(self) -> Observation:
        first, *more = (self._picture(camera) for camera in self._seen_by)
        proprio = self._state[: len(self.spec.proprio_names)].astype(np.float32)
        return Observation(first, proprio, self._instruction, tuple(more))

    def _picture(self, camera: str) -> np.ndarray:
        """[64, 64, 3] uint8."""
        model = self._env.model
        number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
        picture = self._stage.screen.render(model, self._env.data, number)
        # This camera is upside down.
        return np.ascontiguousarray(picture[::-1, ::-1]) if camera == table.CAMERA else picture

    def step(self, action: np.ndarray, look: bool = True) -> Step:
        """See `contract.TaskEnv`."""
        control = checked(action, len(self.spec.action_names))
        _put(self._env.model, self._places)
        self._state, _, _, _, info = self._env.step(control)
        self._steps += 1
        success = bool(info["success"])
        done = success or self._steps >= self.spec.max_steps
        return Step(self._observe() if look else None, success, None, done)

    def expert_action(self) -> np.ndarray:
        """The scripted policy's action [4] float32, clipped as the benchmark clips it."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about clipped actions
            action = self._policy.get_action(self._state)
        return np.clip(action, -1.0, 1.0).astype(np.float32)

    def distance(self) -> None:
        """None, because most tasks are about an object, not about the position of the hand."""

    def target_circle(self) -> None:
        """None: there is no target to mark in a picture."""


def _published(task: str) -> str:
    return task.removeprefix(METAWORLD) + _VERSION


def _environment(task: str) -> Any:
    """A new environment of the benchmark, whose goals depend on its seed.

    All environments of a task share one model, because its textures make it large. Each writes the
    positions of its objects to it before each use.
    """
    cls = ENV_CLS_MAP[_published(task)]
    ours = {"_initialize_simulation": _shared_simulation, "reset_mocap_welds": _nothing}
    env = type(cls.__name__, (cls,), ours)()
    # The benchmark's own ways to set these fix the goals, or draw them from NumPy's global
    # generator. The expert has to be told the goal, as in the benchmark's multi-task sets.
    env._set_task_called = True
    env._partially_observable = False
    del env.sawyer_observation_space  # it was computed for a hidden goal
    env._freeze_rand_vec, env.seeded_rand_vec = False, True
    return env


def _shared_simulation(env: Any) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Replaces a method of gymnasium that compiles the model each time."""
    model = _stage(env.model_name).model
    return model, mujoco.MjData(model)


def _nothing(env: Any) -> None:
    """Replaces a method that sets welds, but fails from MuJoCo 3.17 on."""


@dataclass(frozen=True)
class _Stage:
    """One compiled model and one rendering context, shared by all environments of a file."""

    model: mujoco.MjModel
    screen: Screen
    initial: Places


@cache
def _stage(path: str) -> _Stage:
    model = mujoco.MjModel.from_xml_path(path)
    camera = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, table.CAMERA)
    model.cam_pos[camera] = _CAMERA_M
    for weld in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_WELD):
        model.eq_data[weld] = 0
        model.eq_data[weld, : len(_WELD)] = _WELD
    drawn = coarse(model, _CELL_M, _LEAST_FACES)
    return _Stage(model, Screen(drawn, camera), _places(model))


def _places(model: mujoco.MjModel) -> Places:
    return model.body_pos.copy(), model.site_pos.copy()


def _put(model: mujoco.MjModel, places: Places) -> None:
    model.body_pos[:], model.site_pos[:] = places
