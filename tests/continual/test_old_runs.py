"""Runs of a stream by an earlier version: today's code inspects, probes and resumes them.

The sample was made by version 2e38d13 from two tasks of small pictures with igsp: a finished run,
and the same run interrupted between its tasks and in either phase of the second. Beside them are
the images and the dual encoder, named by paths relative to the folder.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from aegis_cli import inspection, recipes
from aegis_cli.common import artifacts
from aegis_cli.continual import files, probe, state, train
from aegis_cli.recipes import StreamRecipe

SAMPLE = Path(__file__).parent.parent / "samples" / "old_runs" / "stream-2e38d13"
INTERRUPTED = {"between-tasks": (0, 2), "in-phase-1": (4, 1), "in-phase-2": (8, 2)}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the sample as the working folder."""
    copy = shutil.copytree(SAMPLE, tmp_path / "old")
    monkeypatch.chdir(copy)
    return copy


def first_experts(run: Path) -> dict[str, torch.Tensor]:
    """The experts that were added by the first task."""
    saved = artifacts.load(run / files.EXPERTS, "experts")
    report = files.read(run)
    names = {
        f"{site.site}.experts.{number}.{factor}"
        for site in report.records[0].sites
        for number in site.experts
        for factor in ("a", "b")
    }
    assert names and names <= saved.tensors.keys()
    return {name: saved.tensors[name] for name in names}


def test_a_finished_run_is_inspected(folder: Path) -> None:
    found = inspection.run(Path("finished"))
    raw = json.loads(Path("finished/stream.json").read_text(encoding="utf-8"))
    assert found.kind == "stream-run" and found.report.method == "igsp"
    plain = json.loads(json.dumps(found.report.to_json()))
    assert {name: plain[name] for name in raw} == raw
    assert plain.keys() - raw.keys() == {"out", "minutes"}


def test_a_finished_run_is_shown(folder: Path, aegis: Callable[..., tuple[int, str, str]]) -> None:
    code, out, err = aegis("inspect", "finished")
    assert code == 0 and "igsp on shapes" in out and "after striped" in out, err


def matrix() -> dict[str, Any]:
    """The finished run's accuracies; Python 3.12 sums numbers to more digits than 3.11."""
    written = Path("finished/accuracy_matrix.json").read_text(encoding="utf-8")
    return json.loads(written, parse_float=lambda digits: round(float(digits), 12))


def test_a_finished_run_is_probed(folder: Path) -> None:
    before = matrix()
    found = probe.run(Path("finished"))
    assert found.measured == 2 and found.largest_difference == 0
    assert matrix() == before


def test_a_finished_run_is_not_learned_again(folder: Path) -> None:
    before = {path: path.read_bytes() for path in Path("finished").iterdir()}
    recipe = recipes.load("finished/recipe.yaml", kind=StreamRecipe)
    train.run(recipe, Path("finished"), resume=True)
    assert {path: path.read_bytes() for path in Path("finished").iterdir()} == before


@pytest.mark.parametrize("name", INTERRUPTED)
def test_an_interrupted_run_goes_on(name: str, folder: Path) -> None:
    """What was learned before is kept bit for bit, and the rest is learned as it was then.

    Equal bytes of the newly learned part are guaranteed only on one processor, so this test
    compares its shapes.
    """
    place = artifacts.read_header(Path(name) / state.STATE).meta["place"]
    assert (place["task"], place["step"], place["phase"]) == (1, *INTERRUPTED[name])
    recipe = recipes.load(f"{name}/recipe.yaml", kind=StreamRecipe)
    report = train.run(recipe, Path(name), resume=True)
    whole = files.read(Path("finished"))
    assert report.records[0] == whole.records[0] and report.oracle[0] == whole.oracle[0]
    assert report.records[1].phase1_steps == whole.records[1].phase1_steps == 6
    assert report.scores.forgetting == 0 and report.inputs == whole.inputs
    kept = first_experts(Path("finished"))
    assert all(torch.equal(kept[key], t) for key, t in first_experts(Path(name)).items())
    written = {path.name for path in Path(name).iterdir()}
    assert written == {path.name for path in Path("finished").iterdir()}
