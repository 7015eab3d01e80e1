"""Strict YAML: no key twice, none of the surprises of YAML 1.1, and a line for every key.

A `Problem` is one mistake; `refuse` names all of them at once. Knows nothing about recipes.
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

_LARGEST = 100_000  # values in a text
# What PyYAML's constructors raise at `!!int ""`, `!!bool maybe` and the like, and at great depth.
_DAMAGED = (ValueError, KeyError, IndexError, TypeError, AttributeError, RecursionError)


class Problem(NamedTuple):
    """One mistake, in the words of `AegisError`; `line` is where it stands in the file."""

    found: str
    expected: str
    fix: str
    line: int | None = None


class _Lines(dict[Any, Any]):
    """A mapping of a file; `lines` says where each key stands that is still the file's own."""

    lines: dict[str, int] = {}

    def __setitem__(self, name: Any, value: Any) -> None:
        # A new mapping, since copies share this one.
        self.lines = {key: line for key, line in self.lines.items() if key != name}
        super().__setitem__(name, value)

    def put(self, name: str, value: Any, line: int | None) -> None:
        """Set a key that stands in this line of the file; None if it is not from there."""
        self[name] = value
        if line is not None:
            self.lines = {**self.lines, name: line}

    def __deepcopy__(self, memo: dict[int, Any]) -> _Lines:
        copied = _Lines((name, copy.deepcopy(value, memo)) for name, value in self.items())
        copied.lines = self.lines
        return copied


def line_of(raw: Mapping[Any, Any], name: Any) -> int | None:
    """The line of a key in its file; None where the key is not from a file."""
    return raw.lines.get(str(name)) if isinstance(raw, _Lines) else None


def put(raw: dict[Any, Any], dotted: str, value: Any, line: int | None = None) -> str | None:
    """Set the key 'section.name' in place; sections that are missing are added.

    Args:
        raw: as `parse` returns it, or a plain mapping, which keeps no lines.
        line: where the key stands in its file.

    Returns:
        The section that is none, in which case nothing is set; None if all went well.
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
    """The same value, whose mappings no longer know their lines."""
    if isinstance(value, dict):
        return {name: plain(inner) for name, inner in value.items()}
    return [plain(item) for item in value] if isinstance(value, list) else value


def did_you_mean(word: str, choices: Iterable[str]) -> str | None:
    """The choice closest to a mistyped `word`, if any is close."""
    return next(iter(difflib.get_close_matches(word.lower(), list(choices), n=1, cutoff=0.6)), None)


def refuse(problems: Sequence[Problem], source: str) -> None:
    """Raise one AegisError that names every problem, in the file's order, if there are any."""
    if len(problems) == 1:
        only = problems[0]
        place = source if only.line is None else f"{source}, line {only.line}"
        raise AegisError(f"{only.found} (in {place})", only.expected, only.fix)
    if problems:
        # What has no line, such as an override, comes first.
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

    There `1e-4` is a number; `no`, `010` and `2024-01-01` are text.
    """

    yaml_implicit_resolvers: dict[str, Any] = {}  # none of PyYAML's own, which are those of 1.1
    problems: list[Problem]

    def construct_lines(self, node: yaml.MappingNode) -> Iterator[_Lines]:
        """A mapping whose keys know their lines; keys given twice become problems."""
        mapping = _Lines()
        yield mapping  # first, as PyYAML's own constructors do, for what refers to itself
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
    """Nodes of the events that libyaml finds in a text.

    They are made here, since the function of PyYAML's that makes them of libyaml's events ends the
    process at a text that is nested too deeply.
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
    """Quotes text that YAML 1.1 or 1.2 would take for something else."""


# What a scalar without quotes is, by its letters, and which letters it may begin with: PyYAML only
# tries the patterns of a scalar's first letter. The dumper has 1.1's patterns too, as its own.
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
        AegisError: the text is not YAML, or its values are nested or repeated beyond measure;
            nothing else can be judged then.
    """
    loader = _Loader("")  # what makes values of nodes
    loader.problems = []
    try:
        node = _node(text)
        if node is None:  # nothing, or comments alone
            return None, loader.problems
        # Before anything is made of it: a few lines of aliases can stand for billions of values.
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
    """A text as nodes. libyaml takes a fifth of the time; what it refuses, PyYAML judges.

    Raises:
        yaml.YAMLError: the text is not YAML, in PyYAML's words.
    """
    if yaml.__with_libyaml__:
        with contextlib.suppress(yaml.YAMLError, ValueError):
            return _LibYaml(text).get_single_node()
    return _Loader(text).get_single_node()


def _each_its_own(value: Any) -> Any:
    """The same value, in which what an alias names is a copy: to change one leaves the other."""
    if isinstance(value, _Lines):
        copied = _Lines((name, _each_its_own(inner)) for name, inner in value.items())
        copied.lines = value.lines
        return copied
    return [_each_its_own(inner) for inner in value] if isinstance(value, list) else value


def _why(error: Exception) -> str:
    """What is wrong with the text, by an error that PyYAML's own constructors let pass."""
    if isinstance(error, RecursionError):
        return "values nested too deeply"
    if isinstance(error, ValueError) and str(error):
        return str(error).splitlines()[0]
    return "a value that is not of the kind that its tag says"


def _size(node: yaml.Node, known: dict[int, int]) -> int:
    """How many values a node stands for when each alias is written out.

    Args:
        known: the sizes of the nodes so far by their ids; that of a node that is still being
            counted is infinite for our purpose, for it holds itself.
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
    """A text in YAML's quotes, and in a shell's."""
    return shlex.quote("'" + text.strip().replace("'", "''") + "'")


def override(raw: dict[Any, Any], setting: str) -> list[Problem]:
    """Put one `a.b=c` into the raw mapping; whether a.b and c are any good, `build` says.

    `c` is YAML, but for a text that begins with a place for another: `{} Answer briefly.`
    """
    dotted, equals, text = setting.partition("=")  # the value may have further signs
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
