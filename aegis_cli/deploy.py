"""A trained policy for your own program: pictures, instruction and positions in, actions out.

    policy = load_policy("runs/x")
    policy.reset()  # a new episode
    action = policy.select_action(frame, "go to the red target", positions)

A LeRobot observation, or that of a LeRobot robot, can be given instead of pictures and positions:

    action = policy.select_action(robot.get_observation(), "go to the red target")
    robot.send_action(policy.named(action))

The methods have the names of LeRobot's policy methods. All values are in the units of the
demonstrations.
"""

from __future__ import annotations

import copy
import logging
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from aegis_cli.common import devices
from aegis_cli.common.errors import AegisError, in_short
from aegis_cli.common.pictures import fit
from aegis_cli.continual import places, robots
from aegis_cli.core import ensemble as temporal
from aegis_cli.core.continuation import Continued
from aegis_cli.core.ensemble import TemporalEnsemble
from aegis_cli.data.far_positions import FarPositions
from aegis_cli.data.lerobot import layout, observation
from aegis_cli.data.selection import listed
from aegis_cli.evaluation.rollout import load_run
from aegis_cli.models.acting import Acting
from aegis_cli.models.policy import Policy, check_actions
from aegis_cli.recipes import is_robot_stream_run
from aegis_cli.training import checkpoint

_ORDER = "the order is: pictures, instruction, positions"
Pictures = np.ndarray | Mapping[str, np.ndarray]
Positions = Sequence[float] | np.ndarray
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Seen:
    """A policy's input: pictures in the backbone's order, text, and positions [P] float32."""

    pictures: list[np.ndarray]
    instruction: str
    positions: np.ndarray

    def copy(self) -> Seen:
        """A copy that shares no memory."""
        pictures = [picture.copy() for picture in self.pictures]
        return Seen(pictures, self.instruction, self.positions.copy())


