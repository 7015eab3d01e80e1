"""Small studies as files, and invented rows in place of trainings."""

from __future__ import annotations

import copy
import dataclasses
import random
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from aegis_cli.evaluation import bench
from aegis_cli.recipes import PolicyVariant, Recipe, StudyRecipe, Train, study_cells
from aegis_cli.recipes.strict_yaml import dump
from aegis_cli.studies.comparison import Cost, StudyReport, task_results
from aegis_cli.studies.figures import Divergence, PolicyFigures, VqaFigures
from aegis_cli.studies.policy_cells import PolicyRunner
from aegis_cli.studies.tuning import PolicyPoint
from samples import small_run

VARIANTS: dict[str, Any] = {
    "naive": {"method": "naive", "tune": {"train.backbone_lr": [1e-3, 1e-2]}},
    "aegis-update": {"method": "aegis", "set": {"aegis.projects": "update"}},
}
TUNING = {"task": "reach", "seed": 1000, "questions": 14, "episodes": 2, "within": 3}


def raw(backbone: str | Path, **changes: Any) -> dict[str, Any]:
    """The keys of a study whose cells take about a second each.

    `changes` replace top-level keys; None removes them.
    """
    shared = dataclasses.asdict(small_run.recipe(backbone))
    for name in ("name", "task", "seed", "methods"):
        del shared[name]
    del shared["train"]["method"]
    keys = {
        "name": "small",
        "tasks": ["reach"],
        "seeds": [0, 1],
        "shared": shared,
        "variants": VARIANTS,
        "tuning": TUNING,
    }
    return copy.deepcopy(
        {name: value for name, value in (keys | changes).items() if value is not None}
    )


def write(folder: Path, keys: dict[str, Any]) -> Path:
    path = folder / "study.yaml"
    path.write_text(dump(keys))
    return path


def study(folder: Path, backbone: str | Path, **changes: Any) -> StudyRecipe:
    """The study as read from a file."""
    loaded = study_cells.load(write(folder, raw(backbone, **changes)))
    assert isinstance(loaded, StudyRecipe)
    return loaded


def row(recipe: Recipe, **changes: Any) -> PolicyFigures:
    """Invented figures that depend on the recipe alone."""
    draw = random.Random(
        f"{recipe.train} {recipe.seed} {recipe.task} {recipe.aegis} {recipe.nullspace}"
    ).random
    drop = 0.0 if recipe.train.method == "stop-gradient" else 10 * draw()
    made = PolicyFigures(
        method=recipe.train.method,
        accuracy=0.98 - drop / 100,
        drop_points=drop,
        drop_interval=(drop - 1, drop + 1),
        cross_entropy=0.05 + drop / 20,
        success_seen=0.7 + 0.3 * draw(),
        success_held_out=0.6 + 0.3 * draw(),
        wrong_target=0.1 * draw(),
        w2=100 * draw(),
        energy_shed=0.01 if recipe.train.method == "aegis" else None,
        step_s=1.0,
        step_time_ratio=None,
        validation_loss=0.2,
        baseline_accuracy=0.98,
        baseline_cross_entropy=0.05,
        majority_accuracy=0.3,
    )
    return replace(made, **changes)


def unplayed(figures: PolicyFigures) -> PolicyFigures:
    """The same for a policy that cannot be rolled out; its error is less if it succeeds more."""
    error = 1.3 - figures.success_seen if figures.success_seen is not None else None
    acted = dict.fromkeys(("success_seen", "success_held_out", "wrong_target"))
    return replace(figures, **acted, open_loop_error=error, hold_error=0.75)


def vqa_figures(**changes: Any) -> VqaFigures:
    """Invented figures for a further set of questions."""
    made = VqaFigures(0.9, 5.0, (4.0, 6.0), 0.3, 2.0, 0.95, 0.2, 0.5)
    return replace(made, **changes)


def invent(monkeypatch: pytest.MonkeyPatch, stop_after: int | None = None) -> list[str]:
    """Invented rows instead of trainings; returns the labels of the calls.

    The call after `stop_after` raises a Ctrl-C.
    """
    labels: list[str] = []

    def measured(
        self: PolicyRunner, label: str, recipe: Recipe, validation: bool = False
    ) -> PolicyFigures:
        if len(labels) == stop_after:
            raise KeyboardInterrupt
        labels.append(label)
        (self.folder / label / "checkpoints" / "last").mkdir(parents=True)
        return row(recipe)

    monkeypatch.setattr(PolicyRunner, "figures", measured)
    monkeypatch.setattr(
        PolicyRunner,
        "anchor",
        lambda self, recipe: SimpleNamespace(path=self.folder / "anchor.safetensors"),
    )
    return labels


def fake_bench(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Invented costs instead of timings; returns the variants of each call."""
    calls: list[list[str]] = []

    def compare(recipes: dict[str, Recipe], anchor: Path, on_event: Any = None) -> dict[str, Any]:
        calls.append(list(recipes))
        return {
            name: SimpleNamespace(step_time=1.0 + len(name) / 100, peak_memory=2.0)
            for name in recipes
        }

    monkeypatch.setattr(bench, "compare", compare, raising=False)
    return calls


def found(
    names: tuple[str, ...],
    seeds: int = 5,
    tuned: bool = True,
    diverged: Mapping[str, set[int]] = {},
    by_error: bool = False,
) -> StudyReport:
    """An invented study of one task.

    The last variant has a knob, and some seeds of some variants diverged.

    Args:
        by_error: whether nothing was rolled out, so there are open-loop errors instead.
    """
    methods = {name: name if name in ("naive", "cotrain") else "lora" for name in names}
    rows = {
        n: {s: row(Recipe(name="x", seed=s, train=Train(method=m))) for s in range(seeds)}
        for n, m in methods.items()
    }
    if by_error:
        rows = {n: {s: unplayed(r) for s, r in own.items()} for n, own in rows.items()}
    rows = {
        n: {s: Divergence(7) if s in diverged.get(n, ()) else r for s, r in own.items()}
        for n, own in rows.items()
    }
    variants = {
        name: PolicyVariant(m, tune={"lora.rank": [4, 16]} if name == names[-1] else {})
        for name, m in methods.items()
    }
    costs = {name: Cost(1.5, 2.0) for name in names} if "naive" in names else {}
    task = task_results("reach", rows, variants, {names[-1]: 16}, costs, frozenset({"cotrain"}))
    points = [
        PolicyPoint(n, "lora", v, 0.5 + 0.04 * i, 0.98, 0.9 - 0.05 * i, v != 4)
        for i, n in enumerate(names)
        for v in (4, 16)
    ]
    if by_error:
        points = [replace(p, success=None, open_loop_error=1.4 - p.success) for p in points]
    return StudyReport(
        "n",
        1,
        2,
        list(range(seeds)),
        [task],
        "reach" if tuned else None,
        3.0,
        points if tuned else [],
        "runs/n",
    )
