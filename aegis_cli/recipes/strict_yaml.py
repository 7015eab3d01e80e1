"""Strict YAML to frozen dataclasses, every mistake reported at once. Knows nothing about recipes.

A section is a nested dataclass, a key a field, and a field's `Check` says which values it takes.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, get_args, get_origin, get_type_hints

import yaml

from aegis_cli.common.errors import AegisError


class Check(NamedTuple):
    """Which values a field takes beyond its type; of a list, `accepts` judges each item."""

    expected: str
    accepts: Callable[[Any], bool]
    choices: tuple[str, ...] = ()


class Problem(NamedTuple):
    """One mistake, in the words of `AegisError`."""

    found: str
    expected: str
    fix: str


def key(check: Check, default: Any = dataclasses.MISSING, first: Any = dataclasses.MISSING) -> Any:
    """A dataclass field with its check; without a default the file must give it.

    Args:
        first: the default that it came with, if that has changed since: finished work is still
            found under it.
    """
    began = default if first is dataclasses.MISSING else first
    return dataclasses.field(default=default, metadata={"check": check, "first": began})


def first_default(field: dataclasses.Field[Any]) -> Any:
    """The default that a key came with."""
    return field.metadata.get("first", field.default)


def did_you_mean(word: str, choices: Iterable[str]) -> str | None:
    """The choice closest to a mistyped `word`, if any is close."""
    return next(iter(difflib.get_close_matches(word.lower(), list(choices), n=1, cutoff=0.6)), None)


def refuse(problems: Sequence[Problem], source: str) -> None:
    """Raise one AegisError that names every problem; none, and nothing happens."""
    if len(problems) == 1:
        only = problems[0]
        raise AegisError(f"{only.found} (in {source})", only.expected, only.fix)
    if problems:
        found, expected, fix = (
            "".join(f"\n  {i}. {line}" for i, line in enumerate(column, 1))
            for column in zip(*problems, strict=True)
        )
        raise AegisError(f"{len(problems)} problems in {source}{found}", expected, fix)


class _Loader(yaml.SafeLoader):
    """YAML with the scalars of version 1.2: `1e-4` is a number, `no`, `010` and `2024-01-01` are
    text.
    """

    yaml_implicit_resolvers: dict[str, Any] = {}
    problems: list[Problem]

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        first_line: dict[str, int] = {}
        for name_node, _ in node.value:
            line, name = name_node.start_mark.line + 1, str(name_node.value)
            if name in first_line:
                found = f"the key '{name}' twice, in lines {first_line[name]} and {line}"
                self.problems.append(
                    Problem(found, "each key once", f"delete '{name}' in one of these lines")
                )
            first_line.setdefault(name, line)
        return super().construct_mapping(node, deep=deep)


class _Dumper(yaml.SafeDumper):
    """Quotes text that YAML 1.1 or 1.2 would take for something else."""


for _tag, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?(?:0|[1-9][0-9_]*)", list("-+0123456789")),
    (
        "float",
        r"[-+]?(?:[0-9][0-9_]*\.[0-9]*|\.[0-9]+|[0-9]+(?=[eE]))(?:[eE][-+]?[0-9]+)?",
        list("-+.0123456789"),
    ),
    ("float", r"[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)", list("-+.")),
):
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(
            f"tag:yaml.org,2002:{_tag}", re.compile(f"(?:{_pattern})$"), _first
        )


def dump(value: Any) -> str:
    """Plain values as YAML that `parse` reads back unchanged; keys keep their order."""
    return yaml.dump(value, Dumper=_Dumper, sort_keys=False)


def parse(text: str, source: str) -> tuple[Any, list[Problem]]:
    """The plain value of a YAML text, and the keys given twice.

    Raises:
        AegisError: the text is not YAML; nothing else can be judged then.
    """
    loader = None
    try:
        loader = _Loader(text)
        loader.problems = []
        return loader.get_single_data(), loader.problems
    except (yaml.YAMLError, ValueError) as e:
        mark = getattr(e, "problem_mark", None)
        where = f" line {mark.line + 1}, column {mark.column + 1}:" if mark else ""
        why = getattr(e, "problem", None) or str(e).splitlines()[0]
        raise AegisError(
            f"{source}:{where} {why}", "YAML: lines of 'key: value'", "correct that line"
        ) from None
    finally:
        if loader is not None:
            loader.dispose()


def override(raw: dict[Any, Any], setting: str) -> list[Problem]:
    """Put one `a.b=c` into the raw mapping; whether a.b and c are any good, `build` says."""
    dotted, equals, text = setting.partition("=")
    *sections, name = dotted.strip().split(".")
    if not equals or not all((*sections, name)):
        return [
            Problem(f"--set '{setting}'", "--set KEY=VALUE", "write e.g. --set train.steps=200")
        ]
    value, problems = parse(text, f"--set '{setting}'")
    for section in sections:
        raw = raw.setdefault(section, {})
        if not isinstance(raw, dict):
            return [
                Problem(
                    f"--set '{setting}', but '{section}' has no keys below it",
                    "a section and its key",
                    f"correct '{section}'",
                )
            ]
    raw[name] = value
    return problems


def build(
    kind: type,
    raw: dict[Any, Any],
    problems: list[Problem],
    prefix: str = "",
    places: Callable[[str], list[str]] | None = None,
) -> Any:
    """The dataclass `kind` from a raw mapping; appends to `problems`, and returns None if there are
    any.

    Args:
        places: where an unknown key may have been meant to stand; by default the sections where
            `below` finds it.
    """
    hints, fields = get_type_hints(kind), {f.name: f for f in dataclasses.fields(kind)}
    unknown = [str(name) for name in raw if name not in fields]
    problems += [
        _unknown(prefix, name, kind, places(name) if places else below(name, kind))
        for name in unknown
    ]
    missing = [f for f in fields.values() if _required(f) and f.name not in raw]
    problems += [
        Problem(
            f"no key '{prefix}{f.name}'", f"'{prefix}{f.name}'", f"add the line '{f.name}: ...'"
        )
        for f in missing
    ]
    values = {
        name: _section(_base(hints[name]), raw[name], problems, f"{prefix}{name}")
        if dataclasses.is_dataclass(_base(hints[name]))
        and not (raw[name] is None and _optional(hints[name]))
        else _value(field, hints[name], raw[name], problems, f"{prefix}{name}")
        for name, field in fields.items()
        if name in raw
    }
    return None if problems else kind(**values)


def _section(kind: type, raw: Any, problems: list[Problem], dotted: str) -> Any:
    if isinstance(raw, dict):
        return build(kind, raw, problems, f"{dotted}.")
    names = ", ".join(f.name for f in dataclasses.fields(kind))
    problems.append(
        Problem(
            f"{dotted}: {_quote(raw)}",
            f"a section with keys of: {names}",
            f"indent the keys below '{dotted}:'",
        )
    )
    return None


def _value(
    field: dataclasses.Field[Any], hint: Any, raw: Any, problems: list[Problem], dotted: str
) -> Any:
    """`raw` as the field's type; a wrong type or value becomes a problem."""
    if raw is None and _optional(hint):
        return None
    phrase, convert = _TYPES[hint if hint in _TYPES else _base(hint)]
    check = field.metadata.get("check")
    value = convert(raw)
    items = value if isinstance(value, tuple) else (value,)
    if value is None or (check and not all(check.accepts(item) for item in items)):
        limits = [phrase] if not (check and check.choices and phrase == "text") else []
        expected = f"{dotted}: " + ", ".join(limits + ([check.expected] if check else []))
        listed = _base(hint) is tuple and type(raw) in (str, int) and str(raw).strip(" ,")
        fix = _as_list(raw, dotted, check) if listed else _fix(field, raw, dotted, check)
        problems.append(Problem(f"{dotted}: {_quote(raw)}", expected, fix))
    return value


