"""MetaWorld's tasks: the benchmark's names, steps, goals and successes, and learning."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from samples.metaworld import MISSING
from samples.small_run import recipe
from samples.tiny import make_tiny

if MISSING:
    pytest.skip(MISSING, allow_module_level=True)

from aegis_cli import inspection, sim
from aegis_cli.common import artifacts, processes
from aegis_cli.data import demonstrations, keeping, record
from aegis_cli.data.vqa.words import wide_vocabulary
from aegis_cli.recipes import Demos, to_yaml
from aegis_cli.sim import metaworld_table as table
from aegis_cli.sim import recording
from aegis_cli.sim.contract import EVALUATION, Step, TaskEnv, episode_rng

import mujoco  # isort: skip  (after ours, which choose the OpenGL backend)
from metaworld import env_dict  # isort: skip

SET = "metaworld/mt4"


def start(name: str, i: int = 0) -> TaskEnv:
    env = sim.make(name, number=i)
    env.reset(episode_rng(0, EVALUATION, i), ())
    return env


def finish(env: TaskEnv) -> tuple[Step, int]:
    """The expert's last step, and the number of steps; nothing is rendered."""
    count = 0
    while True:
        step = env.step(env.expert_action(), look=False)
        count += 1
        if step.done:
            return step, count


# --- the benchmark's own --------------------------------------------------------------------------


def test_names_and_sets_are_the_benchmarks() -> None:
    def ours(names: dict) -> tuple[str, ...]:
        return tuple(name.removesuffix("-v3") for name in names)

    assert tuple(table.SENTENCES) == ours(env_dict.ALL_V3_ENVIRONMENTS)
    assert table.SETS["mt10"] == ours(env_dict.MT10_V3)
    assert table.SETS["mt50"] == ours(env_dict.MT50_V3)


@pytest.mark.skipif(mujoco.mjNEQDATA > 11, reason="MetaWorld alone fails on this MuJoCo")
@pytest.mark.parametrize("task", ["button-press", "drawer-open"])
def test_steps_are_the_benchmarks(task: str) -> None:
    """Equal goals and actions give the observations and the success of the benchmark's own."""
    ours = start(f"metaworld/{task}", 3)
    theirs = env_dict.ENV_CLS_MAP[f"{task}-v3"]()
    theirs._set_task_called, theirs._last_rand_vec = True, ours._env._last_rand_vec
    theirs.reset()
    for _ in range(120):
        action = ours.expert_action()
        step = ours.step(action)
        observation, _, _, _, info = theirs.step(action)
        np.testing.assert_allclose(step.observation.proprio, observation[:4], atol=1e-4)
        assert step.success == bool(info["success"])
        if step.done:
            break
    assert step.success


def test_goals_follow_from_the_episode_alone() -> None:
    env = sim.make("metaworld/button-press")
    goals = []
    for i in (0, 1, 0):
        np.random.seed(i + len(goals))  # the benchmark draws from it by default
        env.reset(episode_rng(0, EVALUATION, i), ())
        goals.append(env._env._last_rand_vec.copy())
    np.testing.assert_array_equal(goals[0], goals[2])
    assert not np.allclose(goals[0], goals[1])


def test_the_first_observation_shows_this_episodes_objects() -> None:
    """The benchmark itself reports their earlier positions."""
    places, told = [], []
    for i in range(2):
        env = start("metaworld/drawer-open", i)
        places.append(env._env.model.body("drawer").pos.copy())
        told.append(env._state[4:7])
    np.testing.assert_allclose(places[0] - places[1], told[0] - told[1], atol=1e-6)
    assert np.abs(places[0] - places[1]).max() > 0.005


def test_the_hand_is_welded_as_the_benchmark_says() -> None:
    """This holds however many numbers MuJoCo has for it."""
    model = sim.make("metaworld/reach")._env.model
    row = model.eq_data[model.eq_type == mujoco.mjtEq.mjEQ_WELD][0]
    assert row[:11].tolist() == [0, 0, 0, 0, 0, 0, -1, 0, 0, 0, 5] and not row[11:].any()


def test_an_episode_ends_at_the_limit() -> None:
    env = start("metaworld/door-open")
    count, step = 0, None
    while step is None or not step.done:
        step = env.step(np.zeros(4), look=False)
        count += 1
    assert count == env.spec.max_steps <= 500 and not step.success


def test_the_picture_is_upright_and_shows_the_hand() -> None:
    env, rows = start("metaworld/button-press"), []
    for dz in (1.0, -1.0):
        for _ in range(20):
            step = env.step(np.array([0.0, 0.0, dz, 0.0]))
        up = env._env.data.camera(table.CAMERA).xmat.reshape(3, 3)[:, 1]
        assert up[2] < 0  # so the picture is rotated
        rows.append(step.observation)
    assert rows[0].proprio[2] > rows[1].proprio[2]
    assert np.abs(rows[0].image.astype(int) - rows[1].image).max() > 50