class DeployedPolicy:
    """A robot's policy, loaded and ready to act.

    Attributes:
        task: the task that it was trained on; None for a dataset of no simulated task.
        in_stream: the name that a stream gives such a task; None outside a stream.
        cameras: names of the pictures that it takes, in order; empty for a single unnamed picture.
        sizes: (height, width) of the pictures that it was trained on, one per camera; empty if
            unknown, or if the backbone reads squares of `image_size`.
        positions, actions: P and A, the sizes of the two vectors.
        chunk: how many actions are predicted at once, of which `replan` are executed.
        ensemble: the decay of the temporal ensemble (see `core.ensemble`), which predicts at every
            step; None without one.
        action_names, state_names: of the A actions and the P positions, in order; None if the
            demonstrations had no names, or the policy is older than this feature.
        state: the features of the demonstrations that make up the positions, usually
            `observation.state`. `predict_action_chunk` reads them from an observation that has all
            of them.
        fps: actions per second, equal to the frame rate of the demonstrations; None if unknown.
    """

    def __init__(
        self,
        policy: Policy,
        task: str | None,
        cameras: Sequence[str],
        replan: int,
        seed: int = 0,
        sizes: Sequence[tuple[int, int]] = (),
        recorded: Mapping[str, Any] | None = None,
        ensemble: float | None = None,
        in_stream: str | None = None,
    ) -> None:
        """Begin the first episode.

        Args:
            recorded: what a checkpoint's meta says of the demonstrations: `action_names`,
                `proprio_names`, `state`, `fps`, `normalization` and `proprio_reach`, each only if
                it is known.
            ensemble: decay of a temporal ensemble; `replan` is then always 1.
            in_stream: see the attribute.
        """
        self._policy, self._generator = policy, torch.Generator()
        self.task, self.cameras, self._seed = task, tuple(cameras), seed
        self.in_stream = in_stream
        self.ensemble, self.replan = ensemble, replan if ensemble is None else 1
        self.sizes = tuple(sizes)
        self.positions, self.actions = len(policy.proprio_scale.mean), len(policy.action_scale.mean)
        self.chunk = policy.expert.shape.chunk
        known = recorded or {}
        self.action_names = _names(known.get("action_names"))
        self.state_names = _names(known.get("proprio_names"))
        self.state = tuple(listed(known.get("state", layout.STATE)))
        self.fps: float | None = known.get("fps")
        self._far = FarPositions(
            policy.proprio_scale,
            self.state_names,
            known.get("normalization", "mean_std"),
            known.get("proprio_reach"),
        )
        self._tell: Callable[[str], object] = _log.warning
        # A backbone records what its modules do in a pass, and would mix up two at once.
        self._one_at_a_time = threading.Lock()
        self.reset()

    def __repr__(self) -> str:
        seen = ", ".join(self.cameras) or "one picture"
        return (
            f"<policy of {self.task or 'a robot'}: {seen} and {self.positions} positions to "
            f"{self.chunk} x {self.actions} actions, {self.replan} of them executed>"
        )

    @property
    def precision(self) -> str:
        """Of the matrix products: bf16 or float32."""
        return self._policy.acts_in

    @property
    def image_size(self) -> int | None:
        """The side in pixels of the squares that the backbone reads; None: it reads any size."""
        return self._policy.backbone.image_size

    def check_instruction(self, text: str) -> None:
        """Raise AegisError for an instruction that the backbone cannot read."""
        self._policy.backbone.check_prompt(text)

    def begin(self, tell: Callable[[str], object] | None = None) -> DeployedPolicy:
        """The same policy at the start of a separate episode; the weights are shared.

        Several of them may be used from several threads; they wait for each other.

        Args:
            tell: called with a warning about positions far from those of the training; None: the
                warning is logged.
        """
        other = copy.copy(self)
        other._generator, other._far = torch.Generator(), self._far.anew()
        other._tell = _log.warning if tell is None else tell
        other.reset()
        return other

    def reset(self) -> None:
        """Begin an episode: forget the last prediction, and restart the flow's noise."""
        self._ahead: deque[np.ndarray] = deque()
        self._averaged = None if self.ensemble is None else TemporalEnsemble(self.ensemble)
        self._follows: str | None = None  # the instruction of the last prediction
        self._generator.manual_seed(self._seed)

    def select_action(
        self,
        pictures: Pictures | Mapping[str, Any],
        instruction: str | None = None,
        positions: Positions | None = None,
    ) -> np.ndarray:
        """The next action [A]; every `replan`-th call predicts, the others continue its chunk.

        With a temporal ensemble each call predicts, and the action is the weighted mean of the
        predictions made for it so far. A changed instruction predicts at once, and drops what is
        left of earlier predictions.

        Args:
            pictures, instruction, positions: see `predict_action_chunk`.

        Raises:
            AegisError: as in `predict_action_chunk`, at each call: a robot whose sensor fails does
                not continue on an older prediction.
        """
        seen = self.read(pictures, instruction, positions)
        if seen.instruction != self._follows:
            self._ahead.clear()
            if self._averaged is not None:
                self._averaged.reset()
        if self._averaged is not None:
            action = self._averaged.next(torch.from_numpy(self.predict(seen)))
            self._follows = seen.instruction
            return action.numpy()
        if not self._ahead:
            self._ahead.extend(self.predict(seen)[: self.replan])
            self._follows = seen.instruction
        return self._ahead.popleft()

    def predict_action_chunk(
        self,
        pictures: Pictures | Mapping[str, Any],
        instruction: str | None = None,
        positions: Positions | None = None,
        previous: np.ndarray | None = None,
        delay: int | np.integer = 0,
    ) -> np.ndarray:
        """The next actions [H, A] float32.

        A robot that moves while it waits for them passes the actions it is executing (`previous`),
        and gets a chunk that continues them: real-time chunking, see `core.continuation`. It
        executes `delay` of its own actions until the chunk arrives, and then the chunk's actions
        from index `delay` on. `RealTime` does all of this.

        Args:
            pictures: RGB [H, W, 3] uint8 of any size, which are resized to the size that the
                backbone was trained on; one picture, or a mapping from camera names, with or
                without LeRobot's prefix `observation.images.`. Without positions, a whole
                observation as `data.lerobot.observation` reads it.
            instruction: a text in words that the backbone knows; None: the observation's `task`.
            positions: proprioception [P], in the demonstrations' order; None: the observation's.
            previous: the rest of the last chunk at this observation [n, A], n <= H; None: nothing.
            delay: how many of these actions are executed before the new chunk arrives.

        Raises:
            AegisError: pictures or numbers differ from those it was trained on, the backbone does
                not know a word, or predicted actions are not finite.
        """
        seen = self.read(pictures, instruction, positions)
        return self.predict(seen, self._continued(previous, delay))

    def named(self, action: np.ndarray) -> dict[str, float]:
        """The numbers of an action [A] by name, as for a robot's `send_action`.

        Raises:
            AegisError: the policy does not know the names, or the action has another size.
        """
        if self.action_names is None:
            raise AegisError(
                "a policy that does not know the names of its actions",
                "demonstrations that name each number of their actions",
                "name the numbers in your program, in the demonstrations' order",
            )
        if np.shape(action) != (self.actions,):
            raise AegisError(
                f"an action of shape {np.shape(action)}",
                f"({self.actions},): {', '.join(self.action_names)}",
                "give one action; a chunk has one per row",
            )
        found = {name: float(x) for name, x in zip(self.action_names, action, strict=True)}
        if len(found) < len(action):
            raise AegisError(
                f"a policy with several actions of one name among {', '.join(self.action_names)}",
                "a name of its own for each number",
                "name the numbers in your program, in the demonstrations' order",
            )
        return found

    @devices.cpu_by_default()
    def predict(self, seen: Seen, continued: Continued | None = None) -> np.ndarray:
        """The next actions [H, A] float32 for what `read` returned.

        Raises:
            AegisError: they are not finite.
        """
        # In a caller's inference mode nothing could be differentiated.
        with self._one_at_a_time, torch.inference_mode(mode=False):
            frames = [torch.from_numpy(self._fitted(p, i)) for i, p in enumerate(seen.pictures)]
            images = [tuple(frames)] if len(frames) > 1 else frames[0][None]
            proprio, texts = torch.from_numpy(seen.positions)[None], [seen.instruction]
            acted = self._policy.act(images, texts, proprio, self._generator, continued)
        return check_actions(acted[0].cpu()).numpy()

    def _continued(self, previous: np.ndarray | None, delay: int | np.integer) -> Continued | None:
        """What a chunk has to continue; None if nothing is left.

        Raises:
            AegisError: `previous` cannot be the end of a chunk, or the delay is longer than it.
        """
        nothing = np.zeros((0, self.actions), np.float32)
        left = nothing if previous is None else _numbers(previous, "actions")
        if left.ndim != 2 or left.shape[1] != self.actions or len(left) > self.chunk:
            raise AegisError(
                f"previous actions of shape {left.shape}",
                f"(n, {self.actions}), with n at most {self.chunk}",
                "give what is left of the last chunk",
            )
        if not np.isfinite(left).all():
            raise AegisError(
                "previous actions that are not finite",
                "finite numbers",
                "give the actions as the policy predicted them",
            )
        if previous is None and delay:
            raise AegisError(
                f"a delay of {delay} actions, and no previous actions",
                "what is left of the last chunk, whose actions are executed in the meantime",
                "give previous=, or previous_actions in a message to aegis serve",
            )
        whole = isinstance(delay, int | np.integer) and delay >= 0
        if not whole or delay > len(left):
            later = "ask for the next chunk earlier, so that more are left"
            raise AegisError(
                f"a delay of {delay} actions, where {len(left)} are left of the last chunk",
                f"a whole number from 0 to {len(left)}",
                later if whole else "count the actions that are executed in the meantime",
            )
        return Continued(torch.from_numpy(left)[None], int(delay)) if len(left) else None

    def read(
        self,
        pictures: Pictures | Mapping[str, Any],
        instruction: str | None = None,
        positions: Positions | None = None,
    ) -> Seen:
        """The input of `predict`, from the same arguments as `predict_action_chunk`.

        Warns once of each position that is far from those of the training, which may be in other
        units.

        Raises:
            AegisError: pictures or numbers differ from those the policy was trained on.
        """
        if positions is None:
            if not isinstance(pictures, Mapping):
                raise AegisError("no positions", f"numbers [{self.positions}]", _ORDER)
            seen = observation.read(pictures, self.cameras, self.state_names, self.state)
            pictures, positions = seen.pictures, seen.positions
            if instruction is None:
                instruction = seen.task
            if instruction is None:
                raise AegisError(
                    "no instruction",
                    "a text: the second argument, or 'task' in the observation",
                    'give one, as in select_action(observation, "go to the red target")',
                )
        given = _numbers(positions)
        if given.shape != (self.positions,):
            raise AegisError(
                f"positions of shape {given.shape}",
                f"({self.positions},){_after_colon(self.state_names)}",
                "give the positions that the demonstrations have, in their order",
            )
        if not np.isfinite(given).all():
            raise AegisError(
                f"positions that are not finite: {given.tolist()}",
                "finite numbers",
                "check the robot's sensors",
            )
        if not isinstance(instruction, str):
            found = f"an instruction of type {type(instruction).__name__}"
            raise AegisError(found, "a text", f"give one str; {_ORDER}")
        if not instruction.strip():
            raise AegisError("a blank instruction", "what the robot should do", _ORDER)
        shown = self._in_order(pictures)
        several = len(self.cameras) > 1
        names = [f" of {name}" for name in self.cameras] if several else [""]
        found = [_picture(of, picture) for of, picture in zip(names, shown, strict=True)]
        if (far := self._far.notice(given)) is not None:
            self._tell(far)
        return Seen(found, instruction, given)

    def _in_order(self, pictures: Pictures) -> list[np.ndarray]:
        """The pictures in the backbone's order."""
        if isinstance(pictures, Mapping):
            named = {layout.short(name): picture for name, picture in pictures.items()}
            names = [layout.short(name) for name in self.cameras]
            if len(named) != len(pictures) or set(named) != set(names):
                expected = ", ".join(self.cameras) or "one picture without a name"
                raise AegisError(
                    f"pictures of {', '.join(pictures) or 'no camera'}",
                    expected,
                    "use the names of training",
                )
            return [named[name] for name in names]
        if len(self.cameras) > 1:
            expected = f"{{name: picture}} with {', '.join(self.cameras)}"
            raise AegisError(
                f"one picture for a policy of {len(self.cameras)} cameras",
                expected,
                "give one per camera",
            )
        return [pictures]

    def _fitted(self, picture: np.ndarray, camera: int) -> np.ndarray:
        """The picture of camera number `camera`, resized to the size used in training."""
        side = self.image_size
        if side is not None:
            picture = fit(picture, side, side)
        elif self.sizes:
            picture = fit(picture, *self.sizes[camera])
        # PyTorch accepts no negative strides, and warns of read-only memory, such as a file's
        # pixels. Such pictures are copied.
        return np.require(picture, requirements=["C_CONTIGUOUS", "WRITEABLE"])


