"""Recipes: what a run is made of, as frozen dataclasses that map one to one onto YAML files."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from aegis_cli.common.errors import AegisError
from aegis_cli.common.files import canonical
from aegis_cli.recipes.policy import NEEDS, SUITE, Anchor, Recipe
from aegis_cli.recipes.pretraining import PretrainRecipe
from aegis_cli.recipes.stream_recipes import DualRecipe, RobotStreamRecipe, StreamRecipe
from aegis_cli.recipes.streams import TEST
from aegis_cli.recipes.strict_yaml import (
    Problem,
    build,
    did_you_mean,
    dump,
    first_default,
    override,
    parse,
    refuse,
)
from aegis_cli.recipes.studies import StreamStudyRecipe, StudyRecipe

R = TypeVar("R", Recipe, PretrainRecipe, DualRecipe, StreamRecipe, RobotStreamRecipe)
AnyRecipe = (
    Recipe
    | PretrainRecipe
    | DualRecipe
    | StudyRecipe
    | StreamStudyRecipe
    | StreamRecipe
    | RobotStreamRecipe
)
_COMMANDS = {
    Recipe: ("run", "train"),
    PretrainRecipe: ("pretrain",),
    DualRecipe: ("pretrain",),
    StudyRecipe: ("run",),
    StreamStudyRecipe: ("run",),
    StreamRecipe: ("train",),
    RobotStreamRecipe: ("train",),
}
_READS: dict[str | None, str] = {
    "run": "a recipe for `aegis run`, of one run or of a study",
    "train": "a recipe for `aegis train`, of one run or of a stream",
    "pretrain": "a recipe for `aegis pretrain`",
}


def load(
    path: str | Path,
    overrides: Sequence[str] = (),
    kind: type[R] = Recipe,
    command: str | None = None,
) -> R:
    """Read a recipe file, apply `key.sub=value` overrides, check everything; `command` is the one
    that may read several kinds.

    Raises:
        AegisError: the file cannot be read, or the recipe has problems; one error names all of
            them.
    """
    path = Path(path)
    raw, problems = read(path)
    _refuse_other_kind(raw, path, kind, command)
    for setting in overrides:
        problems += override(raw, setting)
    recipe = build(kind, raw, problems)
    refuse(problems or list(cross_checks(recipe)), str(path))
    return recipe


def load_training(
    path: str | Path, overrides: Sequence[str] = ()
) -> Recipe | StreamRecipe | RobotStreamRecipe:
    """What `aegis train` takes: a recipe for demonstrations or for a stream, told apart by their
    keys, as `load` reads them.
    """
    return load(path, overrides, _trained_kind(Path(path)), "train")


def is_stream_run(path: Path) -> bool:
    """Whether a folder is the run of a stream, finished or not."""
    saved = path / "recipe.yaml"
    return saved.is_file() and _trained_kind(saved) is not Recipe


def is_robot_stream_run(path: Path) -> bool:
    """Whether it is one of robot tasks."""
    saved = path / "recipe.yaml"
    return saved.is_file() and _trained_kind(saved) is RobotStreamRecipe


def _trained_kind(path: Path) -> type:
    """The kind of recipe that has most of the file's keys; a key of all kinds tells nothing."""
    raw, _ = read(path)
    kinds = (Recipe, StreamRecipe, RobotStreamRecipe)
    return max(kinds, key=lambda kind: len(raw.keys() & {f.name for f in dataclasses.fields(kind)}))


def load_pretrain(path: str | Path, overrides: Sequence[str] = ()) -> PretrainRecipe | DualRecipe:
    """What `aegis pretrain` takes: of the two kinds, the one that has more of the file's keys, as
    `load` reads it.
    """
    raw, _ = read(Path(path))
    vlm, dual = (
        len(raw.keys() & {f.name for f in dataclasses.fields(kind)})
        for kind in (PretrainRecipe, DualRecipe)
    )
    return load(path, overrides, DualRecipe if dual > vlm else PretrainRecipe, "pretrain")


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
    """The resolved recipe, every key written out; `load` reads it back to an equal recipe."""
    return dump(json.loads(json.dumps(dataclasses.asdict(recipe))))  # JSON turns tuples into lists


