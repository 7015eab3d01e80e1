"""`train.accumulate` and `train.gradient_checkpointing` of streams: equal steps, less memory."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.lerobot import frame_cache  # noqa: F401
from samples.own_robots import Done, assert_resumes
from samples.robots import Make
from torch import Tensor

from aegis_cli import recipes
from aegis_cli.common.errors import AegisError
from aegis_cli.continual import dry_run, loop, robots, train
from aegis_cli.continual.robots import RobotStreamRun
from aegis_cli.recipes import RobotStreamRecipe, to_yaml

pytestmark = pytest.mark.usefixtures("frame_cache")

METHODS = ("igsp", "isolated-lora", "sequential")
CLOSE = {"rtol": 1e-4, "atol": 1e-6}


def taken(recipe: RobotStreamRecipe, out: Path) -> tuple[RobotStreamRun, float, dict[str, Tensor]]:
    """A run after a step of its second task: the step's loss and gradients."""
    run = robots.build(recipe, out)
    begun = dry_run._Begun.at(run, 0)
    loop.take(run, begun.training, 0, begun.training.fetch(0))
    begun.ended()
    training = dry_run._Begun.at(run, 1).training
    loss = loop.take(run, training, 1, training.fetch(1))
    return run, loss, {name: p.grad for name, p in run.learning().items() if p.grad is not None}


def same(found: dict[str, Tensor], wanted: dict[str, Tensor]) -> None:
    assert found.keys() == wanted.keys() and found
    for name, value in wanted.items():
        torch.testing.assert_close(found[name], value, **CLOSE, msg=lambda m, n=name: f"{n}: {m}")


# --- several passes -------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_a_step_in_passes_has_the_loss_and_the_gradients_of_one(
    method: str, real: Make, tmp_path: Path
) -> None:
    """This holds if the passes differ by a frame, and for igsp's terms of the loss."""
    _, wanted_loss, wanted = taken(real(method), tmp_path / "run")
    for passes in (2, 3, 4):
        _, loss, found = taken(real(method, accumulate=passes), tmp_path / "run")
        assert loss == pytest.approx(wanted_loss, rel=1e-5), passes
        same(found, wanted)


def test_what_igsp_charges_is_paid_once_in_all_passes(real: Make, tmp_path: Path) -> None:
    """This is about its gradient alone, at a price at which it outweighs the task's."""
    dear = dataclasses.replace(real("igsp").igsp, reuse=1e4, norm=1e3)
    _, _, wanted = taken(real("igsp", igsp=dear, clip_norm=1e9), tmp_path / "run")
    _, _, found = taken(real("igsp", igsp=dear, clip_norm=1e9, accumulate=4), tmp_path / "run")
    same(found, wanted)
    _, _, without = taken(real("igsp", clip_norm=1e9), tmp_path / "run")
    assert max((wanted[n] - without[n]).abs().max() for n in without) > 1