def _numbers(given: Positions, what: str = "positions") -> np.ndarray:
    """Positions or actions as float32.

    Raises:
        AegisError: they are not numbers.
    """
    try:
        return np.asarray(given, dtype=np.float32)
    except (TypeError, ValueError) as error:  # a text, or lists of several lengths
        found = f"{what} of type {type(given).__name__}: {in_short(error)}"
        raise AegisError(found, f"numbers, one for each of the {what}", _ORDER) from error


def _picture(of: str, given: np.ndarray) -> np.ndarray:
    """One camera's picture.

    Args:
        of: which camera it is from, for an error.

    Raises:
        AegisError: it is no picture.
    """
    found = np.asarray(given)
    is_picture = found.ndim == 3 and found.shape[2] == 3 and found.dtype == np.uint8
    if not is_picture or 0 in found.shape:
        said = f"a picture{of} of shape {found.shape} and type {found.dtype}"
        fix = "channels come last, values are 0 to 255"
        if is_picture:
            fix = "check that the camera delivered a frame"
        raise AegisError(said, "[H, W, 3] uint8, RGB, of at least one pixel", fix)
    return found


def _after_colon(names: tuple[str, ...] | None) -> str:
    return "" if names is None or not any(names) else f": {', '.join(names)}"


def _names(given: Sequence[str] | None) -> tuple[str, ...] | None:
    return None if given is None else tuple(given)


