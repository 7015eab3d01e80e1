"""A policy in LeRobot's layout is the run's whole policy, and works without LeRobot."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from samples.command import refused
from samples.training import images, make_policy, policy_over

from aegis_cli import load_policy, recipes
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Progress, Warned
from aegis_cli.models import backbones, lerobot_folder
from aegis_cli.models.policy import Policy
from aegis_cli.publishing import card, export
from aegis_cli.training import checkpoint

META = {"method": "naive", "task": None, "replan": 2, "normalization": "mean_std"}
LOADED = [Progress("export (loading)", done, 1, "model") for done in (0, 1)]
TEXTS = ["go to the red target", "go to the blue target"]
Aegis = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def exported(run_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("policies") / "x"
    export.run(run_folder, out)
    return out


def acts(policy: Policy) -> torch.Tensor:
    proprio = torch.linspace(-1, 1, 2 * len(policy.proprio_scale.mean)).view(2, -1)
    generator = torch.Generator().manual_seed(5)
    return policy.act(images(2), TEXTS, proprio, generator)


def json_of(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def test_lerobot_finds_its_files_with_the_features_of_the_run(exported: Path) -> None:
    names = {"config.json", "model.safetensors", "policy_preprocessor.json"}
    names |= {"policy_postprocessor.json", "README.md"}
    assert {p.name for p in exported.iterdir()} == names
    config = json_of(exported / "config.json")
    policy = checkpoint.load_policy(exported)[0]
    assert config["type"] == "aegis" and config["n_action_steps"] == 20
    assert config["chunk_size"] == policy.expert.shape.chunk
    assert list(config["input_features"]) == ["observation.images.top", "observation.state"]
    size = policy.backbone.image_size
    assert config["input_features"]["observation.images.top"]["shape"] == [3, size, size]
    assert config["output_features"] == {"action": {"type": "ACTION", "shape": [2]}}


def test_a_run_that_is_not_finished_is_exported_with_a_word_on_it(
    run_folder: Path, tmp_path: Path, aegis: Aegis
) -> None:
    run, told = tmp_path / "run", list[Event]()
    shutil.copytree(run_folder, run, symlinks=True)
    whole = export.run(run, tmp_path / "whole", on_event=told.append)
    assert (whole.steps, whole.planned_steps) == (2, 2)
    assert told == LOADED
    told.clear()
    recipe = run / "recipe.yaml"
    recipe.write_text(recipe.read_text().replace("steps: 2", "steps: 3000"))
    found = export.run(run, tmp_path / "part", on_event=told.append)
    assert (found.steps, found.planned_steps) == (2, 3000)
    *loaded, warned = told
    assert loaded == LOADED and isinstance(warned, Warned)
    assert f"'{run}' is not finished: 2 of 3,000 steps" in warned.text
    card = (tmp_path / "part" / "README.md").read_text(encoding="utf-8")
    assert "2 of 3,000 steps" in card
    code, _, err = aegis("push", run, "me/reach", "--dry-run")
    assert code == 0 and "2 of 3,000 steps" in " ".join(err.split())
    # A policy taken out of its run has none.
    alone = export.run(tmp_path / "part", tmp_path / "alone")
    assert (alone.steps, alone.planned_steps) == (None, None)


def test_every_step_that_lerobots_programs_override_is_there(exported: Path) -> None:
    steps = {
        kind: [s["registry_name"] for s in json_of(exported / f"policy_{kind}.json")["steps"]]
        for kind in ("preprocessor", "postprocessor")
    }
    for name in ("rename_observations", "device", "normalizer"):
        assert f"{name}_processor" in steps["preprocessor"]
    assert "unnormalizer_processor" in steps["postprocessor"]


def test_neither_way_needs_lerobot(exported: Path) -> None:
    assert "lerobot" not in sys.modules


def test_the_weights_have_the_names_of_the_policys_modules(exported: Path) -> None:
    policy = checkpoint.load_policy(exported)[0]
    tensors = load_file(exported / "model.safetensors")
    assert {name.removeprefix("model.") for name in tensors} == set(policy.state_dict())


def test_it_acts_as_the_run_does_bit_for_bit(run_folder: Path, exported: Path) -> None:
    one, other = (checkpoint.load_policy(folder) for folder in (run_folder, exported))
    assert torch.equal(acts(one[0]), acts(other[0]))
    assert {name: one[1][name] for name in META} == {name: other[1][name] for name in META}
    own = [load_policy(folder, seed=3) for folder in (run_folder, exported)]
    frame, positions = images(1)[0].numpy(), [0.1] * own[0].positions
    first, second = (p.predict_action_chunk(frame, TEXTS[0], positions) for p in own)
    assert (first == second).all() and own[1].task == "reach"


def test_probe_rollout_and_inspect_take_the_folder(
    aegis: Aegis, run_folder: Path, exported: Path
) -> None:
    found = []
    for folder in (run_folder, exported):
        said = json.loads(aegis("rollout", folder, "--episodes", "2", "--json")[1])
        # By default only a run is compared with the model that it began from.
        given = ("probe", folder, "--questions", "14", "--baseline", "none", "--json")
        asked = json.loads(aegis(*given)[1])
        del said["episodes_per_s"], asked["asked"]["target"]
        found.append((said, asked))
    assert found[0] == found[1]
    code, out, _ = aegis("inspect", exported, "--json")
    assert code == 0 and json.loads(out)["kind"] == "policy"


def test_the_command_says_what_lerobot_will_see(
    aegis: Aegis, run_folder: Path, tmp_path: Path
) -> None:
    out = tmp_path / "named"
    options = ("--format", "lerobot", "--camera", "wrist", "--json")
    code, said, _ = aegis("export", run_folder, "--out", out, *options)
    report = json.loads(said)
    assert code == 0 and report["pictures"] == ["observation.images.wrist"]
    assert "observation.images.wrist" in json_of(out / "config.json")["input_features"]
    again = refused(aegis("export", run_folder, "--out", out))
    assert "there already" in again


def test_a_camera_that_a_dataset_names_otherwise_keeps_its_name(
    run_folder: Path, tmp_path: Path
) -> None:
    """For example `observation.image` of lerobot/pusht; the prefix is only added to bare names."""
    report = export.run(run_folder, tmp_path / "x", camera="observation.image")
    assert report.pictures == ("observation.image",)
    features = json_of(tmp_path / "x" / "config.json")["input_features"]
    assert list(features) == ["observation.image", "observation.state"]
    assert checkpoint.load_policy(tmp_path / "x")[1]["cameras"] == ["observation.image"]
    assert load_policy(tmp_path / "x").cameras == ("observation.image",)
    again = export.run(tmp_path / "x", tmp_path / "again")
    assert again.pictures == report.pictures
    whole = export.run(run_folder, tmp_path / "y", camera="observation.images.wrist")
    assert whole.pictures == ("observation.images.wrist",)


@pytest.mark.parametrize("name", ["", " ", "a/b", "../x", "top\nx"])
def test_a_camera_that_no_feature_can_be_called_is_refused(
    name: str, run_folder: Path, tmp_path: Path
) -> None:
    with pytest.raises(AegisError, match="a camera's name"):
        export.run(run_folder, tmp_path / "x", camera=name)
    assert not list(tmp_path.iterdir())


def test_the_card_names_a_picture_that_is_not_the_tasks_own(
    run_folder: Path, exported: Path, tmp_path: Path
) -> None:
    export.run(run_folder, tmp_path / "x", camera="wrist")
    assert "--env.task=reach --env.camera=wrist\n" in (tmp_path / "x" / "README.md").read_text()
    assert "--env.task=reach\n" in (exported / "README.md").read_text()


def test_a_checkpoints_layout_has_the_recipe_that_its_card_names(
    run_folder: Path, tmp_path: Path
) -> None:
    """As in a push, under a name that does not make the folder look like a run."""
    export.run(run_folder, tmp_path / "x", form=card.AEGIS)
    assert f"`{export.RECIPE}`" in (tmp_path / "x" / "README.md").read_text()
    learned = recipes.load(run_folder / "recipe.yaml")
    told = recipes.load(tmp_path / "x" / export.RECIPE)
    assert told == dataclasses.replace(learned, backbone=Path(learned.backbone).name)
    assert checkpoint.load_policy(tmp_path / "x")[1]["task"] == "reach"


def test_the_card_calls_the_policy_as_the_hub_can(run_folder: Path, tmp_path: Path) -> None:
    export.run(run_folder, tmp_path / "für x -- y", "lerobot")
    card = (tmp_path / "für x -- y" / "README.md").read_text(encoding="utf-8")
    assert "--policy.path=ORG/f-r-x-y " in card


def test_an_export_can_be_exported_again(exported: Path, tmp_path: Path) -> None:
    export.run(exported, tmp_path / "again")
    one, other = (folder / "model.safetensors" for folder in (exported, tmp_path / "again"))
    assert one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize("form", [card.LEROBOT, card.AEGIS])
def test_what_a_policy_learned_from_is_kept(
    form: str, run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which episodes, and of which data set on the hub; also by an export of the export."""
    policy, meta = checkpoint.load_policy(run_folder)
    learned = {"only": "0-3", "dataset": "lab/arm"}
    with monkeypatch.context() as patch:
        told = {**meta, **learned}
        patch.setattr(checkpoint, "load_policy", lambda _: (policy, told))
        export.run(run_folder, tmp_path / "first", form)
    export.run(tmp_path / "first", tmp_path / "second", card.AEGIS)
    for name in ("first", "second"):
        _, kept = checkpoint.load_policy(tmp_path / name)
        assert {key: kept.get(key) for key in learned} == learned


