"""The names of positions and actions: whether two recordings are of the same joints, in order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

_TOLD = {"action_names": "actions", "proprio_names": "positions"}


@dataclass(frozen=True)
class Difference:
    """Names that are not the same.

    Attributes:
        what: 'actions' or 'positions'.
        known: names that a policy was trained on.
        found: names of other demonstrations.
    """

    what: str
    known: Sequence[str]
    found: Sequence[str]

    @property
    def moved(self) -> str | None:
        """The first joint that has another place; None where the others have other names at most.

        The same joint may be called otherwise.
        """
        for place, name in enumerate(self.known):
            if name in self.found and self.found.index(name) != place:
                return name
        return None


def differences(known: Mapping[str, Any], found: Mapping[str, Any]) -> Iterator[Difference]:
    """What differs, of what both have names for.

    Args:
        known: `action_names` and `proprio_names` of a policy's meta, each as far as it is known.
        found: those of `Demonstrations.recorded`.
    """
    for key, what in _TOLD.items():
        one, other = known.get(key), found.get(key)
        # Lists, since a file's header has lists where the demonstrations have tuples.
        if one is not None and other is not None and list(one) != list(other):
            yield Difference(what, one, other)


def told_apart(known: Mapping[str, Any], found: Mapping[str, Any]) -> str:
    """Which joints are missing and which are more, for an error of how many there are.

    It reads as ", without the actions pan"; '' where a name is not known, or none differs.
    """
    said = list[str]()
    for other in differences(known, found):
        missing = [name for name in other.known if name not in other.found]
        more = [name for name in other.found if name not in other.known]
        if missing:
            said.append(f"without the {other.what} {', '.join(missing)}")
        if more:
            said.append(f"with the {other.what} {', '.join(more)} besides")
    return f", {', '.join(said)}" if said else ""
