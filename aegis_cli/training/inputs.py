"""Where a run's demonstrations and anchor lie, so that its folder alone says how it goes on.

What they hold, a checkpoint knows by digests; these are only the places.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError
from aegis_cli.data import mixture
from aegis_cli.data.selection import Paths

NAME = "inputs.json"
_RELATIVE = "relative"  # of its keys: the places as they are seen from the run
_BEGAN_IN = "began_in"  # and the folder from which the recipe's own paths are seen


@dataclass(frozen=True)
class Inputs:
    """An absolute path each, or of demonstrations the id of a dataset on the hub.

    Attributes:
        demos: one for each set.
        anchor: None where the run was given none.
    """

    demos: tuple[str, ...]
    anchor: str | None

    @classmethod
    def given(cls, demos: Paths, anchor: Path | None) -> Inputs:
        """Those that a command names, from the folder that it is called in."""
        places = []
        for path in mixture.each(demos):
            # What is not here may be the id of a dataset on the hub, which is no path.
            places.append(str(path.absolute() if path.exists() else path))
        return cls(tuple(places), None if anchor is None else str(anchor.absolute()))

    def each(self, change: Callable[[str], str]) -> Inputs:
        """The same with every place changed."""
        anchor = None if self.anchor is None else change(self.anchor)
        return Inputs(tuple(map(change, self.demos)), anchor)


def is_gone(place: str) -> bool:
    """Whether nothing is there; the id of a dataset is the hub's to find."""
    path = Path(place)
    return path.is_absolute() and not path.exists()  # what is kept of a file is absolute


def keep(out: Path, inputs: Inputs, place: Path | None = None, began: Path | None = None) -> None:
    """Write them into a run's folder, also as they are seen from there.

    Args:
        place: where the folder is going to lie; None: where it is.
        began: the folder that the run was begun in; None: what the run says, else the present one.
    """
    here, first = (place or out).absolute(), str(began or began_in(out) or Path.cwd())

    def relative(given: str) -> str:
        return os.path.relpath(given, here) if Path(given).is_absolute() else given

    seen = asdict(inputs.each(relative)) | {_BEGAN_IN: relative(first)}
    files.save_json(out / NAME, asdict(inputs) | {_BEGAN_IN: first, _RELATIVE: seen})


def began_in(out: Path) -> Path | None:
    """The folder that a run was begun in, also where both have been moved together.

    None of a run that does not say it, or where it is gone.
    """
    said = files.load_json(out / NAME) if (out / NAME).is_file() else None
    if not isinstance(said, dict) or not isinstance(said.get(_RELATIVE), dict):
        return None
    places = [said.get(_BEGAN_IN), said[_RELATIVE].get(_BEGAN_IN)]
    known = [out.absolute() / place for place in places if isinstance(place, str)]
    return next((Path(os.path.normpath(path)) for path in known if path.is_dir()), None)


def of(out: Path) -> Inputs | None:
    """Those of a run; None of one that an earlier version has begun.

    What is gone from its place, but lies as it did before when it is seen from the run, has been
    moved together with the run.

    Raises:
        AegisError: a damaged file.
    """
    path = out / NAME
    if not path.is_file():
        return None
    said = files.load_json(path)
    kept = _read(said)
    # The first version kept no places as seen from the run. Then each stands for itself.
    relative = _read(said[_RELATIVE]) if kept and _RELATIVE in said else kept
    if kept is None or relative is None or len(relative.demos) != len(kept.demos):
        raise AegisError(
            f"'{path}' is damaged: no paths of demonstrations and an anchor",
            "the file as Aegis wrote it",
            "delete it, and give their paths: aegis train RUN --demos PATH --anchor FILE",
        )
    seen = dict(zip((*kept.demos, kept.anchor), (*relative.demos, relative.anchor), strict=True))

    def found(place: str) -> str:
        moved = Path(os.path.normpath(out.absolute() / str(seen[place])))
        return str(moved) if is_gone(place) and moved.exists() else place

    return kept.each(found)


def _read(said: Any) -> Inputs | None:
    """The places that a file's JSON holds; None where it does not hold them."""
    places = [said.get(name) for name in ("demos", "anchor")] if isinstance(said, dict) else []
    match places:
        case [[str(), *_] as demos, (str() | None) as anchor] if all(
            isinstance(each, str) for each in demos
        ):
            return Inputs(tuple(demos), anchor)
    return None
