"""`train.relative_actions` of streams: each task's actions relative to its own robot's position."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from samples.lerobot import frame_cache  # noqa: F401
from samples.own_robots import FRAMES, JOINTS, TASKS, TEXTS, assert_resumes, robot
from samples.robots import Make
from samples.training_runs import contents
from torch import Tensor

from aegis_cli import load_policy, recipes
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Warned
from aegis_cli.continual import dry_run, evaluate, plain, probe, robots, train
from aegis_cli.data import demonstrations
from aegis_cli.publishing import export
from aegis_cli.recipes import RobotDemos, RobotStreamRecipe, to_yaml

pytestmark = pytest.mark.usefixtures("frame_cache")

Relative = Callable[..., RobotStreamRecipe]
PLACES = {"pick": (0, None, 2), "open-drawer": (0, None)}  # "joint 1" stays absolute


@pytest.fixture
def relative(real: Make) -> Relative:
    def recipe(method: str, **changes: Any) -> RobotStreamRecipe:
        own = {"relative_actions": True, "relative_exclude": ("JOINT 1",)}
        return real(method, **own | changes)

    return recipe


def batch_of(run: robots.RobotStreamRun, number: int) -> Any:
    demos = run.demos[number]
    return demos.batch(demos.train[:3], 4)


def acted(run: robots.RobotStreamRun, number: int, batch: Any) -> Tensor:
    run.activate(number)
    policy = run.policies[number].eval()
    draws = torch.Generator().manual_seed(0)
    return policy.act(batch.images, batch.instructions, batch.proprio, draws)


# --- what is learned ------------------------------------------------------------------------------


def test_each_task_learns_its_actions_less_its_own_positions(
    relative: Relative, tmp_path: Path
) -> None:
    run = robots.build(relative("igsp"), tmp_path / "run")
    for number, task in enumerate(TASKS):
        policy, demos = run.policies[number], run.demos[number]
        assert policy.origins.places == PLACES[task] == demos.relative_places(("joint 1",))
        scales = demos.scales("mean_std", 4, PLACES[task])
        for found, wanted in zip((policy.proprio_scale, policy.action_scale), scales, strict=True):
            assert torch.equal(found.mean, wanted.mean) and torch.equal(found.std, wanted.std)
        batch = batch_of(run, number)
        moved = batch.proprio.clone()
        moved[:, 1] = 0  # what stays absolute
        wanted = policy.action_scale(batch.actions - moved[:, None])
        assert torch.equal(policy.targets(batch), wanted)


@pytest.mark.parametrize("method", ["igsp", "isolated-lora", "sequential"])
def test_errors_are_of_absolute_actions_however_they_are_measured(
    method: str, relative: Relative, tmp_path: Path
) -> None:
    report = train.run(relative(method), tmp_path / "run")
    run = robots.build(relative(method), tmp_path / "other")
    again = probe.run(tmp_path / "run")
    assert again.errors[-1] == report.errors[-1]
    for number, task in enumerate(TASKS):
        found = evaluate.run(tmp_path / "run", task, frames=FRAMES)
        assert found.relative_error == pytest.approx(report.errors[-1][number], rel=1e-5)
        assert found.hold_error == pytest.approx(report.hold_errors[number])
        spread = [each.training_std for each in found.dimensions]
        np.testing.assert_allclose(spread, run.demos[number].action_std, rtol=1e-5)


@pytest.mark.parametrize("method", ["igsp", "isolated-lora"])
def test_a_learned_task_acts_as_before_when_another_has_been_learned(
    method: str, relative: Relative, tmp_path: Path
) -> None:
    one = relative(method)
    demos = dataclasses.replace(one.demos, paths=one.demos.paths[:1])
    alone = dataclasses.replace(one, tasks=TASKS[:1], demos=demos)
    first, both = (train.run(each, tmp_path / each.tasks[-1]) for each in (alone, one))
    assert both.errors[1][0] == both.errors[0][0]
    assert both.scores.forgetting == 0 and len(first.errors) == 1


def test_interrupted_and_resumed_it_ends_in_the_same_bytes(
    relative: Relative, tmp_path: Path
) -> None:
    assert_resumes(relative("igsp"), tmp_path)
    assert dry_run.run(relative("igsp"), tmp_path / "run", resume=True).hours == 0


# --- what acts ------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["isolated-lora", "sequential"])
def test_the_robot_and_what_is_exported_get_the_run_s_absolute_actions(
    method: str, relative: Relative, paths: dict[str, Path], tmp_path: Path
) -> None:
    out = tmp_path / "run"
    train.run(relative(method), out)
    run = robots.load_to_act(out)
    for number, task in enumerate(TASKS):
        assert run.policies[number].origins.places == PLACES[task]
        assert run.meta(number)["relative"] == list(PLACES[task])
        shown = demonstrations.load(paths[task], None, 0, image_size=run.model.backbone.image_size)
        batch = shown.batch(torch.tensor([3]), 4)
        wanted = acted(run, number, batch)
        alone, draws = plain.policy(robots.load_to_act(out), number), torch.Generator()
        seen = batch.images, batch.instructions, batch.proprio, draws.manual_seed(0)
        torch.testing.assert_close(alone.act(*seen), wanted, rtol=1e-4, atol=1e-4)
        names = [f"joint {n}.pos" for n in range(JOINTS[task])]
        observation = dict(zip(names, batch.proprio[0].tolist(), strict=True))
        observation["top"] = batch.images[0].numpy()
        action = load_policy(out, task).select_action(observation, TEXTS[task])
        np.testing.assert_allclose(action, wanted[0, 0].numpy(), rtol=1e-4, atol=1e-5)
        for form in ("lerobot", "aegis"):
            folder = tmp_path / f"{task}-{form}"
            export.run(out, folder, form, task=task)
            policy = load_policy(folder)
            assert policy._policy.origins.places == PLACES[task]
            found = policy.select_action(observation, TEXTS[task])
            np.testing.assert_allclose(found, action, rtol=1e-4, atol=1e-4)


def test_a_header_with_places_of_another_robot_is_refused(
    relative: Relative, tmp_path: Path
) -> None:
    train.run(relative("sequential", steps=1), tmp_path / "run")
    path = tmp_path / "run" / robots.ACTION_EXPERT
    saved = artifacts.load(path, "expert")
    saved.header.meta["views"][1]["relative"] = [0, 2]
    header = saved.header
    artifacts.save(
        path,
        "expert",
        saved.tensors,
        seed=header.seed,
        inputs=header.inputs,
        fingerprint=header.fingerprint,
        meta=header.meta,
    )
    with pytest.raises(AegisError, match="'relative' is"):
        robots.load_to_act(tmp_path / "run")


# --- robots that differ, and mistakes -------------------------------------------------------------


def test_a_word_that_only_one_robot_has_excludes_nothing_of_another(
    relative: Relative, tmp_path: Path
) -> None:
    told: list[Event] = []
    run = robots.build(relative("igsp", relative_exclude=("joint 2",)), tmp_path, told.append)
    assert [policy.origins.places for policy in run.policies] == [(0, 1, None), (0, 1)]
    texts = [event.text for event in told if isinstance(event, Warned)]
    assert [text for text in texts if "all actions of 'open-drawer' are relative" in text]
    told.clear()
    robots.build(relative("igsp", relative_exclude=("joint 2", "joint 0")), tmp_path, told.append)
    assert not [event for event in told if isinstance(event, Warned) and "relative" in event.text]


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"relative_actions": False}, "train.relative_exclude: JOINT 1"),
        ({"relative_exclude": ("gripper",)}, "'gripper', which is in no action's name"),
        ({"relative_exclude": None}, "for task 'open-drawer'"),
    ],
)
def test_what_belongs_to_no_position_is_refused_before_a_frame_is_decoded(
    changes: dict[str, Any],
    says: str,
    relative: Relative,
    paths: dict[str, Path],
    tmp_path: Path,
    bad: Callable[..., str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    other = robot(tmp_path / "other", "open-drawer", actions=("joint 0.pos", "torque"))
    given = RobotDemos(paths=(str(paths["pick"]), str(other)))
    recipe = relative("igsp", **{"demos": given, **changes})
    (tmp_path / "robot.yaml").write_text(to_yaml(recipe))

    def decoded(*_: Any, **__: Any) -> None:
        raise AssertionError("frames are decoded")

    monkeypatch.setattr(demonstrations, "load", decoded)
    bad("train", tmp_path / "robot.yaml", "--out", tmp_path / "run", says=(says,))


def test_simulated_tasks_whose_actions_are_no_positions_are_refused(
    make: Make, tmp_path: Path
) -> None:
    for demos in (make("igsp").demos, RobotDemos(episodes=2)):
        recipe = make("igsp", relative_actions=True, demos=demos)
        with pytest.raises(AegisError, match="for task 'reach', train.relative_actions"):
            robots.build(recipe, tmp_path / "run")
    assert list(tmp_path.iterdir()) == []  # nothing has been recorded


# --- without the key ------------------------------------------------------------------------------


def test_runs_without_it_are_as_they_were(real: Make, tmp_path: Path) -> None:
    known = recipes.training_part(real("igsp"))["train"]
    assert not {"relative_actions", "relative_exclude"} & known.keys()
    train.run(real("igsp", steps=1), tmp_path / "run")
    meta = artifacts.read_header(tmp_path / "run" / robots.ACTION_EXPERT).meta
    assert "relative" not in json.dumps(meta) and contents(tmp_path / "run")
    run = robots.load_to_act(tmp_path / "run")
    assert all(policy.origins.places == () for policy in run.policies)
