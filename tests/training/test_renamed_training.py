"""Training on demonstrations with other names: what it records, and where the names are known."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from samples.lerobot import otherwise
from samples.training_runs import SETTINGS, Start, assert_resumes, metrics

from aegis_cli import inspection, load_policy, recipes
from aegis_cli.anchors import anchor_file
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Warned, ignore
from aegis_cli.data import record
from aegis_cli.evaluation import open_loop
from aegis_cli.merging.settings import MergeSettings
from aegis_cli.merging.sources import PolicyRun
from aegis_cli.models import backbones
from aegis_cli.publishing import export
from aegis_cli.recipes import Recipe
from aegis_cli.studies.cells import Cell
from aegis_cli.studies.policy_cells import cell_key
from aegis_cli.training import checkpoint, dry_run, loading

TOP, OVERHEAD = "observation.images.top", "observation.images.overhead"
RENAME = {OVERHEAD: TOP, "main_dx": "dx"}
Aegis = Callable[..., tuple[int, str, str]]
pytestmark = pytest.mark.usefixtures("frame_cache")


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A dataset of `reach`, and another one whose camera and one action have other names."""
    folder = tmp_path_factory.mktemp("sets")
    for name, seed in (("own", 0), ("plain", 1)):
        record.run("reach", 4, seed, folder / name, workers=1, form="lerobot")
    names = {new: old for old, new in RENAME.items()}
    return folder / "own", otherwise(folder / "plain", folder / "other", names)


def renaming(recipe: Recipe, **demos: Any) -> Recipe:
    return replace(recipe, demos=replace(recipe.demos, **{"rename": RENAME} | demos))