def _as_list(raw: str | int, dotted: str, check: Check | None) -> str:
    """Words without brackets, written as the list that was meant."""
    words = str(raw).replace(",", " ").split()
    meant = ", ".join(
        (did_you_mean(word, check.choices) if check else None) or word for word in words
    )
    return f"write '{dotted}: [{meant}]', or --set '{dotted}=[{meant}]'"


def _fix(field: dataclasses.Field[Any], raw: Any, dotted: str, check: Check | None) -> str:
    wrong = next(
        (
            w
            for w in (raw if isinstance(raw, list) else [raw])
            if check and str(w) not in check.choices
        ),
        "",
    )
    near = did_you_mean(str(wrong), check.choices) if check else None
    if near:
        return f"did you mean '{near}'?"
    if field.default is dataclasses.MISSING:
        return f"change '{dotted}'"
    default = list(field.default) if isinstance(field.default, tuple) else field.default
    return f"change '{dotted}'; its default is {_quote(default)}"


def _unknown(prefix: str, name: str, kind: type, elsewhere: list[str]) -> Problem:
    """A key of that very name elsewhere is what was meant, before one that is spelled
    alike here.
    """
    names = [f.name for f in dataclasses.fields(kind)]
    near = did_you_mean(name, names)
    meant = elsewhere or ([near] if near else [])
    said = " or ".join(f"'{prefix}{key}'" for key in meant)
    fix = f"did you mean {said}?" if meant else f"delete '{prefix}{name}'"
    return Problem(
        f"unknown key '{prefix}{name}'",
        f"a key of {prefix.rstrip('.') or 'a recipe'}: " + ", ".join(names),
        fix,
    )


