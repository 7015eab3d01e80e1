"""The kinds of recipes: how a file names its kind, and which commands read it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from aegis_cli.common.errors import AegisError
from aegis_cli.recipes.policy import Recipe
from aegis_cli.recipes.pretraining import DualRecipe, PretrainRecipe
from aegis_cli.recipes.streams import RobotStreamRecipe, StreamRecipe
from aegis_cli.recipes.strict_yaml import did_you_mean, line_of
from aegis_cli.recipes.studies import (
    AnyStudy,
    RobotStreamStudyRecipe,
    StreamStudyRecipe,
    StudyRecipe,
)

AnyRecipe = Recipe | StreamRecipe | RobotStreamRecipe | AnyStudy | PretrainRecipe | DualRecipe


class Kind(NamedTuple):
    """A kind of recipe.

    Attributes:
        recipe: the dataclass with its keys.
        what: a description of such a file, which is followed by 'for `aegis run`'.
        commands: the commands that read it.
    """

    recipe: type
    what: str
    commands: tuple[str, ...]


KINDS: dict[str, Kind] = {
    "policy": Kind(Recipe, "a recipe", ("run", "train")),
    "study": Kind(StudyRecipe, "a study of several runs, a recipe", ("run",)),
    "stream": Kind(StreamRecipe, "a stream of tasks, a recipe", ("train",)),
    "robot-stream": Kind(RobotStreamRecipe, "a stream of robot tasks, a recipe", ("train",)),
    "stream-study": Kind(StreamStudyRecipe, "a study of several runs, a recipe", ("run",)),
    "robot-stream-study": Kind(
        RobotStreamStudyRecipe, "a study of several runs, a recipe", ("run",)
    ),
    "pretrain": Kind(PretrainRecipe, "a recipe", ("pretrain",)),
    "pretrain-dual": Kind(DualRecipe, "a recipe", ("pretrain",)),
}
_NAMES = {kind.recipe: name for name, kind in KINDS.items()}

# If a file names no kind, the first of these keys that it has decides its kind.
TELLING: dict[str, type] = {
    "streams": StreamStudyRecipe,
    "pairs": StreamStudyRecipe,
    "variants": StudyRecipe,
    "shared": StudyRecipe,
    "stream": StreamRecipe,
    "scenes": PretrainRecipe,
    "pictures": DualRecipe,
    "towers": DualRecipe,
    "tasks": RobotStreamRecipe,
}


def take_kind(raw: dict[Any, Any], path: Path, default: type = Recipe) -> type:
    """The kind of a recipe; removes its key `kind` from the raw keys.

    A file names its kind, such as `kind: stream`. In an older file without that line, the first key
    of `TELLING` that it has decides. Without any of them, it is the command's default kind.

    Raises:
        AegisError: there is no such kind.
    """
    if "kind" not in raw:
        return next((kind for name, kind in TELLING.items() if name in raw), default)
    line = line_of(raw, "kind")
    name = raw.pop("kind")  # no section has this key, so `build` would call it unknown
    if isinstance(name, str) and name in KINDS:
        return KINDS[name].recipe
    near = did_you_mean(str(name), KINDS)
    place = path if line is None else f"{path}, line {line}"
    fix = f"did you mean '{near}'?" if near else "choose one of them"
    raise AegisError(f"kind: {name} (in {place})", f"kind: one of {', '.join(KINDS)}", fix)


def name_of(recipe: type) -> str:
    """The value of `kind` in a recipe's file."""
    return _NAMES[recipe]


def describe(recipe: type) -> str:
    """A description of a kind of recipe, with the commands that read it."""
    kind = KINDS[name_of(recipe)]
    return f"{kind.what} for " + " and ".join(f"`aegis {name}`" for name in kind.commands)