@torch.inference_mode(mode=False)  # weights made in inference mode cannot be differentiated through
@devices.cpu_by_default()
def load_policy(
    run: str | Path,
    task: str | None = None,
    seed: int = 0,
    precision: str = devices.AUTO,
    ensemble: float | None = None,
    backbone: str | None = None,
) -> DeployedPolicy:
    """Load the policy of a run, on the GPU if there is one.

    Args:
        run: what `aegis train` or `aegis export` wrote, or the id on the hub of a policy that
            `aegis push` sent.
        task: which one, if the run is a stream of robot tasks.
        seed: seed of the flow's initial noise.
        precision: of matrix products, bf16 or float32; auto is bf16 on a GPU that supports it, as
            in training. The returned actions are float32.
        ensemble: decay of a temporal ensemble; None: the setting that the policy was trained with,
            which is no ensemble unless its recipe has `rollout.ensemble`.
        backbone: the new place of the backbone of a stream of robot tasks, if it has moved.

    Raises:
        AegisError: there is no run, files are missing, broken or from different checkpoints, the
            task was not learned, or the decay is not finite.
    """
    if ensemble is not None:
        temporal.check(ensemble)
    folder, device = Path(run), devices.pick()
    acts_in = devices.acting_precision(device, precision)
    if is_robot_stream_run(folder):
        return _of_stream(folder, task, device, acts_in, seed, ensemble, backbone)
    if backbone is not None:
        raise places.refuse(folder)
    policy, meta = checkpoint.load_policy(folder)
    checkpoint.check_task(meta, task)
    policy.acts_in = acts_in
    return DeployedPolicy(
        policy.to(device),
        meta["task"],
        meta.get("cameras", ()),
        meta["replan"],
        seed,
        checkpoint.sizes_of(meta),
        meta,
        meta.get("ensemble") if ensemble is None else ensemble,
    )


