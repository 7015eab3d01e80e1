"""Recipes as files: reading, checking and writing them, and digests of their values."""

from __future__ import annotations

import copy
import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from aegis_cli.common import commands
from aegis_cli.common.errors import AegisError
from aegis_cli.common.files import refuse_special, sha256_value
from aegis_cli.recipes import shipped
from aegis_cli.recipes.cross_checks import cross_checks
from aegis_cli.recipes.decoding import build
from aegis_cli.recipes.keys import adjusting, changed, is_retired, recorded
from aegis_cli.recipes.kinds import KINDS, AnyRecipe, describe, name_of, take_kind
from aegis_cli.recipes.policy import PASSES_DIFFER, Anchor, Recipe
from aegis_cli.recipes.pretraining import DualRecipe, PretrainRecipe
from aegis_cli.recipes.streams import TEST, RobotStreamRecipe, StreamRecipe
from aegis_cli.recipes.strict_yaml import Problem, did_you_mean, dump, override, parse, refuse

R = TypeVar("R", bound=Recipe | PretrainRecipe | DualRecipe | StreamRecipe | RobotStreamRecipe)
_READS: dict[str | None, str] = {
    "run": "a recipe for `aegis run`, of one run or of a study",
    "train": "a recipe for `aegis train`, of one run or of a stream",
    "pretrain": "a recipe for `aegis pretrain`",
}
_STREAMS = (StreamRecipe, RobotStreamRecipe)
_WRITTEN_WHOLE = ("train", "expert", "probe")  # see `earlier_training_part`


def load(
    path: str | Path,
    overrides: Sequence[str] = (),
    kind: type[R] = Recipe,
    command: str | None = None,
) -> R:
    """Read a recipe file, apply `key.sub=value` overrides and check everything.

    `command` is the calling command, if it reads several kinds.

    Raises:
        AegisError: the file cannot be read, or the recipe has problems; one error names all of
            them.
    """
    return _load(Path(path), overrides, (kind,), command)


def load_training(
    path: str | Path, overrides: Sequence[str] = ()
) -> Recipe | StreamRecipe | RobotStreamRecipe:
    """Read a recipe for `aegis train`, for demonstrations or for a stream, as `load` does."""
    return _load(Path(path), overrides, (Recipe, *_STREAMS), "train")


def load_pretrain(path: str | Path, overrides: Sequence[str] = ()) -> PretrainRecipe | DualRecipe:
    """Read a recipe for `aegis pretrain`, for one of the embedded models, as `load` does."""
    return _load(Path(path), overrides, (PretrainRecipe, DualRecipe), "pretrain")


def _load(path: Path, overrides: Sequence[str], kinds: Sequence[type], command: str | None) -> Any:
    """A recipe of one of these kinds; the first is the default for a file that names no kind."""
    raw, problems = read(path)
    # First of all, because nearly every key of another kind would be unknown.
    kind = take_kind(raw, path, kinds[0])
    if kind not in kinds:
        expected = _READS.get(command, describe(kinds[0]))
        fix = commands.aegis(KINDS[name_of(kind)].commands[0], path)
        raise AegisError(f"{path} is {describe(kind)}", expected, fix)
    for setting in overrides:
        problems += override(raw, setting)
    recipe = build(kind, raw, problems)
    # The recipe as a whole can be checked only if every key is right.
    without_line = f"{path} with its --set" if overrides else None
    refuse(problems or list(cross_checks(recipe)), str(path), without_line)
    return recipe


def from_mapping(raw: Mapping[str, Any], overrides: Sequence[str] = ()) -> Recipe:
    """A recipe from raw keys, with `key.sub=value` overrides, checked like a file.

    Raises:
        AegisError: the recipe has problems; one error names all of them.
    """
    keys, problems = copy.deepcopy(dict(raw)), list[Problem]()  # overrides change its sections
    for setting in overrides:
        problems += override(keys, setting)
    recipe = build(Recipe, keys, problems)
    refuse(problems or list(cross_checks(recipe)), "the options")
    return recipe


def is_stream_run(path: Path) -> bool:
    """Whether a folder is the run of a stream, finished or not."""
    return _kind_of_run(path) in _STREAMS


def is_policy_run(path: Path) -> bool:
    """Whether a folder is the run of one policy."""
    return _kind_of_run(path) is Recipe


