"""Studies: one recipe file for variants x tasks x seeds, and the plain recipe of each of its cells."""

from __future__ import annotations

import copy
import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from aegis_cli import recipe as recipes
from aegis_cli.files import canonical
from aegis_cli.recipe import FOLDER_NAME, Recipe, StudyRecipe, Variant
from aegis_cli.strict_yaml import Problem, build, override, refuse

# What every cell of a study has in common or gets from it, so that rows can be compared.
_THE_STUDYS = {"name": "name", "task": "tasks", "seed": "seeds", "methods": "variants", "train.method": "variants"}
_FOR_ALL = ("backbone", "probe", "rollout.episodes", "rollout.colors")


def load(path: str | Path, overrides: Sequence[str] = ()) -> Recipe | StudyRecipe:
    """What `aegis run` takes: a recipe, or a study, told apart by their keys.

    Raises:
        AegisError: the file cannot be read, or has problems in any of its cells; one error names all of them.
    """
    path = Path(path)
    raw, problems = recipes.read(path)
    if not _is_study(raw):
        return recipes.load(path, overrides)
    for setting in overrides:
        problems += override(raw, setting)
    study = build(StudyRecipe, raw, problems)
    variants = _variants(raw.get("variants"), problems)
    problems += _cell_problems(raw.get("shared", {}), variants, _tasks(raw.get("tasks")))
    problems += _tuning_problems(raw, variants)
    refuse(list(dict.fromkeys(problems)), str(path))
    return dataclasses.replace(study, variants=variants)


def cell(study: StudyRecipe, variant: str, task: str, seed: int, value: Any = None) -> Recipe:
    """The recipe of one training; `value` is what the variant's knob is set to, if it has one.

    Raises:
        AegisError: keys or values that make no recipe.
    """
    problems: list[Problem] = []
    raw = _merged(study.shared, study.variants[variant], value)
    made = build(Recipe, raw | {"name": study.name, "task": task, "seed": seed}, problems)
    refuse(problems or _together(made), f"variant {variant} of {study.name}")
    return made


def _is_study(raw: Mapping[Any, Any]) -> bool:
    """Most of its keys are a study's; a key of both kinds tells nothing."""
    ours, theirs = ({f.name for f in dataclasses.fields(kind)} for kind in (StudyRecipe, Recipe))
    return len(raw.keys() & ours) > len(raw.keys() & theirs)


def _merged(shared: Mapping[str, Any], variant: Variant, value: Any = None) -> dict[str, Any]:
    raw = copy.deepcopy(dict(shared))
    for dotted, chosen in variant.set.items():
        _put(raw, dotted, chosen)
    if variant.knob is not None:
        _put(raw, variant.knob, value)
    _put(raw, "train.method", variant.method)
    return raw | {"methods": [variant.method]}


def _put(raw: dict[str, Any], dotted: str, value: Any) -> None:
    """Set one key; where something else than a section is in its way, `build` has already complained."""
    *sections, name = dotted.split(".")
    for section in sections:
        raw = raw.setdefault(section, {})
        if not isinstance(raw, dict):
            return
    raw[name] = copy.deepcopy(value)


# --- all problems at once -------------------------------------------------------------------------


def _variants(raw: Any, problems: list[Problem]) -> dict[str, Variant]:
    """Those that can be read; the others' problems are appended."""
    found = {}
    for name, keys in (raw if isinstance(raw, dict) else {}).items():
        where, own = f"variants.{name}", []
        if not isinstance(name, str) or not FOLDER_NAME.accepts(name):
            own.append(Problem(f"the variant '{name}'", f"a name of {FOLDER_NAME.expected}", "rename it"))
        if isinstance(keys, dict):
            variant = build(Variant, keys, own, f"{where}.")
        else:
            own.append(Problem(f"{where}: {keys}", "a section with keys of: method, set, tune", f"indent them below '{name}:'"))
        if not own:
            own += _variant_problems(where, variant)
        if not own:
            found[name] = variant
        problems += own
    return found


