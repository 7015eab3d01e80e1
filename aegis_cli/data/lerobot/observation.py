"""A robot's observation at one step as one mapping, in LeRobot's form.

Two kinds are read:

- LeRobot's observation, from a dataset's frame or from its processors: `observation.images.top`,
  `observation.state`, `task`.
- The result of a robot's `get_observation()`: a number for each motor (`shoulder_pan.pos`) and a
  picture for each camera (`top`). LeRobot's `hw_to_dataset_features` turns these into a dataset's
  features: the motors' names become those of `observation.state`, and cameras get the prefix
  `observation.images.`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from aegis_cli.common.errors import AegisError
from aegis_cli.data.lerobot import layout

TASK = "task"
_OBSERVED = "observation."  # prefix of LeRobot's names of observations
_PICTURES = "observation.image"  # prefix of its pictures: `observation.images.top`, or PushT's


@dataclass(frozen=True)
class Observed:
    """A policy's input.

    Attributes:
        pictures: each camera's picture by its name in the policy, or the only one, as returned by
            `picture`.
        positions: [P] numbers.
        task: the instruction, if the observation has one.
    """

    pictures: Any
    positions: Any
    task: str | None


def is_one(
    mapping: Mapping[Any, Any],
    state_names: Sequence[str] | None,
    state: Sequence[str] = (layout.STATE,),
) -> bool:
    """Whether a mapping has a key of LeRobot's observation or of a motor, or all of `state`."""
    motors = state_names or ()
    keys = [key for key in mapping if isinstance(key, str)]
    named = any(key.startswith(_OBSERVED) or key in motors for key in keys)
    return named or all(name in keys for name in state)


def read(
    observation: Mapping[str, Any],
    cameras: Sequence[str],
    state_names: Sequence[str] | None,
    state: Sequence[str] = (layout.STATE,),
) -> Observed:
    """The pictures, the positions and the task of an observation of either kind.

    Pictures of further cameras and texts other than the task are ignored; so is, in LeRobot's
    observation, every other key, such as `action` or `timestamp` of a dataset's frame.

    Args:
        cameras: the policy's cameras, in order; empty for one picture of any name.
        state_names: names of the policy's positions, in order; None if it does not know them.
        state: the features that its positions were made from in its demonstrations. If an
            observation has all of these, they are read; otherwise `observation.state` holds them
            concatenated.

    Raises:
        AegisError: cameras or positions are missing, or unknown to the policy.
    """
    observation = {key: value for key, value in observation.items() if isinstance(key, str)}
    read_from = state if all(name in observation for name in state) else (layout.STATE,)
    if all(name in observation for name in read_from):
        parts = [_unbatched(_array(observation[name]), 1) for name in read_from]
        # A single feature keeps its shape, so that the policy can report a wrong one.
        positions = parts[0] if len(parts) == 1 else np.concatenate([p.reshape(-1) for p in parts])
        shown = {name: v for name, v in observation.items() if _is_picture(name, cameras)}
        shown = _known(shown, cameras)
        _check(shown, cameras, [layout.STATE], [layout.STATE])
    else:
        if state_names is None:
            raise AegisError(
                f"an observation of {_listed(observation)}, and a policy that does not know the "
                "names of its positions",
                f"'{layout.STATE}' in the observation",
                f"put the positions there, in the demonstrations' order, and the pictures at "
                f"'{layout.CAMERA}NAME'",
            )
        # A robot's own keys do not show their kind: values with several dimensions are pictures.
        kinds = {name: _dimensions(value) for name, value in observation.items()}
        _check_frames(observation, kinds, cameras, state_names)
        shown = {name: observation[name] for name, count in kinds.items() if count > 1}
        shown = _known(shown, cameras)
        told = [name for name, count in kinds.items() if 0 <= count < 2 and name != TASK]
        _check(shown, cameras, told, state_names)
        positions = np.array([_number(name, observation[name]) for name in state_names], np.float32)
    own = {layout.short(name): name for name in cameras}  # in the policy's names
    named = {}
    for name, value in shown.items():
        named[own.get(layout.short(name), name)] = picture(name, value)
    pictures = named if cameras else next(iter(named.values()))
    return Observed(pictures, positions, _task(observation))


