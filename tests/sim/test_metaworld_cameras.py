"""MetaWorld with several cameras: recorded, learned from and rolled out with the same ones."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from samples.command import refused
from samples.metaworld import MISSING
from samples.small_run import recipe

if MISSING:
    pytest.skip(MISSING, allow_module_level=True)

from aegis_cli import sim
from aegis_cli.common.errors import AegisError
from aegis_cli.common.palette import SEEN
from aegis_cli.data import demonstrations, record
from aegis_cli.data.selection import Selection
from aegis_cli.evaluation import rollout
from aegis_cli.models import acting, lerobot_folder
from aegis_cli.publishing import export
from aegis_cli.recipes import Demos
from aegis_cli.sim.contract import EVALUATION, VALIDATION, episode_rng
from aegis_cli.training import checkpoint, train, validation_rollout

pytestmark = pytest.mark.usefixtures("frame_cache")

ROOT = Path(__file__).parents[2]
TASK = "metaworld/button-press"
BOTH = ("gripperPOV", "corner2")
FULL = tuple(f"observation.images.{name}" for name in BOTH)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demos") / "d"
    record.run(TASK, 2, 0, folder, form="lerobot", cameras=BOTH, workers=1)
    return folder


def trained(
    backbone: Path, dataset: Path, out: Path, camera: Any, played: int | None = None, **demos: Any
) -> Path:
    made = recipe(backbone, steps=1, validation_share=0.5)
    made = replace(made, task=TASK, demos=Demos(camera=camera, **demos))
    made = replace(made, rollout=replace(made.rollout, while_training=played))
    train.run(made, "naive", dataset, None, out)
    return out


def begun(*cameras: str) -> Any:
    return sim.make(TASK, seen_by=cameras).reset(np.random.default_rng(0), ())


def test_pictures_come_in_the_order_asked_for() -> None:
    usual, both, other = begun(), begun(*BOTH), begun("topview")
    assert usual.more == () and other.more == () and len(both.more) == 1
    assert np.array_equal(both.more[0], usual.image)
    assert not np.array_equal(both.image, usual.image)
    assert not np.array_equal(other.image, usual.image)


@pytest.mark.parametrize("cameras", [("top",), ("corner2", "corner2")])
def test_cameras_that_a_task_has_not_are_refused(cameras: tuple[str, ...]) -> None:
    with pytest.raises(AegisError, match="as cameras of"):
        sim.make(TASK, seen_by=cameras)
    with pytest.raises(AegisError, match="reach"):
        sim.make("reach", seen_by=("corner2",))


def test_every_camera_is_one_of_the_benchmarks() -> None:
    assert all(begun(camera).image.std() > 5 for camera in sim.cameras(TASK))


def test_a_dataset_has_each_cameras_frames(dataset: Path, tmp_path: Path) -> None:
    found = demonstrations.load(dataset, 0.5, 0, Selection(BOTH))
    assert found.task == TASK and found.cameras == FULL
    record.run(TASK, 2, 0, tmp_path / "usual", form="lerobot", workers=1)
    usual = demonstrations.load(tmp_path / "usual", 0.5, 0)
    assert torch.equal(found.frames[1], usual.frames[0])
    assert torch.equal(found.tensors["actions"], usual.tensors["actions"])
    assert demonstrations.playable_task(dataset, BOTH, TASK) == TASK
    assert demonstrations.playable_task(dataset, "gripperPOV", TASK) == TASK


def test_a_policy_of_two_cameras_is_rolled_out_by_both(
    dataset: Path,
    hf_folder: Callable[[str], Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = trained(hf_folder("smolvlm"), dataset, tmp_path / "run", BOTH)
    seen = []
    act = rollout.Policy.act

    def noting(policy: Any, images: Any, *rest: Any) -> torch.Tensor:
        seen.append(images)
        return act(policy, images, *rest)

    monkeypatch.setattr(rollout.Policy, "act", noting)
    report = rollout.run(run, None, 1, acting.DEFAULT)
    assert report.episodes == 1 and all(len(row) == 2 for images in seen for row in images)
    export.run(run, tmp_path / "exported")
    config = json.loads((tmp_path / "exported" / lerobot_folder.CONFIG).read_text())
    assert {name for name in config["input_features"] if "images" in name} == {*FULL}
    assert rollout.load_run(tmp_path / "exported", None).cameras == BOTH


def test_a_policy_of_two_cameras_acts_by_both_while_it_trains(
    dataset: Path,
    hf_folder: Callable[[str], Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = []
    play = validation_rollout.play

    def noting(*given: Any, **named: Any) -> acting.RolloutReport:
        found.append(play(*given, **named))
        return found[-1]

    monkeypatch.setattr(validation_rollout, "play", noting)
    run = trained(hf_folder("smolvlm"), dataset, tmp_path / "run", BOTH, played=1)
    again = rollout.run(run, None, 1, acting.DEFAULT, stream=VALIDATION)
    assert len(found) == 1 and found[0].outcomes == again.outcomes
    assert found[0].action_change == pytest.approx(again.action_change, rel=1e-4)


def test_another_single_camera_than_the_usual_is_remembered(
    dataset: Path, tiny_folder: Path, tmp_path: Path, aegis: Callable[..., tuple[int, str, str]]
) -> None:
    known = wide(tmp_path)
    one = trained(known, dataset, tmp_path / "one", "gripperPOV")
    usual = trained(known, dataset, tmp_path / "usual", "corner2")
    assert rollout.load_run(one, None).cameras == ("gripperPOV",)
    assert rollout.load_run(usual, None).cameras == ()
    assert checkpoint.load_policy(usual)[1]["cameras"] == ["observation.images.corner2"]


def test_a_camera_that_is_called_otherwise_is_looked_by_all_the_same(
    dataset: Path, tmp_path: Path
) -> None:
    """It is renamed for the training, for LeRobot, or for both."""
    known = wide(tmp_path)
    plain = trained(known, dataset, tmp_path / "plain", "gripperPOV")
    rename = {"gripperPOV": "front"}
    renamed = trained(known, dataset, tmp_path / "renamed", "front", rename=rename)
    assert checkpoint.load_policy(renamed)[1]["cameras"] == ["observation.images.front"]
    assert rollout.load_run(renamed, None).cameras == ("gripperPOV",)
    for number, run in enumerate((plain, renamed)):
        exported, again = (tmp_path / f"{name} {number}" for name in ("exported", "again"))
        export.run(run, exported, camera="eye")
        said = (exported / "README.md").read_text()
        names = '{"observation.images.gripperPOV": "observation.images.eye"}'
        assert f"--env.camera=gripperPOV --rename_map='{names}'\n" in said
        export.run(exported, again, camera="lens")
        for folder, name in ((exported, "eye"), (again, "lens")):
            assert checkpoint.load_policy(folder)[1]["cameras"] == [name]
            assert rollout.load_run(folder, None).cameras == ("gripperPOV",)
    usual = trained(known, dataset, tmp_path / "usual", "corner2")
    export.run(usual, tmp_path / "eye", camera="eye")
    assert f"--env.task={TASK} --env.camera=eye\n" in (tmp_path / "eye" / "README.md").read_text()
    export.run(plain, tmp_path / "own")
    said = (tmp_path / "own" / "README.md").read_text()
    assert f"--env.task={TASK} --env.camera=gripperPOV\n" in said
    assert rollout.load_run(tmp_path / "eye", None).cameras == ()


@pytest.mark.parametrize("camera", ["gripperPOV", "corner2", "eye"])
def test_lerobots_environment_shows_the_camera_that_was_asked_for(camera: str) -> None:
    """If another name is requested, the usual camera's picture gets that name."""
    path = ROOT / "plugins/lerobot_env_aegis/src/lerobot_env_aegis/task_env.py"
    found = importlib.util.spec_from_file_location("task_env", path)
    assert found is not None and found.loader is not None
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    seen, _ = module.AegisTask(TASK, acting.DEFAULT, camera).reset(seed=0)
    own = sim.make(TASK, seen_by=(camera,) if camera in BOTH else ())
    wanted = own.reset(episode_rng(acting.EVALUATION_SEED, EVALUATION, 0), SEEN)
    assert np.array_equal(seen["pixels"][camera], wanted.image)


def wide(folder: Path) -> Path:
    """A backbone that knows the words of the task's instructions."""
    from samples.tiny import make_tiny

    from aegis_cli.data.vqa.words import wide_vocabulary

    made = folder / "wide"
    make_tiny(words=wide_vocabulary()).save(made)
    return made


def test_a_file_has_one_camera(aegis: Callable[..., tuple[int, str, str]], tmp_path: Path) -> None:
    given = ("demos", TASK, "--episodes", "1", "--camera", "gripperPOV")
    said = refused(aegis(*given, "--out", tmp_path / "x.safetensors"))
    assert "--format lerobot" in said
