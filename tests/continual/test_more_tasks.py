"""Tasks that are added to a finished stream of robot tasks."""

from __future__ import annotations

import dataclasses
import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.interrupted import at_each
from samples.lerobot import frame_cache  # noqa: F401
from samples.own_robots import TASKS, Done, robot
from samples.robots import Make
from samples.training_runs import contents

from aegis_cli import recipes
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Warned
from aegis_cli.continual import dry_run, files, robots, state, train
from aegis_cli.recipes import ROBOT_LEARNERS, RobotDemos, RobotStreamRecipe, to_yaml

pytestmark = pytest.mark.usefixtures("frame_cache")
Aegis = Any


def of_first(recipe: RobotStreamRecipe) -> RobotStreamRecipe:
    """The recipe of the first of its two tasks."""
    paths = recipe.demos.paths
    demos = RobotDemos(paths=paths if paths is None else paths[:1])
    return dataclasses.replace(recipe, tasks=recipe.tasks[:1], demos=demos)


@pytest.fixture(scope="module")
def first(real: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished igsp stream of the first task; read-only."""
    out = tmp_path_factory.mktemp("first") / "run"
    train.run(of_first(real()), out)
    return out


@pytest.fixture
def run(first: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(first, tmp_path / "run"))


@pytest.mark.parametrize("method", ROBOT_LEARNERS)
def test_a_stream_with_an_added_task_has_the_bytes_of_one_that_began_with_it(
    method: str, real: Make, done: Done, tmp_path: Path
) -> None:
    train.run(of_first(real(method)), tmp_path / "run")
    told: list[Any] = []
    report = train.run(real(method), tmp_path / "run", resume=True, on_event=told.append)
    wanted, out = done(method)
    assert contents(tmp_path / "run") == contents(out)
    assert dataclasses.replace(report, minutes=0, out="") == dataclasses.replace(
        wanted, minutes=0, out=""
    )
    said = [event.text for event in told if isinstance(event, Warned)]
    assert any(f"goes on with {TASKS[1]}" in text for text in said)


def test_so_it_is_for_simulated_tasks(make: Make, tmp_path: Path) -> None:
    both = make("igsp")
    train.run(of_first(both), tmp_path / "grown")
    train.run(both, tmp_path / "grown", resume=True)
    train.run(both, tmp_path / "whole")
    assert contents(tmp_path / "grown") == contents(tmp_path / "whole")


def test_interrupted_anywhere_it_goes_on_to_the_same_bytes(
    run: Path, real: Make, done: Done
) -> None:
    places = ((f"task 2 {TASKS[1]}", 0), (f"task 2 {TASKS[1]}", 3), ("stream", 2))
    for place in at_each(places, lambda on_event, resume: more(run, real(), on_event)):
        assert not files.is_done(run), place
        with pytest.raises(AegisError, match="is not finished"):
            robots.load_to_act(run)
    train.run(real(), run, resume=True)
    assert contents(run) == contents(done("igsp")[1])


def more(run: Path, recipe: RobotStreamRecipe, on_event: Any) -> None:
    train.run(recipe, run, resume=True, on_event=on_event)


def test_killed_before_the_earlier_report_is_gone_it_goes_on(
    run: Path, real: Make, done: Done, monkeypatch: pytest.MonkeyPatch
) -> None:
    unlink = Path.unlink

    def killed(path: Path, *given: Any, **named: Any) -> None:
        if path.name == files.REPORT:
            raise KeyboardInterrupt
        unlink(path, *given, **named)

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(Path, "unlink", killed)
        train.run(real(), run, resume=True)
    assert (run / files.REPORT).is_file() and not files.is_done(run)
    train.run(real(), run, resume=True)
    assert contents(run) == contents(done("igsp")[1])


def test_killed_before_its_recipe_is_written_it_is_still_finished(
    run: Path, first: Path, real: Make, done: Done, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*given: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr("aegis_cli.training.folder.write_recipe", killed)
        train.run(real(), run, resume=True)
    (run / state.STATE).rename(run.with_name("state"))
    assert contents(run) == contents(first)
    run.with_name("state").rename(run / state.STATE)
    assert files.is_done(run) and robots.load_to_act(run).names == TASKS[:1]
    train.run(of_first(real()), run, resume=True)
    train.run(real(), run, resume=True)
    assert contents(run) == contents(done("igsp")[1])


def test_a_dry_run_counts_only_the_added_task(run: Path, first: Path, real: Make) -> None:
    left = partial(dry_run._left, overwrite=False)
    before = contents(run)
    built = robots.build(real(), run)
    steps = real().train.steps
    assert left(built) == [0, steps]
    whole = dry_run.run(real(), run.with_name("new"))
    added = dry_run.run(real(), run, resume=True)
    assert added.hours is not None and whole.hours is not None
    assert list(added.tasks) == list(TASKS) and contents(run) == before


def refused(run: Path, recipe: RobotStreamRecipe, match: str) -> None:
    """A recipe with which the run does not go on; nothing of it changes."""
    before = contents(run)
    with pytest.raises(AegisError, match=match):
        train.run(recipe, run, resume=True)
    assert contents(run) == before and files.is_done(run)


def test_a_robot_with_more_joints_is_refused(real: Make, tmp_path: Path) -> None:
    recipe = real()
    paths = tuple(reversed(recipe.demos.paths or ()))
    turned = dataclasses.replace(recipe, tasks=TASKS[::-1], demos=RobotDemos(paths=paths))
    train.run(of_first(turned), tmp_path / "run")
    refused(tmp_path / "run", turned, r"robots of 3 positions and 3 actions .*\n.*at most the 2")


def test_other_settings_are_refused(run: Path, real: Make) -> None:
    refused(run, real(steps=real().train.steps + 1), "started with other settings: .*steps")
    turned = dataclasses.replace(real(), tasks=TASKS[::-1])
    refused(run, turned, "started with other settings: .*tasks")


def test_a_learned_tasks_demonstrations_may_lie_elsewhere_but_not_differ(
    run: Path, real: Make, done: Done, tmp_path: Path
) -> None:
    paths = real().demos.paths
    assert paths is not None
    elsewhere = tmp_path / "elsewhere"
    moved = dataclasses.replace(real(), demos=RobotDemos(paths=(str(elsewhere), paths[1])))
    robot(elsewhere, scale=2.0)
    refused(run, moved, "a different demos of pick than the run")
    shutil.rmtree(elsewhere)
    shutil.copytree(paths[0], elsewhere)
    report = train.run(moved, run, resume=True)
    assert report.measured_rows == done("igsp")[0].measured_rows


def test_tasks_are_added_only_to_a_finished_stream(real: Make, tmp_path: Path) -> None:
    begin = partial(train.run, of_first(real()), tmp_path / "run")
    for _ in at_each(((f"task 1 {TASKS[0]}", 3),), begin):
        with pytest.raises(AegisError, match=r"open-drawer added to .* has not learned all"):
            train.run(real(), tmp_path / "run", resume=True)


def test_the_command_takes_the_folder_and_the_longer_lists(
    run: Path, real: Make, done: Done, aegis: Aegis
) -> None:
    paths = real().demos.paths
    assert paths is not None
    lists = f"tasks={json.dumps(TASKS)}", f"demos.paths={json.dumps(paths)}"
    code, _, err = aegis("train", run, "--set", lists[0], "--set", lists[1])
    assert code == 0, err
    assert contents(run) == contents(done("igsp")[1])
    (run.parent / "bench.yaml").write_text(to_yaml(real()))
    code, out, _ = aegis("train", run.parent / "bench.yaml", "--out", run, "--resume", "--json")
    assert code == 0 and json.loads(out)["tasks"] == list(TASKS)


def test_settings_of_memory_and_of_what_is_written_may_change(
    run: Path, real: Make, done: Done
) -> None:
    told: list[Any] = []
    recipe = real(accumulate=2, checkpoint_every=3, log_every=2)
    train.run(recipe, run, resume=True, on_event=told.append)
    said = [event.text for event in told if isinstance(event, Warned)]
    assert any("train.accumulate: 2 instead of 1" in text for text in said)
    assert recipes.load(run / "recipe.yaml", kind=RobotStreamRecipe).train == recipe.train
    wanted = artifacts.load(done("igsp")[1] / robots.ACTION_EXPERT).tensors
    found = artifacts.load(run / robots.ACTION_EXPERT).tensors
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-5)
