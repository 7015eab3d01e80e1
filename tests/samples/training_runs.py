"""Short trainings of the tiny backbone: fixtures that make them, and how two are compared."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from aegis_cli import recipes
from aegis_cli.anchors import anchor_file as anchor_files
from aegis_cli.common.events import Event, OnEvent, Progress
from aegis_cli.data import demonstrations
from aegis_cli.methods import METHODS
from aegis_cli.models import backbones
from aegis_cli.models.expert import ActionExpert, ExpertShape
from aegis_cli.models.policy import Policy
from aegis_cli.recipes import Cotrain, Expert, Lora, Recipe, Rollout, Train
from aegis_cli.training import checkpoint, inputs, train
from samples.nullspace import share_of_displacement

STEPS, EVERY = 6, 2
SETTINGS = Train(
    steps=STEPS,
    batch_size=4,
    chunk=4,
    flow_samples=2,
    backbone_lr=1e-3,
    expert_lr=3e-3,
    warmup=2,
    validate_every=3,
    checkpoint_every=EVERY,
    log_every=1,
    precision="float32",
)
TIMES = {"data_s", "update_s", "step_s", "samples_per_s"}


@pytest.fixture(scope="session")
def recipe(tiny_folder: Path) -> Recipe:
    return Recipe(
        name="test",
        backbone=str(tiny_folder),
        train=SETTINGS,
        expert=Expert(width=16),
        lora=Lora(rank=4, alpha=8.0),
        cotrain=Cotrain(questions=14, batch_size=3),
        rollout=Rollout(replan=2),
    )


Start = Callable[..., train.TrainReport]


@pytest.fixture(scope="session")
def start(recipe: Recipe, demos_file: Path, anchor_file: Path) -> Start:
    """`train.run` with everything but the method and the folder filled in."""

    def run(method: str, out: Path, **changes: Any) -> train.TrainReport:
        options = {"recipe": recipe, "demos": demos_file, "anchor": anchor_file} | changes
        return train.run(method=method, out=out, **options)

    return run


@pytest.fixture(scope="session")
def whole_run(start: Start, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """A run of a method from the first step to the last, made once; read-only."""

    @cache
    def run(method: str) -> Path:
        out = tmp_path_factory.mktemp("run") / method
        start(method, out)
        return out

    return run


@pytest.fixture(params=sorted(METHODS))
def finished(request: pytest.FixtureRequest, whole_run: Callable[[str], Path]) -> tuple[str, Path]:
    """A method and a run of it from the first step to the last."""
    return request.param, whole_run(request.param)


@pytest.fixture(scope="session")
def naive_run(whole_run: Callable[[str], Path]) -> Path:
    return whole_run("naive")


def contents(out: Path) -> dict[str, bytes | str]:
    """Every file of a run folder except metrics.jsonl, whose times differ; links by target.

    Without a stream's inputs.json too, which has paths relative to the run.
    """
    paths = (p for p in sorted(out.rglob("*")) if p.is_symlink() or p.is_file())
    found = {
        str(p.relative_to(out)): str(p.readlink()) if p.is_symlink() else p.read_bytes()
        for p in paths
    }
    differs = {"metrics.jsonl"} | ({inputs.NAME} if recipes.is_stream_run(out) else set())
    return {name: value for name, value in found.items() if name not in differs}


def metrics(out: Path, without: frozenset[str] | set[str] = frozenset()) -> list[dict[str, float]]:
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    return [{key: value for key, value in line.items() if key not in without} for line in lines]


def assert_same_run(one: Path, other: Path) -> None:
    a, b = contents(one), contents(other)
    assert a.keys() == b.keys()
    # The file also has relative paths from the run, whose place is different here.
    assert inputs.of(one) == inputs.of(other)
    for found in (a, b):
        found.pop(inputs.NAME, None)
    assert [name for name in a if a[name] != b[name]] == []
    assert metrics(one, TIMES) == metrics(other, TIMES)


def assert_resumes(
    start: Start, method: str, recipe: Recipe, folder: Path, whole: Path | None = None
) -> None:
    """A run that is interrupted and resumed equals the uninterrupted one, byte for byte.

    Args:
        whole: the uninterrupted run if there is one already; otherwise it is made in the folder.
    """
    if whole is None:
        whole = folder / "whole"
        start(method, whole, recipe=recipe)
    with pytest.raises(KeyboardInterrupt):
        start(method, folder / "cut", recipe=recipe, on_event=stop_at(3, KeyboardInterrupt()))
    start(method, folder / "cut", recipe=recipe, resume=True)
    assert_same_run(folder / "cut", whole)


@dataclass(frozen=True)
class Told:
    """A finished run, which is only read, and what was said of it."""

    out: Path
    report: train.TrainReport
    events: list[Event]


def told(start: Start, method: str, recipe: Recipe, out: Path) -> Told:
    """Train, and keep what is said."""
    events: list[Event] = []
    return Told(out, start(method, out, recipe=recipe, on_event=events.append), events)


def stop_at(done: int, error: BaseException) -> OnEvent:
    def on_event(event: Event) -> None:
        if isinstance(event, Progress) and (event.stage, event.done) == ("train", done):
            raise error

    return on_event


def small_policy(backbone: backbones.Backbone, demos: demonstrations.Demonstrations) -> Policy:
    """A policy of these trainings' size, drawn from the global generator."""
    proprio, actions = (demos.tensors[name].shape[1] for name in ("proprio", "actions"))
    shape = ExpertShape(
        backbone.depth,
        backbone.heads,
        backbone.head_dim,
        proprio,
        actions,
        SETTINGS.chunk,
        width=16,
        kv_heads=None if backbone.kv_heads == backbone.heads else backbone.kv_heads,
    )
    return Policy(backbone, ActionExpert(shape), *demos.scales())


def protected_shares(out: Path, anchor: Path, energy: float) -> list[float]:
    """At each checkpoint of a run, the share of the movement inside the span of VQA's inputs.

    Args:
        anchor: file with the inputs of the backbone with which the run began.
        energy: share of the inputs' energy that the directions hold.
    """
    named = recipes.load(out / "recipe.yaml").backbone
    origin = backbones.load(named)
    wanted = anchor_files.Wanted(origin.fingerprint(), named, "--backbone ")
    measured = anchor_files.load(anchor, wanted)
    saved = [path for path in sorted((out / "checkpoints").iterdir()) if not path.is_symlink()]
    found = [checkpoint.load_policy(path)[0].backbone for path in saved]
    return [share_of_displacement(then, origin, measured, energy) for then in found]