def picture(name: str, given: Any) -> np.ndarray:
    """Convert a picture from a camera or from LeRobot's processors to RGB [H, W, 3] uint8.

    Args:
        given: [H, W, 3] uint8, or [3, H, W] of floats in [0, 1] or uint8; each with or without a
            leading dimension of 1.

    Raises:
        AegisError: floats have another range or shape.
    """
    found = _unbatched(_array(given), 3)
    if found.dtype.kind != "f":
        # If both outer dimensions are 3, channels last, as from cameras, is more likely.
        first = found.ndim == 3 and found.shape[0] == 3 != found.shape[2]
        return np.ascontiguousarray(found.transpose(1, 2, 0)) if first else found
    # Comparisons with NaN are false, too.
    if found.ndim != 3 or found.shape[0] != 3 or not ((found >= 0) & (found <= 1)).all():
        span = f" from {found.min():g} to {found.max():g}" if found.size else ""
        raise AegisError(
            f"'{name}' of shape {found.shape} and type {found.dtype}{span}",
            "[H, W, 3] uint8, or [3, H, W] floats from 0 to 1",
            "give it as the camera or LeRobot's processor gives it, without normalizing it",
        )
    return np.ascontiguousarray((found * 255).round().astype(np.uint8).transpose(1, 2, 0))


def _is_picture(name: str, cameras: Sequence[str]) -> bool:
    """Whether a key of LeRobot's observation belongs to a picture."""
    return name.startswith(_PICTURES) or name in cameras


def _known(shown: dict[str, Any], cameras: Sequence[str]) -> dict[str, Any]:
    """The pictures of the policy's cameras if all are there; a robot may have further cameras."""
    wanted = {layout.short(name) for name in cameras}
    known = {name: value for name, value in shown.items() if layout.short(name) in wanted}
    return known if wanted and wanted <= {*map(layout.short, known)} else shown


def _array(given: Any) -> np.ndarray:
    if isinstance(given, torch.Tensor):
        held = given.detach().cpu()
        if held.is_floating_point():
            held = held.float()  # NumPy has no bfloat16
        return held.numpy()
    try:
        return np.asarray(given)
    except ValueError as error:  # lists of several lengths
        found = f"a value of an observation that is not an array: {error}"
        raise AegisError(found, "an array or a tensor", "give what the robot returns") from error


def _unbatched(given: np.ndarray, dimensions: int) -> np.ndarray:
    """Remove a batch dimension of size 1; everything else is returned unchanged."""
    return given[0] if given.ndim == dimensions + 1 and len(given) == 1 else given


def _dimensions(value: Any) -> int:
    """The number of dimensions of a robot's value; -1 for a text, 0 for anything but arrays."""
    if isinstance(value, str):
        return -1
    return int(getattr(value, "ndim", 0))


def _check_frames(
    observation: Mapping[str, Any],
    kinds: Mapping[str, int],
    cameras: Sequence[str],
    motors: Sequence[str],
) -> None:
    """Raise AegisError if a camera of the policy has returned something else than a picture.

    Args:
        kinds: the number of dimensions of each value.
    """
    wanted = {layout.short(name) for name in cameras}
    for name, count in kinds.items():
        if layout.short(name) in wanted and count < 2 and name not in motors:
            given = observation[name]
            shape = f" of shape {tuple(given.shape)}" if count > 0 else ""
            raise AegisError(
                f"'{name}' is {type(given).__name__}{shape}",
                "a picture: an array or a tensor [H, W, 3]",
                "check that the camera delivered a frame; for a Pillow image: np.asarray(image)",
            )


def _number(name: str, value: Any) -> float:
    try:
        return float(_array(value).item())
    except (TypeError, ValueError) as error:
        raise AegisError(
            f"'{name}' is {type(value).__name__}", "a number", "give what the robot returns"
        ) from error


def _task(observation: Mapping[str, Any]) -> str | None:
    """The text at `task`, which LeRobot's processors put into a list; None if it is empty."""
    found = observation.get(TASK)
    if isinstance(found, list | tuple) and len(found) == 1:
        found = found[0]
    return found if isinstance(found, str) and found.strip() else None


def _check(
    shown: Iterable[str], cameras: Sequence[str], told: Sequence[str], positions: Sequence[str]
) -> None:
    """Raise AegisError unless these are exactly the policy's cameras and positions."""
    seen = [layout.short(name) for name in shown]
    wanted = [layout.short(name) for name in cameras]
    is_only = not cameras and len(seen) == 1
    if sorted(told) == sorted(positions) and (is_only or sorted(seen) == sorted(wanted)):
        return
    missing = [name for name in (*wanted, *positions) if name not in {*seen, *told}]
    other = [name for name in (*seen, *told) if name not in {*wanted, *positions}]
    steps = [f"add {_listed(missing)}"] if missing else []
    steps += [f"leave out or rename {_listed(other)}"] if other and not is_only else []
    raise AegisError(
        f"an observation with the cameras {_listed(seen)} and the positions {_listed(told)}",
        f"the cameras {_listed(wanted) if cameras else '(one of any name)'} and the positions "
        f"{_listed(positions)}",
        "; ".join(steps) or "give each camera once",
    )


def _listed(names: Iterable[str]) -> str:
    return ", ".join(map(str, names)) or "(none)"
