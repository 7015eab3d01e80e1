"""`aegis export RUN --task`: the policy of one task of a stream, in plain weights of its own."""

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
from samples.own_robots import JOINTS, TASKS, TEXTS, Done
from samples.robots import Make
from torch import nn

from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.continual import evaluate, robots, train
from aegis_cli.core import routing
from aegis_cli.data.lerobot import layout
from aegis_cli.deploy import DeployedPolicy, load_policy
from aegis_cli.evaluation import open_loop
from aegis_cli.evaluation.probe import run as probed
from aegis_cli.models import backbones
from aegis_cli.models.expert import ActionExpert
from aegis_cli.publishing import card, export, push
from aegis_cli.training import checkpoint

pytestmark = pytest.mark.usefixtures("frame_cache")

FORMS = (card.LEROBOT, card.AEGIS)


def chunk(policy: DeployedPolicy, task: str) -> np.ndarray:
    """A policy's predictions at some observation of a task's robot."""
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (16, 16, 3), dtype=np.uint8)
    positions = rng.normal(size=JOINTS[task]).astype(np.float32)
    policy.reset()
    return policy.predict_action_chunk(picture, TEXTS[task], positions)


# --- what is written ------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("method", ["isolated-lora", "sequential"])
def test_it_predicts_what_the_stream_does_at_the_task(
    method: str, task: str, form: str, done: Done, tmp_path: Path
) -> None:
    """Also where the robot has fewer joints than another task's."""
    _, run = done(method)
    report = export.run(run, tmp_path / "policy", form, task=task)
    assert (report.task, report.method, report.chunk, report.replan) == (None, method, 4, 2)
    own, found = load_policy(run, task), load_policy(tmp_path / "policy")
    wanted = chunk(own, task)
    np.testing.assert_allclose(chunk(found, task), wanted, rtol=1e-4, atol=1e-5)
    if method == "isolated-lora":  # without the task's terms it would be another policy
        bare = robots.load_to_act(run)
        bare.activate(None)
        number = TASKS.index(task)
        without = DeployedPolicy(bare.policies[number].eval(), None, (), 2)
        assert np.abs(chunk(without, task) - wanted).max() > 1e-3
    for name in ("action_names", "state_names", "fps", "replan", "positions"):
        assert getattr(found, name) == getattr(own, name), name
    assert list(map(layout.short, found.cameras)) == list(map(layout.short, own.cameras))


@pytest.mark.parametrize("method", ["isolated-lora", "sequential"])
def test_a_hugging_face_model_goes_out_in_the_type_in_which_it_came(
    method: str, real: Make, hf_folder: Callable[[str], Path], tmp_path: Path
) -> None:
    narrow, vlm = tmp_path / "vlm", backbones.load(str(hf_folder("paligemma")))
    vlm.round_weights(torch.bfloat16)
    vlm.save(narrow)
    run = tmp_path / "run"
    train.run(real(method, steps=2, backbone=str(narrow)), run)
    wanted = chunk(load_policy(run, "pick"), "pick")
    for form in FORMS:
        out, wide = (tmp_path / form / name for name in ("policy", "wide"))
        assert export.run(run, out, form, task="pick").dtype == "bfloat16"
        export.run(run, wide, form, dtype="float32", task="pick")
        found = chunk(load_policy(wide), "pick")
        np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-4, err_msg=form)
        found = chunk(load_policy(out), "pick")
        assert np.abs(found - wanted).max() < 0.1 * np.abs(wanted).max(), form


def test_what_of_igsp_has_one_expert_a_map_is_written(real: Make, tmp_path: Path) -> None:
    recipe = real("igsp", steps=4)
    one = dataclasses.replace(recipe, igsp=dataclasses.replace(recipe.igsp, candidates=1))
    train.run(one, tmp_path / "run")
    export.run(tmp_path / "run", tmp_path / "pick", task="pick")
    wanted = chunk(load_policy(tmp_path / "run", "pick"), "pick")
    found = chunk(load_policy(tmp_path / "pick"), "pick")
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-5)


