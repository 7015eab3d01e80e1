"""The pages generated from the code: committed as generated, and complete."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import get_type_hints

import pytest
import typer
from typer.models import OptionInfo

from aegis_cli.cli import reference
from aegis_cli.cli.app import app
from aegis_cli.recipes import KINDS
from aegis_cli.recipes.keys import is_retired

DOCS = Path(__file__).parent.parent.parent / "docs"


@pytest.mark.parametrize("name", reference.PAGES)
def test_the_committed_page_is_the_one_that_the_code_writes(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "40")  # independent of any terminal
    said = f"run: python -m aegis_cli.cli.reference {DOCS.name}"
    assert (DOCS / name).read_text(encoding="utf-8") == reference.PAGES[name](), said


@pytest.mark.parametrize("kind", KINDS)
def test_every_key_of_a_recipe_has_a_row(kind: str) -> None:
    page = reference.recipes_page()
    for field in dataclasses.fields(KINDS[kind].recipe):
        assert f"| `{field.name}` |" in page or f"### {kind}: {field.name}\n" in page
        if dataclasses.is_dataclass(field.default):
            inner = [f.name for f in dataclasses.fields(field.default) if not is_retired(f)]
            assert inner and all(f"| `{name}` |" in page for name in inner)


def test_every_option_of_a_command_has_a_row() -> None:
    commands = typer.main.get_command(app).commands
    sections = dict(re.findall(r"## aegis (\w+)\n(.*?)(?=\n## |\Z)", reference.cli_page(), re.S))
    assert sections.keys() == commands.keys()
    for name, command in commands.items():
        for param in command.params:
            said = param.metavar if param.param_type_name == "argument" else param.opts[0]
            assert re.search(rf"^\| `{re.escape(said)}[ `]", sections[name], re.M)


def test_no_option_is_spelled_as_its_metavar() -> None:
    """As typer 0.27 did if both have the same letters: `--DEVICE` for `--device DEVICE`."""
    seen = 0
    for command in app.registered_commands:
        hints = get_type_hints(command.callback, include_extras=True)
        for name, hint in hints.items():
            for said in getattr(hint, "__metadata__", ()):
                if isinstance(said, OptionInfo) and (said.metavar or "").lower() == name:
                    given = said.default, *said.param_decls  # typer takes the first name there
                    assert f"--{name}" in given, (command.callback, name)
                    seen += 1
    assert seen > 10


def test_links_within_the_page_lead_to_its_headings() -> None:
    for page in (reference.recipes_page(), reference.cli_page()):
        headings = {reference._anchor(line) for line in re.findall(r"^#+ (.+)$", page, re.M)}
        targets = set(re.findall(r"\]\(#([^)]+)\)", page))
        assert targets and targets <= headings


def test_the_module_writes_both_pages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["reference", str(tmp_path / "docs")])
    reference.main()
    assert {path.name for path in (tmp_path / "docs").iterdir()} == {"recipes.md", "cli.md"}
