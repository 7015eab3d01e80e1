"""Small studies of streams as files, and runners that know the streams of `samples.streams`."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

from aegis_cli.common.events import OnEvent
from aegis_cli.continual import images
from aegis_cli.recipes import StreamStudyRecipe, study_cells
from aegis_cli.recipes.strict_yaml import dump
from aegis_cli.studies.figures import StreamFigures
from aegis_cli.studies.stream_cells import StreamRunner
from samples import streams as stream_samples

VARIANTS: dict[str, Any] = {
    "zero-shot": {"method": "zero-shot"},
    "isolated-lora": {"method": "isolated-lora"},
    "igsp": {"method": "igsp", "tune": {"igsp.reuse": [0.1, 10]}},
}
PAIRS = {"a": "pair", "b": "contrary"}
TUNING = {"stream": "small", "seed": 1000, "within": 1}
SHARED: dict[str, Any] = {
    "encoder": "tiny",
    "train": {
        "steps": 6,
        "batch_size": 16,
        "lr": 1e-2,
        "warmup": 2,
        "checkpoint_every": 2,
        "log_every": 4,
    },
    "igsp": {"rank": 2, "check_every": 2, "checks": 2},
}


def raw(**changes: Any) -> dict[str, Any]:
    """The keys of a study; `changes` replace top-level keys, None removes them."""
    keys = {
        "name": "small",
        "streams": ["small"],
        "pairs": PAIRS,
        "seeds": [0, 1],
        "shared": SHARED,
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


def study(folder: Path, **changes: Any) -> StreamStudyRecipe:
    """The study as it is read from a file."""
    loaded = study_cells.load(write(folder, raw(**changes)))
    assert isinstance(loaded, StreamStudyRecipe)
    return loaded


def make(folder: Path, on_event: OnEvent) -> StreamRunner:
    """A runner in a process where no fixture has any effect."""
    images.backbones.load_dual, images.streams.load = (
        stream_samples.load,
        stream_samples.load_stream,
    )
    images.streams.edition = stream_samples.edition
    return StreamRunner(folder, on_event)


def row(**figures: Any) -> StreamFigures:
    """Figures of two tasks by hand; the inferred ones equal the told ones unless given."""
    plain: dict[str, Any] = {
        "method": "igsp",
        "transfer": 0.5,
        "average": 0.7,
        "last": 0.8,
        "forgetting": 0.0,
        "parameters": 400,
        "inference_parameters": 40,
        "trained_phase1": 300.0,
        "trained": 200.0,
        "trained_mean": 250.0,
        "reuse": 0.5,
        "own": (0.8, 0.8),
        "added": (200, 200),
        "new_experts": (4, 2),
        "first_change": 0.0,
        "minutes": 1.0,
    }
    told = plain | figures
    names = ("transfer", "average", "last", "forgetting")
    return StreamFigures(**{f"inferred_{name}": told[name] for name in names} | told)