@pytest.mark.parametrize("form", [card.LEROBOT, card.AEGIS])
def test_what_it_was_merged_with_is_kept_without_a_folder(
    form: str, run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, meta = checkpoint.load_policy(run_folder)
    told = {**meta, "merge": {"method": "linear", "strength": 0.5, "base": "/home/ann/models/vlm"}}
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "load_policy", lambda _: (policy, told))
        export.run(run_folder, tmp_path / "policy", form)
    _, kept = checkpoint.load_policy(tmp_path / "policy")
    assert kept["merge"] == {"method": "linear", "strength": 0.5, "base": "vlm"}


def test_nothing_is_left_of_an_export_that_fails(
    run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(lerobot_folder, "write_model", full)
    with pytest.raises(AegisError, match="No space left"):
        export.run(run_folder, tmp_path / "x")
    assert list(tmp_path.iterdir()) == []


def test_an_export_that_another_process_has_written_meanwhile_stays(
    run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def slow(*_: Any) -> None:
        (tmp_path / "x").mkdir()
        (tmp_path / "x" / "theirs").touch()

    monkeypatch.setattr(lerobot_folder, "write", slow)
    with pytest.raises(AegisError, match="another process wrote in the meantime"):
        export.run(run_folder, tmp_path / "x")
    assert [path.name for path in tmp_path.rglob("*")] == ["x", "theirs"]


def test_what_a_killed_export_left_is_removed_by_the_next(run_folder: Path, tmp_path: Path) -> None:
    (tmp_path / ".x.12345.tmp" / "backbone").mkdir(parents=True)
    export.run(run_folder, tmp_path / "x")
    assert list(tmp_path.iterdir()) == [tmp_path / "x"]


def test_what_lies_beside_an_export_stays(run_folder: Path, tmp_path: Path) -> None:
    mine = tmp_path / ".x.tmp" / "notes.txt"
    mine.parent.mkdir()
    mine.write_text("mine")
    export.run(run_folder, tmp_path / "x")
    assert mine.read_text() == "mine" and len(list(tmp_path.iterdir())) == 2
    made = tmp_path / "plain"
    made.mkdir()
    assert (tmp_path / "x").stat().st_mode == made.stat().st_mode
    (tmp_path / "link").symlink_to("nowhere")
    with pytest.raises(AegisError, match="is there already"):
        export.run(run_folder, tmp_path / "link")


def test_a_name_as_long_as_a_file_system_takes(run_folder: Path, tmp_path: Path) -> None:
    out = tmp_path / ("x" * 255)
    export.run(run_folder, out)
    assert list(tmp_path.iterdir()) == [out] and (out / "model.safetensors").is_file()


def test_a_name_that_is_no_text_is_refused(run_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(AegisError) as caught:
        export.run(run_folder, tmp_path / os.fsdecode(b"caf\xe9"))
    assert "\\udce9" in caught.value.found and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda t: t.pop("model.expert.layers.0.up.weight"), "missing"),
        (lambda t: t.update(extra=torch.zeros(2)), "not part of it"),
        (lambda t: t.update({"model.action_scale.std": torch.ones(3)}), "instead of"),
    ],
)
def test_other_tensors_than_the_policys_are_refused(
    change: Callable[[dict], None], problem: str, tmp_path: Path
) -> None:
    lerobot_folder.write(tmp_path, make_policy().eval(), META)
    saved = artifacts.load(tmp_path / "model.safetensors", "policy")
    tensors = {name: tensor.clone() for name, tensor in saved.tensors.items()}
    change(tensors)
    meta, fingerprint = saved.header.meta, saved.header.fingerprint
    path = tmp_path / "model.safetensors"
    artifacts.save(path, "policy", tensors, fingerprint=fingerprint, meta=meta)
    with pytest.raises(AegisError, match=problem):
        load_policy(tmp_path)


