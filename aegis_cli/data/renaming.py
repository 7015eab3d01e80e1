"""Names that a policy has for the cameras, features and joints of demonstrations.

Two recordings of one robot may call a camera or a joint otherwise. A renaming gives each name of
the demonstrations that of the policy, wherever it occurs; names that it does not have stay.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from aegis_cli.common.errors import AegisError
from aegis_cli.data.lerobot import layout

Renaming = tuple[tuple[str, str], ...]  # a name of the demonstrations, and the policy's


def of(named: Mapping[str, str] | None) -> Renaming:
    """The renaming that a recipe's mapping, or a checkpoint's, stands for."""
    return tuple((named or {}).items())


def feature(rename: Renaming, name: str) -> str:
    """What the policy calls a feature; a camera goes with and without `observation.images.`."""
    known = dict(rename)
    own = name
    for spelt in (layout.short(name), name):  # the full name decides, where both are renamed
        own = known.get(spelt, own)
    is_short = name.startswith(layout.CAMERA) and not own.startswith("observation.")
    return layout.CAMERA + own if is_short else own


def joints(rename: Renaming, names: Sequence[str], where: str) -> tuple[str, ...]:
    """What the policy calls positions or actions.

    Args:
        where: whose names these are, for an error.

    Raises:
        AegisError: two of them would have one name.
    """
    known = dict(rename)
    found = tuple(known.get(name, name) for name in names)
    check_apart(rename, names, found, where)
    return found


def check_apart(rename: Renaming, names: Sequence[str], renamed: Sequence[str], where: str) -> None:
    """Raise AegisError where a renaming gives one of these names to two."""
    if not rename:
        return
    for place, name in enumerate(renamed):
        first = renamed.index(name)
        # Names that were alike before are the dataset's own affair.
        if first != place and names[first] != names[place]:
            raise AegisError(
                f"'{names[first]}' and '{names[place]}' in {where}, which both become '{name}'",
                "a name of its own for each",
                f"rename the other one, too, in demos.rename (or --rename): {_said(rename)}",
            )


def check_known(rename: Renaming, names: Iterable[str], where: str) -> None:
    """Raise AegisError for a name of a renaming that does not occur in the demonstrations.

    Args:
        names: all that occur, of cameras with and without `observation.images.`.
        where: the demonstrations' names in a sentence.
    """
    known = sorted({*names} - {""})  # numbers without a name have an empty one
    for name, _ in rename:
        if name not in known:
            raise AegisError(
                f"'{name}' in demos.rename (or --rename), which does not occur in {where}",
                f"one of the names there: {', '.join(known)}",
                "correct it, or leave it out",
            )


def _said(rename: Renaming) -> str:
    return "{" + ", ".join(f"{old}: {new}" for old, new in rename) + "}"
