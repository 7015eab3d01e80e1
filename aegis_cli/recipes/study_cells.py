"""Studies as files: variants x tasks or streams x seeds, and the plain recipe of each cell."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

from aegis_cli import recipes
from aegis_cli.recipes import (
    AnyRecipe,
    AnyStudy,
    PolicyVariant,
    Recipe,
    RobotStreamRecipe,
    RobotStreamStudyRecipe,
    RobotStreamTuning,
    RobotStreamVariant,
    StreamRecipe,
    StreamStudyRecipe,
    StreamTuning,
    StreamVariant,
    StudyRecipe,
    Tuning,
    Variant,
    variants,
)
from aegis_cli.recipes.decoding import below, build
from aegis_cli.recipes.strict_yaml import (
    Problem,
    did_you_mean,
    line_of,
    override,
    put,
    refuse,
)
from aegis_cli.recipes.studies import PER_SEED

# The variants that others are compared with.
NAIVE, ISOLATED, ZERO_SHOT = "naive", "isolated-lora", "zero-shot"
# An optional variant of half the rank: what iGSP's smaller experts reach without sharing.
HALF = "isolated-lora-half"


_LONGEST_NAME = 100  # bytes of a folder's name
_TAKEN = {"tuning", "stages"}  # other folders in a study's folder


@dataclass(frozen=True)
class _CellRules:
    """The rules for the cells of a kind of study, which make them comparable.

    Attributes:
        recipe: the kind of a cell's recipe.
        place: the recipe's key for what variants are measured on; `places` is the study's key.
        listed: whether all names under `places` form one place, a stream of these tasks.
        given: a recipe's keys that the study sets in each cell -> the study's own keys for them.
        for_all: further keys that no variant may set, since all share them.
        references: a variant that others are compared with -> the method that it must have.
        any_place: a place for checks if the study names none that can be read.
        tuning_seed: the default of `tuning.seed`; `tuning_keys` are the keys of `tuning`.
        together: checks across the keys of a cell's recipe.
        problems: checks across the keys of the study.
    """

    recipe: type
    variant: type[Variant]
    place: str
    places: str
    given: Mapping[str, str]
    for_all: tuple[str, ...]
    references: Mapping[str, str]
    any_place: str | Sequence[str]
    tuning_seed: int
    tuning_keys: str
    together: Callable[[Any], Iterable[Problem]]
    problems: Callable[[Mapping[str, Any]], Iterable[Problem]]
    listed: bool = False


def load(path: str | Path, overrides: Sequence[str] = ()) -> Recipe | AnyStudy:
    """Read a recipe for `aegis run`, or a study of tasks or of streams.

    Raises:
        AegisError: the file cannot be read, or has problems in any of its cells; one error names
            all of them.
    """
    path = Path(path)
    raw, problems = recipes.read(path)
    kind = recipes.take_kind(raw, path)
    if kind not in _CELL_RULES:  # a recipe for `aegis run`, or for another command (refused)
        return recipes.load(path, overrides, command="run")
    for setting in overrides:
        problems += override(raw, setting)
    study = build(kind, raw, problems, places=lambda name: _places(name, kind))
    checked = _check(raw, _CELL_RULES[kind], problems)
    refuse(list(dict.fromkeys(problems)), str(path))  # many cells have the same problem
    return dataclasses.replace(study, variants=checked)


@overload
def cell(study: StudyRecipe, variant: str, place: str, seed: int, value: Any = None) -> Recipe: ...


@overload
def cell(
    study: StreamStudyRecipe, variant: str, place: str, seed: int, value: Any = None
) -> StreamRecipe: ...


@overload
def cell(
    study: RobotStreamStudyRecipe,
    variant: str,
    place: Sequence[str],
    seed: int,
    value: Any = None,
) -> RobotStreamRecipe: ...


def cell(
    study: AnyStudy, variant: str, place: str | Sequence[str], seed: int, value: Any = None
) -> Recipe | StreamRecipe | RobotStreamRecipe:
    """The recipe of one training.

    Args:
        place: the task or stream; for a stream of robot tasks, its tasks. In a study without tasks
            it is only a name.
        value: the value of the variant's knob, if it has one.

    Raises:
        AegisError: keys or values that are not a valid recipe.
    """
    rules = _CELL_RULES[type(study)]
    problems: list[Problem] = []
    raw = variants.merged(study.shared, study.variants[variant], value)
    if rules.recipe is Recipe:
        raw["methods"] = [study.variants[variant].method]
    # Last, because these override `shared` and the variant.
    raw |= {"name": study.name, "seed": seed}
    if not isinstance(study, StudyRecipe) or study.tasks is not None:
        raw[rules.place] = place
    for dotted in _drawn(study):
        put(raw, dotted, seed)
    made: Recipe | StreamRecipe | RobotStreamRecipe = build(rules.recipe, raw, problems)
    refuse(problems or list(rules.together(made)), f"variant {variant} of {study.name}")
    return made


def places(study: StudyRecipe) -> tuple[str, ...]:
    """The tasks of a study, or a name for the demonstrations that all its cells use.

    The name is that of their file or folder, in characters that are allowed in a folder name.
    """
    if study.tasks is not None:
        return study.tasks
    given = study.shared.get("demos", {}).get("path") or ()
    names = [_name_of(path) for path in ([given] if isinstance(given, str) else given)]
    name = "+".join(filter(None, names)).encode()[:_LONGEST_NAME].decode(errors="ignore")
    if name in _TAKEN:
        name += "-demos"
    return (name or "demonstrations",)


def _name_of(path: str) -> str:
    at = Path(path)
    name = at.stem if at.suffix == ".safetensors" else at.name
    return re.sub(r"[^\w.+-]+", "_", name).strip("._")


def load_any(path: str | Path) -> AnyRecipe:
    """Read a recipe of any kind.

    Raises:
        AegisError: the file cannot be read, or has problems; one error names all of them.
    """
    path = Path(path)
    kind = recipes.take_kind(recipes.read(path)[0], path)
    return load(path) if kind in _CELL_RULES else recipes.load(path, kind=kind)


def written_out(recipe: AnyRecipe) -> dict[str, Any]:
    """Every key that has an effect with its value, as plain values.

    A study's `shared` has every key of its cells' recipes that the study itself does not set.
    """
    own = recipes.without_retired(recipes.every_key(recipe), type(recipe))
    plain = {"kind": recipes.name_of(type(recipe)), **own}
    if not isinstance(recipe, AnyStudy):
        return plain
    rules = _CELL_RULES[type(recipe)]
    given = {"name": "cell", rules.place: rules.any_place}
    shared = recipes.every_key(build(rules.recipe, {**recipe.shared, **given}, []))
    given_below = [dotted for dotted in rules.given if "." in dotted]
    for dotted in (*given_below, *_drawn(recipe)):
        section, name = dotted.split(".")  # every such key is in a section
        del shared[section][name]
    shared = {name: value for name, value in shared.items() if name not in rules.given}
    plain["shared"] = recipes.without_retired(shared, rules.recipe)
    return plain


def _places(name: str, study: type) -> list[str]:
    """Where a key of a plain recipe belongs in a study.

    That is the study's own key for it, or a key of the same name in a section or in 'shared'.
    """
    rules = _CELL_RULES[study]
    if name in rules.given:
        return [rules.given[name]]
    own = [name] if name in {f.name for f in dataclasses.fields(rules.recipe)} else []
    shared = [place for place in own + below(name, rules.recipe) if place not in rules.given]
    return below(name, study) + [f"shared.{place}" for place in shared]


# --- all problems at once -------------------------------------------------------------------------


def _check(
    raw: Mapping[str, Any], rules: _CellRules, problems: list[Problem]
) -> dict[str, Variant]:
    """The variants that can be read; the problems of all cells are appended."""
    # From the raw keys, since there is no study object if one of them is wrong.
    drawn = raw.get("per_seed")
    per_seed = _per_seed(drawn if isinstance(drawn, list) else ())
    places_given = {**rules.given, **dict.fromkeys(per_seed, "per_seed")}
    reserved = {**dict.fromkeys(rules.for_all), **places_given}
    readable = variants.read(
        raw.get("variants"), rules.variant, reserved, rules.references, problems
    )
    # Only the stage knows which streams exist, so any name will do here.
    places = [] if rules.recipe is StreamRecipe else _readable(raw.get(rules.places))
    checked: list[Any] = [*places] or [rules.any_place]
    if rules.listed and places:
        checked = [places]
    given = [{"name": "cell", rules.place: place} for place in checked]
    problems += variants.cell_problems(
        rules.recipe,
        raw.get("shared", {}),
        readable,
        raw.get("variants", {}),
        places_given,
        given,
        rules.together,
    )
    fix = f"add it: {rules.tuning_keys}"
    problems += variants.tuning_problems(raw, readable, rules.tuning_seed, fix)
    problems += rules.problems(raw)
    return readable


def _drawn(study: AnyStudy) -> list[str]:
    """The keys of a cell's recipe that get its seed, for a study that has been read."""
    return [] if isinstance(study, StreamStudyRecipe) else _per_seed(study.per_seed or ())


