"""`libero/<suite>`: LIBERO's original tasks, for policies trained on its demonstrations.

LIBERO has no expert to record: its demonstrations were made by people, and come as data sets.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import sys
import warnings
import weakref
from collections.abc import Callable, Generator, Sequence
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from aegis_cli.common.errors import AegisError
from aegis_cli.common.gl import choose_backend
from aegis_cli.sim import libero_table as table
from aegis_cli.sim.contract import Observation, Step, checked

SIZE = 256  # pixels per side of a picture, as in the data sets
_SETTLING = 10  # idle steps before an episode begins, in which objects settle on the table
_REST = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0)  # no movement, and an open gripper
_TRIES = 20  # attempts to place a scene's objects
_NOTHING = np.zeros((SIZE, SIZE, 3), np.uint8)


@contextlib.contextmanager
def _quietly() -> Generator[None]:
    """Silence LIBERO and its simulator, and accept the folders that LIBERO proposes.

    At its first import LIBERO asks on the terminal where to keep its own data sets, which are not
    needed here, and stores the answer in `~/.libero`.
    """
    stdin, sys.stdin = sys.stdin, io.StringIO("n\n")
    # Logging that other code has disabled stays disabled.
    disabled = logging.root.manager.disable
    logging.disable(max(disabled, logging.WARNING))
    try:
        with contextlib.ExitStack() as hushed:
            hushed.enter_context(contextlib.redirect_stdout(io.StringIO()))
            hushed.enter_context(contextlib.redirect_stderr(io.StringIO()))
            hushed.enter_context(warnings.catch_warnings())
            warnings.simplefilter("ignore")
            yield
    finally:
        sys.stdin = stdin
        logging.disable(disabled)


@contextlib.contextmanager
def _all_devices_seen() -> Generator[None]:
    """Hide CUDA_VISIBLE_DEVICES, because the simulator checks MUJOCO_EGL_DEVICE_ID against it."""
    visible = os.environ.pop("CUDA_VISIBLE_DEVICES", None)
    try:
        yield
    finally:
        if visible is not None:
            os.environ["CUDA_VISIBLE_DEVICES"] = visible


choose_backend()  # before importing the simulator, which uses the current setting
import mujoco  # noqa: E402

try:
    with _quietly(), _all_devices_seen():
        from libero.libero import benchmark, get_assets_path, get_libero_path
        from libero.libero.envs import OffScreenRenderEnv
        from robosuite.utils.errors import RandomizationError
        from robosuite.utils.observables import sensor
        from robosuite.utils.transform_utils import quat2axisangle
except ImportError as error:
    raise AegisError(
        f"LIBERO cannot be imported ({error})",
        "LIBERO in Hugging Face's package (hf-libero), which its tasks need",
        "pip install 'aegis-vla[libero]'",
    ) from error
except OSError as error:
    raise AegisError(
        f"LIBERO cannot be imported ({error})",
        "a folder for its configuration, by default ~/.libero",
        "export LIBERO_CONFIG_PATH=FOLDER",
    ) from error


class LiberoTask:
    """A `contract.TaskEnv` without target colours or expert: one of LIBERO's tasks.

    An episode ends with success as LIBERO defines it. Proprioception is the position of the hand,
    its rotation as axis times angle, and the positions of the fingers. Pictures are turned by 180
    degrees, as in the data sets.

    Args:
        number: number of the episode, by which the tasks of a suite take turns.
        seen_by: names in `table.CAMERAS` that take pictures; empty for the usual one.
        published: whether the episode begins in one of the 50 states that LIBERO has published for
            each task, chosen by its number; otherwise objects are placed anew.
    """

    target_color = None

    def __init__(
        self, name: str, number: int = 0, seen_by: Sequence[str] = (), published: bool = False
    ) -> None:
        tasks = table.members(name)
        turn, self._round = number % len(tasks), number // len(tasks)
        self._suite, self._number = table.place(tasks[turn])
        self._most = table.steps(tasks[turn])
        self.spec = table.spec(name, tuple(_instruction(*table.place(task)) for task in tasks))
        self._instruction = _instruction(self._suite, self._number)
        self._seen_by = tuple(seen_by) or (self.spec.camera,)
        self._cameras = tuple(dict.fromkeys(table.CAMERAS[name] for name in self._seen_by))
        self._published = published
        # Whether a step is observed; shared with the simulator, which must not hold `self`.
        self._looks = SimpleNamespace(wanted=True)
        # Created when an episode begins and closed at its last step: it takes half a gigabyte.
        self._env: Any = None
        self._state: Any = None
        self._closing: weakref.finalize | None = None

    def reset(self, rng: np.random.Generator, target_colors: Sequence[str]) -> Observation:
        """See `contract.TaskEnv`; there are no colours."""
        self._close()
        seed = int(rng.integers(2**31))
        with _global_numbers_kept(), _quietly():
            np.random.seed(seed)
            made = _placed(lambda: _environment(self._suite, self._number, self._cameras))
            self._env = made
            self._closing = weakref.finalize(self, _close, made)
            self._closing.atexit = False  # OpenGL may be gone by then
            # Even a published state does not determine what the table stands on.
            np.random.seed(seed)
            # LIBERO's own `reset` would retry forever, after any error or signal.
            _placed(made.env.reset)
            if self._published:
                states = _states(self._suite, self._number)  # [50, numbers of a state]
                self._env.set_init_state(states[self._round % len(states)])
            self._draw_when_looked_at()
        for left in reversed(range(_SETTLING)):
            self._step(np.array(_REST), look=left == 0)
        self._steps = 0
        return self._observe()

    def step(self, action: np.ndarray, look: bool = True) -> Step:
        """See `contract.TaskEnv`. After the last step, the simulator is closed."""
        success = self._step(checked(action, len(self.spec.action_names)), look)
        self._steps += 1
        done = success or self._steps >= self._most
        step = Step(self._observe() if look else None, success, None, done)
        if done:
            self._close()
        return step

    def _step(self, control: np.ndarray, look: bool) -> bool:
        """Take a step, and return whether the task is done."""
        self._looks.wanted = look
        _make_current(self._env)
        self._state, _, success, _ = self._env.step(control)
        return bool(success)

    def _draw_when_looked_at(self) -> None:
        """Let the simulator render only the pictures that a policy sees.

        By itself it would render one per camera at every step, at its own point in time within the
        step. Rendering at the end of the step instead would give pictures unlike those that a
        policy has learned from.
        """
        simulator, looks = self._env.env, self._looks
        for camera in self._cameras:
            name = f"{camera}_image"
            drawn = simulator._observables[name]._sensor

            @sensor(modality="image")
            def seen(known: Any, drawn: Callable[[Any], np.ndarray] = drawn) -> np.ndarray:
                return drawn(known) if looks.wanted else _NOTHING

            simulator.modify_observable(name, "sensor", seen)

    def expert_action(self) -> np.ndarray:
        """Not available: LIBERO has no expert.

        Raises:
            AegisError: always.
        """
        raise AegisError(
            f"'{self.spec.name}' to be demonstrated",
            "a task with an expert: LIBERO's demonstrations were recorded by people",
            "train on a LeRobot dataset of them",
        )

    def distance(self) -> None:
        """None, because tasks are about objects, not about the position of the hand."""

    def target_circle(self) -> None:
        """None: there is no target to mark in a picture."""

    def _observe(self) -> Observation:
        state = self._state
        pictures = (state[f"{table.CAMERAS[name]}_image"] for name in self._seen_by)
        first, *more = (np.ascontiguousarray(picture[::-1, ::-1]) for picture in pictures)
        turned = quat2axisangle(state["robot0_eef_quat"].copy())  # of (x, y, z, w)
        proprio = np.concatenate([state["robot0_eef_pos"], turned, state["robot0_gripper_qpos"]])
        return Observation(first, proprio.astype(np.float32), self._instruction, tuple(more))

    def _close(self) -> None:
        if self._closing is not None:
            self._closing()
            self._env, self._closing, self._state = None, None, None


def _make_current(env: Any) -> None:
    """Make this simulator's OpenGL context current, instead of another simulator's."""
    env.sim._render_context_offscreen.gl_ctx.make_current()


def _close(env: Any) -> None:
    _make_current(env)  # otherwise another one's textures would be freed and its pictures be black
    env.close()


@contextlib.contextmanager
def _global_numbers_kept() -> Generator[None]:
    """Restore NumPy's global random state, which LIBERO uses, after the block."""
    before = np.random.get_state()
    try:
        yield
    finally:
        np.random.set_state(before)


