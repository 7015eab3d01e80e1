"""The table of `aegis run`, finished or not, read back from the folder that holds it."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError
from aegis_cli.studies.comparison import StudyReport
from aegis_cli.studies.pipeline import PipelineReport
from aegis_cli.studies.stream_comparison import StreamStudyReport

NAME = "table.json"
Report = PipelineReport | StudyReport | StreamStudyReport


def load(folder: Path) -> Report:
    """The report as `aegis run` would return it now; its `out` is where it lies, wherever it was
    written.

    Raises:
        AegisError: a study that has measured nothing yet, or a table of another version.
    """
    if not (folder / NAME).is_file():
        found = f"no {NAME} in '{folder}': the study has measured nothing yet"
        raise AegisError(
            found, "a study with its first cell", "look again later, or call its aegis run again"
        )
    raw = files.load_json(folder / NAME)
    for kind in get_args(Report):
        if isinstance(raw, dict) and raw.keys() == {f.name for f in dataclasses.fields(kind)}:
            try:
                return dataclasses.replace(_value(kind, raw), out=str(folder))
            except _Misfit as misfit:
                raise _foreign(folder / NAME, str(misfit)) from None
    raise _foreign(folder / NAME, "other keys")


def _foreign(path: Path, found: str) -> AegisError:
    fix = "call its aegis run again: what is finished is not measured again"
    return AegisError(
        f"'{path}' is no table of this version: {found}",
        "what this version's aegis run writes",
        fix,
    )


class _Misfit(ValueError):
    pass


def _value(hint: Any, raw: Any) -> Any:
    """What `dataclasses.asdict` and JSON have made plain, as the type that it was."""
    if hint is Any:
        return raw
    if get_origin(hint) is UnionType:  # all unions here are `X | None`
        return (
            None
            if raw is None
            else _value(next(a for a in get_args(hint) if a is not type(None)), raw)
        )
    if dataclasses.is_dataclass(hint):
        return _fields(hint, raw)
    if get_origin(hint) in (list, tuple):
        return _items(hint, raw)
    if hint is float and type(raw) is int:  # as Python's own types allow it (PEP 484)
        return float(raw)
    if type(raw) is not hint or (hint is float and not math.isfinite(raw)):
        raise _Misfit(f"{raw!r:.40} where {hint.__name__} is expected")
    return raw


def _fields(kind: Any, raw: Any) -> Any:
    hints = get_type_hints(kind)
    if not isinstance(raw, dict) or raw.keys() != hints.keys():
        raise _Misfit(f"{raw!r:.40} where {kind.__name__} is expected")
    return kind(**{name: _value(hints[name], value) for name, value in raw.items()})


def _items(hint: Any, raw: Any) -> Any:
    kinds = get_args(hint)
    if not isinstance(raw, list) or (get_origin(hint) is tuple and len(raw) != len(kinds)):
        raise _Misfit(f"{raw!r:.40} where {hint} is expected")
    if get_origin(hint) is list:
        return [_value(kinds[0], item) for item in raw]
    return tuple(_value(kind, item) for kind, item in zip(kinds, raw, strict=True))
