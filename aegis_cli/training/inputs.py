"""Where a run's demonstrations and anchor lie, so that its folder alone is enough to resume it.

Checkpoints hold digests of their contents; this file holds only the paths.
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
_RELATIVE = "relative"  # a key: the places relative to the run
_MERGED_FROM = "merged_from"  # a key: the run that aegis merge has made this one from
BEGAN_IN = "began_in"  # a key: the folder that the recipe's own paths are relative to


@dataclass(frozen=True)
class Inputs:
    """Absolute paths; for demonstrations possibly the id of a dataset on the hub.

    Attributes:
        demos: one for each set.
        anchor: None if the run was given none.
    """

    demos: tuple[str, ...]
    anchor: str | None

    @classmethod
    def given(cls, demos: Paths, anchor: Path | None) -> Inputs:
        """The inputs that a command names, relative to the folder that it is called in."""
        places = []
        for path in mixture.each(demos):
            # A path that does not exist may be the id of a dataset on the hub.
            places.append(str(path.absolute() if path.exists() else path))
        return cls(tuple(places), None if anchor is None else str(anchor.absolute()))

    def each(self, change: Callable[[str], str]) -> Inputs:
        """The same inputs with `change` applied to every place."""
        anchor = None if self.anchor is None else change(self.anchor)
        return Inputs(tuple(map(change, self.demos)), anchor)


def is_gone(place: str) -> bool:
    """Whether a path no longer exists; ids of datasets on the hub are not checked."""
    path = Path(place)
    return path.is_absolute() and not path.exists()  # places of files are kept as absolute paths


def keep(
    out: Path,
    inputs: Inputs,
    place: Path | None = None,
    began: Path | None = None,
    merged: Path | None = None,
) -> None:
    """Write the inputs into a run's folder, both as absolute paths and relative to it.

    Args:
        place: where the folder will lie later; None: where it is now.
        began: the folder that the run was begun in; None: what the run says, else the current
            folder.
        merged: the run that this one was merged from; None: it was trained.
    """
    here, first = (place or out).absolute(), str(began or began_in(out) or Path.cwd())

    def relative(given: str) -> str:
        return os.path.relpath(given, here) if Path(given).is_absolute() else given

    others = {BEGAN_IN: first}
    if merged is not None:
        others[_MERGED_FROM] = str(merged.absolute())
    seen = asdict(inputs.each(relative)) | {key: relative(at) for key, at in others.items()}
    files.save_json(out / NAME, asdict(inputs) | others | {_RELATIVE: seen})


def began_in(out: Path) -> Path | None:
    """The folder that a run was begun in, even if both have been moved together.

    None if the run does not say, or the folder is gone.
    """
    return _folder(out, BEGAN_IN)


def merged_from(out: Path) -> Path | None:
    """The run that this one was merged from, likewise; None also for a run that was trained."""
    return _folder(out, _MERGED_FROM)


def _folder(out: Path, key: str) -> Path | None:
    said = files.load_json(out / NAME) if (out / NAME).is_file() else None
    if not isinstance(said, dict) or not isinstance(said.get(_RELATIVE), dict):
        return None
    places = [said.get(key), said[_RELATIVE].get(key)]
    known = [out.absolute() / place for place in places if isinstance(place, str)]
    return next((Path(os.path.normpath(path)) for path in known if path.is_dir()), None)


def of(out: Path) -> Inputs | None:
    """The inputs of a run; None for a run that an earlier version has begun.

    An input that is gone from its absolute path but exists at the same path relative to the run has
    been moved together with the run.

    Raises:
        AegisError: the file is damaged.
    """
    path = out / NAME
    if not path.is_file():
        return None
    said = files.load_json(path)
    kept = _read(said)
    # The first version kept no relative places. Then the absolute ones are used.
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
    """The places in a file's JSON; None if they are not there."""
    places = [said.get(name) for name in ("demos", "anchor")] if isinstance(said, dict) else []
    match places:
        case [[str(), *_] as demos, (str() | None) as anchor] if all(
            isinstance(each, str) for each in demos
        ):
            return Inputs(tuple(demos), anchor)
    return None
