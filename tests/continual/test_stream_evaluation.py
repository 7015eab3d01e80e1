"""`aegis evaluate --task`: the open-loop error of one of the policies that a stream has learned."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from samples.lerobot import frame_cache  # noqa: F401
from samples.own_robots import FRAMES, JOINTS, TASKS, Done, robot
from samples.robots import Make
from samples.training_runs import contents

from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Warned
from aegis_cli.continual import evaluate, robots, train
from aegis_cli.data import demonstrations
from aegis_cli.recipes import RobotDemos

pytestmark = pytest.mark.usefixtures("frame_cache")


def warnings_of(*given: Any, **options: Any) -> list[str]:
    seen: list[Event] = []
    evaluate.run(*given, on_event=seen.append, **options)
    return [event.text for event in seen if isinstance(event, Warned)]


# --- on the task's own episodes -------------------------------------------------------------------


@pytest.mark.parametrize("method", ["igsp", "isolated-lora", "sequential"])
def test_the_error_is_the_one_that_the_training_measured(method: str, done: Done) -> None:
    """It is for the task's own policy, at the same frames, whichever task was evaluated before."""
    measured, out = done(method)
    before = contents(out)
    for number, task in reversed(list(enumerate(TASKS))):
        found = evaluate.run(out, task, frames=FRAMES)
        assert found.relative_error == pytest.approx(measured.errors[-1][number], rel=1e-5)
        ends = measured.error_intervals[-1][number]
        assert found.relative_interval == pytest.approx(ends, rel=1e-4)
        assert found.hold_error == pytest.approx(measured.hold_errors[number])
        assert (found.task, found.split, found.trained_on) == (task, "validation", [])
        names = [f"joint {n}.pos" for n in range(JOINTS[task])]
        assert [each.name for each in found.dimensions] == names
        assert [step.step for step in found.horizon] == [1, 2, 3, 4] and found.fps == 10
    assert contents(out) == before  # the matrix has the figure already


def test_the_error_is_relative_to_the_actions_own_spread_under_quantiles_too(
    real: Make, tmp_path: Path
) -> None:
    recipe = real("isolated-lora", steps=1, normalization="quantiles")
    measured = train.run(recipe, tmp_path / "run")
    assert not [text for text in warnings_of(tmp_path / "run", "pick") if "earlier" in text]
    found = evaluate.run(tmp_path / "run", "pick", frames=FRAMES)
    assert found.relative_error == pytest.approx(measured.errors[-1][0], rel=1e-5)


def test_each_task_has_its_own_part_of_one_dataset(
    real: Make, paths: dict[str, Path], tmp_path: Path
) -> None:
    one = RobotDemos(paths=str(paths["pick"]), only=("0-2", "3-5"))
    train.run(real("sequential", steps=1, demos=one), tmp_path / "run")
    shown = evaluate.run(tmp_path / "run", "pick"), evaluate.run(tmp_path / "run", "open-drawer")
    own = [set(each.episodes) for each in shown]
    assert own[0] <= {0, 1, 2} and own[1] <= {3, 4, 5} and all(own)
    mixed = evaluate.run(tmp_path / "run", "open-drawer", episodes=range(6))
    assert mixed.split == "chosen" and set(mixed.trained_on) == {3, 4, 5} - own[1]
    # All weights continue to learn, so each task has also learned from the other's episodes.
    for task, other in (TASKS, TASKS[::-1]):
        told = warnings_of(tmp_path / "run", task, episodes=range(6))
        assert [text for text in told if f"trained on as '{other}' of the same stream" in text]


def test_what_is_frozen_owes_nothing_to_later_tasks(
    real: Make, paths: dict[str, Path], tmp_path: Path
) -> None:
    one = RobotDemos(paths=str(paths["pick"]), only=("0-2", "3-5"))
    train.run(real("isolated-lora", steps=1, demos=one), tmp_path / "run")
    said = "of the same stream"
    assert said not in "".join(warnings_of(tmp_path / "run", "pick", episodes=range(6)))
    assert said in "".join(warnings_of(tmp_path / "run", "open-drawer", episodes=range(6)))


