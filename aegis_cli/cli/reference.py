"""Generates two pages of docs/ from the code: recipes.md and cli.md.

`python -m aegis_cli.cli.reference docs` writes both; a test compares them with the committed pages.
They are made from the declarations of keys and options, not from formatted help, so they do not
depend on a terminal or on the version of a library.
"""

from __future__ import annotations

import argparse
import dataclasses
import enum
import inspect
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, get_args, get_type_hints

import typer

from aegis_cli.cli.app import app
from aegis_cli.common import files
from aegis_cli.recipes import KINDS, name_of
from aegis_cli.recipes.keys import (
    NOT_EMPTY,
    NOT_EMPTY_EACH,
    Check,
    base_type,
    is_optional,
    is_required,
    is_retired,
)
from aegis_cli.recipes.kinds import TELLING
from aegis_cli.recipes.strict_yaml import dump

_GENERATED = (
    "<!-- Written by `python -m aegis_cli.cli.reference docs`; change the code instead. -->"
)
_TYPES: dict[Any, str] = {
    int: "whole number",
    float: "number",
    bool: "true or false",
    str: "text",
    dict: "keys and values",
    dict[str, str] | None: "names with names",
    str | tuple[str, ...]: "text or list of words",
    str | tuple[str, ...] | None: "text or list of words",
    tuple[int, ...]: "list of whole numbers",
    tuple[int, ...] | None: "list of whole numbers",
    tuple[float, ...] | None: "list of numbers",
    tuple[float, float]: "list of two numbers",
    tuple: "list of words",
}
_ABOUT_RECIPES = """\
A recipe is a YAML file that says what a command does. `name` and what is marked *required* must
stand in it; every other key has a default.

- `aegis inspect recipes/quickstart.yaml` prints a recipe with every key written out.
- `--set train.steps=200` overrides a key for one call; lists are written `--set 'seeds=[0, 1]'`.
- A key that does not exist, a value out of range and a key given twice are refused; one message
  names all of them, each with its line and what was probably meant.
- Numbers are those of YAML 1.2: `1e-4` is a number, and `no` and `010` are text."""
_ABOUT_COMMANDS = """\
`aegis COMMAND --help` prints the same text. `python -m aegis_cli` is the command too, where its
script is not on the path. Reports go to standard output, as tables or with `--json` as JSON;
progress and messages go to standard error."""


def recipes_page() -> str:
    """docs/recipes.md: every kind of recipe with every section and key."""
    lines = ["# Recipes", "", _GENERATED, "", _ABOUT_RECIPES, "", "## Kinds", ""]
    rows = [
        (f"[`{name}`](#{name})", f"`aegis {'`, `aegis '.join(kind.commands)}`", _said(kind.recipe))
        for name, kind in KINDS.items()
    ]
    lines += [*_table(("`kind`", "Commands", "What it does"), rows), "", _without_kind()]
    described: dict[type, str] = {}  # section -> the heading of its description
    for name, kind in KINDS.items():
        lines += ["", f"## {name}", "", _said(kind.recipe), ""]
        lines += _keys(
            kind.recipe, lead=[("`kind`", f"`{name}`", f"`{name}`", "What the recipe is.")]
        )
        for dotted, section in _sections(kind.recipe):
            lines += ["", f"### {name}: {dotted}", "", _said(section), ""]
            if section in described:  # such as `probe`, which occurs in several kinds
                first = described[section]
                lines.append(f"The keys are those of [{first}](#{_anchor(first)}).")
            else:
                described[section] = f"{name}: {dotted}"
                lines += _keys(section)
    return "\n".join(lines) + "\n"


def _without_kind() -> str:
    """The kind of a file that does not name one, in words."""
    cases = [f"`{name}` makes it `{name_of(kind)}`" for name, kind in TELLING.items()]
    return (
        "A file without the line `kind: ...` is told by the first of these keys that it has: "
        f"{', '.join(cases)}. Without any of them it is `policy`, and `pretrain` for `aegis "
        "pretrain`."
    )


def _sections(recipe: type) -> Iterator[tuple[str, type]]:
    """The sections of a recipe by name; `variants.NAME` for a mapping of sections."""
    for name, hint in get_type_hints(recipe).items():
        kind = base_type(hint)
        if dataclasses.is_dataclass(kind):
            yield name, kind
        elif kind is dict and dataclasses.is_dataclass(get_args(hint)[1]):
            yield f"{name}.NAME", get_args(hint)[1]


def _keys(section: type, lead: Sequence[tuple[str, ...]] = ()) -> list[str]:
    """A table of a section's own keys."""
    hints = get_type_hints(section)
    rows = list(lead)
    for field in dataclasses.fields(section):
        hint = hints[field.name]
        if dataclasses.is_dataclass(base_type(hint)) or is_retired(field):
            continue  # sections have their own headings, and retired keys have no effect
        takes = _takes(hint, field.metadata["check"])
        rows.append((f"`{field.name}`", takes, _default(field), field.metadata["doc"]))
    return _table(("Key", "Takes", "Default", "Meaning"), rows)