def _of_stream(
    folder: Path,
    task: str | None,
    device: torch.device,
    acts_in: str,
    seed: int,
    ensemble: float | None,
    backbone: str | None,
) -> DeployedPolicy:
    """The policy of one task of a stream."""
    number = robots.number_of(folder, task)
    run = robots.load_to_act(folder, backbone)
    policy = run.policies[number]
    policy.acts_in = acts_in
    view, normalization = run.views[number], run.recipe.train.normalization
    if run.recipe.simulated:
        found = run.acting(number)
        # A single picture needs no name.
        cameras = found.cameras if len(found.cameras) > 1 else ()
        known = {"normalization": normalization, "proprio_reach": view.get("proprio_reach")}
        decay = found.ensemble if ensemble is None else ensemble
        return DeployedPolicy(
            policy.to(device), found.task, cameras, found.replan, seed, found.sizes, known, decay
        )
    run.activate(number)
    settings = run.recipe.rollout
    decay = settings.ensemble if ensemble is None else ensemble
    cameras = view.get("cameras", ())
    sizes = checkpoint.sizes_of(view)
    known = {**view, "normalization": normalization}
    return DeployedPolicy(
        policy.eval().to(device),
        None,
        cameras,
        settings.replan,
        seed,
        sizes,
        known,
        decay,
        in_stream=run.names[number],
    )


def load_acting(run: Path, task: str | None, backbone: str | None = None) -> Acting:
    """Load what `aegis rollout` runs: the policy of a training run, or of one task of a stream.

    Args:
        backbone: as in `load_policy`.

    Raises:
        AegisError: there is no such run, or it has not learned the task.
    """
    if is_robot_stream_run(run):
        return robots.load_policy(run, task, backbone)
    if backbone is not None:
        raise places.refuse(run)
    return load_run(run, task)
