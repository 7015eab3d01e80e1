"""Recipes: what a run is made of, as frozen dataclasses that map one to one onto YAML files."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from aegis_cli.errors import AegisError
from aegis_cli.files import canonical
from aegis_cli.strict_yaml import Check, Problem, build, did_you_mean, dump, key, override, parse, refuse

METHODS = ("naive", "stop-gradient", "lora", "aegis", "nullspace", "l2sp", "maps", "ewc", "distill", "cotrain")
TASKS = ("reach", "point")
VQA_SETS = ("scenes",)
PRECISIONS = ("auto", "bf16", "float32")
COLOR_SETS = ("seen", "held-out")
WEIGHTINGS = ("none", "variance")
SCOPES = ("all", "image", "text", "each")
PROJECTED = ("gradient", "update", "both")
GROUPS = ("all", "language")
SITE_KINDS = ("maps", "norms", "embeddings", "stem")
ANCHOR_PARTS = ("moments", "inputs", "fisher")
NEEDS = {"aegis": "moments", "nullspace": "inputs", "ewc": "fisher"}  # method -> the anchor part it reads


def _choice(*choices: str) -> Check:
    return Check("one of " + ", ".join(choices), lambda v: v in choices, choices)


POSITIVE = Check("above 0", lambda v: v > 0)
NOT_NEGATIVE = Check("0 or more", lambda v: v >= 0)
SHARE = Check("above 0 and below 1", lambda v: 0 < v < 1)
UP_TO_ONE = Check("from 0 to 1", lambda v: 0 <= v <= 1)
SHARE_OR_ONE = Check("above 0 and up to 1", lambda v: 0 < v <= 1)
NOT_EMPTY = Check("not empty", lambda v: bool(v.strip()))
FOLDER_NAME = Check("letters, digits, '.', '_', '-'", lambda v: bool(re.fullmatch(r"\w[\w.-]*", v)))


@dataclass(frozen=True)
class Demos:
    episodes: int = key(POSITIVE, 300)
    noise: float = key(NOT_NEGATIVE, 0.3)  # standard deviation of the executed action, in action units
    seed: int = key(NOT_NEGATIVE, 0)


@dataclass(frozen=True)
class Anchor:
    vqa: str = key(_choice(*VQA_SETS), "scenes")
    samples: int = key(POSITIVE, 3000)
    batch_size: int = key(POSITIVE, 64)
    seed: int = key(NOT_NEGATIVE, 0)
    parts: tuple[str, ...] = key(_choice(*ANCHOR_PARTS), ("moments", "inputs"))
    energy: float = key(SHARE_OR_ONE, 0.9999)  # of each map's inputs, up to which eigenvectors are kept
    fisher_samples: int = key(POSITIVE, 1000)


@dataclass(frozen=True)
class Train:
    method: str = key(_choice(*METHODS), "naive")
    steps: int = key(POSITIVE, 1500)
    batch_size: int = key(POSITIVE, 32)
    chunk: int = key(POSITIVE, 8)  # actions predicted at once
    flow_samples: int = key(POSITIVE, 8)  # flow times and noises an image
    backbone_lr: float = key(NOT_NEGATIVE, 1e-4)
    expert_lr: float = key(NOT_NEGATIVE, 1e-3)
    warmup: int = key(NOT_NEGATIVE, 100)  # steps
    weight_decay: float = key(NOT_NEGATIVE, 0.01)
    clip_norm: float = key(POSITIVE, 1.0)
    final_lr_share: float = key(UP_TO_ONE, 0.1)
    validation_share: float = key(SHARE, 0.05)  # of the episodes
    validate_every: int = key(POSITIVE, 250)
    checkpoint_every: int = key(POSITIVE, 500)
    log_every: int = key(POSITIVE, 25)
    leak_every: int = key(POSITIVE, 10)  # steps between two measurements of the leak, which cost about 5 % of a step
    leak_energy: float = key(SHARE_OR_ONE, 0.999)  # of each map's VQA inputs, whose directions the leak is measured in
    precision: str = key(_choice(*PRECISIONS), "auto")
    compile: bool = False


@dataclass(frozen=True)
class Expert:
    width: int = key(POSITIVE, 128)  # heads and their size are the backbone's, whose keys and values it reads
    mlp_ratio: int = key(POSITIVE, 4)


@dataclass(frozen=True)
class Lora:
    rank: int = key(POSITIVE, 16)
    alpha: float = key(POSITIVE, 32.0)


@dataclass(frozen=True)
class Aegis:
    weighting: str = key(_choice(*WEIGHTINGS), "none")  # of the layers in the transport penalty
    scope: str = key(_choice(*SCOPES), "all")  # tokens that are compared; each: one Gaussian a token type
    projects: str = key(_choice(*PROJECTED), "gradient")  # what the conflict is removed from
    restoration: float = key(NOT_NEGATIVE, 0.0)  # weight of the anchor gradient added to the task's
    groups: str = key(_choice(*GROUPS), "all")  # which parameter groups are projected; language: the layers


@dataclass(frozen=True)
class Nullspace:
    energy: float = key(UP_TO_ONE, 0.999)  # share of each map's VQA input energy whose directions are protected
    soft: float = key(NOT_NEGATIVE, 0.0)  # 0: hard; else the energy share at which a direction is half protected
    protect: tuple[str, ...] = key(_choice(*SITE_KINDS), SITE_KINDS)


@dataclass(frozen=True)
class L2sp:
    weight: float = key(NOT_NEGATIVE, 0.01)


@dataclass(frozen=True)
class Maps:
    weight: float = key(NOT_NEGATIVE, 1.0)  # of the first module; it falls linearly to 0 at the last


@dataclass(frozen=True)
class Ewc:
    weight: float = key(NOT_NEGATIVE, 100.0)


@dataclass(frozen=True)
class Distill:
    weight: float = key(NOT_NEGATIVE, 1.0)


@dataclass(frozen=True)
class Cotrain:
    weight: float = key(NOT_NEGATIVE, 0.1)  # of the VQA cross-entropy
    questions: int = key(POSITIVE, 14_000)  # of the training scenes
    batch_size: int = key(POSITIVE, 32)  # questions a step


@dataclass(frozen=True)
class Probe:
    vqa: str = key(_choice(*VQA_SETS), "scenes")
    questions: int = key(POSITIVE, 5000)
    batch_size: int = key(POSITIVE, 64)
    max_drop: float | None = key(NOT_NEGATIVE, None)  # percentage points


@dataclass(frozen=True)
class Rollout:
    episodes: int = key(POSITIVE, 50)
    colors: tuple[str, ...] = key(_choice(*COLOR_SETS), COLOR_SETS)
    replan: int = key(POSITIVE, 4)  # actions executed before the next prediction


@dataclass(frozen=True)
class Recipe:
    """What `aegis run` and `aegis train` read."""

    name: str = key(FOLDER_NAME)
    task: str = key(_choice(*TASKS), "reach")
    backbone: str = key(NOT_EMPTY, "embedded")
    seed: int = key(NOT_NEGATIVE, 0)
    methods: tuple[str, ...] = key(_choice(*METHODS), METHODS[:5])
    demos: Demos = Demos()
    anchor: Anchor = Anchor()
    train: Train = Train()
    expert: Expert = Expert()
    lora: Lora = Lora()
    aegis: Aegis = Aegis()
    nullspace: Nullspace = Nullspace()
    l2sp: L2sp = L2sp()
    maps: Maps = Maps()
    ewc: Ewc = Ewc()
    distill: Distill = Distill()
    cotrain: Cotrain = Cotrain()
    probe: Probe = Probe()
    rollout: Rollout = Rollout()


@dataclass(frozen=True)
class Model:
    width: int = key(POSITIVE, 192)
    depth: int = key(POSITIVE, 6)
    heads: int = key(POSITIVE, 6)


@dataclass(frozen=True)
class PretrainRecipe:
    """What `aegis pretrain` reads."""

    name: str = key(FOLDER_NAME)
    seed: int = key(NOT_NEGATIVE, 0)
    scenes: int = key(POSITIVE, 50_000)
    probe_questions: int = key(POSITIVE, 7000)  # asked of the finished model
    steps: int = key(POSITIVE, 4000)
    batch_size: int = key(POSITIVE, 48)  # scenes, each with all its questions
    lr: float = key(NOT_NEGATIVE, 2e-3)
    warmup: int = key(NOT_NEGATIVE, 100)  # steps
    weight_decay: float = key(NOT_NEGATIVE, 0.02)
    precision: str = key(_choice(*PRECISIONS), "bf16")
    compile: bool = False
    checkpoint_every: int = key(POSITIVE, 1000)
    model: Model = Model()


@dataclass(frozen=True)
class Variant:
    """A method with some keys of its own, and at most one knob: a key and the values it is chosen among."""

    method: str = key(_choice(*METHODS))
    set: dict[str, Any] = dataclasses.field(default_factory=dict)  # dotted recipe key -> value
    tune: dict[str, Any] = dataclasses.field(default_factory=dict)  # one dotted recipe key -> list of values

    @property
    def knob(self) -> str | None:
        return next(iter(self.tune), None)

    @property
    def values(self) -> list[Any]:
        """What the knob may be; [None] without one."""
        return next(iter(self.tune.values()), [None])


@dataclass(frozen=True)
class Tuning:
    """How each variant's knob is chosen: `stages/selection.py` has the rule."""

    task: str = key(_choice(*TASKS), "reach")
    seed: int = key(NOT_NEGATIVE, 1000)  # of the training; never one of the study's seeds
    questions: int = key(POSITIVE, 1400)  # on validation scenes
    episodes: int = key(POSITIVE, 100)  # validation rollouts, seen colours
    within: float = key(NOT_NEGATIVE, 3.0)  # points of success


