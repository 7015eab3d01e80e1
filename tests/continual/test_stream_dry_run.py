"""`aegis train --dry-run` for a stream of robot tasks: its report, and that it writes nothing."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch
from samples.interrupted import stop
from samples.lerobot import frame_cache  # noqa: F401
from samples.own_robots import TASKS, robot
from samples.robots import STEPS, Make
from samples.training_runs import contents

from aegis_cli.common import memory
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Progress
from aegis_cli.continual import dry_run, loop, robots, train
from aegis_cli.recipes import RobotDemos, to_yaml

CAMERA = "observation.images.top"
pytestmark = pytest.mark.usefixtures("frame_cache")


# --- what it tells --------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["igsp", "isolated-lora", "sequential"])
def test_each_task_learns_what_the_training_lets_it_learn(
    method: str, real: Make, tmp_path: Path
) -> None:
    recipe = real(method)
    found = dry_run.run(recipe, tmp_path / "run")
    assert list(tmp_path.iterdir()) == []
    report = train.run(recipe, tmp_path / "run")
    for record in report.records:
        told = found.tasks[record.task]
        # In the dry run igsp has not pruned before the task, so there may be more.
        learned = record.trained if method != "igsp" else record.trained_phase1
        assert told["trainable"] is not None and told["trainable"] >= (learned or 0) > 0
        if method != "igsp" or record.task == TASKS[0]:
            assert told["trainable"] == learned
    shown = robots.build(recipe, tmp_path / "other").demos
    assert [told["training_frames"] for told in found.tasks.values()] == [
        len(demos.train) for demos in shown
    ]
    assert (found.steps, found.method, found.cameras) == (STEPS, method, [CAMERA])
    assert found.memory_fits and found.disk_fits and dry_run.shortage(found) is None


@pytest.mark.parametrize("method", ["igsp", "sequential"])
def test_time_and_memory_are_of_real_steps(
    method: str, real: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[tuple[int, int]] = []
    step = loop.take

    def noted(run: robots.RobotStreamRun, *given: object) -> float:
        taken.append((run.current.task, int(given[1])))  # type: ignore[call-overload]
        return step(run, *given)  # type: ignore[arg-type]

    monkeypatch.setattr(loop, "take", noted)
    found = dry_run.run(real(method), tmp_path / "run")
    assert taken == [(task, index) for task in (0, 1) for index in range(4)]
    assert all((told["step_s"] or 0) > 0 for told in found.tasks.values())
    assert found.memory_measured_mb is not None and found.memory_measured_mb > 0
    assert found.hours is not None and found.measuring_s is not None
    looked = {"routing"} if method == "igsp" else set()
    assert found.measuring_s.keys() == {"questions", "loss", *(f"task {t}" for t in TASKS), *looked}
    # All steps, and the measurements before the first task and after each.
    times, steps_s = found.measuring_s, sum(told["step_s"] or 0 for told in found.tasks.values())
    seconds = STEPS * steps_s + 3 * times["questions"] + 2 * times["loss"]
    seconds += 2 * times[f"task {TASKS[0]}"] + times[f"task {TASKS[1]}"]
    looks = 2 if method == "igsp" else 0  # at the end of each task
    looks += 2 * 2 if method == "igsp" else 0  # at step 2, and at step 3 with which phase 1 ends
    seconds += looks * times.get("routing", 0)
    assert found.hours == pytest.approx(seconds / 3600)


def test_later_tasks_have_the_experts_of_all_before(real: Make, tmp_path: Path) -> None:
    recipe = real("igsp")
    three = dataclasses.replace(
        recipe,
        tasks=(*TASKS, "again"),
        demos=RobotDemos(paths=(*recipe.demos.paths, str(robot(tmp_path / "again")))),
    )
    of_two, of_three = (dry_run.run(each, tmp_path / "run") for each in (recipe, three))
    # With the second task the action expert's maps get experts; their routers then read old ones.
    learning = [told["trainable"] for told in of_three.tasks.values()]
    assert learning[2] > learning[1] and list(of_two.tasks) == list(TASKS)
    first, between, last = (told["step_s"] for told in of_three.tasks.values())
    assert between == pytest.approx((first + last) / 2)


def test_what_is_left_of_an_interrupted_stream_takes_less(real: Make, tmp_path: Path) -> None:
    recipe, out = real("isolated-lora"), tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        train.run(recipe, out, on_event=partial(stop, "task 2 open-drawer", 4))
    before = contents(out)
    found = dry_run.run(recipe, out, resume=True)
    assert contents(out) == before
    times, told = found.measuring_s, found.tasks["open-drawer"]
    assert times is not None and found.hours is not None
    seconds = (told["step_s"] or 0) * 2 + sum(times.values())
    assert found.hours == pytest.approx(seconds / 3600)
    with pytest.raises(AegisError, match="an existing run"):
        dry_run.run(recipe, out)
    train.run(recipe, out, resume=True)
    assert dry_run.run(recipe, out, resume=True).hours == 0
    assert dry_run.run(recipe, out, overwrite=True).hours > 0


def test_a_simulated_stream_is_told_of_too(make: Make, tmp_path: Path) -> None:
    found = dry_run.run(make("sequential", steps=2), tmp_path / "run")
    assert found.measuring_s is not None and found.measuring_s["task reach"] > 0
    assert not (tmp_path / "run").exists()


# --- what does not fit ----------------------------------------------------------------------------


def test_what_cannot_fit_takes_no_step(
    real: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "free", lambda device: 1000)
    monkeypatch.setattr(loop, "take", lambda *given: pytest.fail("a step"))
    found = dry_run.run(real("sequential"), tmp_path / "run")
    assert (found.memory_fits, found.hours, found.memory_measured_mb) == (False, None, None)
    assert "use a smaller backbone" in str(dry_run.shortage(found))


def test_a_later_task_that_cannot_fit_is_seen(
    real: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    estimated, huge = dry_run._estimated, 10**15

    def grown(begun: dry_run._Begun, *given: object) -> dry_run._Estimated:
        found = estimated(begun, *given)  # type: ignore[arg-type]
        return found._replace(parts=found.parts | {"weights": huge}) if begun.number else found

    monkeypatch.setattr(dry_run, "_estimated", grown)
    found = dry_run.run(real("isolated-lora"), tmp_path / "run")
    assert found.memory_fits is False and found.hours is None
    assert found.memory_mb["weights"] == huge / 1e6 and found.tasks[TASKS[1]]["step_s"] is None
    assert "use a smaller backbone" in str(dry_run.shortage(found))


def test_a_step_that_runs_out_of_memory_is_told_of(
    real: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def out_of_memory(*given: object) -> float:
        raise torch.OutOfMemoryError("no memory is left")

    monkeypatch.setattr(loop, "take", out_of_memory)
    found = dry_run.run(real("igsp"), tmp_path / "run")
    assert found.memory_fits is False
    assert "more memory than the estimate" in str(dry_run.shortage(found))


def test_a_disk_that_is_too_small_is_seen(
    real: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dry_run, "free_disk", lambda out: 10)
    found = dry_run.run(real("sequential"), tmp_path / "run")
    assert not found.disk_fits and "choose another --out" in str(dry_run.shortage(found))


def test_nothing_is_recorded(make: Make, tmp_path: Path) -> None:
    recipe = make("sequential", steps=2, demos=RobotDemos(episodes=3))
    with pytest.raises(AegisError, match="no demonstrations of 'reach' yet") as caught:
        dry_run.run(recipe, tmp_path / "run")
    assert "aegis demos reach --episodes 3" in caught.value.fix and not list(tmp_path.iterdir())
    train.run(recipe, tmp_path / "run")
    before = contents(tmp_path)
    assert dry_run.run(recipe, tmp_path / "other").hours > 0
    assert contents(tmp_path) == before


# --- the command line -----------------------------------------------------------------------------


def test_the_command_tells_it_and_ends_at_what_does_not_fit(
    aegis: Callable[..., tuple[int, str, str]],
    real: Make,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "robot.yaml").write_text(to_yaml(real("igsp", steps=2)))
    command = ("train", tmp_path / "robot.yaml", "--out", tmp_path / "run", "--dry-run")
    code, said, err = aegis(*command)
    assert code == 0 and "hours" in said and "open-drawer" in said, err
    code, said, _ = aegis(*command, "--json")
    told = json.loads(said)
    assert code == 0 and set(told["tasks"]) == set(TASKS) and told["hours"] > 0
    monkeypatch.setattr(memory, "free", lambda device: 1000)
    code, _, err = aegis(*command)
    assert code == 1 and "gate failed: training needs about" in err
    assert not (tmp_path / "run").exists()


def test_progress_is_told(real: Make, tmp_path: Path) -> None:
    seen: list[Event] = []
    dry_run.run(real("sequential"), tmp_path / "run", on_event=seen.append)
    steps = [e for e in seen if isinstance(e, Progress) and e.stage == "dry run"]
    assert steps and steps[-1].done == steps[-1].total == 8