def digest(recipe: AnyRecipe) -> str:
    """sha256 of the recipe's canonical JSON: equal values, equal digest, however the file was
    written.
    """
    return hashlib.sha256(canonical(dataclasses.asdict(recipe)).encode()).hexdigest()


def training_part(recipe: Recipe | StreamRecipe | RobotStreamRecipe) -> dict[str, Any]:
    """What shapes the trained weights: other methods' options, probes, rollouts and the name do
    not.

    The last two are part of what a stream of robot tasks writes, and count. So does a stream's
    `split`, but where it is the default, so that runs that began before there was the key go on.
    """
    if isinstance(recipe, RobotStreamRecipe):
        everything = dataclasses.asdict(recipe)
        own = ("tasks", "backbone", "seed", "train", "expert", "rollout", "probe")
        return {key: everything[key] for key in own} | {recipe.train.method: options(recipe)}
    if isinstance(recipe, StreamRecipe):
        shared = (
            "stream",
            "order",
            "encoder",
            "seed",
            "train",
            "inference",
            *(("split",) if recipe.split != TEST else ()),
        )
        everything = dataclasses.asdict(recipe)
        return {key: everything[key] for key in shared} | {recipe.train.method: options(recipe)}
    part: dict[str, Any] = {"task": recipe.task, "backbone": recipe.backbone, "seed": recipe.seed}
    part |= {key: dataclasses.asdict(getattr(recipe, key)) for key in ("train", "expert")}
    return part | {recipe.train.method: options(recipe)}


def changed(section: Any) -> dict[str, Any]:
    """The keys of a recipe's section whose values are not the defaults that they came with."""
    values = {f: getattr(section, f.name) for f in dataclasses.fields(section)}
    return {f.name: value for f, value in values.items() if value != first_default(f)}


def options(recipe: Recipe | StreamRecipe | RobotStreamRecipe) -> dict[str, Any]:
    """The options of `recipe.train.method`; {} for a method without any."""
    part = getattr(recipe, recipe.train.method.replace("-", "_"), None)
    return {} if part is None else dataclasses.asdict(part)


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        near = did_you_mean(path.stem, [p.stem for p in path.parent.glob("*.yaml")])
        fix = (
            f"did you mean {path.with_name(near + '.yaml')}?"
            if near
            else "check the path, e.g. recipes/quickstart.yaml"
        )
        raise AegisError(f"no file {path}", "a recipe, a YAML file", fix) from None
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


def _refuse_other_kind(raw: dict[Any, Any], path: Path, kind: type, command: str | None) -> None:
    """A whole recipe of the other command gets one plain sentence instead of a list of unknown
    keys.
    """
    for other in _COMMANDS:
        names, own = ({f.name for f in dataclasses.fields(k)} for k in (other, kind))
        if other is not kind and set(raw) <= names and not set(raw) <= own:
            fix = f"aegis {_COMMANDS[other][0]} {path}"
            raise AegisError(
                f"{path} is {describe(other)}", _READS.get(command, describe(kind)), fix
            )


def describe(kind: type) -> str:
    """What a recipe of a kind is, and which commands read it."""
    study = "a study of several runs, a recipe"
    what = {
        StudyRecipe: study,
        StreamStudyRecipe: study,
        StreamRecipe: "a stream of tasks, a recipe",
        RobotStreamRecipe: "a stream of robot tasks, a recipe",
    }
    return f"{what.get(kind, 'a recipe')} for " + " and ".join(
        f"`aegis {c}`" for c in _COMMANDS[kind]
    )


