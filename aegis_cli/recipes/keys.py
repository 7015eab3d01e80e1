"""The keys of a recipe's section: a default, the values that a key takes, and its meaning.

A section is a frozen dataclass that pydantic can decode. `TypeAdapter(Train)` takes every value as
it is written (`1.0` is not a whole number, `true` is not a number) and applies each key's `Check`.
pydantic is imported only when something is decoded, so that `aegis --help` stays fast.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
import re
from collections.abc import Callable
from types import GenericAlias, UnionType
from typing import (
    Annotated,
    Any,
    NamedTuple,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

from aegis_cli.common.limits import MOST_MADE
from aegis_cli.recipes.strict_yaml import plain

LARGEST = 10**12  # largest whole number that a key takes; larger ones overflow arrays and times
LARGEST_FLOAT = 1e30  # float32 overflows at 3e38, and a step multiplies values
_SCALARS = (int, float, bool, str)
T = TypeVar("T")


class Check(NamedTuple):
    """The values that a key takes, beyond its type; for a list, `accepts` checks each item.

    The items of a list must differ, unless `repeats` is set.
    """

    expected: str
    accepts: Callable[[Any], bool]
    choices: tuple[str, ...] = ()
    repeats: bool = False


def choice(*choices: str) -> Check:
    """One of some words."""
    return Check("one of " + ", ".join(choices), lambda v: v in choices, choices)


WITH_PLACE = Check("a text with one {}", lambda v: v.count("{}") == 1)
POSITIVE = Check("above 0", lambda v: v > 0)
MADE = Check(f"from 1 to {MOST_MADE:,}", lambda v: 1 <= v <= MOST_MADE)
POSITIVE_EACH = Check("above 0", lambda v: v > 0, repeats=True)
TWO_OR_MORE = Check("2 or more", lambda v: v >= 2)
EVEN = Check("above 0 and even", lambda v: v > 0 and v % 2 == 0)
NOT_NEGATIVE = Check("0 or more", lambda v: v >= 0)
AT_LEAST_MINUS_ONE = Check("-1 or more", lambda v: v >= -1)
SEED = Check("from 0 to 4294967295", lambda v: 0 <= v < 2**32)
SHARE = Check("above 0 and below 1", lambda v: 0 < v < 1)
BELOW_ONE = Check("0 or more and below 1", lambda v: 0 <= v < 1)
BELOW_ONE_EACH = Check("each 0 or more and below 1", lambda v: 0 <= v < 1, repeats=True)
# Smaller values are 0 or nearly 0 in float32, and a step would divide 0 by them.
DIVIDES = Check("1e-30 or more", lambda v: v >= 1e-30)
UP_TO_ONE = Check("from 0 to 1", lambda v: 0 <= v <= 1)
SHARE_OR_ONE = Check("above 0 and up to 1", lambda v: 0 < v <= 1)
NOT_EMPTY = Check("not empty", lambda v: bool(v.strip()))
NOT_EMPTY_EACH = Check("not empty", NOT_EMPTY.accepts, repeats=True)
NAMES = Check(
    "texts that are not empty, each with another",
    lambda v: (
        bool(v)
        and all(isinstance(x, str) and x.strip() for pair in v.items() for x in pair)
        and all(old != new for old, new in v.items())
    ),
)
FOLDER_NAME = Check("letters, digits, '.', '_', '-'", lambda v: bool(re.fullmatch(r"\w[\w.-]*", v)))


def key(
    check: Check | None = None,
    *,
    default: Any = dataclasses.MISSING,
    first: Any = dataclasses.MISSING,
    factory: Any = dataclasses.MISSING,
    later: bool = False,
    shapes: bool = True,
    adjusts: bool = False,
    retired: bool = False,
    doc: str = "",
) -> Any:
    """A key of a section; without a default and a factory, the file must give it.

    Args:
        check: the values that it takes, beyond its type.
        first: the original default, if it has changed since; it is used to find finished work.
        factory: makes the default, if that is a mapping.
        later: the key was added when runs already existed whose records do not have it, so
            `recorded` leaves it out at its default.
        retired: it no longer has an effect. Older recipes may have it, and their records do.
        shapes: whether it affects the result. Other keys are not part of any record, so a run
            resumes with any value of them.
        adjusts: it affects memory, time or how often something is written, and the result at most
            by rounding. It is part of records, but a run of a policy resumes with any value of it.
        doc: meaning and unit, for docs/recipes.md.
    """
    began = default if first is dataclasses.MISSING else first
    metadata = {
        "check": check,
        "first": began,
        "later": later,
        "shapes": shapes,
        "adjusts": adjusts,
        "retired": retired,
        "doc": doc,
    }
    return dataclasses.field(default=default, default_factory=factory, metadata=metadata)


def first_default(field: dataclasses.Field[Any]) -> Any:
    """The original default of a key."""
    return field.metadata.get("first", field.default)


def changed(section: Any) -> dict[str, Any]:
    """The keys of a recipe's section whose values differ from their original defaults."""
    found = {}
    for field in dataclasses.fields(section):
        value = getattr(section, field.name)
        if field.metadata.get("shapes", True) and value != first_default(field):
            found[field.name] = value
    return found