@dataclass(frozen=True)
class StudyRecipe:
    """What `aegis run` reads to compare variants over tasks and seeds; `studies.load` reads and checks it."""

    name: str = key(FOLDER_NAME)
    tasks: tuple[str, ...] = key(_choice(*TASKS))
    seeds: tuple[int, ...] = key(NOT_NEGATIVE)
    variants: dict[str, Variant] = key(Check("at least one", bool))
    shared: dict[str, Any] = dataclasses.field(default_factory=dict)  # a recipe's keys, for every run
    tuning: Tuning | None = None
    keep_runs: bool = False  # the checkpoints of runs that have been measured


R = TypeVar("R", Recipe, PretrainRecipe)
_COMMANDS = {Recipe: ("run", "train"), PretrainRecipe: ("pretrain",), StudyRecipe: ("run",)}


def load(path: str | Path, overrides: Sequence[str] = (), kind: type[R] = Recipe) -> R:
    """Read a recipe file, apply `key.sub=value` overrides, check everything.

    Raises:
        AegisError: the file cannot be read, or the recipe has problems; one error names all of them.
    """
    path = Path(path)
    raw, problems = read(path)
    _refuse_other_kind(raw, path, kind)
    for setting in overrides:
        problems += override(raw, setting)
    recipe = build(kind, raw, problems)
    refuse(problems or list(cross_checks(recipe)), str(path))
    return recipe


