"""Reports and figures read back from JSON, as strictly as they were written."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

T = TypeVar("T")

# Figures that older versions wrote. They are no longer measured, and nothing reads them.
_RETIRED = frozenset({"leak"})
_MOST = 3  # problems that a message names


class Misfit(ValueError):
    """JSON that no value of the expected type was written as."""


def decode(kind: type[T], raw: Any) -> T:
    """The dataclass that `dataclasses.asdict` and JSON have made plain.

    Fields with a default may be missing: older versions did not write them.

    Raises:
        Misfit: another type, a missing field, an unknown one, or a number that is not finite.
    """
    try:
        text = json.dumps(raw, allow_nan=False)
    except ValueError:
        raise Misfit("a number that is not finite") from None
    try:
        made: T = _adapter(kind).validate_json(text, strict=True)
    except ValidationError as error:
        raise Misfit(_listed(error.errors())) from None
    # What was not read, at any depth, is missing in what was. pydantic itself passes over keys that
    # a standard dataclass does not have.
    read, given = json.loads(_adapter(kind).dump_json(made)), json.loads(text)
    unread = [k for k in given if not _was_read({k: given[k]}, read)]
    if unread:
        raise Misfit(f"{', '.join(unread)}: keys that this version does not know")
    return made


def _was_read(given: Any, read: Any) -> bool:
    """Whether everything that was given is in what was read, which may have defaults besides."""
    if isinstance(given, dict) and isinstance(read, dict):
        kept = given.keys() - _RETIRED
        return all(key in read and _was_read(given[key], read[key]) for key in kept)
    if isinstance(given, list) and isinstance(read, list):
        return len(given) == len(read) and all(map(_was_read, given, read))
    return bool(given == read)


@cache
def _adapter(kind: type[T]) -> TypeAdapter[T]:
    return TypeAdapter(kind)


def _listed(problems: Sequence[Any]) -> str:
    """The first problems, and how many there are besides."""
    said = [_said(problem) for problem in problems[:_MOST]]
    if len(problems) > _MOST:
        said.append(f"and {len(problems) - _MOST} more")
    return "; ".join(said)


def _said(problem: Any) -> str:
    """One problem as pydantic has found it, with the value that it found."""
    where = ".".join(map(str, problem["loc"])) or "all of it"
    return f"{where}: {problem['msg']}, not {problem['input']!r:.40}"
