"""Decodes raw keys into the dataclasses of a recipe, and reports all mistakes at once.

pydantic finds the mistakes. This module describes them in the terms of `AegisError`: what was
found, in which line, what is expected, and what was probably meant. It knows nothing about recipes.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, get_type_hints

from aegis_cli.common.home import at_home
from aegis_cli.recipes.keys import (
    LARGEST,
    LARGEST_FLOAT,
    Check,
    base_type,
    is_retired,
    is_too_large,
)
from aegis_cli.recipes.strict_yaml import Problem, did_you_mean, line_of

if TYPE_CHECKING:
    from pydantic import TypeAdapter

# The values that a key of each type takes. A union is looked up as a whole first, then by its base
# type.
_PHRASES: dict[Any, str] = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "text",
    tuple: "a list of different words such as [a, b]",
    str | tuple[str, ...]: "text, or a list of different words such as [a, b]",
    str | tuple[str, ...] | None: "text, or a list of different words such as [a, b]",
    tuple[float, ...] | None: "a list of numbers such as [2, 1]",
    tuple[float, float]: "a list of two numbers such as [0.9, 0.95]",
    tuple[int, ...]: "a list of different whole numbers such as [0, 1]",
    tuple[int, ...] | None: "a list of different whole numbers such as [100, 200]",
    dict: "a section of keys and values",
    dict[str, str] | None: "names with theirs, such as {overhead: top}",
}


def build(
    kind: type,
    raw: Mapping[Any, Any],
    problems: list[Problem],
    prefix: str = "",
    places: Callable[[str], list[str]] | None = None,
) -> Any:
    """The dataclass `kind` from a raw mapping, or None if there are problems.

    Mistakes are appended to `problems`. A text that starts with `~/` is a path in the home folder.

    Args:
        kind: a class made by `keys.section`.
        prefix: put before the name of each key, such as 'lora.'.
        places: where an unknown key may belong; by default the sections where `below` finds it.
    """
    from pydantic import ValidationError

    try:
        made = _adapter(kind).validate_python(at_home(raw))
    except ValidationError as error:
        wrong = error.errors(include_url=False, include_context=False)
        found = [_problem(kind, raw, each["loc"], prefix, places) for each in wrong]
        problems += dict.fromkeys(found)  # each alternative of a union reports its own error
        return None
    # With earlier problems, such as a key given twice, it is unclear what was meant.
    return None if problems else made


@functools.cache
def _adapter(kind: type) -> TypeAdapter[Any]:
    """Imported and created on demand, since each takes a tenth of a second."""
    from pydantic import TypeAdapter

    return TypeAdapter(kind)


def _problem(
    kind: type,
    raw: Mapping[Any, Any],
    place: Sequence[int | str],
    prefix: str,
    places: Callable[[str], list[str]] | None = None,
    line: int | None = None,
) -> Problem:
    """The problem with the key at `place`, a path below `kind`; `line` is its section's line."""
    name, *inner = place  # for a union, `inner` also has pydantic's names for its alternatives
    fields = {field.name: field for field in dataclasses.fields(kind)}
    dotted, here = f"{prefix}{name}", line_of(raw, name)
    if name not in fields:
        elsewhere = places(str(name)) if places else below(str(name), kind)
        return _unknown(prefix, str(name), kind, elsewhere)._replace(line=here)
    if name not in raw:
        return Problem(f"no key '{dotted}'", f"'{dotted}'", f"add the line '{name}: ...'", line)
    hint = get_type_hints(kind)[name]
    if not dataclasses.is_dataclass(base_type(hint)):
        return _wrong_value(fields[name], hint, raw[name], dotted)._replace(line=here)
    if inner and isinstance(raw[name], dict):
        return _problem(base_type(hint), raw[name], inner, f"{dotted}.", line=here)
    names = ", ".join(field.name for field in dataclasses.fields(base_type(hint)))
    expected, fix = f"a section with keys of: {names}", f"indent the keys below '{dotted}:'"
    return Problem(f"{dotted}: {_quote(raw[name])}", expected, fix, here)


