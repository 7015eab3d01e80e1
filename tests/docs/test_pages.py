"""What a reader relies on: a short README, links that work, and pages that can be found."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from samples.command_blocks import ROOT

from aegis_cli import recipes
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.backbones.families import FAMILIES
from aegis_cli.sim.contract import TaskEnv

README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = sorted((ROOT / "docs").glob("**/*.md"))
LINKING = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES]

_LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
_FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)


def links(path: Path) -> list[str]:
    """Targets of the page's links and pictures that are in this repository."""
    text = _FENCE.sub("", path.read_text(encoding="utf-8"))
    return [target for target in _LINK.findall(text) if "://" not in target]


def anchors(path: Path) -> set[str]:
    """Possible targets of links into a page: its headings in lower case, words joined by '-'."""
    text = _FENCE.sub("", path.read_text(encoding="utf-8"))
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {
        re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower())
        for heading in headings
    }


def test_a_page_has_no_section_twice() -> None:
    """A link could only lead to one of them."""
    for path in [*LINKING, ROOT / "CHANGELOG.md"]:
        text = _FENCE.sub("", path.read_text(encoding="utf-8"))
        own = re.findall(r"^## .+$", text, re.MULTILINE)
        assert sorted(set(own)) == sorted(own), path


def test_the_readme_is_short() -> None:
    assert len(README.splitlines()) <= 150


def test_the_readme_starts_with_title_and_picture() -> None:
    title, picture = [line for line in README.splitlines() if line][:2]
    assert title == "# Aegis" and picture.startswith("![") and "docs/pictures/" in picture


def test_the_two_setup_commands_come_first() -> None:
    block = re.search(r"^```sh\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)
    assert block is not None and README.count("\n", 0, block.end()) < 30
    commands = [line.partition("#")[0].strip() for line in block[1].splitlines()]
    assert commands == [
        "pip install -e . && aegis run recipes/quickstart.yaml",
        "pip install -e '.[test]' && pytest",
    ]


def test_the_readme_has_two_tables() -> None:
    rules = re.findall(r"^\|(?:-+\|)+$", README, re.MULTILINE)
    assert len(rules) == 2


@pytest.mark.parametrize("path", LINKING, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_link_leads_somewhere(path: Path) -> None:
    missing = []
    for target in links(path):
        file, _, anchor = target.partition("#")
        found = (path.parent / file).resolve() if file else path
        if not found.exists() or (anchor and anchor not in anchors(found)):
            missing.append(target)
    assert missing == []


def test_there_are_links() -> None:
    assert sum(len(links(path)) for path in LINKING) > 60


def listed(entry: object) -> list[str]:
    """The pages of a part of the navigation, in order."""
    if isinstance(entry, str):
        return [entry]
    parts = entry.values() if isinstance(entry, dict) else entry
    return [page for part in parts for page in listed(part)]


def test_every_page_is_in_the_navigation() -> None:
    site = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    pages = [str(path.relative_to(ROOT / "docs")) for path in PAGES]
    assert len(pages) >= 18 and sorted(listed(site["nav"])) == pages


@pytest.mark.parametrize(
    ("page", "names"),
    [
        ("methods", recipes.METHODS),
        ("tasks", recipes.TASKS),
        ("streams", recipes.LEARNERS),
        ("hugging-face", tuple(FAMILIES)),
    ],
)
def test_what_can_be_chosen_has_a_row(page: str, names: tuple[str, ...]) -> None:
    """Whoever adds one is told that its page still lacks it."""
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    rows = "\n".join(line for line in text.splitlines() if line.startswith("|"))
    assert names
    assert [name for name in names if f"`{name}`" not in rows] == []


def test_every_method_has_a_section() -> None:
    found = re.findall(r"^## (.+)$", (ROOT / "docs" / "methods.md").read_text(), re.MULTILINE)
    assert [name for name in recipes.METHODS if name not in found] == []


@pytest.mark.parametrize(
    ("kind", "members"),
    [
        (Backbone, {*Backbone.__abstractmethods__, "depth", "width", "heads", "kv_heads"}),
        (TaskEnv, {*TaskEnv.__annotations__, *(n for n in vars(TaskEnv) if n.islower())}),
    ],
)
def test_contributors_are_told_all_that_a_new_one_needs(kind: type, members: set[str]) -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    own = {name for name in members if not name.startswith("_")}
    assert len(own) >= 6, kind
    assert [name for name in sorted(own) if f"`{name}`" not in text] == []
