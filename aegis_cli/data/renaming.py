"""A policy's own names for the cameras, features and joints of demonstrations.

Two recordings of one robot may name a camera or a joint differently. A renaming maps names of the
demonstrations to the policy's, wherever they occur; other names stay.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from aegis_cli.common.errors import AegisError
from aegis_cli.data.lerobot import layout

Renaming = tuple[tuple[str, str], ...]  # (a name in the demonstrations, the policy's name)


def of(named: Mapping[str, str] | None) -> Renaming:
    """The renaming given by a mapping in a recipe or a checkpoint."""
    return tuple((named or {}).items())


def feature(rename: Renaming, name: str) -> str:
    """The policy's name of a feature; a camera is found with or without `observation.images.`."""
    known = dict(rename)
    own = name
    for spelt in (layout.short(name), name):  # if both are renamed, the full name decides
        own = known.get(spelt, own)
    is_short = name.startswith(layout.CAMERA) and not own.startswith("observation.")
    return layout.CAMERA + own if is_short else own


def joints(rename: Renaming, names: Sequence[str], where: str) -> tuple[str, ...]:
    """The policy's names of positions or actions.

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
    """Raise AegisError if a renaming maps two different names to the same one."""
    if not rename:
        return
    for place, name in enumerate(renamed):
        first = renamed.index(name)
        # Names that were equal before are left to the dataset.
        if first != place and names[first] != names[place]:
            raise AegisError(
                f"'{names[first]}' and '{names[place]}' in {where}, which both become '{name}'",
                "a name of its own for each",
                f"rename the other one, too, in demos.rename (or --rename): {_said(rename)}",
            )


def check_known(rename: Renaming, names: Iterable[str], where: str) -> None:
    """Raise AegisError for a name to be renamed that does not occur in the demonstrations.

    Args:
        names: all names that occur, cameras both with and without `observation.images.`.
        where: the demonstrations, as named in a sentence.
    """
    known = sorted({*names} - {""})  # unnamed numbers have an empty name
    for name, _ in rename:
        if name not in known:
            raise AegisError(
                f"'{name}' in demos.rename (or --rename), which does not occur in {where}",
                f"one of the names there: {', '.join(known)}",
                "correct it, or leave it out",
            )


def _said(rename: Renaming) -> str:
    return "{" + ", ".join(f"{old}: {new}" for old, new in rename) + "}"