def _per_seed(names: Iterable[str]) -> list[str]:
    """The keys of a cell's recipe that get its seed."""
    known = [name for name in names if isinstance(name, str) and name in PER_SEED]
    return [f"{PER_SEED[name]}.seed" for name in known]


def _readable(tasks: Any) -> list[str]:
    """The tasks that can be read; `build` has reported the others."""
    listed = tasks if isinstance(tasks, list) else []
    return [task for task in listed if isinstance(task, str) and recipes.TASK.accepts(task)]


def _drawn_problems(raw: Mapping[str, Any]) -> list[Problem]:
    """Problems of `per_seed: demos` with given demonstrations, which are equal for all seeds."""
    names = raw.get("per_seed")
    if not isinstance(names, list) or "demos" not in names:
        return []
    return [
        Problem(
            f"per_seed: demos with {where}",
            "recorded demonstrations, which differ with every seed",
            "take demos out of per_seed: the seeds still hold out other episodes",
        )
        for where in _given_demos(raw)
    ]


def _given_demos(raw: Mapping[str, Any]) -> Iterator[str]:
    """Where a study names demonstrations, for all cells or for those of a variant."""
    shared, named = raw.get("shared"), raw.get("variants")
    settings = shared.get("demos") if isinstance(shared, dict) else None
    if isinstance(settings, dict):
        for key in ("path", "paths"):
            if settings.get(key) is not None:
                yield f"shared: demos.{key}: {settings[key]}"
    for name, variant in named.items() if isinstance(named, dict) else ():
        for part in ("set", "tune"):
            own = variant.get(part) if isinstance(variant, dict) else None
            if not isinstance(own, dict):
                continue
            for key in ("demos.path", "demos.paths"):
                if own.get(key) is not None:
                    yield f"variants.{name}.{part}: {key}: {own[key]}"


