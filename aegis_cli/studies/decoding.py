"""Reads reports and figures back from JSON, with strict checks."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

T = TypeVar("T")

# Figures that only older versions measured and stored. Nothing reads them.
_RETIRED = frozenset({"leak"})
_MOST = 3  # maximum number of problems in a message


class Misfit(ValueError):
    """JSON that does not encode a value of the expected type."""


def decode(kind: type[T], raw: Any) -> T:
    """The dataclass from the plain values of `dataclasses.asdict` and JSON.

    Fields with a default may be missing, since older versions did not write them.

    Raises:
        Misfit: a wrong type, a missing or unknown field, or a number that is not finite.
    """
    try:
        text = json.dumps(raw, allow_nan=False)
    except ValueError:
        raise Misfit("a number that is not finite") from None
    try:
        made: T = _adapter(kind).validate_json(text, strict=True)
    except ValidationError as error:
        raise Misfit(_listed(error.errors())) from None
    # pydantic ignores keys that a standard dataclass does not have, at any depth. They are found by
    # comparing the given values with those that were read.
    read, given = json.loads(_adapter(kind).dump_json(made)), json.loads(text)
    unread = [k for k in given if not _was_read({k: given[k]}, read)]
    if unread:
        raise Misfit(f"{', '.join(unread)}: keys that this version does not know")
    return made


def _was_read(given: Any, read: Any) -> bool:
    """Whether all given values were read; `read` may have additional defaults."""
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
    """The first problems, and the number of further ones."""
    said = [_said(problem) for problem in problems[:_MOST]]
    if len(problems) > _MOST:
        said.append(f"and {len(problems) - _MOST} more")
    return "; ".join(said)


def _said(problem: Any) -> str:
    """One problem found by pydantic, with the offending value."""
    where = ".".join(map(str, problem["loc"])) or "all of it"
    return f"{where}: {problem['msg']}, not {problem['input']!r:.40}"
