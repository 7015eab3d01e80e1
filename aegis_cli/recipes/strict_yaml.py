"""Strict YAML: no duplicate keys, none of the surprises of YAML 1.1, and a line for every key.

A `Problem` is one mistake; `refuse` reports all of them at once. This module knows nothing about
recipes.
"""

from __future__ import annotations

import contextlib
import copy
import difflib
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import yaml
from yaml.composer import Composer
from yaml.resolver import BaseResolver

from aegis_cli.common.errors import AegisError

_LARGEST = 100_000  # maximum number of values in a text
# Raised by PyYAML's constructors for `!!int ""`, `!!bool maybe` and the like, and by deep nesting.
_DAMAGED = (ValueError, KeyError, IndexError, TypeError, AttributeError, RecursionError)


class Problem(NamedTuple):
    """One mistake, in the terms of `AegisError`; `line` is its line in the file."""

    found: str
    expected: str
    fix: str
    line: int | None = None


class _Lines(dict[Any, Any]):
    """A mapping from a file; `lines` has the line of each key that still comes from the file."""

    lines: dict[str, int] = {}

    def __setitem__(self, name: Any, value: Any) -> None:
        # A new dict, since copies share this one.
        self.lines = {key: line for key, line in self.lines.items() if key != name}
        super().__setitem__(name, value)

    def put(self, name: str, value: Any, line: int | None) -> None:
        """Set a key with its line in the file, or None if it does not come from the file."""
        self[name] = value
        if line is not None:
            self.lines = {**self.lines, name: line}

    def __deepcopy__(self, memo: dict[int, Any]) -> _Lines:
        copied = _Lines((name, copy.deepcopy(value, memo)) for name, value in self.items())
        copied.lines = self.lines
        return copied


def line_of(raw: Mapping[Any, Any], name: Any) -> int | None:
    """The line of a key in its file; None if the key does not come from a file."""
    return raw.lines.get(str(name)) if isinstance(raw, _Lines) else None


def put(raw: dict[Any, Any], dotted: str, value: Any, line: int | None = None) -> str | None:
    """Set the key 'section.name' in place; missing sections are added.

    Args:
        raw: a mapping from `parse`, or a plain mapping, which keeps no lines.
        line: the line of the key in its file.

    Returns:
        None, or the name that is not a section, in which case nothing is set.
    """
    *sections, name = dotted.split(".")
    for section in sections:
        raw = raw.setdefault(section, _Lines())
        if not isinstance(raw, dict):  # such as the number in `train: 3`
            return section
    if isinstance(raw, _Lines):
        raw.put(name, value, line)
    else:
        raw[name] = value
    return None


def plain(value: Any) -> Any:
    """The same value with plain mappings, which have no lines."""
    if isinstance(value, dict):
        return {name: plain(inner) for name, inner in value.items()}
    return [plain(item) for item in value] if isinstance(value, list) else value


def did_you_mean(word: str, choices: Iterable[str]) -> str | None:
    """The choice closest to a mistyped `word`, if any is close."""
    return next(iter(difflib.get_close_matches(word.lower(), list(choices), n=1, cutoff=0.6)), None)


def refuse(problems: Sequence[Problem], source: str, without_line: str | None = None) -> None:
    """Raise one AegisError that names every problem, in the file's order, if there are any.

    Args:
        without_line: where a problem without a line may be, if not only in `source`.
    """
    if len(problems) == 1:
        only = problems[0]
        place = f"{source}, line {only.line}"
        if only.line is None:
            place = without_line or source
        raise AegisError(f"{only.found} (in {place})", only.expected, only.fix)
    if problems:
        # Problems without a line, such as those of an override, come first.
        ordered = sorted(problems, key=lambda problem: problem.line or 0)
        found = _numbered(_with_line(problem) for problem in ordered)
        expected = _numbered(problem.expected for problem in ordered)
        fix = _numbered(problem.fix for problem in ordered)
        raise AegisError(f"{len(problems)} problems in {source}{found}", expected, fix)


def _with_line(problem: Problem) -> str:
    return problem.found if problem.line is None else f"{problem.found} (line {problem.line})"


def _numbered(lines: Iterable[str]) -> str:
    return "".join(f"\n  {i}. {line}" for i, line in enumerate(lines, 1))


class _Loader(yaml.SafeLoader):
    """YAML with the scalars of version 1.2.

    In it `1e-4` is a number; `no`, `010` and `2024-01-01` are text.
    """

    yaml_implicit_resolvers: dict[str, Any] = {}  # without PyYAML's own, which follow YAML 1.1
    problems: list[Problem]

    def construct_lines(self, node: yaml.MappingNode) -> Iterator[_Lines]:
        """A mapping with the lines of its keys; duplicate keys become problems."""
        mapping = _Lines()
        yield mapping  # first, as in PyYAML's own constructors, for values that refer to themselves
        lines: dict[str, int] = {}
        for name_node, _ in node.value:
            line, name = name_node.start_mark.line + 1, str(name_node.value)
            if name in lines:
                found = f"the key '{name}' twice, in lines {lines[name]} and {line}"
                fix = f"delete '{name}' in one of these lines"
                self.problems.append(Problem(found, "each key once", fix))
            lines.setdefault(name, line)
        mapping.update(self.construct_mapping(node))
        mapping.lines = lines


_Loader.add_constructor("tag:yaml.org,2002:map", _Loader.construct_lines)