@pytest.mark.parametrize("method", METHODS)
def test_a_pass_sees_its_own_frames_alone(
    method: str, real: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[int] = []
    encode = robots.Policy.encode

    def noted(self: robots.Policy, images: Any, texts: Any) -> Any:
        seen.append(len(texts))
        return encode(self, images, texts)

    monkeypatch.setattr(robots.Policy, "encode", noted)
    run = robots.build(real(method, accumulate=2), tmp_path / "run")
    training = dry_run._Begun.at(run, 0).training
    loop.take(run, training, 0, training.fetch(0))
    assert seen == [2, 2]
    seen.clear()
    if run.sites:  # routers are not measured in larger passes
        loop.measure(run, training)
        assert set(seen) <= {1, 2} and sum(seen) == len(training.objective._calibration)  # type: ignore[attr-defined]


def test_routers_are_measured_alike_in_passes(real: Make, tmp_path: Path) -> None:
    flows = []
    for passes in (1, 3):
        run = robots.build(real("igsp", accumulate=passes), tmp_path / "run")
        training = dry_run._Begun.at(run, 0).training
        with torch.no_grad():
            for site in run.sites.values():
                for expert in site.experts.values():
                    torch.nn.init.normal_(expert.b, generator=torch.Generator().manual_seed(1))
        flows.append(loop.measure(run, training))
    for name, wanted in flows[0].items():
        torch.testing.assert_close(flows[1][name].mass, wanted.mass, rtol=1e-5, atol=1e-7)
        torch.testing.assert_close(flows[1][name].load, wanted.load, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("method", METHODS)
def test_a_stream_in_passes_ends_where_one_in_whole_batches_does(
    method: str, real: Make, done: Done, tmp_path: Path
) -> None:
    wanted = done(method)[0]
    found = train.run(real(method, accumulate=2), tmp_path / "run")
    for row, own in zip(wanted.errors, found.errors, strict=True):
        assert own == pytest.approx(row, rel=1e-2)
    for before, now in zip(wanted.records, found.records, strict=True):
        assert (now.trained, now.added) == (before.trained, before.added)
        assert now.loss == pytest.approx(before.loss, rel=1e-2)


# --- gradient checkpointing -----------------------------------------------------------------------


@pytest.fixture
def hugging_face(real: Make, hf_folder: Callable[[str], Path]) -> Make:
    """A recipe with a Hugging Face backbone."""
    return partial(real, backbone=str(hf_folder("paligemma")))


@pytest.mark.parametrize("method", METHODS)
def test_checkpointed_gradients_are_the_same(
    method: str, hugging_face: Make, tmp_path: Path
) -> None:
    _, wanted_loss, wanted = taken(hugging_face(method), tmp_path / "run")
    recipe = hugging_face(method, gradient_checkpointing=True)
    run, loss, found = taken(recipe, tmp_path / "run")
    assert run.model.expert.recomputes
    assert loss == pytest.approx(wanted_loss, rel=1e-5)
    same(found, wanted)


def test_less_is_kept_of_a_pass(hugging_face: Make, tmp_path: Path) -> None:
    kept = []
    changes: tuple[dict[str, Any], ...] = ({}, {"gradient_checkpointing": True}, {"accumulate": 4})
    for each in changes:
        found = dry_run.run(hugging_face("isolated-lora", **each), tmp_path / "run")
        kept.append(found.memory_mb["activations"])
        assert found.hours is not None  # steps were taken, and routers were measured
    plain, checkpointed, in_passes = kept
    assert checkpointed < 0.7 * plain and in_passes < 0.7 * plain


# --- both -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["igsp", "sequential"])
def test_interrupted_and_resumed_it_ends_in_the_same_bytes(
    method: str, hugging_face: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(robots, "CALIBRATION_FRAMES", 6)  # measuring routers takes the most time
    recipe = hugging_face(method, steps=4, gradient_checkpointing=True, accumulate=2)
    assert_resumes(recipe, tmp_path)


def test_runs_that_began_before_there_were_the_keys_are_the_same_runs(real: Make) -> None:
    known = recipes.training_part(real("igsp"))["train"]
    assert not {"accumulate", "gradient_checkpointing"} & known.keys()
    other = recipes.training_part(real("igsp", accumulate=2))["train"]
    assert other == {**known, "accumulate": 2}


def test_more_passes_than_frames_are_refused(
    real: Make, tmp_path: Path, bad: Callable[..., str]
) -> None:
    (tmp_path / "robot.yaml").write_text(to_yaml(real("igsp", accumulate=5)))
    says = ("train.batch_size: 4 with train.accumulate: 5", "set train.accumulate to at most 4")
    bad("train", tmp_path / "robot.yaml", "--out", tmp_path / "run", says=says)


def test_the_embedded_backbone_checkpoints_nothing(real: Make, tmp_path: Path) -> None:
    with pytest.raises(AegisError, match="gradient_checkpointing with the embedded backbone"):
        train.run(real("igsp", gradient_checkpointing=True), tmp_path / "run")
    assert not (tmp_path / "run").exists()