# --- experts --------------------------------------------------------------------------------------


@pytest.mark.parametrize("turn", range(4))
def test_the_experts_of_mt4_succeed(turn: int) -> None:
    for i in range(3):
        step, count = finish(start(SET, turn + 4 * i))
        assert step.success and 10 < count < 150


def test_random_actions_do_not_succeed() -> None:
    rng = np.random.default_rng(0)
    for turn in range(4):
        env = start(SET, turn)
        steps = (env.step(rng.uniform(-1, 1, 4), look=False) for _ in range(60))
        assert not any(step.success for step in steps)


# --- demonstrations -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, record.DemosReport]:
    """Demonstrations of the set, by one process; read-only."""
    path = tmp_path_factory.mktemp("set") / "demos.safetensors"
    return path, record.run(SET, 5, 0, path, workers=1)


@pytest.mark.usefixtures("quick_workers")
def test_demonstrations_of_a_set_are_the_same_by_any_number_of_processes(
    recorded: tuple[Path, record.DemosReport], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With this few episodes, each process takes one at a time, so fewer are started in vain."""
    path, report = recorded
    monkeypatch.setattr(keeping, "mapped", lambda *given, chunk: processes.mapped(*given, chunk=1))
    assert record.run(SET, 5, 0, tmp_path / "two", workers=2).sha256 == report.sha256
    artifact = artifacts.load(path, "demos")
    tensors, meta = artifact.tensors, artifact.header.meta
    assert meta["task"] == SET and meta["tasks"] == list(sim.members(SET))
    assert sorted(tensors["task"].tolist()) == [0, 0, 1, 2, 3]
    assert "target_color" not in tensors and "colors" not in meta
    for task, instruction in zip(tensors["task"], tensors["instruction"], strict=True):
        said = table.sentences(meta["tasks"][task])
        assert meta["instructions"][instruction] in said
    assert [count.episodes for count in report.tasks.values()] == [2, 1, 1, 1]
    assert tensors["proprio"].shape[1] == 4 and tensors["actions"].abs().max() <= 1


def test_a_lerobot_dataset_knows_its_set(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    record.run(SET, 4, 0, tmp_path / "set", workers=1, form="lerobot")
    found = demonstrations.load(tmp_path / "set", 0.5, 0)
    assert found.task == SET and len(found.instructions) == 4
    assert inspection.run(tmp_path / "set").facts["cameras"] == ["observation.images.corner2"]


# --- learning from them ---------------------------------------------------------------------------


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with a recipe for the set and a VLM that has its words."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "wide"
    folder.mkdir()
    make_tiny(words=wide_vocabulary()).save(folder)
    settings = recipe(folder, methods=("naive",))
    settings = dataclasses.replace(settings, task=SET, demos=Demos(episodes=4))
    (tmp_path / "small.yaml").write_text(to_yaml(settings))
    return tmp_path


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Episodes of a policy have at most 12 steps."""
    monkeypatch.setattr(table, "_TASK", dataclasses.replace(table._TASK, max_steps=12))
    recording._env.cache_clear()


def test_from_demonstrations_to_a_rollout_by_task(aegis, place: Path, request) -> None:
    code, out, _ = aegis("demos", SET, "--episodes", 4, "--out", "d.safetensors")
    assert code == 0 and "metaworld/button-press" in out and "Failed" in out
    command = ("train", "small.yaml", "--demos", "d.safetensors", "--out", "run")
    assert aegis(*command)[0] == 0
    request.getfixturevalue("short")
    played = aegis("rollout", "run", "--episodes", 6, "--video", "v.gif", "--json")
    report = json.loads(played[1])
    assert played[0] == 0 and report["task"] == SET and (place / "v.gif").exists()
    tasks = report["tasks"]
    assert list(tasks) == list(sim.members(SET))
    assert [tasks[name]["episodes"] for name in tasks] == [2, 2, 1, 1]
    total = sum(found["success"] * found["episodes"] for found in tasks.values())
    assert report["success"] == pytest.approx(total / 6)
    absent = ("colors", "wrong_target", "final_distance_m", "mean_return")
    assert {report[key] for key in absent} == {None}
    code, out, _ = aegis("rollout", "run", "--episodes", 1)
    assert code == 0 and "metaworld/button-press" in out and "Success %" in out


def test_a_recipe_from_demonstrations_to_its_table(
    aegis, recorded: tuple[Path, record.DemosReport], place: Path, short: None
) -> None:
    path, _ = recorded
    code, out, _ = aegis("run", "small.yaml", "--set", f"demos.path={path}", "--out", "runs")
    assert code == 0 and "Success seen %" in out
    row = json.loads((place / "runs/small/table.json").read_text())["rows"][0]
    played = json.loads((place / "runs/small/naive/rollout-seen.json").read_text())
    assert row["success_seen"] == played["success"] and row["success_held_out"] is None
    assert set(played["tasks"]) == set(list(sim.members(SET))[:2])
