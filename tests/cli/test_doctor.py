"""`aegis doctor` and `aegis recipes`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from samples.command import ROOT

from aegis_cli.cli import doctor
from aegis_cli.common import gl
from aegis_cli.common.errors import AegisError


def states(report: doctor.DoctorReport) -> dict[str, str]:
    return {check.name: check.state for check in report.checks}


def test_all_is_well_where_the_tests_run() -> None:
    found = states(doctor.run(self_test=False))
    assert {"aegis", "python", "torch", "mujoco", "opengl", "disk"} <= found.keys()
    assert {name for name, state in found.items() if state == "failed"} == set()


def test_the_self_test_runs_every_stage() -> None:
    seen = []
    report = doctor.run(on_event=lambda event: seen.append(event.stage))
    model, last = report.checks[-2:]
    assert (last.name, last.state) == ("self-test", "ok") and report.failed == []
    assert (model.name, model.state) == ("hugging face", "ok") and "answers" in model.found
    for stage in ("demos", "anchor", "aegis/train", "aegis/probe", "aegis/rollout seen"):
        assert stage in seen


def test_a_release_of_transformers_that_is_not_known_is_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """For example one that calls a layer with other arguments than earlier releases."""
    from aegis_cli.models.backbones.hf import HFBackbone

    def fails(*_: object) -> None:
        raise TypeError("forward() got an unexpected keyword argument 'cache'")

    monkeypatch.setattr(HFBackbone, "encode", fails)
    monkeypatch.setattr(doctor, "_self_test", lambda _: "every stage ran")
    by_name = {check.name: check for check in doctor.run().checks}
    assert by_name["hugging face"].state == "failed"
    assert "'cache'" in by_name["hugging face"].found and by_name["hugging face"].fix


def test_what_is_missing_is_named_with_its_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_driver() -> None:
        raise AegisError("no driver", "one", "apt-get install driver")

    monkeypatch.setattr(gl, "check", no_driver)
    version = doctor._version
    gone = {"scipy", "pyarrow"}
    monkeypatch.setattr(doctor, "_version", lambda name: None if name in gone else version(name))
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda _: SimpleNamespace(free=1e9))
    report = doctor.run(self_test=False)
    by_name = {check.name: check for check in report.checks}
    assert report.failed == ["scipy", "opengl", "disk"]
    assert by_name["opengl"].fix == "apt-get install driver"
    assert by_name["[lerobot]"].state == "missing"
    assert by_name["[lerobot]"].fix == "pip install 'aegis-vla[lerobot]'"


def test_the_command_exits_with_1_where_something_does_not_work(
    aegis: Callable[..., tuple[int, str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert aegis("doctor", "--quick")[0] == 0
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda _: SimpleNamespace(free=0))
    code, out, err = aegis("doctor", "--quick", "--json")
    assert code == 1 and "gate failed: disk of aegis doctor" in err
    assert {check["name"] for check in json.loads(out)["checks"]} >= {"torch", "disk"}


# --- recipes --------------------------------------------------------------------------------------


def test_recipes_are_listed_shown_and_copied(
    aegis: Callable[..., tuple[int, str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [recipe["name"] for recipe in json.loads(aegis("recipes", "--json")[1])["recipes"]]
    assert sorted(names) == sorted(path.stem for path in (ROOT / "recipes").glob("*.yaml"))
    assert aegis("recipes") == aegis("recipes", "ls")
    text = (ROOT / "recipes" / "reach.yaml").read_text()
    assert aegis("recipes", "show", "reach") == (0, text, "")
    copy = tmp_path / "mine.yaml"
    assert aegis("recipes", "cp", "reach", copy)[0] == 0 and copy.read_text() == text
    monkeypatch.chdir(tmp_path)
    assert aegis("recipes", "cp", "reach")[0] == 0
    assert (tmp_path / "reach.yaml").read_text() == text


def test_each_of_the_three_prints_one_json_document(
    aegis: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    path = ROOT / "recipes" / "reach.yaml"
    code, out, _ = aegis("recipes", "show", "reach", "--json")
    shown = {"name": "reach", "path": str(path), "text": path.read_text()}
    assert code == 0 and json.loads(out) == shown
    code, out, _ = aegis("recipes", "cp", "reach", tmp_path / "mine.yaml", "--json")
    assert code == 0 and json.loads(out) == {"name": "reach", "out": str(tmp_path / "mine.yaml")}


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (("cp", "reach", "there.yaml"), "'there.yaml' exists"),
        (("show", "raech"), "no recipe 'raech'"),
        (("show",), "without a name"),
        (("cp",), "without a name"),
        (("ls", "reach"), "'reach' after ls"),
        (("show", "reach", "mine.yaml"), "aegis recipes cp reach mine.yaml"),
        (("reach",), "'ls', 'show', 'cp'"),
    ],
)
def test_recipes_are_refused_what_they_cannot_do(
    aegis: Callable[..., tuple[int, str, str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    args: tuple[str, ...],
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.yaml").write_text("mine")
    code, out, err = aegis("recipes", *args)
    assert code == 2 and out == "" and said in err
    assert (tmp_path / "there.yaml").read_text() == "mine"


def test_recipes_are_read_where_the_locale_has_no_utf_8() -> None:
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    command = [sys.executable, "-m", "aegis_cli", "recipes", "show", "igsp-mtil"]
    shown = subprocess.run(command, env={**os.environ, **plain}, capture_output=True, check=True)
    assert shown.stdout.isascii() and b"pink primrose" in shown.stdout