def _place_problems(raw: Mapping[str, Any]) -> list[Problem]:
    """Problems of a study without tasks: missing demonstrations, or a task for tuning."""
    if raw.get("tasks") is not None:
        return []
    named, given = raw.get("variants"), [*_given_demos(raw)]
    own = [f"variants.{name}." for name in (named if isinstance(named, dict) else ())]
    everywhere = own and all(any(where.startswith(name) for where in given) for name in own)
    if not everywhere and not any(where.startswith("shared") for where in given):
        return [
            Problem(
                "no key 'tasks', and no demonstrations",
                "'tasks', or demonstrations of your robot (shared: demos.path)",
                "add the line 'tasks: [reach]'",
            )
        ]
    tuning = raw.get("tuning")
    if isinstance(tuning, dict) and tuning.get("task") is not None:
        return [
            Problem(
                f"tuning.task: {tuning['task']} without tasks",
                "the demonstrations that the study compares on, to tune on as well",
                "delete tuning.task",
                line_of(tuning, "task"),
            )
        ]
    return []


def _gate_problems(raw: Mapping[str, Any]) -> list[Problem]:
    """Problems with a gate, which is for single runs; a study judges every variant by its bar."""
    shared = raw.get("shared")
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


def _reference_problems(raw: Mapping[str, Any]) -> list[Problem]:
    """Problems of variants whose `against` is not another variant."""
    given = raw.get("variants")
    named = given if isinstance(given, dict) else {}
    found = []
    for name, keys in named.items():
        against = keys.get("against") if isinstance(keys, dict) else None
        others = [other for other in named if other != name]
        if isinstance(against, str) and against not in others:
            near = did_you_mean(against, list(map(str, others)))
            fix = f"did you mean '{near}'?" if near else f"delete variants.{name}.against"
            line = line_of(keys, "against")
            what = f"variants.{name}.against: '{against}'"
            found.append(Problem(what, "the name of another variant", fix, line))
    return found