def _variant_problems(where: str, variant: Variant) -> Iterator[Problem]:
    for part, keys in (("set", variant.set), ("tune", variant.tune)):
        for dotted, value in keys.items():
            if not all(dotted.split(".")) or isinstance(value, dict):
                yield Problem(f"{where}.{part}: {dotted}", "dotted recipe keys", "write e.g. train.backbone_lr: 1e-4")
            yield from _reserved(f"{where}.{part}", dotted, (*_THE_STUDYS, *_FOR_ALL))
    if len(variant.tune) > 1:
        yield Problem(f"{where}.tune: {', '.join(variant.tune)}", "one knob a variant", "keep one, and set the others")
    for knob, values in variant.tune.items():
        distinct = {canonical(v) for v in values} if isinstance(values, list) else set()
        if not distinct or len(distinct) < len(values):
            yield Problem(f"{where}.tune.{knob}: {values}", "a list of different values", "write e.g. [0.1, 1, 10]")
        if knob in variant.set:
            yield Problem(f"{where}: {knob} in set and in tune", "each key once", "delete it in one of them")
    if where == "variants.naive" and variant.method != "naive":
        yield Problem(f"{where}.method: {variant.method}", "naive: the others are measured against it", "rename the variant")


def _reserved(where: str, dotted: str, keys: Sequence[str]) -> Iterator[Problem]:
    """A key that a single variant may not have."""
    if any(dotted == key or dotted.startswith(f"{key}.") for key in keys):
        place = _THE_STUDYS.get(dotted)
        said, fix = (f"the study's '{place}'", f"use '{place}'") if place else ("the same for all", "move it to 'shared'")
        yield Problem(f"{where}: {dotted}", said, fix)


def _tasks(raw: Any) -> list[str]:
    """Those that can be read; `build` has complained of the others."""
    return [task for task in (raw if isinstance(raw, list) else []) if isinstance(task, str) and recipes.TASK.accepts(task)]


def _cell_problems(shared: Any, variants: Mapping[str, Variant], tasks: Sequence[str]) -> Iterator[Problem]:
    """What the ordinary checks say of each cell's recipe; what is wrong in `shared` is said once."""
    if not isinstance(shared, dict):
        return
    for dotted in _dotted(shared):
        yield from _reserved("shared", dotted, tuple(_THE_STUDYS))
    common: list[Problem] = []
    build(Recipe, {**shared, "name": "cell"}, common)
    yield from (p._replace(found=f"shared: {p.found}") for p in common)
    for name, variant in variants.items():
        for value, task in itertools.product(variant.values, tasks or ("reach",)):
            found: list[Problem] = []
            made = build(Recipe, _merged(shared, variant, value) | {"name": "cell", "task": task}, found)
            own = [p for p in found if p not in common] or ([] if made is None else _together(made))
            yield from (p._replace(found=f"variants.{name}: {p.found}") for p in own)


def _together(made: Recipe) -> list[Problem]:
    """What a single key cannot tell."""
    found = [*recipes.cross_checks(made), *recipes.anchor_checks(made, made.methods)]
    if "seen" not in made.rollout.colors:
        found.append(Problem("rollout.colors without seen", "seen among them: success on these is compared", "add seen"))
    return found


def _dotted(raw: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for name, value in raw.items():
        yield f"{prefix}{name}"
        if isinstance(value, dict):
            yield from _dotted(value, f"{prefix}{name}.")


def _tuning_problems(raw: Mapping[str, Any], variants: Mapping[str, Variant]) -> Iterator[Problem]:
    tuned, tuning, seeds = [n for n, v in variants.items() if v.tune], raw.get("tuning"), raw.get("seeds")
    if tuned and tuning is None:
        fix = "add it: task, seed, questions, episodes, within"
        yield Problem(f"{', '.join(tuned)} with 'tune'", "the section 'tuning'", fix)
    seed = tuning.get("seed", recipes.Tuning().seed) if isinstance(tuning, dict) else None
    if isinstance(seed, int) and isinstance(seeds, list) and seed in seeds:
        fix = f"set tuning.seed to {max(s for s in seeds if isinstance(s, int)) + 1000}"
        yield Problem(f"tuning.seed: {seed} is also one of seeds", "a seed that no compared run has", fix)
