"""Streams of robot tasks whose run, backbone or demonstrations have moved."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from samples.interrupted import stop
from samples.lerobot import frame_cache  # noqa: F401
from samples.own_robots import TASKS
from samples.robots import Make
from samples.training_runs import contents

from aegis_cli.common.errors import AegisError
from aegis_cli.continual import evaluate, places, probe, robots, train
from aegis_cli.deploy import load_policy
from aegis_cli.publishing import export
from aegis_cli.recipes import RobotDemos, RobotStreamRecipe, to_yaml

pytestmark = pytest.mark.usefixtures("frame_cache")
Aegis = Callable[..., tuple[int, str, str]]


@pytest.fixture
def place(
    real: Make,
    tiny_folder: Path,
    paths: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Path:
    """The current folder, with a model and datasets of its own, and a folder beside it."""
    home = tmp_path / "home"
    shutil.copytree(tiny_folder, home / "models" / "tiny")
    for task in TASKS:
        shutil.copytree(paths[task], home / "datasets" / task)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(home)
    (home / "bench.yaml").write_text(to_yaml(relative(real())))
    return home


def relative(recipe: RobotStreamRecipe) -> RobotStreamRecipe:
    """A recipe that names everything relative to the folder of `place`."""
    demos = RobotDemos(paths=tuple(f"datasets/{task}" for task in TASKS))
    return dataclasses.replace(recipe, backbone="models/tiny", demos=demos)


@pytest.fixture
def run(real: Make, place: Path) -> Path:
    """The absolute path of a finished run."""
    train.run(relative(real("isolated-lora")), Path("run"))
    return place / "run"


def use(run: Path, out: Path, backbone: str | None = None) -> None:
    """Everything that needs the backbone of a finished run."""
    assert load_policy(run, "pick", backbone=backbone).chunk == 4
    assert evaluate.run(run, "pick", backbone=backbone).task == "pick"
    assert probe.run(run, backbone=backbone).largest_difference == 0
    export.run(run, out, task="pick", backbone=backbone)


def test_a_run_is_used_from_another_folder(
    run: Path, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(place.parent / "elsewhere")
    use(run, Path("policy"))


def test_what_has_the_same_names_in_another_folder_is_not_taken_for_its_inputs(
    run: Path, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = place.parent / "elsewhere"
    (other / "models" / "tiny").mkdir(parents=True)
    shutil.copytree(place / "datasets" / TASKS[1], other / "datasets" / TASKS[0])
    monkeypatch.chdir(other)
    use(run, Path("policy"))


def test_demonstrations_that_only_the_command_names_are_taken_again(run: Path, place: Path) -> None:
    """As where they were recorded, are gone, and were given when the run was resumed."""
    recorded = RobotStreamRecipe(name="x", tasks=("reach", "point"), backbone="models/tiny")
    given = relative(recorded)
    (run / "recipe.yaml").write_text(to_yaml(recorded))
    found = places.here(run, given)
    assert found.demos == given.demos and found.backbone == str(place / "models" / "tiny")


def test_a_damaged_report_does_not_keep_a_run_from_being_overwritten(run: Path, real: Make) -> None:
    whole = contents(run)
    (run / "stream.json").write_text("{")
    with pytest.raises(AegisError, match="not JSON"):
        train.run(relative(real("isolated-lora")), run, resume=True)
    train.run(relative(real("isolated-lora")), run, overwrite=True)
    assert contents(run) == whole


def test_a_run_that_has_moved_with_its_inputs_is_used(
    run: Path, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = place.parent / "there"
    place.rename(there)
    monkeypatch.chdir(there.parent)
    use(there / "run", Path("policy"))


def test_the_new_place_of_its_backbone_can_be_given(
    run: Path, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moved = place.parent / "elsewhere" / "tiny"
    (place / "models" / "tiny").rename(moved)
    with pytest.raises(AegisError, match="'models/tiny|tiny' is gone") as caught:
        robots.load_to_act(run)
    assert "--backbone MODEL" in caught.value.fix and "backbone='MODEL'" in caught.value.fix
    use(run, Path("policy"), str(moved))


def test_another_backbone_there_is_refused(run: Path, embedded: str) -> None:
    with pytest.raises(AegisError, match="belongs to|another"):
        robots.load_to_act(run, embedded)


@pytest.fixture
def embedded() -> str:
    return "embedded"


@pytest.mark.parametrize("method", ["igsp", "sequential"])
def test_an_interrupted_run_goes_on_elsewhere_to_the_same_bytes(
    method: str, real: Make, place: Path, monkeypatch: pytest.MonkeyPatch, aegis: Aegis
) -> None:
    recipe = relative(real(method))
    train.run(recipe, Path("whole"))
    with pytest.raises(KeyboardInterrupt):
        train.run(recipe, Path("run"), on_event=partial(stop, f"task 1 {TASKS[0]}", 3))
    there = place.parent / "elsewhere"
    monkeypatch.chdir(there)
    (place / "models" / "tiny").rename(there / "tiny")
    code, _, err = aegis("train", place / "run")
    assert code == 2 and f"aegis train {place / 'run'} --set backbone=MODEL" in err
    for task in TASKS:
        (place / "datasets" / task).rename(there / task)
    moved = ("--set", f"backbone={there / 'tiny'}")
    code, _, err = aegis("train", place / "run", *moved)
    assert code == 2 and "'demos.paths=[PATH, PATH]'" in err and "of 'pick'" in err
    moved += ("--set", f"demos.paths=[{there / 'pick'}, {there / 'open-drawer'}]")
    code, _, err = aegis("train", place / "run", *moved)
    assert code == 0, err
    assert contents(place / "run") == contents(place / "whole")
    # From now on, the folder says where they are.
    code, out, err = aegis("probe", place / "run", "--json")
    assert code == 0 and json.loads(out)["largest_difference"] == 0, err


def test_a_model_of_other_weights_does_not_continue_a_run(
    real: Make, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(KeyboardInterrupt):
        train.run(relative(real()), Path("run"), on_event=partial(stop, f"task 1 {TASKS[0]}", 3))
    other = dataclasses.replace(relative(real()), backbone="embedded")
    with pytest.raises(AegisError, match="different backbone"):
        train.run(other, Path("run"), resume=True)


def test_probe_takes_the_new_places_of_demonstrations(run: Path, place: Path, aegis: Aegis) -> None:
    (place / "datasets").rename(place / "data")
    code, _, err = aegis("probe", run)
    assert code == 2 and f"aegis probe {run} --demos PATH --demos PATH" in err
    named: list[Any] = []
    for task in TASKS:
        named += ["--demos", place / "data" / task]
    code, out, err = aegis("probe", run, *named, "--json")
    assert code == 0 and json.loads(out)["largest_difference"] == 0, err
    code, _, err = aegis("probe", run, *named[:2])
    assert code == 2 and "1 of --demos" in err


@pytest.mark.parametrize("command", ["train", "probe"])
def test_a_relative_question_set_names_the_folder_to_call_the_command_in(
    command: str, run: Path, place: Path, aegis: Aegis, monkeypatch: pytest.MonkeyPatch
) -> None:
    (place / "questions.jsonl").write_text("{}")
    recipe = run / "recipe.yaml"
    recipe.write_text(recipe.read_text().replace("vqa: scenes", "vqa: questions.jsonl"))
    monkeypatch.chdir(place.parent / "elsewhere")
    code, _, err = aegis(command, run)
    assert code == 2 and "no 'questions.jsonl' here" in err
    assert f"cd {place} && aegis {command} {run}" in err


def test_a_backbones_place_is_refused_where_a_run_holds_its_own(
    real: Make, place: Path, aegis: Aegis
) -> None:
    train.run(relative(real("sequential")), Path("run"))
    shutil.rmtree(place / "models")
    assert load_policy(place / "run", "pick").chunk == 4
    code, _, err = aegis("evaluate", "run", "--task", "pick", "--backbone", "embedded")
    assert code == 2 and "holds its own" in err


def test_a_run_without_recorded_places_says_how_to_give_them(run: Path, place: Path) -> None:
    (run / "inputs.json").unlink()  # as an earlier version left it
    (place / "models").rename(place / "moved")
    with pytest.raises(AegisError, match="'models/tiny' is gone") as caught:
        load_policy(run, "pick")
    assert "--backbone MODEL" in caught.value.fix
    assert load_policy(run, "pick", backbone="moved/tiny").chunk == 4
