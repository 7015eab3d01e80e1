"""A run folder that commit 2e38d13 wrote until an interruption: today's code can resume it.

The folder holds two of four steps of `aegis` on the untrained two-layer VLM, with the model, the
demonstrations and the anchor of the run.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

Aegis = Callable[..., tuple[int, str, str]]

OLD = Path(__file__).parent.parent / "samples" / "old_runs" / "policy-2e38d13"
# The results of 2e38d13 itself when it resumed, on another processor: losses of steps 1 to 4.
LOSSES = [2.531140089035034, 3.1994669437408447, 2.390641927719116, 2.4156343936920166]
# and the W2^2 of its two layers in a probe of the finished run with 14 questions
DRIFT = [0.5159394422116477, 0.15827987701673263]


@pytest.fixture
def old(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy to work in; its recipe names the model by a relative path."""
    folder = shutil.copytree(OLD, tmp_path / "old", symlinks=True)
    monkeypatch.chdir(folder)
    return folder


def resume(aegis: Aegis) -> tuple[int, str, str]:
    files = ["--demos", "demos.safetensors", "--anchor", "anchor.safetensors"]
    return aegis("train", "run/recipe.yaml", *files, "--out", "run", "--resume", "--json")


def test_it_is_inspected(aegis: Aegis, old: Path) -> None:
    code, out, _ = aegis("inspect", "run", "--json")
    report = json.loads(out)
    assert code == 0
    assert report["facts"]["method"] == "aegis"
    assert {"layers.0", "layers.1"} <= {layer["name"] for layer in report["layers"]}


def test_it_is_resumed_to_what_its_own_code_reached(aegis: Aegis, old: Path) -> None:
    code, out, err = resume(aegis)
    assert code == 0, err
    assert json.loads(out)["steps"] == 4
    lines = (old / "run" / "metrics.jsonl").read_text().splitlines()
    rows = [json.loads(line) for line in lines]
    losses = [row["loss"] for row in rows if "loss" in row]
    assert losses == pytest.approx(LOSSES, rel=1e-3)
    assert (old / "run" / "checkpoints" / "last").resolve().name == "000004"


def test_it_is_probed_and_rolled_out_once_finished(aegis: Aegis, old: Path) -> None:
    assert resume(aegis)[0] == 0
    probe = ["--baseline", "backbone", "--anchor", "anchor.safetensors", "--questions", 14]
    code, out, err = aegis("probe", "run", *probe, "--json")
    assert code == 0, err
    assert [layer["w2"] for layer in json.loads(out)["layers"]] == pytest.approx(DRIFT, rel=1e-2)
    code, out, err = aegis("rollout", "run", "--episodes", 2, "--json")
    assert code == 0, err
    assert json.loads(out)["episodes"] == 2


def test_the_begun_run_acts_from_its_last_checkpoint(aegis: Aegis, old: Path) -> None:
    code, out, err = aegis("rollout", "run", "--episodes", 1, "--json")
    assert code == 0, err
    assert json.loads(out)["task"] == "reach"