def read(path: Path) -> tuple[dict[Any, Any], list[Problem]]:
    """The raw keys of a recipe file of any kind, and the keys given twice.

    Raises:
        AegisError: the file cannot be read, or is no mapping.
    """
    raw, problems = parse(_read(path), str(path))
    if not isinstance(raw, dict):
        raise AegisError(f"no keys in {path}", "a recipe: lines of 'key: value'", "start from recipes/quickstart.yaml")
    return raw, problems


def read_anchor(options: dict[str, Any]) -> Anchor:
    """Anchor settings from command-line options, checked as a recipe's are."""
    problems: list[Problem] = []
    settings: Anchor = build(Anchor, options, problems, "--")
    refuse(problems, "the options")
    return settings


def to_yaml(recipe: Recipe | PretrainRecipe | StudyRecipe) -> str:
    """The resolved recipe, every key written out; `load` reads it back to an equal recipe."""
    return dump(json.loads(json.dumps(dataclasses.asdict(recipe))))  # JSON turns tuples into lists


def digest(recipe: Recipe | PretrainRecipe | StudyRecipe) -> str:
    """sha256 of the recipe's canonical JSON: equal values, equal digest, however the file was written."""
    return hashlib.sha256(canonical(dataclasses.asdict(recipe)).encode()).hexdigest()