def _environment(suite: str, number: int, cameras: Sequence[str]) -> Any:
    described = _file(suite, number, "bddl_files", "bddl_file")
    _share_display()
    return OffScreenRenderEnv(
        bddl_file_name=str(described),
        camera_names=list(cameras),
        camera_heights=SIZE,
        camera_widths=SIZE,
    )


def _share_display() -> None:
    """Let LIBERO's simulator render on the EGL display that MuJoCo itself uses.

    Its own choice depends on CUDA_VISIBLE_DEVICES, which may be empty or contain names, and it
    would terminate the display before other renderers are closed.
    """
    theirs: Any = sys.modules.get("robosuite.renderers.context.egl_context")
    if theirs is not None and theirs.EGL_DISPLAY is None:
        context = mujoco.GLContext(8, 8)  # opens the display if it is not open yet
        context.free()
        theirs.EGL_DISPLAY = sys.modules["mujoco.egl"].EGL_DISPLAY


def _placed(draw: Callable[[], Any]) -> Any:
    """The result of `draw`, repeated until LIBERO finds random places for all objects.

    Raises:
        AegisError: it has failed too often.
    """
    for _ in range(_TRIES):
        with contextlib.suppress(RandomizationError):
            return draw()
    raise AegisError(
        f"no places for a scene's objects in {_TRIES} tries of LIBERO's",
        "places that do not overlap",
        "use another --seed",
    )


