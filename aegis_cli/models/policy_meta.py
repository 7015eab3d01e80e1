"""What a user of a policy needs besides its weights, as stored in the headers of its files."""

from __future__ import annotations

import math
from typing import Any, Required, TypedDict

from aegis_cli.models.backbones.base import FLOAT32, STORED_TYPES


class PolicyMeta(TypedDict, total=False):
    """How a policy was trained, and on what; a missing key is unknown, or at its default.

    Attributes:
        method: the method that it was trained with.
        task: the simulated task that it was trained on; None if it was not simulated.
        replan: how many actions of a chunk are executed.
        ensemble: the decay of its temporal ensemble, if it has one.
        normalization: of positions and actions.
        relative: for each action the index of the position that it is predicted relative to, or
            None; missing if all are absolute.
        only, state, action, rename: the part of the demonstrations that was used, as in the
            recipe's section `demos`.
        action_names, proprio_names: a name for each number.
        fps: frames per second of the demonstrations.
        action_std: the actions' standard deviations, if the policy's scales are not these.
        proprio_reach: how far each position ever was in training, if one was far by its scale (see
            `data.far_positions`).
        dataset: the id on the hub of the demonstrations, or the ids of several sets.
        base_model: the id on the hub of the original model of the backbone.
        began_as: if the run began with another run's backbone, the name of the model that that run
            began with, without its folder.
        cameras: in order, if there are several or they are not the task's own.
        pictures: (height, width) of each camera's pictures, for a backbone that accepts pictures of
            any size.
        stored: the dtype in which the backbone's weights were stored, if it is not float32.
        merge: the rule by which `aegis merge` moved the backbone back, and how far.
    """

    method: Required[str]
    task: Required[str | None]
    replan: Required[int]
    ensemble: float
    normalization: str
    relative: list[int | None]
    only: str
    state: str | list[str]
    action: str | list[str]
    rename: dict[str, str]
    action_names: list[str]
    proprio_names: list[str]
    fps: float
    action_std: list[float]
    proprio_reach: list[float]
    dataset: str | list[str]
    base_model: str
    began_as: str
    cameras: list[str]
    pictures: list[list[int]]
    stored: str
    merge: dict[str, Any]


def check(meta: PolicyMeta, actions: int, positions: int) -> None:
    """Check the meta of a file.

    Args:
        actions, positions: how many numbers the policy's actions and positions have.

    Raises:
        ValueError: a required value is missing, has the wrong type, or belongs to another robot.
    """
    for name in ("method", "task", "replan"):
        if name not in meta:
            raise ValueError(f"no '{name}'")
    _check_types(meta)
    check_recorded(meta, actions, positions)


def _check_types(meta: PolicyMeta) -> None:
    """Raise ValueError if a value has another type than its key requires."""
    kinds = {"method": str, "task": str | None, "replan": int}
    kinds |= dict.fromkeys(("normalization", "only", "began_as"), str)
    for name, kind in kinds.items():
        if name in meta and not isinstance(meta[name], kind):
            raise ValueError(f"'{name}' is {meta[name]!r}")
    for name in ("state", "action"):
        if not isinstance(meta.get(name, ""), str | list):
            raise ValueError(f"'{name}' is {meta[name]!r}")
    if meta["replan"] < 1:
        raise ValueError(f"'replan' is {meta['replan']}")
    ensemble = meta.get("ensemble", 0.0)
    if type(ensemble) not in (int, float) or not math.isfinite(ensemble):
        raise ValueError(f"'ensemble' is {ensemble!r}")
    if meta.get("stored", FLOAT32) not in STORED_TYPES:
        raise ValueError(f"'stored' is {meta['stored']!r}")
    check_view(meta)


def check_view(meta: PolicyMeta) -> None:
    """Raise ValueError unless cameras, picture sizes and renamings are valid, if present."""
    if not all(isinstance(camera, str) for camera in meta.get("cameras", [])):
        raise ValueError(f"'cameras' is {meta['cameras']!r}")
    for size in meta.get("pictures", []):
        if len(size) != 2 or not all(isinstance(n, int) and n > 0 for n in size):
            raise ValueError(f"'pictures' has the size {size!r}")
    if not isinstance(meta.get("rename", {}), dict):
        raise ValueError(f"'rename' is {meta['rename']!r}")


def check_recorded(meta: PolicyMeta, actions: int, positions: int) -> None:
    """Raise ValueError unless names, spread and rate, if present, fit a robot of these sizes.

    Older checkpoints have none of them.
    """
    for key, count in (("action_names", actions), ("proprio_names", positions)):
        names = meta.get(key)
        if names is None:
            continue
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ValueError(f"'{key}' is {names!r}")
        if len(names) != count:
            raise ValueError(f"'{key}' has {len(names)} names for {count} numbers")
    for key, count in (("action_std", actions), ("proprio_reach", positions)):
        spread = meta.get(key, [0.0] * count)
        if not isinstance(spread, list) or len(spread) != count:
            raise ValueError(f"'{key}' is {spread!r} for {count} numbers")
        if not all(type(one) in (int, float) and 0 <= one < math.inf for one in spread):
            raise ValueError(f"'{key}' is {spread!r}")
    fps = meta.get("fps", 1.0)
    if type(fps) not in (int, float) or not 0 < fps < math.inf:
        raise ValueError(f"'fps' is {fps!r}")