def _takes(hint: Any, check: Check | None) -> str:
    """A key's type and allowed values: `whole number, above 0, or null`."""
    words = _TYPES.get(hint) or _TYPES[base_type(hint)]
    # "not empty" is obvious for a text, and so is the type "text" for a choice of words.
    limits = [check.expected] if check and check not in (NOT_EMPTY, NOT_EMPTY_EACH) else []
    known = [] if words == "text" and check and check.choices else [words]
    return ", ".join(known + limits + (["or null"] if is_optional(hint) else []))


def _default(field: dataclasses.Field[Any]) -> str:
    if is_required(field):
        return "*required*"
    value = {} if field.default is dataclasses.MISSING else field.default  # `factory=dict`
    if isinstance(value, tuple):
        return f"`[{', '.join(map(str, value))}]`"
    return f"`{dump(value).splitlines()[0]}`"


def cli_page() -> str:
    """docs/cli.md: every command with its arguments and options."""
    root: Any = typer.main.get_command(app)
    lines = ["# Commands", "", _GENERATED, "", *_prose(root), "", _ABOUT_COMMANDS, ""]
    rows = [(f"[`aegis {name}`](#aegis-{name})", c.short_help) for name, c in root.commands.items()]
    lines += _table(("Command", "What it does"), rows)
    for name, command in root.commands.items():
        lines += ["", f"## aegis {name}", "", f"`{_usage(name, command)}`", ""]
        lines += [*_prose(command), ""]
        rows = [_option(command, param) for param in command.params]
        lines += _table(("Option", "Default", "Meaning"), rows)
    return "\n".join(lines) + "\n"


def _usage(name: str, command: Any) -> str:
    """`aegis train RECIPE --out FOLDER [OPTIONS]`."""
    needed = [_spelled(command, param) for param in command.params if param.required]
    return " ".join(["aegis", name, *needed, "[OPTIONS]"])


def _option(command: Any, param: Any) -> tuple[str, str, str]:
    value = param.default.value if isinstance(param.default, enum.Enum) else param.default
    shown = value is not None and not isinstance(value, bool)
    default = "*required*" if param.required else f"`{value}`" if shown else ""
    return f"`{_spelled(command, param)}`", default, param.help


def _spelled(command: Any, param: Any) -> str:
    """An argument's word, or an option with a placeholder for its value: `--out FOLDER`."""
    if _is_argument(param):
        return param.metavar
    hint = base_type(get_type_hints(command.callback)[param.name])
    if hint is bool:
        return param.opts[0]
    words = "|".join(hint) if issubclass(hint, enum.StrEnum) else _TYPES.get(hint, "").upper()
    return f"{param.opts[0]} {param.metavar or words.replace(' ', '-')}"


def _is_argument(param: Any) -> bool:
    return param.param_type_name == "argument"


def _prose(command: Any) -> list[str]:
    """A command's help as Markdown: paragraphs that click does not wrap become separate blocks."""
    lines: list[str] = []
    for paragraph in inspect.cleandoc(command.help).split("\n\n"):
        head, *kept = paragraph.split("\n")
        if head.strip() != "\b":  # click's mark for a paragraph that it does not wrap
            lines += ["", " ".join([head, *(line.strip() for line in kept)])]
            continue
        notes = [" ".join(line.split()) for line in kept if _is_note(line)]
        # `Example: aegis ...` without its first word; continuation lines have none.
        code = [line.partition(": ")[2] or line for line in kept if not _is_note(line)]
        lines += ["", *(notes if len(notes) == 1 else [f"- {note}" for note in notes])]
        if code:
            lines += ["", "```text", *code, "```"]
    return lines[1:]  # without the blank line before the first paragraph


def _is_note(line: str) -> bool:
    """Whether a line is text, not an example or its continuation."""
    return not line.startswith(("Example:", "Start with:", " "))


def _said(section: type) -> str:
    """A docstring as one paragraph."""
    return " ".join(inspect.cleandoc(section.__doc__ or "").split())


def _anchor(heading: str) -> str:
    """The link target that Markdown makes from a heading."""
    kept = "".join(c for c in heading.lower() if c.isalnum() or c in " -_")
    return kept.replace(" ", "-")


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return [f"| {' | '.join(map(_cell, line))} |" for line in lines]


def _cell(text: str) -> str:
    """A text escaped so that it neither ends its cell nor starts an HTML element."""
    return text.replace("|", r"\|").replace("<", "&lt;")


PAGES = {"recipes.md": recipes_page, "cli.md": cli_page}


def main() -> None:
    """Write the pages into a folder."""
    parser = argparse.ArgumentParser(description="Write docs/recipes.md and docs/cli.md.")
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    files.make_folder(folder)
    for name, page in PAGES.items():
        files.write_text(folder / name, page())


if __name__ == "__main__":
    main()