def _together(made: Recipe) -> list[Problem]:
    """Problems across the keys of a cell's recipe."""
    found = list(recipes.cross_checks(made))
    for check in (recipes.anchor_checks, recipes.merge_checks):
        found += check(made, (made.train.method,))
    if "seen" not in made.rollout.colors:
        found.append(
            Problem(
                "rollout.colors without seen",
                "seen among them: success on these is compared",
                "add seen",
            )
        )
    return found


def _pair_problems(raw: Mapping[str, Any]) -> list[Problem]:
    """Problems of pairs that are also a stream of the main table, or the other pair."""
    pairs, streams = raw.get("pairs"), raw.get("streams")
    named = [pairs.get("a"), pairs.get("b")] if isinstance(pairs, dict) else []
    named = [name for name in named if isinstance(name, str)]
    main = streams if isinstance(streams, list) else []
    return [
        Problem(
            f"the stream '{name}' twice, in pairs and streams",
            "each stream once",
            "delete it in one of them",
        )
        for name in dict.fromkeys(named)
        if named.count(name) > 1 or name in main
    ]


_CELL_RULES: Mapping[type, _CellRules] = {
    StudyRecipe: _CellRules(
        recipe=Recipe,
        variant=PolicyVariant,
        place="task",
        places="tasks",
        given={
            "name": "name",
            "task": "tasks",
            "seed": "seeds",
            "methods": "variants",
            "train.method": "variants",
        },
        for_all=("backbone", "probe", "rollout.episodes", "rollout.colors", "rollout.seed"),
        references={NAIVE: "naive"},
        any_place="reach",
        tuning_seed=Tuning().seed,
        tuning_keys="task, seed, questions, episodes, within, runs",
        together=_together,
        problems=lambda raw: [
            *_place_problems(raw),
            *_gate_problems(raw),
            *_drawn_problems(raw),
            *_reference_problems(raw),
        ],
    ),
    StreamStudyRecipe: _CellRules(
        recipe=StreamRecipe,
        variant=StreamVariant,
        place="stream",
        places="streams",
        given={
            "name": "name",
            "stream": "streams",
            "order": "streams",
            "seed": "seeds",
            "train.method": "variants",
            "split": "tuning",
        },
        for_all=("path", "encoder", "inference"),
        references={ISOLATED: "isolated-lora", ZERO_SHOT: "zero-shot", HALF: "isolated-lora"},
        any_place="any",
        tuning_seed=StreamTuning("any").seed,
        tuning_keys="stream, seed, within",
        together=recipes.cross_checks,
        problems=_pair_problems,
    ),
    RobotStreamStudyRecipe: _CellRules(
        recipe=RobotStreamRecipe,
        variant=RobotStreamVariant,
        place="tasks",
        places="tasks",
        listed=True,
        given={
            "name": "name",
            "tasks": "tasks",
            "seed": "seeds",
            "train.method": "variants",
            "rollout.split": "tuning",
        },
        for_all=("backbone", "probe", "rollout.episodes", "rollout.colors", "rollout.seed"),
        references={ISOLATED: "isolated-lora"},
        any_place=("reach",),
        tuning_seed=RobotStreamTuning().seed,
        tuning_keys="seed, within",
        together=recipes.cross_checks,
        problems=_drawn_problems,
    ),
}