def cross_checks(
    recipe: Recipe | PretrainRecipe | DualRecipe | StreamRecipe | RobotStreamRecipe,
) -> Iterator[Problem]:
    """What a single key cannot tell."""
    if isinstance(recipe, StreamRecipe):
        return
    if isinstance(recipe, PretrainRecipe | DualRecipe):
        section, model = (
            ("model", recipe.model)
            if isinstance(recipe, PretrainRecipe)
            else ("towers", recipe.towers)
        )
        if model.width % model.heads:
            found = f"{section}.width: {model.width} with {section}.heads: {model.heads}"
            fix = f"set {section}.width to {model.heads * max(1, model.width // model.heads)}"
            yield Problem(found, "a width that the heads divide", fix)
        return
    if recipe.rollout.replan > recipe.train.chunk:
        found = f"rollout.replan: {recipe.rollout.replan} with train.chunk: {recipe.train.chunk}"
        yield Problem(
            found,
            "no more actions executed than predicted",
            f"set rollout.replan to at most {recipe.train.chunk}",
        )
    if isinstance(recipe, RobotStreamRecipe):
        yield from _robot_checks(recipe)
        return
    if recipe.task.startswith(SUITE) and "colors" in changed(recipe.rollout):
        found = f"rollout.colors: {', '.join(recipe.rollout.colors)} with task: {recipe.task}"
        yield Problem(
            found, "no colours: a suite task has no coloured targets", "delete rollout.colors"
        )
    if not recipe.task.startswith(SUITE) and recipe.demos.drop_below is not None:
        found = f"demos.drop_below: {recipe.demos.drop_below:g} with task: {recipe.task}"
        yield Problem(
            found,
            "a suite task, whose episodes have a return",
            "delete demos.drop_below: failures are dropped",
        )


def _robot_checks(recipe: RobotStreamRecipe) -> Iterator[Problem]:
    paths, suite = recipe.demos.paths, [task for task in recipe.tasks if task.startswith(SUITE)]
    if paths is not None and len(paths) != len(recipe.tasks):
        found = f"demos.paths: {len(paths)} with {len(recipe.tasks)} tasks"
        yield Problem(
            found,
            "one a task, in their order",
            "correct demos.paths, or delete it and let them be recorded",
        )
    if recipe.probe.max_drop is not None:
        found = f"probe.max_drop: {recipe.probe.max_drop:g} with a stream"
        yield Problem(
            found, "no gate: a stream has a figure after each task", "delete probe.max_drop"
        )
    if suite and "colors" in changed(recipe.rollout):
        found = f"rollout.colors: {recipe.rollout.colors} with task {suite[0]}"
        yield Problem(
            found, "no colours: a suite task has no coloured targets", "delete rollout.colors"
        )


def anchor_checks(recipe: Recipe, methods: Sequence[str]) -> Iterator[Problem]:
    """Whether the anchor that `aegis run` measures holds what these methods, and the leak, read."""
    measured = recipe.anchor
    for method in methods:
        missing = [part for part in NEEDS.get(method, ()) if part not in measured.parts]
        if missing:
            fix = f"set anchor.parts to [{', '.join((*measured.parts, *missing))}]"
            found = f"anchor.parts: {', '.join(measured.parts)} with method {method}"
            yield Problem(found, f"anchor.parts with {' and '.join(missing)}", fix)
    shares = {"train.leak_energy": recipe.train.leak_energy} if "inputs" in measured.parts else {}
    if "nullspace" in methods and recipe.nullspace.energy is not None:
        shares["nullspace.energy"] = recipe.nullspace.energy
    for name, share in shares.items():
        if share > measured.energy:
            found = f"{name}: {share:g} with anchor.energy: {measured.energy:g}"
            yield Problem(
                found, "an anchor that keeps at least that share", f"set anchor.energy to {share:g}"
            )


def check_anchor(recipe: Recipe) -> None:
    """Raise AegisError unless the recipe's anchor holds what its methods read."""
    refuse(list(anchor_checks(recipe, recipe.methods)), f"recipe {recipe.name}")