def is_robot_stream_run(path: Path) -> bool:
    """Whether a folder is the run of a stream of robot tasks."""
    return _kind_of_run(path) is RobotStreamRecipe


def _kind_of_run(path: Path) -> type | None:
    """The kind of the recipe in a run folder; None for another folder."""
    saved = path / "recipe.yaml"
    return take_kind(read(saved)[0], saved) if saved.is_file() else None


def read(path: Path) -> tuple[dict[Any, Any], list[Problem]]:
    """The raw keys of a recipe file of any kind, and the keys given twice.

    Raises:
        AegisError: the file cannot be read, or is not a mapping.
    """
    raw, problems = parse(_read(path), str(path))
    if not isinstance(raw, dict):
        raise AegisError(
            f"no keys in {path}",
            "a recipe: lines of 'key: value'",
            "start from recipes/quickstart.yaml",
        )
    return raw, problems


def read_anchor(options: dict[str, Any]) -> Anchor:
    """Anchor settings from command-line options, checked like those of a recipe."""
    problems: list[Problem] = []
    settings: Anchor = build(Anchor, options, problems, "--")
    refuse(problems, "the options")
    return settings


def to_yaml(recipe: AnyRecipe) -> str:
    """The resolved recipe with every key written out; `load` reads it back as an equal recipe.

    A retired key is written only if it differs from its default.
    """
    return dump({"kind": name_of(type(recipe)), **_plain(recipe)})


def _plain(value: Any) -> Any:
    """Sections as mappings and tuples as lists, as in YAML."""
    if dataclasses.is_dataclass(value):
        own = changed(value)
        written = [f.name for f in dataclasses.fields(value) if not is_retired(f) or f.name in own]
        return {name: _plain(getattr(value, name)) for name in written}
    if isinstance(value, Mapping):
        return {name: _plain(inner) for name, inner in value.items()}
    return [_plain(item) for item in value] if isinstance(value, tuple | list) else value


def retired(kind: type = Recipe) -> frozenset[str]:
    """The dotted keys of a recipe that no longer have an effect."""
    found = set[str]()
    for field in dataclasses.fields(kind):
        if dataclasses.is_dataclass(field.default):
            inner = dataclasses.fields(field.default)
            found.update(f"{field.name}.{own.name}" for own in inner if is_retired(own))
    return frozenset(found)


def without_retired(values: Mapping[str, Any], kind: type = Recipe) -> dict[str, Any]:
    """A recipe's values by section without those of retired keys."""
    gone = retired(kind)

    def kept(section: str, inner: Any) -> Any:
        if not isinstance(inner, Mapping):
            return inner
        return {name: value for name, value in inner.items() if f"{section}.{name}" not in gone}

    return {name: kept(name, inner) for name, inner in values.items()}


def every_key(recipe: AnyRecipe) -> dict[str, Any]:
    """Every key with its value, including retired keys, as if read from a JSON file."""
    return json.loads(json.dumps(dataclasses.asdict(recipe)))  # JSON turns tuples into lists


def digest(recipe: AnyRecipe) -> str:
    """sha256 of the recipe's canonical JSON.

    Equal values have equal digests, no matter how the file was written.
    """
    values = dataclasses.asdict(recipe)
    if isinstance(recipe, PretrainRecipe):
        # The shipped weights contain a digest that is older than these keys.
        for name in {"easy_vqa", "start"} - changed(recipe).keys():
            del values[name]
    return sha256_value(values)


def training_part(recipe: Recipe | StreamRecipe | RobotStreamRecipe) -> dict[str, Any]:
    """The keys that affect the trained weights, without other methods' options, probe and rollout.

    For a stream of robot tasks, probe and rollout count too, because the run contains their
    results. A stream's `split` counts unless it is the default, so that runs from before this key
    can be resumed.
    """
    # The result is compared with the records of run folders of all earlier versions. A key may be
    # added here only with a value that no older run had.
    part: dict[str, Any]
    if isinstance(recipe, RobotStreamRecipe):
        part = {key: getattr(recipe, key) for key in ("tasks", "backbone", "seed")}
        part |= {key: recorded(getattr(recipe, key)) for key in (*_WRITTEN_WHOLE, "rollout")}
        if chosen := selected(recipe):
            part["demos"] = chosen
        return part | _own_part(recipe)
    if isinstance(recipe, StreamRecipe):
        part = {key: getattr(recipe, key) for key in ("stream", "order", "encoder", "seed")}
        part |= {key: recorded(getattr(recipe, key)) for key in ("train", "inference")}
        if recipe.split != TEST:
            part["split"] = recipe.split
        return part | _own_part(recipe)
    part = {"task": recipe.task, "backbone": recipe.backbone, "seed": recipe.seed}
    part |= {key: recorded(getattr(recipe, key)) for key in ("train", "expert")}
    # The weights do not depend on how many processes train them or how these share them.
    part["train"].pop("parallel", None)
    if chosen := drawn(recipe):  # the digest of the data does not cover the selection
        part["demos"] = chosen
    return part | _own_part(recipe)