def test_the_file_of_another_program_is_refused(tmp_path: Path) -> None:
    lerobot_folder.write(tmp_path, make_policy().eval(), META)
    from safetensors.torch import save_file

    tensors = load_file(tmp_path / "model.safetensors")
    save_file(tensors, tmp_path / "model.safetensors")
    with pytest.raises(AegisError, match="another program wrote it"):
        load_policy(tmp_path)


@pytest.mark.parametrize("family", ["smolvlm", "paligemma"])
def test_a_hugging_face_model_keeps_its_files_and_its_answers(
    family: str, hf_folder: Callable[[str], Path], tmp_path: Path
) -> None:
    backbone = backbones.load(str(hf_folder(family)))
    policy = policy_over(backbone).eval()
    seen = {**META, "cameras": ["left", "right"], "pictures": [[30, 40], [20, 20]]}
    lerobot_folder.write(tmp_path, policy, seen)
    again, meta = lerobot_folder.load(tmp_path)
    assert torch.equal(acts(policy), acts(again)) and meta["cameras"] == ["left", "right"]
    features = json_of(tmp_path / "config.json")["input_features"]
    assert [name for name in features if "images" in name] == [
        "observation.images.left",
        "observation.images.right",
    ]
    assert [features[name]["shape"] for name in features if "images" in name] == [
        [3, 30, 40],
        [3, 20, 20],
    ]
    assert checkpoint.sizes_of(meta) == ((30, 40), (20, 20))
    alone = backbones.load(str(tmp_path))
    assert alone.answer(images(2), TEXTS) == backbone.answer(images(2), TEXTS)
    assert alone.fingerprint() == backbone.fingerprint()
    assert not list((tmp_path / "backbone").glob("*.safetensors"))
