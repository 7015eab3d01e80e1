"""Compare the names of positions and actions: do two recordings have the same joints, in order?"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

_TOLD = {"action_names": "actions", "proprio_names": "positions"}


@dataclass(frozen=True)
class Difference:
    """Two lists of names that differ.

    Attributes:
        what: 'actions' or 'positions'.
        known: the names that a policy was trained on.
        found: the names in other demonstrations.
    """

    what: str
    known: Sequence[str]
    found: Sequence[str]

    @property
    def moved(self) -> str | None:
        """The first joint that has another index; None if names differ but no known name has moved.

        The same joint may have another name.
        """
        for place, name in enumerate(self.known):
            if name in self.found and self.found.index(name) != place:
                return name
        return None


def differences(known: Mapping[str, Any], found: Mapping[str, Any]) -> Iterator[Difference]:
    """The differences in what both have names for.

    Args:
        known: `action_names` and `proprio_names` of a policy's meta, each if it is known.
        found: those of `Demonstrations.recorded`.
    """
    for key, what in _TOLD.items():
        one, other = known.get(key), found.get(key)
        # Lists, since a file's header has lists but the demonstrations have tuples.
        if one is not None and other is not None and list(one) != list(other):
            yield Difference(what, one, other)


def told_apart(known: Mapping[str, Any], found: Mapping[str, Any]) -> str:
    """Which joints are missing or additional, for an error about their number.

    For example ", without the actions pan"; '' if names are unknown or do not differ.
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