def below(name: str, kind: type) -> list[str]:
    """Where the sections of a dataclass have a key of this name."""
    sections = {section: _base(hint) for section, hint in get_type_hints(kind).items()}
    return [
        f"{section}.{name}"
        for section, inner in sections.items()
        if dataclasses.is_dataclass(inner) and name in {f.name for f in dataclasses.fields(inner)}
    ]


def _quote(raw: Any) -> str:
    if raw is None:
        return "nothing"
    if isinstance(raw, bool):
        return str(raw).lower()
    return f"'{raw}'" if isinstance(raw, str) else f"{raw}"


def _required(field: dataclasses.Field[Any]) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _optional(hint: Any) -> bool:
    return type(None) in get_args(hint)


def _base(hint: Any) -> type:
    """`int | None` -> int, `tuple[str, ...]` -> tuple."""
    inner = (
        next((a for a in get_args(hint) if a is not type(None)), hint) if _optional(hint) else hint
    )
    return get_origin(inner) or inner


def _number(raw: Any) -> float | None:
    try:
        return float(raw) if type(raw) in (int, float) and math.isfinite(raw) else None
    except OverflowError:  # a whole number of hundreds of digits
        return None


def _words(raw: Any) -> tuple[str, ...] | None:
    ok = (
        isinstance(raw, list)
        and raw
        and all(isinstance(w, str) for w in raw)
        and len(set(raw)) == len(raw)
    )
    return tuple(raw) if ok else None


def _text_or_words(raw: Any) -> str | tuple[str, ...] | None:
    return raw if type(raw) is str else _words(raw)


def _whole_numbers(raw: Any) -> tuple[int, ...] | None:
    ok = (
        isinstance(raw, list)
        and raw
        and all(type(n) is int for n in raw)
        and len(set(raw)) == len(raw)
    )
    return tuple(raw) if ok else None


def _mapping(raw: Any) -> dict[str, Any] | None:
    return raw if isinstance(raw, dict) and all(isinstance(name, str) for name in raw) else None


def _exactly(kind: type) -> Callable[[Any], Any]:
    return lambda raw: raw if type(raw) is kind else None  # a bool is no int


_TYPES: dict[Any, tuple[str, Callable[[Any], Any]]] = {
    int: ("a whole number", _exactly(int)),
    float: ("a number", _number),
    bool: ("true or false", _exactly(bool)),
    str: ("text", _exactly(str)),
    tuple: ("a list of different words such as [a, b]", _words),
    str | tuple[str, ...] | None: (
        "text, or a list of different words such as [a, b]",
        _text_or_words,
    ),
    tuple[int, ...]: ("a list of different whole numbers such as [0, 1]", _whole_numbers),
    dict: ("a section of keys and values", _mapping),
}