@cache
def _benchmark(suite: str) -> Any:
    _check_assets()
    with _quietly():
        return benchmark.get_benchmark(f"libero_{suite}")()


def _instruction(suite: str, number: int) -> str:
    return _benchmark(suite).get_task(number).language


@cache
def _states(suite: str, number: int) -> np.ndarray:
    """The published initial simulator states [50, S] of a task."""
    path = _file(suite, number, "init_states", "init_states_file")
    # The files are part of LIBERO's own package and contain NumPy arrays, which need pickle.
    return np.asarray(torch.load(path, weights_only=False))


def _file(suite: str, number: int, kind: str, name: str) -> Path:
    """A task's file in LIBERO's folder for a kind of file, which its configuration names.

    Raises:
        AegisError: the configuration was written by another installation, which no longer exists.
    """
    task = _benchmark(suite).get_task(number)
    path = Path(get_libero_path(kind)) / task.problem_folder / getattr(task, name)
    if not path.is_file():
        folder = os.environ.get("LIBERO_CONFIG_PATH", "~/.libero")
        raise AegisError(
            f"no file '{path}'",
            f"LIBERO's files where {folder}/config.yaml says that they are",
            "delete that file: LIBERO writes it again when it is next imported",
        )
    return path


def _check_assets() -> None:
    """Raise AegisError unless LIBERO's meshes exist or can be downloaded from the hub."""
    with contextlib.redirect_stdout(io.StringIO()):  # the hub's own progress is on stderr
        folder = get_assets_path()
    if not os.path.isdir(folder):
        raise AegisError(
            f"no folder '{folder}'",
            "LIBERO's meshes and textures, which it could not fetch from the Hugging Face hub",
            "run this once with a network, or put the folder 'assets' of LIBERO's repository there",
        )
