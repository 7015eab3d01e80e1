"""Where a run's demonstrations and anchor lie, so that its folder alone says how it goes on.

What they hold, a checkpoint knows by digests; these are only the places.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError
from aegis_cli.data import mixture
from aegis_cli.data.selection import Paths

NAME = "inputs.json"


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
        return cls(
            tuple(str(p.absolute() if p.exists() else p) for p in mixture.each(demos)),
            None if anchor is None else str(anchor.absolute()),
        )


def is_gone(place: str) -> bool:
    """Whether nothing is there; the id of a dataset is the hub's to find."""
    path = Path(place)
    return path.is_absolute() and not path.exists()


def keep(out: Path, inputs: Inputs) -> None:
    """Write them into a run's folder."""
    files.save_json(out / NAME, asdict(inputs))


def of(out: Path) -> Inputs | None:
    """Those of a run; None of one that an earlier version has begun.

    Raises:
        AegisError: a damaged file.
    """
    path = out / NAME
    if not path.is_file():
        return None
    said = files.load_json(path)
    places = [said.get(name) for name in ("demos", "anchor")] if isinstance(said, dict) else []
    match places:
        case [[str(), *_] as demos, (str() | None) as anchor] if all(
            isinstance(each, str) for each in demos
        ):
            return Inputs(tuple(demos), anchor)
    raise AegisError(
        f"'{path}' is damaged: no places of demonstrations and an anchor",
        "what Aegis has written there",
        "delete it, and say where they lie: aegis train RUN --demos PATH --anchor FILE",
    )
