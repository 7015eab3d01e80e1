"""The recipes that come with Aegis, by their names."""

from __future__ import annotations

import itertools
import sysconfig
from dataclasses import dataclass
from pathlib import Path

from aegis_cli.common.errors import AegisError
from aegis_cli.recipes.kinds import KINDS

_CHECKOUT = Path(__file__).parents[2] / "recipes"  # in a checkout of the sources
_INSTALLED = Path(sysconfig.get_path("data")) / "share" / "aegis-vla" / "recipes"  # from a wheel
_FIRST = "quickstart"


@dataclass(frozen=True)
class Shipped:
    """A recipe, its kind, and the command and purpose in its first lines."""

    name: str
    kind: str
    command: str
    about: str


@dataclass(frozen=True)
class Listed:
    """All recipes, grouped by kind: policies first, and the quickstart before them."""

    recipes: list[Shipped]


@dataclass(frozen=True)
class Shown:
    """A recipe with the text of its file."""

    name: str
    path: str
    text: str


@dataclass(frozen=True)
class Copied:
    """A recipe that was copied to `out`."""

    name: str
    out: str


def folder() -> Path:
    """The folder of the recipes.

    Raises:
        AegisError: this installation has no recipes.
    """
    for place in (_CHECKOUT, _INSTALLED):
        if (place / "quickstart.yaml").is_file():
            return place
    raise AegisError(
        f"no recipes in {_CHECKOUT} or {_INSTALLED}",
        "the recipes that come with Aegis",
        "install Aegis again, or give the path of a recipe file",
    )


def listed() -> Listed:
    """Every recipe that comes with Aegis."""
    kinds = list(KINDS)
    found = [_described(path) for path in folder().glob("*.yaml")]
    found.sort(key=lambda one: (kinds.index(one.kind), one.name != _FIRST, one.name))
    return Listed(found)


def path(name: str) -> Path:
    """The file of a recipe by its name.

    Raises:
        AegisError: there is no recipe of this name.
    """
    found = folder() / f"{name}.yaml"
    if not found.is_file():
        names = ", ".join(recipe.name for recipe in listed().recipes)
        raise AegisError(f"no recipe '{name}'", f"one of {names}", "aegis recipes ls lists them")
    return found


def is_one(name: str) -> bool:
    """Whether a recipe of this name comes with Aegis."""
    return any((place / f"{name}.yaml").is_file() for place in (_CHECKOUT, _INSTALLED))


def find(given: Path) -> Path:
    """The file that a user means: the file at this path, or the recipe of this name."""
    bare = given.name == str(given) and not given.suffix  # `quickstart`; a file takes precedence
    return path(given.name) if bare and not given.exists() else given


def _described(path: Path) -> Shipped:
    """A recipe's description from the comment at its start.

    Its first line is the command, followed by a description of which the first sentence is used.
    The line below the comment gives the kind.
    """
    # Read as text, because YAML drops comments.
    lines = path.read_text(encoding="utf-8").splitlines()
    comment = list(itertools.takewhile(lambda line: line.startswith("#"), lines))
    kind = lines[len(comment)].removeprefix("kind:").strip()
    command, *about = (line.removeprefix("#").strip() for line in comment)
    first, dot, _ = " ".join(about).partition(". ")
    return Shipped(path.stem, kind, command, first + dot.strip())
