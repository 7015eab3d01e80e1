"""Actions that are predicted relative to the robot's positions at the start of their chunk.

That is `action - position` of the same joint, as in LeRobot's `use_relative_actions` and openpi's
`DeltaActions`. Grippers are often left absolute.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from aegis_cli.common.errors import AegisError

# For each action, the index of its own joint among the positions; None if it stays absolute.
Places = Sequence[int | None]


class Origins(nn.Module):
    """What is subtracted from each target action of the expert, and added to each predicted one.

    Attributes:
        places: for each of the A actions; empty if all are absolute.
    """

    def __init__(self, places: Places = ()) -> None:
        super().__init__()
        self.places = tuple(places)
        self._columns: Tensor
        # Absolute actions use the last of P + 1 columns, which is 0. The buffer is not saved with
        # the weights: the header of a policy's file has the places.
        columns = torch.tensor([-1 if place is None else place for place in places]).long()
        self.register_buffer("_columns", columns, persistent=False)

    def forward(self, proprio: Tensor) -> Tensor | float:
        """The origins [B, 1, A] of chunks that start at positions [B, P]; 0 if all are absolute."""
        if not self.places:
            return 0.0
        with_zero = nn.functional.pad(proprio, (0, 1))  # [B, P + 1]
        return with_zero[:, None, self._columns]


def places(
    actions: Sequence[str],
    positions: Sequence[str],
    sizes: tuple[int, int],
    absolute: Sequence[str],
) -> tuple[int | None, ...]:
    """The index of the position that each action is relative to: the one of the same name.

    If the data names neither, actions and positions correspond by order.

    Args:
        actions: names of the A actions; empty if there are none.
        positions: names of the P positions.
        sizes: (A, P).
        absolute: words in the names of actions that stay absolute, such as gripper.

    Raises:
        AegisError: an action has no position of its name, unnamed actions and positions differ in
            number, or a word is in no action's name.
    """
    if not actions and not positions and not absolute and sizes[0] == sizes[1]:
        return tuple(range(sizes[0]))
    if len(actions) != sizes[0] or len(positions) != sizes[1]:
        raise AegisError(
            f"train.relative_actions: true with {sizes[0]} actions and {sizes[1]} positions, not "
            "all of which have names",
            "names of both in the demonstrations; or, without any names, as many positions as "
            "actions and no train.relative_exclude",
            "delete train.relative_actions, or name the features' components in info.json",
        )
    lowered = [name.lower() for name in actions]
    words = [word.lower() for word in absolute]
    for word, as_found in zip(absolute, words, strict=True):
        # A word that excludes nothing is a mistake, and would leave the gripper relative.
        if not any(as_found in name for name in lowered):
            raise AegisError(
                f"train.relative_exclude: '{word}', which is in no action's name",
                f"a word of {', '.join(actions)}",
                "correct it, or delete it",
            )
    stays = [any(word in name for word in words) for name in lowered]
    moved = [name for name, stay in zip(actions, stays, strict=True) if not stay]
    lacking = [name for name in moved if name not in positions]
    if lacking:
        raise AegisError(
            f"train.relative_actions: true, and no position is named {' or '.join(lacking)}",
            f"actions named as positions are: {', '.join(positions)}",
            "list what stays absolute in train.relative_exclude, or delete train.relative_actions",
        )
    twice = [name for name in moved if moved.count(name) > 1 or positions.count(name) > 1]
    if twice:
        raise AegisError(
            f"train.relative_actions: true, and several actions or positions named '{twice[0]}'",
            "names that say which position an action is relative to",
            "give each its own name in the feature's names in info.json, or delete "
            "train.relative_actions",
        )
    found = list[int | None]()
    for name, stay in zip(actions, stays, strict=True):
        found.append(None if stay else positions.index(name))
    return tuple(found)


def of_meta(meta: Mapping[str, Any], actions: int, positions: int) -> tuple[int | None, ...]:
    """The places in the meta of a policy's file; empty if all actions are absolute.

    Raises:
        ValueError: they do not fit these numbers of actions and positions.
    """
    told = meta.get("relative", [])
    known = [None, *range(positions)]
    fits = isinstance(told, list) and len(told) in (0, actions)
    # In Python, True equals 1.
    if not fits or not all(place in known and type(place) is not bool for place in told):
        raise ValueError(f"'relative' is {told!r}")
    return tuple(told)
