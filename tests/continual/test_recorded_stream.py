"""Streams of robot tasks without a simulator: the action error on held-out episodes."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from samples.interrupted import at_each, stop
from samples.lerobot import frame_cache, save  # noqa: F401
from samples.own_robots import FRAMES, JOINTS, TASKS, TEXTS, Done, robot
from samples.robots import Make
from samples.training_runs import contents

from aegis_cli import recipes
from aegis_cli.common.errors import AegisError, Diverged
from aegis_cli.common.events import Warned
from aegis_cli.continual import files, probe, robot_demos, robots, state, train
from aegis_cli.continual.held_out import HeldOut
from aegis_cli.data import demonstrations, spread
from aegis_cli.data.lerobot.write import NewEpisode
from aegis_cli.deploy import load_acting, load_policy
from aegis_cli.evaluation import open_loop
from aegis_cli.models.action_errors import predict
from aegis_cli.recipes import RobotDemos, to_yaml
from aegis_cli.serving.observations import Reader

pytestmark = pytest.mark.usefixtures("frame_cache")

# --- what is measured -----------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["igsp", "isolated-lora", "sequential"])
def test_errors_are_those_of_an_evaluation_of_held_out_frames(
    method: str, done: Done, real: Make
) -> None:
    report, out = done(method)
    run = robots.load_to_act(out)
    for number, task in enumerate(TASKS):
        shown = robot_demos.load(real(method), number, run.model.backbone, out, lambda event: None)
        # Frames that no step has learned from, evenly spread.
        assert len(shown.validation) > FRAMES
        at = shown.validation[spread.rows(len(shown.validation), FRAMES)]
        assert not set(at.tolist()) & set(shown.train.tolist())
        run.activate(number)
        predicted = predict(run.policies[number].eval(), shown, at, 0, 4, "x")
        found = open_loop.compare(shown, at, predicted, np.array(shown.action_std))
        assert report.errors[-1][number] == pytest.approx(found.relative_error, rel=1e-6), task
        assert report.error_intervals[-1][number] == pytest.approx(found.relative_interval)
        assert report.hold_errors[number] == pytest.approx(found.hold_error, rel=1e-12), task


def test_a_joint_whose_scale_a_glitch_makes_is_warned_of(
    done: Done, real: Make, tmp_path: Path
) -> None:
    _, out = done("igsp")
    backbone = robots.load_to_act(out).model.backbone
    rng = np.random.default_rng(0)
    made = []
    for glitch in (0.0, 1e4, 0.0):
        path = rng.normal(size=(101, JOINTS[TASKS[0]])).astype(np.float32)
        path[50, 0] += glitch
        shown = np.zeros((100, 16, 16, 3), dtype=np.uint8)
        made.append(NewEpisode({"top": shown}, path[:-1], path[1:], TEXTS[TASKS[0]]))
    names = tuple(f"joint {n}.pos" for n in range(JOINTS[TASKS[0]]))
    folder = save(tmp_path / "robot", made, state_names=names, action_names=names)
    recipe = real(demos=RobotDemos(paths=(str(folder), str(folder)), only=("0-2", "0-2")))
    told: list[Any] = []
    robot_demos.load(recipe, 0, backbone, out, told.append)
    warned = [event.text for event in told if isinstance(event, Warned)]
    assert any("make most of the spread" in text and "in episode 1;" in text for text in warned)


def test_an_unfinished_stream_shows_how_far_it_is(
    aegis: Callable[..., tuple[int, str, str]], real: Make, done: Done, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    begin = partial(train.run, real("sequential"), run)
    for place in at_each(((f"task 1 {TASKS[0]}", 2), ("stream", 1)), begin):
        code, out, _ = aegis("inspect", run, "--json")
        told = json.loads(out)
        assert code == 0 and told["kind"] == "unfinished-stream" and told["tasks"] == list(TASKS)
        code, shown, _ = aegis("inspect", run)
        assert f"continue it: aegis train {run}" in shown
        if place[0] == "stream":
            assert told["matrix"]["errors"] == [list(done("sequential")[0].errors[0])]
            assert "1 of 2 tasks are learned, and 'open-drawer' has taken 0 of" in shown
            assert "Open-loop error" in shown
        else:
            assert (told["learned"], told["step"], told["matrix"]) == (0, 2, None)
    code, _, err = aegis("inspect", run, "--plot", tmp_path / "x.png")
    assert code == 2 and "an unfinished stream" in err
    (run / "error_matrix.json").write_text("{}")
    code, _, err = aegis("inspect", run)
    assert code == 2 and "is damaged" in err


def test_streams_are_compared_in_one_table(
    aegis: Callable[..., tuple[int, str, str]], done: Done, real: Make, tmp_path: Path
) -> None:
    (igsp, one), (sequential, other) = done("igsp"), done("sequential")
    code, out, err = aegis("compare", one, other, "--json")
    told = json.loads(out)
    assert code == 0 and told["score"] == "errors" and told["differs"] == [] and not err
    for row, report in zip(told["rows"], (igsp, sequential), strict=True):
        figures = report.scores.average, report.scores.last, report.scores.forgetting
        assert (row["average"], row["last"], row["forgetting"]) == figures
        assert row["drop_points"] == report.vqa[-1].drop_points
        assert (row["method"], row["parameters"]) == (report.method, report.parameters)
    code, out, _ = aegis("compare", one, other)
    assert code == 0 and "Open-loop errors on pick, open-drawer" in out and "Transfer" not in out
    refused = aegis("compare", one, other, "--against", one)
    assert refused[0] == 2 and "leave out --against" in refused[2]
    train.run(dataclasses.replace(real("sequential", steps=1), tasks=TASKS), tmp_path / "run")
    shorter = json.loads((tmp_path / "run" / "stream.json").read_text())
    shorter["tasks"] = ["pick", "wipe"]
    (tmp_path / "run" / "stream.json").write_text(json.dumps(shorter))
    refused = aegis("compare", one, tmp_path / "run")
    assert refused[0] == 2 and "the tasks pick, wipe in" in refused[2]


def test_a_stream_says_what_is_said_of_a_policy(real: Make, tmp_path: Path) -> None:
    told: list[Any] = []
    train.run(real("sequential", steps=1), tmp_path / "run", on_event=told.append)
    warned = [event.text for event in told if isinstance(event, Warned)]
    assert sum("it can hardly lose what it does not know" in text for text in warned) == 1
    assert sum("no better than standing still" in text for text in warned) == 2  # one per task


@pytest.mark.parametrize(("method", "keeps"), [("igsp", True), ("sequential", False)])
def test_what_serves_a_learned_task_has_the_error_that_it_had(
    method: str, keeps: bool, done: Done
) -> None:
    report, _ = done(method)
    assert [len(row) for row in report.errors] == [1, 2]
    assert (report.errors[0][0] == report.errors[1][0]) == keeps
    assert (report.scores.forgetting == 0) == keeps
    rise = report.errors[1][0] - min(report.errors[0][0], report.errors[1][0])
    assert report.scores.forgetting == pytest.approx(rise)
    assert report.scores.last == pytest.approx(sum(report.errors[1]) / 2)
    assert report.scores.average == pytest.approx(sum(sum(report.errors, ())) / 3)


@pytest.mark.parametrize("method", ["igsp", "sequential"])
def test_nothing_is_called_a_success(method: str, done: Done) -> None:
    report, out = done(method)
    matrix = json.loads((out / "error_matrix.json").read_text())
    assert matrix.keys() == {
        *("tasks", "method", "errors", "error_intervals", "hold_errors", "scores", "vqa")
    }
    assert not (out / "success_matrix.json").exists()
    told = json.loads((out / "stream.json").read_text())
    assert "success" not in (out / "stream.json").read_text()
    assert {key: told[key] for key in matrix} == matrix
    assert files.read(out) == report


@pytest.mark.parametrize("method", ["igsp", "sequential"])
def test_a_probe_of_the_files_gives_the_same_errors(method: str, done: Done) -> None:
    report, out = done(method)
    before = contents(out)
    (out / "error_matrix.json").unlink()
    found = probe.run(out)
    assert found.largest_difference == 0 and found.measured == (2 if method == "igsp" else 1)
    assert found.to_json()["errors"] == report.errors
    assert found.to_json()["error_intervals"] == report.error_intervals
    assert contents(out) == before


def test_where_actions_are_no_positions_there_is_no_error_of_holding_one(
    real: Make, tmp_path: Path
) -> None:
    moves = robot(tmp_path / "moves", "pick", actions=("dx", "dy", "dz"))
    drawer = robot(tmp_path / "drawer", "open-drawer")
    recipe = real("sequential", steps=1, demos=RobotDemos(paths=(str(moves), str(drawer))))
    report = train.run(recipe, tmp_path / "run")
    assert report.hold_errors[0] is None and report.hold_errors[1] > 0


def test_an_error_that_is_no_number_ends_the_stream(
    real: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(HeldOut, "error", lambda *given: (float("inf"), None))
    with pytest.raises(Diverged, match="after task 'pick'"):
        train.run(real("sequential", steps=1), tmp_path / "run")


def test_the_error_of_a_single_episode_has_no_interval(real: Make, tmp_path: Path) -> None:
    recipe = real("sequential", steps=1, validation_share=0.05)
    report = train.run(recipe, tmp_path / "run")
    assert report.error_intervals == ((None,), (None, None))
    assert probe.run(tmp_path / "run").error_intervals == report.error_intervals


def test_two_tasks_take_their_episodes_of_one_dataset(
    real: Make, paths: dict[str, Path], tmp_path: Path
) -> None:
    one = RobotDemos(paths=str(paths["pick"]), only=("0-2", "3-5"))
    built = train.build(real("sequential", demos=one), tmp_path / "run")
    of_each = [set(shown.episode_of[shown.read].tolist()) for shown in built.demos]
    assert of_each == [{0, 1, 2}, {3, 4, 5}]


# --- interrupted ----------------------------------------------------------------------------------


ONE, TWO = "task 1 pick", "task 2 open-drawer"
PLACES = {
    "igsp": ((ONE, 1), (ONE, 5), ("actions pick", FRAMES), ("stream", 1), (TWO, 5), ("stream", 2)),
    "sequential": ((ONE, 5), ("stream", 1), (TWO, 3), ("actions open-drawer", FRAMES)),
}


@pytest.mark.parametrize("method", PLACES)
def test_interrupted_anywhere_and_resumed_it_ends_in_the_same_bytes(
    method: str, real: Make, done: Done, tmp_path: Path
) -> None:
    begin = partial(train.run, real(method), tmp_path / "run")
    for place in at_each(PLACES[method], begin):
        if place == ("stream", 1):  # the results so far already exist
            so_far = json.loads((tmp_path / "run" / "error_matrix.json").read_text())
            whole = done(method)[0]
            assert so_far["errors"] == [list(whole.errors[0])]
            assert so_far["hold_errors"] == [whole.hold_errors[0]]
    report = begin(resume=True)
    wanted, out = done(method)
    assert contents(tmp_path / "run") == contents(out)
    alike = [dataclasses.replace(each, minutes=0, out="") for each in (report, wanted)]
    assert alike[0] == alike[1] and not (tmp_path / "run" / state.STATE).exists()
    assert begin(resume=True).errors == report.errors


def test_other_demonstrations_neither_continue_nor_probe_a_run(real: Make, tmp_path: Path) -> None:
    own = [robot(tmp_path / task, task) for task in TASKS]
    recipe = real("sequential", steps=2, demos=RobotDemos(paths=tuple(map(str, own))))
    with pytest.raises(KeyboardInterrupt):
        train.run(recipe, tmp_path / "cut", on_event=partial(stop, TWO, 1))
    train.run(recipe, tmp_path / "run")
    shutil.rmtree(own[1])
    robot(own[1], "open-drawer", scale=2.0)
    with pytest.raises(AegisError, match="a different demos of open-drawer"):
        train.run(recipe, tmp_path / "cut", resume=True)
    with pytest.raises(AegisError, match="different demos of open-drawer than the run"):
        probe.run(tmp_path / "run")
    shutil.rmtree(own[1])
    with pytest.raises(AegisError, match="open-drawer"):
        probe.run(tmp_path / "run")


# --- the robot acts -------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["igsp", "sequential"])
def test_the_policy_of_a_task_acts_on_the_robot(
    method: str, done: Done, paths: dict[str, Path]
) -> None:
    out = done(method)[1]
    run = robots.load_to_act(out)
    for number, task in enumerate(TASKS):
        policy = load_policy(out, task)
        names = tuple(f"joint {n}.pos" for n in range(JOINTS[task]))
        assert (policy.action_names, policy.state_names, policy.fps) == (names, names, 10.0)
        assert (policy.task, policy.replan, policy.chunk) == (None, 2, 4)
        shown = demonstrations.load(paths[task], None, 0, image_size=run.model.backbone.image_size)
        batch = shown.batch(torch.tensor([3]), 1)
        picture, position = batch.images[0].numpy(), batch.proprio[0].numpy()
        observation = dict(zip(names, position.tolist(), strict=True)) | {"top": picture}
        assert Reader(policy).greeting()["task"] == task
        action = policy.select_action(observation, TEXTS[task])
        run.activate(number)
        draws = torch.Generator().manual_seed(0)
        chunk = run.policies[number].eval()
        wanted = chunk.act(batch.images, [TEXTS[task]], batch.proprio, draws)[0, 0]
        np.testing.assert_allclose(action, wanted.numpy(), rtol=1e-5)
        assert list(policy.named(action)) == list(names)


def test_no_simulator_plays_it(done: Done) -> None:
    out = done("igsp")[1]
    with pytest.raises(AegisError, match="(?s)'pick'.*no simulator has.*aegis serve") as caught:
        load_acting(out, "pick")
    assert "--task pick" in caught.value.fix
    with pytest.raises(AegisError, match="no --task") as unnamed:
        load_policy(out)
    assert "task='pick'" in unnamed.value.fix
    with pytest.raises(AegisError, match="one of its tasks: pick, open-drawer"):
        load_acting(out, "reach")


def test_policies_of_several_cameras_say_which(
    real: Make, hf_folder: Callable[[str], Path], tmp_path: Path
) -> None:
    own = [robot(tmp_path / task, task, ("wrist", "top", "side")) for task in TASKS]
    demos = RobotDemos(paths=tuple(map(str, own)), camera=("top", "wrist"))
    backbone = str(hf_folder("paligemma"))
    recipe = real("sequential", steps=1, backbone=backbone, demos=demos)
    report = train.run(recipe, tmp_path / "run")
    assert probe.run(tmp_path / "run").errors[-1] == report.errors[-1]
    cameras = load_policy(tmp_path / "run", "pick").cameras
    assert cameras == ("observation.images.top", "observation.images.wrist")


# --- the command line -----------------------------------------------------------------------------


@pytest.fixture
def place(real: Make, paths: dict[str, Path], tmp_path: Path, monkeypatch: Any) -> Path:
    (tmp_path / "robot.yaml").write_text(to_yaml(real("igsp", steps=2)))
    robot(tmp_path / "still", "pick", scale=0.0)
    robot(tmp_path / "single", "open-drawer", count=1)
    shutil.copytree(paths["pick"], tmp_path / "picked")
    monkeypatch.chdir(tmp_path)
    return tmp_path


TRAIN = ("train", "robot.yaml", "--out", "run")


def test_train_inspect_probe_and_report(
    aegis: Callable[..., tuple[int, str, str]], place: Path, bad: Callable[..., str]
) -> None:
    code, out, _ = aegis(*TRAIN)
    assert code == 0 and "Success" not in out
    for word in ("Open-loop error", "after pick", "holding the position", "rise of the error"):
        assert word in out
    code, out, _ = aegis("inspect", "run")
    assert code == 0 and "Open-loop error" in out and "holding the position" in out
    code, out, _ = aegis("inspect", "run", "--json")
    told = json.loads(out)
    assert code == 0 and told["kind"] == "robot-stream-run" and "success" not in told["report"]
    code, out, _ = aegis("probe", "run", "--json")
    assert code == 0 and json.loads(out)["errors"] == told["report"]["errors"]
    code, out, _ = aegis("report", "run")
    page = (place / "run" / "report.html").read_text()
    assert code == 0 and "The open-loop error in each task" in page
    assert f"{told['report']['errors'][0][0]:.3f}" in page and "What was reached" not in page
    bad("rollout", "run", "--task", "pick", says=("'pick'", "no simulator has", "aegis serve run"))


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (
            ("--set", "tasks=[reech, point]", "--set", "demos.paths=null"),
            ("'reech'", "one of reach, point", "did you mean 'reach'?", "demos.paths"),
        ),
        (
            ("--set", "tasks=[reech, point]"),
            ("'reech', which is not simulated, beside 'point'", "one of reach, point", "'reach'?"),
        ),
        (("--set", "tasks=[a/b, c]"), ("tasks", "one of reach, point", "names of your own")),
        (("--set", "tasks=[reach, point]"), ("rollout.frames: 9 with task reach", "delete")),
        (
            ("--set", "rollout.episodes=3"),
            (
                "rollout.episodes: 3 with task pick",
                "no simulator has this task",
                "delete rollout.episodes",
            ),
        ),
        (("--set", "rollout.split=validation"), ("rollout.split", "no simulator has this task")),
        (
            ("--set", "demos.paths=picked"),
            ("'picked' for 'pick' and other tasks", "demos.only, such as [0-49, 50-99]"),
        ),
        (
            ("--set", "demos.paths=[still, picked]"),
            ("'pick' whose actions never vary", "demos.action"),
        ),
        (
            ("--set", "tasks=[reach, point]", "--set", "rollout.frames=1000"),
            ("no simulated task", "for the task 'reach'", "a name of your own"),
        ),
        (("--set", "demos.paths=[picked, single]"), ("1 episode",)),
    ],
)
def test_what_cannot_be_trained(
    place: Path, bad: Callable[..., str], args: tuple[str, ...], says: tuple[str, ...]
) -> None:
    bad(*TRAIN, *args, says=says)


def test_only_simulated_tasks_are_said_to_be_recorded(
    place: Path, aegis: Callable[..., tuple[int, str, str]]
) -> None:
    for tasks, says in (("[a, b]", False), ("[reach, point]", True)):
        more = ("--set", f"tasks={tasks}", "--set", "demos.paths=[picked]")
        code, _, err = aegis(*TRAIN, *more)
        assert code == 2 and "demos.paths: 1 with 2 tasks" in err
        assert ("have them recorded" in err) == says


def test_demonstrations_of_a_simulated_task_are_told_by_what_they_say(
    place: Path, bad: Callable[..., str], demos_file: Path
) -> None:
    """They are refused before anything is decoded."""
    given = f"demos.paths=[{demos_file}, picked]"
    says = ("demonstrations of 'reach'", "for the task 'reech'", "call the task 'reach'")
    bad(*TRAIN, "--set", "tasks=[reech, pick]", "--set", given, says=says)


def test_what_a_later_dataset_lacks_is_found_before_the_first_is_decoded(
    real: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = [robot(tmp_path / task, task, (task,)) for task in TASKS]
    monkeypatch.setattr(demonstrations, "load", lambda *given, **options: pytest.fail("decoded"))
    demos = RobotDemos(paths=tuple(map(str, own)), camera="pick")
    with pytest.raises(AegisError, match="open-drawer"):
        train.build(real(demos=demos), tmp_path / "run")


def test_a_recipe_says_whether_its_tasks_are_simulated(real: Make, make: Make) -> None:
    assert make().simulated and not real().simulated
    assert recipes.training_part(make())["rollout"].keys() == {
        *("episodes", "colors", "replan", "split")
    }


# --- tasks with the same episodes -----------------------------------------------------------------


@pytest.mark.parametrize("only", [("0-2", "0-2"), ("0-2", "2,1,0"), None])
def test_two_tasks_with_the_same_episodes_are_refused_before_anything_is_decoded(
    only: tuple[str, ...] | None,
    real: Make,
    paths: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """This holds even if the dataset is named in two ways."""
    (tmp_path / "link").symlink_to(paths["pick"])
    monkeypatch.setattr(demonstrations, "load", lambda *given, **options: pytest.fail("decoded"))
    demos = RobotDemos(paths=(str(paths["pick"]), str(tmp_path / "link")), only=only)
    says = "the same [36] episodes of .* for 'pick' and 'open-drawer'"
    with pytest.raises(AegisError, match=says):
        train.build(real("sequential", demos=demos), tmp_path / "run")


def test_tasks_that_share_some_episodes_are_warned_of(
    real: Make, paths: dict[str, Path], tmp_path: Path
) -> None:
    demos = RobotDemos(paths=str(paths["pick"]), only=("0-3", "2-5"))
    told: list[Any] = []
    train.build(real("sequential", demos=demos), tmp_path / "run", told.append)
    warned = [event.text for event in told if isinstance(event, Warned)]
    assert any("2 episodes of" in text and "'pick' and 'open-drawer'" in text for text in warned)
    apart = RobotDemos(paths=str(paths["pick"]), only=("0-2", "3-5"))
    told.clear()
    train.build(real("sequential", demos=apart), tmp_path / "run", told.append)
    assert not [e for e in told if isinstance(e, Warned) and "episodes of" in e.text]