class _LibYaml(Composer, BaseResolver):
    """Composes nodes from the events that libyaml finds in a text.

    PyYAML's own function for this ends the process if a text is nested too deeply.
    """

    yaml_implicit_resolvers: dict[str, Any] = {}

    def __init__(self, text: str) -> None:
        Composer.__init__(self)
        BaseResolver.__init__(self)
        events = yaml.cyaml.CParser(text)
        self.check_event = events.check_event
        self.peek_event = events.peek_event
        self.get_event = events.get_event


class _Dumper(yaml.SafeDumper):
    """Quotes text that YAML 1.1 or 1.2 would read as something else."""


# The type of an unquoted scalar by its pattern, and the characters that it may start with: PyYAML
# tries only the patterns for a scalar's first character. The dumper keeps 1.1's patterns as well.
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
    for _class in (_Loader, _LibYaml, _Dumper):
        _class.add_implicit_resolver(
            f"tag:yaml.org,2002:{_tag}", re.compile(f"(?:{_pattern})$"), _first
        )


def dump(value: Any) -> str:
    """Plain values as YAML that `parse` reads back unchanged; keys keep their order."""
    return yaml.dump(value, Dumper=_Dumper, sort_keys=False, allow_unicode=True)


def parse(text: str, source: str) -> tuple[Any, list[Problem]]:
    """The plain value of a YAML text, and the keys given twice.

    Raises:
        AegisError: the text is not YAML, or its values are nested or repeated too much; no other
            problem can be found then.
    """
    loader = _Loader("")  # constructs values from nodes
    loader.problems = []
    try:
        node = _node(text)
        if node is None:  # empty, or only comments
            return None, loader.problems
        # Before values are constructed: a few lines of aliases can stand for billions of values.
        if _size(node, {}) > _LARGEST:
            raise ValueError(f"more than {_LARGEST} values, counted as often as they are named")
        return _each_its_own(loader.construct_document(node)), loader.problems
    except (yaml.YAMLError, *_DAMAGED) as e:
        mark = getattr(e, "problem_mark", None)
        where = f" line {mark.line + 1}, column {mark.column + 1}:" if mark else ""
        why = getattr(e, "problem", None) or _why(e)
        raise AegisError(
            f"{source}:{where} {why}", "YAML: lines of 'key: value'", "correct that line"
        ) from None


def _node(text: str) -> yaml.Node | None:
    """A text as nodes. libyaml needs a fifth of the time; PyYAML reads what libyaml refuses.

    Raises:
        yaml.YAMLError: the text is not YAML; the message is PyYAML's.
    """
    if yaml.__with_libyaml__:
        with contextlib.suppress(yaml.YAMLError, ValueError):
            return _LibYaml(text).get_single_node()
    return _Loader(text).get_single_node()


def _each_its_own(value: Any) -> Any:
    """The same value with aliases replaced by copies, so that changing one leaves the others."""
    if isinstance(value, _Lines):
        copied = _Lines((name, _each_its_own(inner)) for name, inner in value.items())
        copied.lines = value.lines
        return copied
    return [_each_its_own(inner) for inner in value] if isinstance(value, list) else value


def _why(error: Exception) -> str:
    """What is wrong with the text, from an error that PyYAML's constructors do not catch."""
    if isinstance(error, RecursionError):
        return "values nested too deeply"
    if isinstance(error, ValueError) and str(error):
        return str(error).splitlines()[0]
    return "a value that is not of the kind that its tag says"


def _size(node: yaml.Node, known: dict[int, int]) -> int:
    """How many values a node stands for if all aliases are expanded.

    Args:
        known: the sizes of the nodes so far by id; a node that is still being counted has a size
            above the limit, since it contains itself.
    """
    if id(node) in known:
        return known[id(node)]
    known[id(node)] = _LARGEST + 1
    count = 1
    for item in [] if isinstance(node, yaml.ScalarNode) else node.value:
        pair = (
            item if isinstance(item, tuple) else (item,)
        )  # a key with its value, or a list's item
        count += sum(_size(part, known) for part in pair)
    known[id(node)] = count
    return count


def _quoted(text: str) -> str:
    """A text in quotes for YAML, inside quotes for a shell."""
    return shlex.quote("'" + text.strip().replace("'", "''") + "'")


def override(raw: dict[Any, Any], setting: str) -> list[Problem]:
    """Put one `a.b=c` into the raw mapping; `build` checks whether a.b and c are valid.

    `c` is YAML, except for a text that starts with a placeholder, such as `{} Answer briefly.`
    """
    dotted, equals, text = setting.partition("=")  # the value may contain further `=`
    dotted = dotted.strip()
    if not equals or not all(dotted.split(".")):
        fix = "write e.g. --set train.steps=200"
        return [Problem(f"--set '{setting}'", "--set KEY=VALUE", fix)]
    if text.startswith("{}") and text.strip() != "{}":
        value, problems = text, list[Problem]()
    else:
        try:
            value, problems = parse(text, f"--set '{setting}'")
        except AegisError as error:
            fix = f"if it is a text, put it in quotes: --set {dotted}={_quoted(text)}"
            return [Problem(error.found, "a value as in YAML", fix)]
    in_the_way = put(raw, dotted, plain(value))
    if in_the_way:
        found = f"--set '{setting}', but '{in_the_way}' has no keys below it"
        return [Problem(found, "a section and its key", f"correct '{in_the_way}'")]
    return problems