@pytest.fixture(scope="module")
def run(
    recipe: Recipe, start: Start, sets: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A run on both; read-only."""
    out = tmp_path_factory.mktemp("run") / "both"
    start("naive", out, recipe=renaming(recipe), demos=sets)
    return out


def test_the_weights_and_losses_are_those_of_sets_of_one_name(
    run: Path, recipe: Recipe, start: Start, sets: tuple[Path, Path], tmp_path: Path
) -> None:
    """This includes the validation loss."""
    start("naive", tmp_path / "plain", demos=(sets[0], sets[1].parent / "plain"))
    for name in ("expert.safetensors", "backbone/model.safetensors"):
        one, other = (
            load_file(out / "checkpoints/last" / name) for out in (run, tmp_path / "plain")
        )
        assert one.keys() == other.keys()
        assert all(torch.equal(one[key], other[key]) for key in one)
    times = {"data_s", "update_s", "step_s", "samples_per_s"}
    assert metrics(run, times) == metrics(tmp_path / "plain", times)


def test_the_policy_has_its_own_names(run: Path, tmp_path: Path) -> None:
    """This includes an export, by whose names LeRobot finds the pictures."""
    export.run(run, tmp_path / "lerobot")
    for folder in (run, tmp_path / "lerobot"):
        policy = load_policy(folder)
        assert [name.removeprefix("observation.images.") for name in policy.cameras] == ["top"]
        assert policy.action_names == ("dx", "dy")
    config = json.loads((tmp_path / "lerobot/config.json").read_text())
    assert TOP in config["input_features"] and OVERHEAD not in config["input_features"]


def test_a_run_is_resumed_to_the_same_bytes(
    recipe: Recipe, start: Start, sets: tuple[Path, Path], tmp_path: Path
) -> None:
    def begin(method: str, out: Path, **changes: Any) -> object:
        return start(method, out, demos=sets, **changes)

    assert_resumes(begin, "naive", renaming(recipe), tmp_path)


def test_a_run_is_not_resumed_by_another_renaming(
    recipe: Recipe, start: Start, sets: tuple[Path, Path], run: Path
) -> None:
    other = renaming(recipe, rename={**RENAME, "dy": "side"})
    with pytest.raises(AegisError) as caught:
        start("naive", run, recipe=other, demos=sets, resume=True)
    assert "demos.rename.dy: nothing there, side here" in caught.value.found
    order = renaming(recipe, rename=dict(reversed(RENAME.items())))
    start("naive", run, recipe=order, demos=sets, resume=True)


def test_a_renaming_is_part_of_a_cells_key_and_none_is_not(recipe: Recipe) -> None:
    keys = [cell_key(Cell("x", each), "a", demos_sha256="b") for each in (recipe, renaming(recipe))]
    assert keys[0] != keys[1]
    assert "demos" not in recipes.training_part(recipe)


def test_a_run_tells_its_renaming(run: Path) -> None:
    assert inspection.run(run).facts["rename"] == RENAME
    assert checkpoint.load_policy(run)[1]["rename"] == RENAME


def test_a_dry_run_and_a_merge_read_the_renamed(
    recipe: Recipe, run: Path, sets: tuple[Path, Path], tmp_path: Path
) -> None:
    plan = dry_run.run(renaming(recipe), "naive", sets, None, tmp_path / "x")
    assert plan.cameras == [TOP]
    merged = PolicyRun(run, MergeSettings(demos=sets), ignore)._demos
    assert merged.action_names == ("dx", "dy")


# --- evaluation -----------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [0, 1])
def test_each_set_is_evaluated_under_the_policys_names(
    number: int, run: Path, sets: tuple[Path, Path]
) -> None:
    said = list[Event]()
    report = open_loop.run(run, sets[number], frames=4, on_event=said.append)
    assert report.split == "validation" and [d.name for d in report.dimensions] == ["dx", "dy"]
    assert [event for event in said if isinstance(event, Warned)] == []


def test_other_data_of_yet_other_names_is_evaluated_by_an_option(
    run: Path, sets: tuple[Path, Path], aegis: Aegis, tmp_path: Path
) -> None:
    """For a run, and for a policy without one; without the option, each gives a warning of it."""
    data = otherwise(sets[0], tmp_path / "new", {TOP: "observation.images.cam", "dy": "other"})
    export.run(run, tmp_path / "policy")
    for policy in (run, tmp_path / "policy"):
        plain = ("evaluate", policy, "--demos", data, "--frames", 4, "--json")
        code, out, err = aegis(*plain)
        assert code == 0 and "--rename says which" in " ".join(err.split())
        code, out, err = aegis(*plain, "--rename", "cam=top", "--rename", "other=dy")
        assert code == 0 and "named" not in err
        assert [one["name"] for one in json.loads(out)["dimensions"]] == ["dx", "dy"]


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (("nothing=top",), "'nothing' in demos.rename (or --rename)"),
        (("dx=dy",), "which both become 'dy'"),
        (("dx",), "--rename dx"),
        (("dx=",), "--rename dx="),
        (("=dx",), "--rename =dx"),
        (("dx=a", "dx=b"), "'dx' again"),
    ],
)
def test_an_option_that_does_not_fit_is_refused(
    given: tuple[str, ...], told: str, run: Path, sets: tuple[Path, Path], bad: Callable[..., str]
) -> None:
    options = [word for pair in given for word in ("--rename", pair)]
    bad("evaluate", run, "--demos", sets[0], *options, says=(told,))


# --- anchors --------------------------------------------------------------------------------------


def test_an_anchor_of_frames_has_the_policys_names(
    sets: tuple[Path, Path],
    tiny_folder: Path,
    aegis: Aegis,
    bad: Callable[..., str],
    tmp_path: Path,
) -> None:
    frames = ("anchor", "--backbone", tiny_folder, "--samples", 5, "--demos", sets[1])
    code, _, err = aegis(*frames, "--rename", "overhead=top", "--out", tmp_path / "a", "--json")
    assert code == 0, err
    assert anchor_file.artifacts.read_header(tmp_path / "a").meta["cameras"] == [TOP]
    bad(*frames, "--rename", "side=top", "--out", tmp_path / "b", says=("'side'",))
    bad("anchor", "--rename", "a=b", "--out", tmp_path / "b", says=("--rename without --demos",))


def test_the_advice_for_an_anchor_of_other_cameras_renames(
    sets: tuple[Path, Path], tiny_folder: Path, aegis: Aegis, tmp_path: Path
) -> None:
    frames = ("anchor", "--backbone", tiny_folder, "--samples", 5, "--demos", sets[1])
    assert aegis(*frames, "--out", tmp_path / "a", "--json")[0] == 0
    said = list[Event]()
    loading._warn_of_other_cameras(tmp_path / "a", sets[1], (TOP,), RENAME, said.append)
    assert isinstance(said[0], Warned)
    assert f"--camera {TOP} --rename {OVERHEAD}={TOP}" in said[0].text


# --- the recipe -----------------------------------------------------------------------------------


def test_a_recipe_keeps_its_renaming(tmp_path: Path) -> None:
    made = tmp_path / "x.yaml"
    made.write_text("name: x\ndemos: {path: a, rename: {overhead: top}}\n")
    found = recipes.load(made)
    assert found.demos.selection.rename == (("overhead", "top"),)
    again = tmp_path / "again.yaml"
    again.write_text(recipes.to_yaml(found))
    assert recipes.load(again) == found
    told = recipes.load(made, ["demos.rename={observation.images.overhead: top}"])
    assert told.demos.rename == {OVERHEAD: "top"}


@pytest.mark.parametrize("value", ["top", "[a, b]", "{}", "{a: 1}", "{a: ''}", "{1: a}", "{a: a}"])
def test_what_is_no_renaming_is_refused(value: str, tmp_path: Path) -> None:
    made = tmp_path / "x.yaml"
    made.write_text(f"name: x\ndemos: {{path: a, rename: {value}}}\n")
    with pytest.raises(AegisError, match=r"demos\.rename") as caught:
        recipes.load(made)
    assert "such as {overhead: top}" in caught.value.expected


def test_a_renaming_belongs_to_a_path(recipe: Recipe) -> None:
    with pytest.raises(AegisError, match="demos.rename without demos.path"):
        loading.check_named(renaming(recipe), ignore)


def test_a_policy_is_built_of_what_was_renamed(recipe: Recipe, sets: tuple[Path, Path]) -> None:
    backbone = backbones.load(recipe.backbone)
    chosen = renaming(recipe, camera="top")
    found = loading.load_demonstrations(chosen, backbone, sets, ignore)
    assert found.cameras == (TOP,) and SETTINGS.chunk > 1
