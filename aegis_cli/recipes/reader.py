"""Recipes as files: how they are read, checked, written and told apart by their values."""

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
from aegis_cli.recipes.keys import changed, is_retired, recorded
from aegis_cli.recipes.kinds import KINDS, AnyRecipe, describe, name_of, take_kind
from aegis_cli.recipes.policy import Anchor, Recipe
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

    `command` is the one that may read several kinds.

    Raises:
        AegisError: the file cannot be read, or the recipe has problems; one error names all of
            them.
    """
    return _load(Path(path), overrides, (kind,), command)


def load_training(
    path: str | Path, overrides: Sequence[str] = ()
) -> Recipe | StreamRecipe | RobotStreamRecipe:
    """What `aegis train` takes: a recipe for demonstrations or for a stream, as `load` reads."""
    return _load(Path(path), overrides, (Recipe, *_STREAMS), "train")


def load_pretrain(path: str | Path, overrides: Sequence[str] = ()) -> PretrainRecipe | DualRecipe:
    """What `aegis pretrain` takes: a recipe for one of the embedded models, as `load` reads it."""
    return _load(Path(path), overrides, (PretrainRecipe, DualRecipe), "pretrain")


def _load(path: Path, overrides: Sequence[str], kinds: Sequence[type], command: str | None) -> Any:
    """A recipe of one of these kinds; the first is that of a file which does not say."""
    raw, problems = read(path)
    # Before everything else: by the keys of another kind, nearly every key would be unknown.
    kind = take_kind(raw, path, kinds[0])
    if kind not in kinds:
        expected = _READS.get(command, describe(kinds[0]))
        fix = commands.aegis(KINDS[name_of(kind)].commands[0], path)
        raise AegisError(f"{path} is {describe(kind)}", expected, fix)
    for setting in overrides:
        problems += override(raw, setting)
    recipe = build(kind, raw, problems)
    # There is a recipe to check as a whole only where each key is right.
    refuse(problems or list(cross_checks(recipe)), str(path))
    return recipe


def from_mapping(raw: Mapping[str, Any], overrides: Sequence[str] = ()) -> Recipe:
    """A recipe of keys that no file holds, with `key.sub=value` overrides, checked as a file's.

    Raises:
        AegisError: the recipe has problems; one error names all of them.
    """
    keys, problems = copy.deepcopy(dict(raw)), list[Problem]()  # overrides are put into sections
    for setting in overrides:
        problems += override(keys, setting)
    recipe = build(Recipe, keys, problems)
    refuse(problems or list(cross_checks(recipe)), "the options")
    return recipe


def is_stream_run(path: Path) -> bool:
    """Whether a folder is the run of a stream, finished or not."""
    return _kind_of_run(path) in _STREAMS


def is_policy_run(path: Path) -> bool:
    """Whether it is the run of one policy."""
    return _kind_of_run(path) is Recipe


def is_robot_stream_run(path: Path) -> bool:
    """Whether it is one of robot tasks."""
    return _kind_of_run(path) is RobotStreamRecipe


def _kind_of_run(path: Path) -> type | None:
    """The kind of the recipe that a run folder keeps; None of another folder."""
    saved = path / "recipe.yaml"
    return take_kind(read(saved)[0], saved) if saved.is_file() else None


def read(path: Path) -> tuple[dict[Any, Any], list[Problem]]:
    """The raw keys of a recipe file of any kind, and the keys given twice.

    Raises:
        AegisError: the file cannot be read, or is no mapping.
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
    """Anchor settings from command-line options, checked as a recipe's are."""
    problems: list[Problem] = []
    settings: Anchor = build(Anchor, options, problems, "--")
    refuse(problems, "the options")
    return settings


def to_yaml(recipe: AnyRecipe) -> str:
    """The resolved recipe, every key written out; `load` reads it back to an equal recipe.

    A retired key stands there only with a value of its own.
    """
    return dump({"kind": name_of(type(recipe)), **_plain(recipe)})


def _plain(value: Any) -> Any:
    """Sections as mappings and tuples as lists, as YAML has them."""
    if dataclasses.is_dataclass(value):
        own = changed(value)
        written = [f.name for f in dataclasses.fields(value) if not is_retired(f) or f.name in own]
        return {name: _plain(getattr(value, name)) for name in written}
    if isinstance(value, Mapping):
        return {name: _plain(inner) for name, inner in value.items()}
    return [_plain(item) for item in value] if isinstance(value, tuple | list) else value


def every_key(recipe: AnyRecipe) -> dict[str, Any]:
    """Every key with its value, also retired ones, as a JSON file would give them back."""
    return json.loads(json.dumps(dataclasses.asdict(recipe)))  # JSON turns tuples into lists


def digest(recipe: AnyRecipe) -> str:
    """sha256 of the recipe's canonical JSON.

    Equal values have equal digests, however the file was written.
    """
    values = dataclasses.asdict(recipe)
    if isinstance(recipe, PretrainRecipe):
        # The shipped weights name a digest that is older than these keys.
        for name in {"easy_vqa", "start"} - changed(recipe).keys():
            del values[name]
    return sha256_value(values)


def training_part(recipe: Recipe | StreamRecipe | RobotStreamRecipe) -> dict[str, Any]:
    """What shapes the trained weights; other methods' options, probes, rollouts and name do not.

    The last two are part of what a stream of robot tasks writes, and count. So does a stream's
    `split`, but where it is the default, so that runs that began before there was the key go on.
    """
    # What this returns is compared with what a run's folder holds, of any earlier version: a key
    # that is added here may only stand in it with a value that no older run had.
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
    # Any number of processes trains the same weights, however they share them.
    part["train"].pop("parallel", None)
    if chosen := drawn(recipe):  # the digest of the data says nothing of the choice
        part["demos"] = chosen
    return part | _own_part(recipe)


def earlier_training_part(recipe: RobotStreamRecipe, written: Mapping[str, Any]) -> dict[str, Any]:
    """What an earlier version took for the training part of a run whose `recipe.yaml` it wrote.

    It wrote every key that it knew, and every one of some sections was in the part, also those that
    came later and were at their defaults.

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
    """What counts of the options of `recipe.train.method`."""
    own = _own_section(recipe)
    return {recipe.train.method: {} if own is None else recorded(own)}


def selected(recipe: Recipe | RobotStreamRecipe) -> dict[str, Any]:
    """What is learned of the demonstrations' frames, as far as it is not at its default."""
    changes = changed(recipe.demos)
    own = ("only", "state", "action", "rename")
    return {name: changes[name] for name in own if name in changes}


def drawn(recipe: Recipe) -> dict[str, Any]:
    """What is learned of the demonstrations, and how often, as far as it is not at its default."""
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
    """What may have been meant by the path of a recipe that is not there."""
    beside = [other.stem for other in path.parent.glob("*.yaml")]
    near = did_you_mean(path.stem, beside)
    if near:
        return f"did you mean {path.with_name(near + '.yaml')}?"
    if shipped.is_one(path.stem):
        return f"'{path.stem}' ships with Aegis, and is found by its name alone: {path.stem}"
    return "check the path, or give the name of one that ships with Aegis: see aegis recipes ls"


def _read(path: Path) -> str:
    refuse_special(path)  # a pipe gives its bytes once, and a recipe is read more than once
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