def test_what_weighs_several_experts_is_refused_before_anything_is_loaded(
    real: Make, tmp_path: Path, bad: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = real("igsp", steps=4)
    kept = dataclasses.replace(recipe.igsp, prune=False)
    run, out = tmp_path / "run", tmp_path / "policy"
    train.run(dataclasses.replace(recipe, igsp=kept), run)
    monkeypatch.setattr(robots, "load_to_act", lambda *given: pytest.fail("loaded"))
    says = ("'open-drawer'", "mixes several experts at", "aegis serve", "isolated-lora")
    bad("export", run, "--task", "open-drawer", "--out", out, says=says)
    assert not out.exists()


def test_merged_maps_compute_what_the_routed_ones_did() -> None:
    torch.manual_seed(0)
    root = nn.ModuleDict({"a": nn.Linear(5, 3), "b": nn.Linear(3, 4)})
    sites = routing.route(root, {"a": root["a"], "b": root["b"]})  # type: ignore[dict-item]
    generator = torch.Generator().manual_seed(1)
    for site in sites.values():
        number = site.add_expert(2, 0, generator)
        nn.init.normal_(site.experts[str(number)].b)
        site.add_router(1, [number], generator).scale.data.fill_(0.7)
    two = sites["b"].add_expert(2, 1, generator)
    sites["b"].add_router(2, [0, two], generator)
    x = torch.randn(6, 5)
    routing.activate(sites, 1)
    wanted = root["b"](root["a"](x))
    with pytest.raises(ValueError, match="over 2 experts"):
        routing.merge(root, sites, 2)  # "a" has no router for it
    assert root["a"] is sites["a"] and torch.equal(root["b"](root["a"](x)), wanted)
    routing.merge(root, sites, 1)
    assert type(root["a"]) is nn.Linear is type(root["b"])
    torch.testing.assert_close(root["b"](root["a"](x)), wanted)


def test_the_expert_of_a_smaller_robot_predicts_what_the_wide_one_does(done: Done) -> None:
    policy = robots.load_to_act(done("sequential")[1]).policies[1]
    wide, narrow = policy.expert, policy.expert.of_robot(2, 2)
    assert isinstance(narrow, ActionExpert) and narrow.shape.actions == 2 < wide.shape.actions
    assert narrow.of_robot(2, 2).state_dict().keys() == wide.state_dict().keys()


# --- what is done with it -------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
def test_the_folder_is_evaluated_probed_and_exported_again(
    form: str, done: Done, paths: dict[str, Path], tmp_path: Path
) -> None:
    _, run = done("isolated-lora")
    export.run(run, tmp_path / "policy", form, task="pick")
    wanted = evaluate.run(run, "pick", episodes=[0, 1])
    found = open_loop.run(tmp_path / "policy", paths["pick"], episodes=[0, 1])
    assert found.relative_error == pytest.approx(wanted.relative_error, rel=1e-3)
    known = probed(str(tmp_path / "policy"), "scenes", 7, None, None, None)
    assert known.questions == 7
    export.run(tmp_path / "policy", tmp_path / "again", card.AEGIS)
    again = chunk(load_policy(tmp_path / "again"), "pick")
    np.testing.assert_array_equal(again, chunk(load_policy(tmp_path / "policy"), "pick"))


def test_the_command_writes_a_card_with_the_tasks_own_error(
    aegis: Callable[..., tuple[int, str, str]], done: Done, tmp_path: Path
) -> None:
    report, run = done("sequential")
    command = ("export", run, "--task", "open-drawer", "--out", tmp_path / "drawer")
    code, said, _ = aegis(*command, "--format", "aegis", "--json")
    assert code == 0 and json.loads(said)["method"] == "sequential"
    told = (tmp_path / "drawer" / "README.md").read_text()
    assert f"{report.errors[-1][1]:.3f}" in told and "open-drawer" in told
    assert f"{100 * report.vqa[-1].accuracy:.1f} % after its last task" in told
    recipe = (tmp_path / "drawer" / "recipe-of-training.yaml").read_text()
    assert str(tmp_path.parent) not in told + recipe  # nobody else has these folders
    inputs = artifacts.read_header(tmp_path / "drawer" / checkpoint.EXPERT).inputs
    assert inputs["demos"] == report.inputs["demos of open-drawer"]
    sent = push.run(tmp_path / "drawer", "me/drawer", dry_run=True)
    assert "README.md" in sent.files and sent.format == "aegis"


def test_a_card_does_not_claim_what_was_asked_of_another_model(done: Done, tmp_path: Path) -> None:
    export.run(done("isolated-lora")[1], tmp_path / "pick", task="pick")
    told = (tmp_path / "pick" / "README.md").read_text()
    assert "Not measured: the task's low-rank terms" in told and "aegis probe ORG/pick" in told


def test_a_simulated_task_is_rolled_out_from_its_folder(make: Make, tmp_path: Path) -> None:
    train.run(make("isolated-lora", steps=2), tmp_path / "run")
    report = export.run(tmp_path / "run", tmp_path / "point", task="point")
    assert report.task == "point"
    told = (tmp_path / "point" / "README.md").read_text()
    assert "aegis rollout ORG/point" in told and "Success" in told


# --- refusals -------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", [(), ("--task", "reach")])
def test_a_task_has_to_be_named(
    done: Done, bad: Callable[..., str], tmp_path: Path, task: tuple[str, ...]
) -> None:
    run, out = done("isolated-lora")[1], tmp_path / "policy"
    bad("export", run, *task, "--out", out, says=("one of its tasks: pick, open-drawer",))
    assert not out.exists()


def test_a_run_of_one_policy_has_its_own_task_alone(naive_run: Path, tmp_path: Path) -> None:
    with pytest.raises(AegisError, match="task 'point' for a policy of 'reach'"):
        export.run(naive_run, tmp_path / "policy", task="point")


def test_a_push_says_that_a_task_is_exported_first(done: Done, bad: Callable[..., str]) -> None:
    run: Any = done("isolated-lora")[1]
    says = ("a policy for each task", "--task NAME --out FOLDER")
    bad("push", run, "me/policy", "--dry-run", says=says)