def test_a_simulated_task_is_evaluated_too(make: Make, demos_file: Path, tmp_path: Path) -> None:
    train.run(make("igsp", steps=2), tmp_path / "run")
    found = evaluate.run(tmp_path / "run", "reach", frames=20)
    assert found.split == "validation" and found.data == str(demos_file)
    assert found.dimensions[0].unit == "share of a full action"


def test_demonstrations_that_the_run_recorded_are_found(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = make("sequential", steps=1, demos=RobotDemos(episodes=3))
    train.run(recipe, tmp_path / "run")
    found = evaluate.run(tmp_path / "run", "point", frames=5)
    assert found.split == "validation" and Path(found.data).parent == tmp_path / "demos"
    shutil.rmtree(tmp_path / "demos")
    with pytest.raises(AegisError, match=r"is gone, the demonstrations of 'point'"):
        evaluate.run(tmp_path / "run", "point")


# --- on others ------------------------------------------------------------------------------------


def test_other_demonstrations_are_all_taken(done: Done, tmp_path: Path) -> None:
    _, out = done("igsp")
    found = evaluate.run(out, "pick", robot(tmp_path / "new", "pick", count=3))
    assert (found.split, found.episodes) == ("other data", [0, 1, 2])


def test_another_tasks_robot_is_refused_before_anything_is_decoded(
    done: Done, paths: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, out = done("igsp")
    monkeypatch.setattr(demonstrations, "load", lambda *given, **options: pytest.fail("decoded"))
    with pytest.raises(AegisError, match="2 positions and 2 actions"):
        evaluate.run(out, "pick", paths["open-drawer"])


def test_demonstrations_that_have_grown_are_not_guessed_at(real: Make, tmp_path: Path) -> None:
    own = [robot(tmp_path / task, task) for task in TASKS]
    demos = RobotDemos(paths=tuple(map(str, own)))
    train.run(real("sequential", steps=1, demos=demos), tmp_path / "run")
    shutil.rmtree(own[0])
    robot(own[0], "pick", count=8)
    with pytest.raises(AegisError, match="is not as it was") as caught:
        evaluate.run(tmp_path / "run", "pick")
    assert "--task pick --demos" in caught.value.fix
    shutil.move(own[0], tmp_path / "elsewhere")
    with pytest.raises(AegisError, match=r"is gone, the demonstrations of 'pick'") as caught:
        evaluate.run(tmp_path / "run", "pick")
    assert "--task pick --demos PATH" in caught.value.fix


# --- the command line -----------------------------------------------------------------------------


def test_the_command_has_tables_a_plot_and_json(
    aegis: Callable[..., tuple[int, str, str]], done: Done, tmp_path: Path
) -> None:
    _, out = done("igsp")
    plot = tmp_path / "actions.png"
    code, said, _ = aegis("evaluate", out, "--task", "open-drawer", "--plot", plot)
    assert code == 0 and "open-drawer" in said and "joint 1.pos" in said and "Steps ahead" in said
    assert plot.stat().st_size > 10_000
    code, said, _ = aegis("evaluate", out, "--task", "open-drawer", "--json")
    told = json.loads(said)
    assert code == 0 and told["task"] == "open-drawer" and told["split"] == "validation"
    assert np.isfinite(told["relative_error"])


@pytest.mark.parametrize("task", [(), ("--task", "reach")])
def test_a_task_has_to_be_named(done: Done, bad: Callable[..., str], task: tuple[str, ...]) -> None:
    _, out = done("igsp")
    says = ("one of its tasks: pick, open-drawer", "--task pick")
    bad("evaluate", out, *task, says=says)


def test_the_only_task_needs_no_name(real: Make, paths: dict[str, Path], tmp_path: Path) -> None:
    recipe = real("sequential", steps=1, demos=RobotDemos(paths=str(paths["pick"])))
    train.run(dataclasses.replace(recipe, tasks=("pick",)), tmp_path / "run")
    assert evaluate.run(tmp_path / "run", None).task == "pick"
    assert robots.number_of(tmp_path / "run", None) == 0


def test_a_run_of_one_policy_has_its_own_task_alone(
    naive_run: Path, demos_file: Path, bad: Callable[..., str]
) -> None:
    says = ("task 'point' for a policy of 'reach'", "leave out the task")
    bad("evaluate", naive_run, "--task", "point", "--demos", demos_file, says=says)