def training_part(recipe: Recipe) -> dict[str, Any]:
    """What shapes the trained weights: other methods' options, probes, rollouts and the name do not."""
    part: dict[str, Any] = {"task": recipe.task, "backbone": recipe.backbone, "seed": recipe.seed}
    part |= {key: dataclasses.asdict(getattr(recipe, key)) for key in ("train", "expert")}
    return part | {recipe.train.method: options(recipe)}


def options(recipe: Recipe) -> dict[str, Any]:
    """The options of `recipe.train.method`; {} for a method without any."""
    part = getattr(recipe, recipe.train.method, None)
    return {} if part is None else dataclasses.asdict(part)


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        near = did_you_mean(path.stem, [p.stem for p in path.parent.glob("*.yaml")])
        fix = f"did you mean {path.with_name(near + '.yaml')}?" if near else "check the path, e.g. recipes/quickstart.yaml"
        raise AegisError(f"no file {path}", "a recipe, a YAML file", fix) from None
    except UnicodeDecodeError:
        raise AegisError(f"{path} is not text", "a recipe, a YAML file", "give a recipe, e.g. recipes/quickstart.yaml") from None
    except OSError as e:
        raise AegisError(f"{path}: {e.strerror}", "a readable recipe file", "check the path and its permissions") from None


def _refuse_other_kind(raw: dict[Any, Any], path: Path, kind: type) -> None:
    """A whole recipe of the other command gets one plain sentence instead of a list of unknown keys."""
    for other in _COMMANDS:
        names, own = ({f.name for f in dataclasses.fields(k)} for k in (other, kind))
        if other is not kind and set(raw) <= names and not set(raw) <= own:
            fix = f"aegis {_COMMANDS[other][0]} {path}"
            raise AegisError(f"{path} is {_say(other)}", _say(kind), fix)


def _say(kind: type) -> str:
    what = "a study of several runs, a recipe" if kind is StudyRecipe else "a recipe"
    return f"{what} for " + " and ".join(f"`aegis {c}`" for c in _COMMANDS[kind])


def cross_checks(recipe: Recipe | PretrainRecipe) -> Iterator[Problem]:
    """What a single key cannot tell."""
    if isinstance(recipe, PretrainRecipe):
        model = recipe.model
        if model.width % model.heads:
            found = f"model.width: {model.width} with model.heads: {model.heads}"
            fix = f"set model.width to {model.heads * max(1, model.width // model.heads)}"
            yield Problem(found, "a width that the heads divide", fix)
    elif recipe.rollout.replan > recipe.train.chunk:
        found = f"rollout.replan: {recipe.rollout.replan} with train.chunk: {recipe.train.chunk}"
        yield Problem(found, "no more actions executed than predicted", f"set rollout.replan to at most {recipe.train.chunk}")


def anchor_checks(recipe: Recipe, methods: Sequence[str]) -> Iterator[Problem]:
    """Whether the anchor that `aegis run` measures holds what these methods, and the leak, read."""
    measured = recipe.anchor
    needed = [(method, NEEDS[method]) for method in methods if method in NEEDS]
    for method, part in needed:
        if part not in measured.parts:
            fix = f"set anchor.parts to [{', '.join((*measured.parts, part))}]"
            yield Problem(f"anchor.parts: {', '.join(measured.parts)} with method {method}", f"anchor.parts with {part}", fix)
    shares = {"train.leak_energy": recipe.train.leak_energy} if "inputs" in measured.parts else {}
    if "nullspace" in methods and recipe.nullspace.soft == 0:
        shares["nullspace.energy"] = recipe.nullspace.energy
    for name, share in shares.items():
        if share > measured.energy:
            found = f"{name}: {share:g} with anchor.energy: {measured.energy:g}"
            yield Problem(found, "an anchor that keeps at least that share", f"set anchor.energy to {share:g}")


def check_anchor(recipe: Recipe) -> None:
    """Raise AegisError unless the recipe's anchor holds what its methods read."""
    refuse(list(anchor_checks(recipe, recipe.methods)), f"recipe {recipe.name}")
