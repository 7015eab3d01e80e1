"""Figures beside a run: Aegis' own are read, and anything else gives one error that names it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from samples.reports import probe, rollout

from aegis_cli.common.errors import AegisError
from aegis_cli.evaluation import kept_figures
from aegis_cli.evaluation.kept_figures import Plain, ProbeFigures, RolloutFigures, TrainFigures


def saved(folder: Path, document: Any) -> Path:
    path = folder / "figures.json"
    path.write_text(json.dumps(document))
    return path


@pytest.mark.parametrize(
    ("kind", "figures"),
    [
        (ProbeFigures, probe("color")),
        (ProbeFigures, {"accuracy": 1}),  # an older version wrote less
        (RolloutFigures, rollout("seen", 0.5)),
        (RolloutFigures, {"episodes": 3, "novelty": [1]}),
        (TrainFigures, {"loss": 0.5, "steps": 3}),
        (Plain, {"cores": 2, "processor": "x"}),
    ],
)
def test_what_was_written_is_read(kind: Any, figures: dict[str, Any], tmp_path: Path) -> None:
    assert kept_figures.read(saved(tmp_path, figures), kind) == figures


@pytest.mark.parametrize(
    ("kind", "changed", "where"),
    [
        (ProbeFigures, {"accuracy": None}, "accuracy"),
        (ProbeFigures, {"accuracy": 10**400}, "accuracy"),
        (ProbeFigures, {"accuracy": float("nan")}, "JSON compliant"),
        (ProbeFigures, {"families": {"color": []}}, "families.color"),
        (ProbeFigures, {"layers": [{"layer": "a", "w2": "b"}]}, "layers.0.w2"),
        (ProbeFigures, {"wrong": [{}]}, "wrong.0"),
        (RolloutFigures, {"interval": []}, "interval.0"),
        (RolloutFigures, {"interval": [0.5, None]}, "interval.1"),
        (RolloutFigures, {"episodes": "4"}, "episodes"),
        (RolloutFigures, {"final_distance_m": "near"}, "final_distance_m"),
        (RolloutFigures, {"settings": 3}, "settings"),
        (TrainFigures, {"loss": {}}, "loss"),
        (Plain, {"cores": [2]}, "cores"),
    ],
)
def test_another_type_is_named(
    kind: Any, changed: dict[str, Any], where: str, tmp_path: Path
) -> None:
    whole = {ProbeFigures: probe("color"), RolloutFigures: rollout("seen", 0.5)}.get(kind, {})
    path = saved(tmp_path, whole | changed)
    with pytest.raises(AegisError, match="figures.json' is damaged") as caught:
        kept_figures.read(path, kind)
    assert where in caught.value.found


def test_a_list_is_no_figures(tmp_path: Path) -> None:
    with pytest.raises(AegisError, match="is damaged"):
        kept_figures.read(saved(tmp_path, [1, 2]), ProbeFigures)
