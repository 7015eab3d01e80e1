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

METHODS = ("naive", "stop-gradient", "lora", "aegis")
TASKS = ("reach", "point")
VQA_SETS = ("scenes",)
PRECISIONS = ("bf16", "float32")
COLOR_SETS = ("seen", "held-out")
WEIGHTINGS = ("none", "variance")


def _choice(*choices: str) -> Check:
    return Check("one of " + ", ".join(choices), lambda v: v in choices, choices)


POSITIVE = Check("above 0", lambda v: v > 0)
NOT_NEGATIVE = Check("0 or more", lambda v: v >= 0)
SHARE = Check("above 0 and below 1", lambda v: 0 < v < 1)
UP_TO_ONE = Check("from 0 to 1", lambda v: 0 <= v <= 1)
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
    precision: str = key(_choice(*PRECISIONS), "bf16")
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
    methods: tuple[str, ...] = key(_choice(*METHODS), METHODS)
    demos: Demos = Demos()
    anchor: Anchor = Anchor()
    train: Train = Train()
    expert: Expert = Expert()
    lora: Lora = Lora()
    aegis: Aegis = Aegis()
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


R = TypeVar("R", Recipe, PretrainRecipe)
_COMMANDS = {Recipe: ("run", "train"), PretrainRecipe: ("pretrain",)}


def load(path: str | Path, overrides: Sequence[str] = (), kind: type[R] = Recipe) -> R:
    """Read a recipe file, apply `key.sub=value` overrides, check everything.

    Raises:
        AegisError: the file cannot be read, or the recipe has problems; one error names all of them.
    """
    path = Path(path)
    raw, problems = parse(_read(path), str(path))
    if not isinstance(raw, dict):
        raise AegisError(f"no keys in {path}", "a recipe: lines of 'key: value'", "start from recipes/quickstart.yaml")
    _refuse_other_kind(raw, path, kind)
    for setting in overrides:
        problems += override(raw, setting)
    recipe = build(kind, raw, problems)
    refuse(problems or list(_cross_checks(recipe)), str(path))
    return recipe


def to_yaml(recipe: Recipe | PretrainRecipe) -> str:
    """The resolved recipe, every key written out; `load` reads it back to an equal recipe."""
    return dump(json.loads(json.dumps(dataclasses.asdict(recipe))))  # JSON turns tuples into lists


def digest(recipe: Recipe | PretrainRecipe) -> str:
    """sha256 of the recipe's canonical JSON: equal values, equal digest, however the file was written."""
    return hashlib.sha256(canonical(dataclasses.asdict(recipe)).encode()).hexdigest()


def training_part(recipe: Recipe) -> dict[str, Any]:
    """What shapes the trained weights: other methods' options, probes, rollouts and the name do not."""
    part: dict[str, Any] = {"task": recipe.task, "backbone": recipe.backbone, "seed": recipe.seed}
    part |= {key: dataclasses.asdict(getattr(recipe, key)) for key in ("train", "expert")}
    return part | {m: dataclasses.asdict(getattr(recipe, m)) for m in ("lora", "aegis") if m == recipe.train.method}


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
            commands, fix = _COMMANDS[other], f"aegis {_COMMANDS[other][0]} {path}"
            raise AegisError(f"{path} is a recipe for {_say(commands)}", f"a recipe for {_say(_COMMANDS[kind])}", fix)


def _say(commands: Sequence[str]) -> str:
    return " and ".join(f"`aegis {c}`" for c in commands)


def _cross_checks(recipe: Recipe | PretrainRecipe) -> Iterator[Problem]:
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