def adjustable(recipe: Recipe | RobotStreamRecipe) -> set[str]:
    """The keys of `train` with which a run of this recipe may be resumed at any value.

    They change memory, time or how often something is written, and what is learned at most by
    rounding; in a stream with igsp also by the price of experts, a mean over a pass's tokens.
    """
    found = adjusting(recipe.train)
    return found - {"accumulate"} if recipe.train.method in PASSES_DIFFER else found


def learning_part(recipe: RobotStreamRecipe) -> dict[str, Any]:
    """The training part without the keys that may change when the run is resumed."""
    part, free = training_part(recipe), adjustable(recipe)
    train = {name: value for name, value in part["train"].items() if name not in free}
    return part | {"train": train}


def earlier_training_part(recipe: RobotStreamRecipe, written: Mapping[str, Any]) -> dict[str, Any]:
    """The training part of a run as an earlier version computed it, from its `recipe.yaml`.

    That version wrote every key that it knew, and its part contained every key of some sections,
    including later keys at their defaults.

    Args:
        written: the raw keys of that file.
    """
    part = training_part(recipe)
    for name, section in ((name, getattr(recipe, name)) for name in _WRITTEN_WHOLE):
        known = written.get(name) or {}
        values = dataclasses.asdict(section)
        part[name] = {key: value for key, value in values.items() if key in known}
    return part


def _own_part(recipe: Recipe | StreamRecipe | RobotStreamRecipe) -> dict[str, Any]:
    """The recorded options of `recipe.train.method`."""
    own = _own_section(recipe)
    return {recipe.train.method: {} if own is None else recorded(own)}


def selected(recipe: Recipe | RobotStreamRecipe) -> dict[str, Any]:
    """The keys that select what is learned from each frame or episode, without defaults."""
    changes = changed(recipe.demos)
    own = ("only", "state", "action", "rename")
    return {name: changes[name] for name in own if name in changes}


def drawn(recipe: Recipe) -> dict[str, Any]:
    """The keys that select what is learned from the data and how often, without defaults."""
    changes = changed(recipe.demos)
    return selected(recipe) | {name: changes[name] for name in ("weights",) if name in changes}


def options(recipe: Recipe | StreamRecipe | RobotStreamRecipe) -> dict[str, Any]:
    """The options of `recipe.train.method`; {} for a method without any."""
    own = _own_section(recipe)
    return {} if own is None else dataclasses.asdict(own)


def _own_section(recipe: Recipe | StreamRecipe | RobotStreamRecipe) -> Any:
    """The section of `recipe.train.method`; None for a method without options."""
    return getattr(recipe, recipe.train.method.replace("-", "_"), None)


def _instead(path: Path) -> str:
    """A suggestion for the path of a recipe that does not exist."""
    beside = [other.stem for other in path.parent.glob("*.yaml")]
    near = did_you_mean(path.stem, beside)
    if near:
        return f"did you mean {path.with_name(near + '.yaml')}?"
    if shipped.is_one(path.stem):
        return f"'{path.stem}' ships with Aegis, and is found by its name alone: {path.stem}"
    return "check the path, or give the name of one that ships with Aegis: see aegis recipes ls"


def _read(path: Path) -> str:
    refuse_special(path)  # a pipe can be read only once, but a recipe is read several times
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise AegisError(f"no file {path}", "a recipe, a YAML file", _instead(path)) from None
    except UnicodeDecodeError:
        raise AegisError(
            f"{path} is not text",
            "a recipe, a YAML file",
            "give a recipe, e.g. recipes/quickstart.yaml",
        ) from None
    except OSError as e:
        raise AegisError(
            f"{path}: {e.strerror}", "a readable recipe file", "check the path and its permissions"
        ) from None
