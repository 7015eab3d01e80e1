"""Studies: one recipe file for variants x tasks x seeds, and the plain recipe of each
of its cells.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from aegis_cli import recipes
from aegis_cli.recipes import (
    AnyRecipe,
    Recipe,
    StreamRecipe,
    StreamStudyRecipe,
    StudyRecipe,
    Tuning,
    Variant,
    stream_study_cells,
)
from aegis_cli.recipes import variants as spelled
from aegis_cli.recipes.decoding import below, build
from aegis_cli.recipes.strict_yaml import Problem, override, refuse

# What every cell of a study has in common or gets from it, so that rows can be compared.
_THE_STUDYS = {
    "name": "name",
    "task": "tasks",
    "seed": "seeds",
    "methods": "variants",
    "train.method": "variants",
}
_FOR_ALL = ("backbone", "probe", "rollout.episodes", "rollout.colors")
_MEASURED_AGAINST = {"naive": "naive"}


def load(
    path: str | Path, overrides: Sequence[str] = ()
) -> Recipe | StudyRecipe | StreamStudyRecipe:
    """What `aegis run` takes: a recipe, or a study of tasks or of streams.

    Raises:
        AegisError: the file cannot be read, or has problems in any of its cells; one error names
            all of them.
    """
    path = Path(path)
    raw, problems = recipes.read(path)
    kind = recipes.take_kind(raw, path)
    if kind not in (StudyRecipe, StreamStudyRecipe):
        return recipes.load(path, overrides, command="run")
    for setting in overrides:
        problems += override(raw, setting)
    study = build(kind, raw, problems, places=lambda name: _places(name, kind))
    variants = (
        stream_study_cells.check(raw, problems)
        if kind is StreamStudyRecipe
        else _check(raw, problems)
    )
    refuse(list(dict.fromkeys(problems)), str(path))
    return dataclasses.replace(study, variants=variants)


def cell(study: StudyRecipe, variant: str, task: str, seed: int, value: Any = None) -> Recipe:
    """The recipe of one training; `value` is what the variant's knob is set to, if it has one.

    Raises:
        AegisError: keys or values that make no recipe.
    """
    problems: list[Problem] = []
    raw = spelled.merged(study.shared, study.variants[variant], value) | {
        "methods": [study.variants[variant].method]
    }
    made = build(Recipe, raw | {"name": study.name, "task": task, "seed": seed}, problems)
    refuse(problems or _together(made), f"variant {variant} of {study.name}")
    return made


def load_any(path: str | Path) -> AnyRecipe:
    """A recipe of whichever kind its file is.

    Raises:
        AegisError: the file cannot be read, or has problems; one error names all of them.
    """
    path = Path(path)
    kind = recipes.take_kind(recipes.read(path)[0], path)
    return load(path) if kind in (StudyRecipe, StreamStudyRecipe) else recipes.load(path, kind=kind)


def written_out(recipe: AnyRecipe) -> dict[str, Any]:
    """Every key with its value, as plain ones; of a study, those of what its runs share too, but
    for what it gives them.
    """
    plain = {"kind": recipes.name_of(type(recipe)), **_plain(recipe)}
    if not isinstance(recipe, StudyRecipe | StreamStudyRecipe):
        return plain
    kind, given = _of_cells(type(recipe))
    keys = {"name": "cell"} if kind is Recipe else {"name": "cell", "stream": "any"}
    shared = _plain(build(kind, {**recipe.shared, **keys}, []))
    del shared["train"]["method"]
    plain["shared"] = {name: value for name, value in shared.items() if name not in given}
    return plain


def _of_cells(study: type) -> tuple[type, Mapping[str, str]]:
    """The kind of a study's cells, and the keys that it gives them itself."""
    return (
        (Recipe, _THE_STUDYS)
        if study is StudyRecipe
        else (StreamRecipe, stream_study_cells.THE_STUDYS)
    )


def _places(name: str, study: type) -> list[str]:
    """Where a study has a key of a plain recipe: its own for it, or one of the same name in a
    section or in 'shared'.
    """
    kind, given = _of_cells(study)
    if name in given:
        return [given[name]]
    own = [name] if name in {f.name for f in dataclasses.fields(kind)} else []
    return below(name, study) + [
        f"shared.{place}" for place in own + below(name, kind) if place not in given
    ]


def _plain(recipe: AnyRecipe) -> dict[str, Any]:
    return json.loads(json.dumps(dataclasses.asdict(recipe)))  # JSON turns tuples into lists


# --- all problems at once -------------------------------------------------------------------------


def _check(raw: Mapping[str, Any], problems: list[Problem]) -> dict[str, Variant]:
    """The variants that can be read; everything wrong in any cell is appended."""
    places = {**_THE_STUDYS, **dict.fromkeys(_FOR_ALL)}
    variants = spelled.read(raw.get("variants"), Variant, places, _MEASURED_AGAINST, problems)
    given = [{"name": "cell", "task": task} for task in _tasks(raw.get("tasks")) or ("reach",)]
    problems += spelled.cell_problems(
        Recipe, raw.get("shared", {}), variants, _THE_STUDYS, given, _together
    )
    fix = "add it: task, seed, questions, episodes, within"
    problems += spelled.tuning_problems(raw, variants, Tuning().seed, fix)
    problems += _gate_problems(raw.get("shared"))
    return variants


def _gate_problems(shared: Any) -> list[Problem]:
    """A gate is of one run; a study says of every variant whether it passes its bar."""
    settings = shared.get("probe") if isinstance(shared, dict) else None
    limit = settings.get("max_drop") if isinstance(settings, dict) else None
    if limit is None:
        return []
    return [
        Problem(
            f"shared: probe.max_drop: {limit}",
            "no gate: a study has a bar",
            "delete probe.max_drop",
        )
    ]


def _tasks(raw: Any) -> list[str]:
    """Those that can be read; `build` has complained of the others."""
    return [
        task
        for task in (raw if isinstance(raw, list) else [])
        if isinstance(task, str) and recipes.TASK.accepts(task)
    ]


def _together(made: Recipe) -> list[Problem]:
    """What a single key cannot tell."""
    found = [*recipes.cross_checks(made), *recipes.anchor_checks(made, (made.train.method,))]
    if "seen" not in made.rollout.colors:
        found.append(
            Problem(
                "rollout.colors without seen",
                "seen among them: success on these is compared",
                "add seen",
            )
        )
    return found