def _wrong_value(field: dataclasses.Field[Any], hint: Any, raw: Any, dotted: str) -> Problem:
    phrase = _PHRASES.get(hint) or _PHRASES[base_type(hint)]
    check = field.metadata.get("check")
    if check and check.repeats:
        phrase = phrase.replace("different ", "")
    limits = [] if check and check.choices and phrase == "text" else [phrase]
    limits += [check.expected] if check else []
    items = raw if isinstance(raw, list) else [raw]
    if "number" in phrase and any(map(is_too_large, items)):
        # Only for a number that is too large; otherwise the limit would distract.
        most = f"{LARGEST:,}" if "whole" in phrase else f"{LARGEST_FLOAT:g}"
        limits.append(f"at most {most}")
    expected = f"{dotted}: " + ", ".join(limits)
    # `methods: naive, lora` is text in YAML, but a list was meant. `type` excludes bool.
    unlisted = base_type(hint) is tuple and type(raw) in (str, int) and str(raw).strip(" ,")
    fix = _as_list(raw, dotted, check) if unlisted else _fix(field, raw, dotted, check, phrase)
    return Problem(f"{dotted}: {_quote(raw)}", expected, fix)


def _as_list(raw: str | int, dotted: str, check: Check | None) -> str:
    """The fix for words without brackets: the list that was meant."""
    words = str(raw).replace(",", " ").split()
    choices = check.choices if check else ()
    meant = ", ".join(did_you_mean(word, choices) or word for word in words)
    return f"write '{dotted}: [{meant}]', or --set '{dotted}=[{meant}]'"


def _fix(
    field: dataclasses.Field[Any], raw: Any, dotted: str, check: Check | None, phrase: str
) -> str:
    choices = check.choices if check else ()
    words = [str(item) for item in (raw if isinstance(raw, list) else [raw])]
    wrong = next((word for word in words if word not in choices), "")
    near = did_you_mean(wrong, choices)
    if near:
        return f"did you mean '{near}'?"
    if phrase == "text" and not choices and not isinstance(raw, bool | list | None):
        # A number where text is expected, or text that starts with { and is a mapping in YAML.
        meant = raw if isinstance(raw, int | float) else "..."
        return f"put the text in quotes: {dotted}: '{meant}', or --set \"{dotted}='{meant}'\""
    if field.default is dataclasses.MISSING:
        return f"change '{dotted}'"
    if field.default is None:
        return f"change '{dotted}', or leave it out"
    default = list(field.default) if isinstance(field.default, tuple) else field.default
    return f"change '{dotted}'; its default is {_quote(default)}"


def _unknown(prefix: str, name: str, kind: type, elsewhere: list[str]) -> Problem:
    """Suggests a key of this name elsewhere, or one here with a similar spelling or this ending."""
    names = [field.name for field in dataclasses.fields(kind) if not is_retired(field)]
    near = did_you_mean(name, names)
    holding = [key for key in names if key.endswith(f"_{name}")]  # for `lr` both learning rates
    meant = elsewhere or ([near] if near else holding)
    said = " or ".join(f"'{prefix}{key}'" for key in meant)
    fix = f"did you mean {said}?" if meant else f"delete '{prefix}{name}'"
    expected = f"a key of {prefix.rstrip('.') or 'a recipe'}: " + ", ".join(names)
    return Problem(f"unknown key '{prefix}{name}'", expected, fix)


def below(name: str, kind: type) -> list[str]:
    """The dotted keys of this name in the sections of a dataclass."""
    found = []
    for section, hint in get_type_hints(kind).items():
        inner = base_type(hint)
        if not dataclasses.is_dataclass(inner):
            continue
        if name in [field.name for field in dataclasses.fields(inner)]:
            found.append(f"{section}.{name}")
    return found


def _quote(raw: Any) -> str:
    if raw is None:
        return "nothing"
    if isinstance(raw, bool):
        return str(raw).lower()
    return f"'{raw}'" if isinstance(raw, str) else f"{raw}"
