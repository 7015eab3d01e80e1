"""The folder of a finished job, written by hand: nothing is trained."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from aegis_cli.common import artifacts, files
from aegis_cli.evaluation import wrong_answers
from aegis_cli.recipes import Recipe, Train, to_yaml

HOSTILE = "<script>alert('x')</script>\"&\x1b[2J"
GROUPS = ["stem", "layers.0", "layers.1"]
METHODS = ("naive", "aegis")


def write_job(folder: Path, family: str = "color", **changes: Any) -> Path:
    """A job of two methods; `changes` are keys of its recipe, `family` the name of its questions.

    Returns:
        The job's folder.
    """
    job = folder / "job"
    for number, method in enumerate(METHODS):
        _write_run(job / method, method, number, family, changes)
    rows = [_row(method, number) for number, method in enumerate(METHODS)]
    table = {
        "name": changes.get("name", "job"),
        "rows": rows,
        "baseline_accuracy": 0.9,
        "baseline_cross_entropy": 0.25,
        "majority_accuracy": 0.3,
        "out": str(job),
        "gate_failed": [],
        "verdict": "",
    }
    files.save_json(job / "table.json", table)
    return job


def _write_run(run: Path, method: str, number: int, family: str, changes: dict[str, Any]) -> None:
    (run / "checkpoints" / "000006").mkdir(parents=True)
    (run / "checkpoints" / "last").symlink_to("000006")
    finished = {"train": Train(steps=6)}
    recipe = Recipe(**{"name": "job", "task": "reach", "methods": METHODS, **finished, **changes})
    (run / "recipe.yaml").write_text(to_yaml(recipe))
    lines = [
        {"step": step, "loss": 2.0 / step + number, "step_s": 0.5, "lr_backbone": 1e-4 / step}
        for step in range(1, 7)
    ]
    lines[-1]["validation_loss"] = 0.75 + number
    (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (run / "machine.json").write_text(json.dumps({"aegis": "0.1.0", "processor": family}))
    _write_ledger(run / "ledger.safetensors", method)
    files.save_json(run / "probe.json", probe(family, number))
    for colors, success in (("seen", 0.75), ("held-out", 0.5)):
        files.save_json(run / f"rollout-{colors}.json", rollout(colors, success))


def _write_ledger(path: Path, method: str) -> None:
    """Six steps; only `aegis` removes part of the gradient."""
    steps = torch.arange(1, 7)
    anchored = method == "aegis"
    size = (len(steps), len(GROUPS))
    tensors = {
        "tt": torch.ones(size, dtype=torch.float64),
        "ta": -0.1 * steps[:, None].double().expand(size) * anchored,
        "aa": torch.full(size, float(anchored), dtype=torch.float64),
        "w2": torch.ones(len(steps), 2, dtype=torch.float64),
        "step": steps,
    }
    meta = {"groups": GROUPS, "layers": ["layers.0", "layers.1"], "method": method}
    tensors = {name: tensor.contiguous() for name, tensor in tensors.items()}
    artifacts.save(path, "ledger", tensors, meta=meta)


def probe(family: str, number: int = 0) -> dict[str, Any]:
    """What a probe found, with one wrong answer."""
    accuracy = 0.8 - 0.1 * number
    own = {
        "accuracy": accuracy,
        "interval": [accuracy - 0.1, accuracy + 0.1],
        "questions": 40,
        "majority": 0.3,
        "baseline_accuracy": 0.9,
    }
    picture = np.zeros((8, 8, 3), np.uint8)
    wrong = {"family": family, "question": f"what {family}", "said": family, "reference": "red"}
    return {
        **own,
        "cross_entropy": 0.5,
        "baseline_cross_entropy": 0.25,
        "drop_points": 10.0 + 10 * number,
        "drop_interval": [5.0 + 10 * number, 15.0 + 10 * number],
        "families": {family: own},
        "layers": [{"layer": "layers.0", "w2": 12.5}, {"layer": "layers.1", "w2": 250.0}],
        "passed": None,
        "soft_accuracy": None,
        "soft_interval": None,
        "baseline_soft_accuracy": None,
        "skipped": 0,
        "w2_between": None,
        "wrong": [wrong | {"png": wrong_answers.encoded(picture)}],
    }


def rollout(colors: str, success: float) -> dict[str, Any]:
    """What a rollout found."""
    return {
        "task": "reach",
        "colors": colors,
        "success": success,
        "interval": [success - 0.25, success + 0.125],
        "outcomes": "1100",
        "wrong_target": 0.0,
        "final_distance_m": 0.0321,
        "tasks": None,
        "mean_return": None,
        "return_interval": None,
        "return_share": None,
        "episodes": 4,
        "episodes_per_s": 2.0,
        "video": None,
    }


def open_loop(*episodes: int, error: float = 0.25, **changes: Any) -> dict[str, Any]:
    """What an open-loop evaluation on held-out episodes found, as a run keeps it."""
    found = {
        "data": "datasets/arm",
        "split": "validation",
        "episodes": list(episodes),
        "trained_on": [],
        "frames": 50,
        "chunk": 8,
        "seed": 0,
        "relative_error": error,
        "relative_interval": [error - 0.125, error + 0.125],
        "hold_error": 0.5,
    }
    return {**found, **changes}


def _row(method: str, number: int) -> dict[str, Any]:
    return {
        "method": method,
        "accuracy": 0.8 - 0.1 * number,
        "drop_points": 10.0 + 10 * number,
        "drop_interval": [5.0 + 10 * number, 15.0 + 10 * number],
        "cross_entropy": 0.5,
        "success_seen": 0.75,
        "success_held_out": 0.5,
        "wrong_target": 0.0,
        "w2": 131.25,
        "energy_shed": None if method == "naive" else 0.0123,
        "step_s": 0.5,
        "step_time_ratio": 1.0,
        "validation_loss": 0.75 + number,
        "baseline_accuracy": 0.9,
        "baseline_cross_entropy": 0.25,
        "majority_accuracy": 0.3,
    }