def recorded(section: Any) -> dict[str, Any]:
    """A section's keys and values as in a stage's record.

    Keys that were added after the first records are left out at their defaults, so that older
    records stay valid.
    """
    values = dataclasses.asdict(section)
    own = changed(section)
    for field in dataclasses.fields(section):
        late = field.metadata.get("later") and field.name not in own
        if late or not field.metadata.get("shapes", True):
            del values[field.name]
    return values


def is_retired(field: dataclasses.Field[Any]) -> bool:
    """Whether a key no longer has an effect."""
    return bool(field.metadata.get("retired"))


def adjusting(section: Any) -> set[str]:
    """The keys of a section that may change when a run is resumed (`adjusts`), or are retired."""
    fields = dataclasses.fields(section)
    return {f.name for f in fields if f.metadata.get("adjusts") or is_retired(f)}


def is_required(field: dataclasses.Field[Any]) -> bool:
    """Whether a file must give the key."""
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def is_optional(hint: Any) -> bool:
    """Whether a key of this type may be null."""
    return type(None) in get_args(hint)


def base_type(hint: Any) -> Any:
    """`int | None` -> int, `tuple[str, ...]` -> tuple."""
    inner = next((arg for arg in get_args(hint) if arg is not type(None)), hint)
    plain = inner if is_optional(hint) else hint  # a tuple's first argument is its item type
    return get_origin(plain) or plain


@dataclass_transform(frozen_default=True, field_specifiers=(key, dataclasses.field))
def section(kind: type[T]) -> type[T]:
    """Make a class a frozen dataclass that pydantic decodes strictly and with each key's check."""
    made = dataclasses.dataclass(frozen=True)(kind)
    assert dataclasses.is_dataclass(made)
    hints = get_type_hints(made)  # annotations are strings under `from __future__`
    for field in dataclasses.fields(made):
        if not dataclasses.is_dataclass(base_type(hints[field.name])):
            # pydantic decodes a dataclass by the types of its fields.
            field.type = Annotated[hints[field.name], _Value(field.metadata.get("check"))]
    made.__pydantic_config__ = {"extra": "forbid", "allow_inf_nan": False}
    return made


@dataclasses.dataclass(frozen=True)
class _Value:
    """Tells pydantic how to decode a value: strictly, then with the key's check."""

    check: Check | None

    def __get_pydantic_core_schema__(self, hint: Any, handler: Callable[[Any], Any]) -> Any:
        """Called by pydantic to get the schema of the type."""
        from pydantic_core import core_schema

        # pydantic's own rules for the type come first, then the key's check.
        by_type = handler(_strict(hint))
        judged = core_schema.no_info_after_validator_function(self._judged, by_type)
        if self.check is WITH_PLACE:
            return core_schema.no_info_before_validator_function(_as_text, judged)
        return judged

    def _judged(self, value: Any) -> Any:
        """Check a value and return it; pydantic collects the errors of all keys."""
        repeats = self.check is not None and self.check.repeats
        items = value if isinstance(value, tuple) else (value,)
        is_twice = isinstance(value, tuple) and not repeats and len(set(value)) < len(value)
        if value == () or is_twice:
            raise ValueError("not empty, and no word twice")
        # The texts of these errors are not shown: decoding.py describes the mistakes.
        if value is not None and self.check and not all(map(self.check.accepts, items)):
            raise ValueError(self.check.expected)
        if any(map(is_too_large, items)):
            raise ValueError("a smaller number")
        return plain(value)


def is_too_large(value: Any) -> bool:
    """Whether a number is larger than any key of its type allows."""
    limit = LARGEST if isinstance(value, int) else LARGEST_FLOAT
    return isinstance(value, int | float) and value > limit


def _as_text(value: Any) -> Any:
    """Turn an unquoted `{}`, which is an empty mapping in YAML, into the text that was meant."""
    return "{}" if value == {} else value


def _strict(hint: Any) -> Any:
    """The type with scalars that are not converted; lists become tuples, mappings stay open."""
    if hint in _SCALARS:
        from pydantic import Strict

        return Annotated[hint, Strict()]
    origin, args = get_origin(hint), get_args(hint)
    if origin is tuple:
        return GenericAlias(tuple, tuple(map(_strict, args)))  # `tuple[X, ...]` or `tuple[X, Y]`
    if origin in (Union, UnionType):
        return functools.reduce(operator.or_, map(_strict, args))
    return dict[str, Any] if origin is dict else hint
