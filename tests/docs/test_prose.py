"""Commands, options, recipe keys and files that the pages name in their sentences exist."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Mapping
from typing import Any

import pytest
from samples.command_blocks import FENCE, PAGES, ROOT

Aegis = Callable[..., tuple[int, str, str]]  # words -> exit code, stdout, stderr
RECIPES = sorted((ROOT / "recipes").glob("*.yaml"))


def spans(page: str) -> list[str]:
    """The text that the page's sentences and tables format as code."""
    return re.findall(r"`([^`\n]+)`", FENCE.sub("", PAGES[page]))


SPANS = sorted({span for page in PAGES for span in spans(page)})
COMMANDS = [shlex.split(span)[1:] for span in SPANS if re.match(r"aegis [a-z]", span)]
# LeRobot's programs and optimizers have options with dots and underscores.
OPTION = r"(?<!\S)--[a-z][a-z-]*(?![a-z._-])"
OPTIONS = sorted({word for span in SPANS for word in re.findall(OPTION, span)})
SETTINGS = sorted({m[1] for span in SPANS if (m := re.search(r"--set '?([a-z][\w.]*)=", span))})


@pytest.fixture
def helps(aegis: Aegis) -> dict[str, str]:
    """Each command's help, by its name."""
    _, out, _ = aegis("--help")
    names = re.findall(r"^  ([a-z]+)  ", out.partition("Commands:")[2], re.MULTILINE)
    return {name: aegis(name, "--help")[1] for name in names}


@pytest.fixture
def recipe_keys(aegis: Aegis) -> set[str]:
    """Every key of every shipped recipe, defaults included, with dots between its parts."""
    reports = [aegis("inspect", path, "--json")[1] for path in RECIPES]
    return {key for report in reports for key in dotted(json.loads(report)["recipe"])}


def dotted(mapping: Mapping[str, Any], before: str = "") -> set[str]:
    """`train.steps` for {"train": {"steps": 3}}, and `train`."""
    own = {before + key for key in mapping}
    inside = [dotted(v, f"{before}{k}.") for k, v in mapping.items() if isinstance(v, dict)]
    return own.union(*inside)


def test_commands_in_sentences_are_there(helps: Mapping[str, str]) -> None:
    assert len(COMMANDS) > 15
    for command, *words in COMMANDS:
        assert command in helps, f"aegis {command}"
        missing = [word for word in words if word.startswith("--") and word not in helps[command]]
        assert missing == [], f"aegis {command}"


def test_options_in_sentences_are_some_commands(helps: Mapping[str, str]) -> None:
    known = {option for text in helps.values() for option in re.findall(r"--[a-z][a-z-]*", text)}
    assert len(OPTIONS) > 15 and [option for option in OPTIONS if option not in known] == []


def test_settings_in_sentences_are_recipe_keys(recipe_keys: set[str]) -> None:
    assert len(SETTINGS) > 5 and [key for key in SETTINGS if key not in recipe_keys] == []


def test_dotted_keys_in_sentences_are_recipe_keys(recipe_keys: set[str]) -> None:
    """They are words like `train.weights`, with two parts, whose first is a recipe's section."""
    sections = {key.partition(".")[0] for key in recipe_keys if "." in key}
    files = {"py", "json", "jsonl", "md", "yaml", "safetensors", "png"}
    words = (re.fullmatch(r"(\w+)\.(\w+)([:=].+)?", span) for span in SPANS)
    keys = {f"{m[1]}.{m[2]}" for m in words if m and m[1] in sections and m[2] not in files}
    assert len(keys) > 15 and sorted(keys - recipe_keys) == []


def test_files_in_sentences_are_there() -> None:
    """Paths of this repository, some of them patterns."""
    rooms = r"(?:aegis_cli|recipes|tests|docs|\.ci)/[\w./*-]*"
    paths = [span for span in SPANS if re.fullmatch(rooms, span)]
    missing = [path for path in paths if not list(ROOT.glob(path))]
    assert len(paths) > 25 and missing == []
