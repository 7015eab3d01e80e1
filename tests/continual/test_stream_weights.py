"""`train.weights: bf16` of streams: the frozen VLM in half precision, what learns in float32."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch
from samples.lerobot import frame_cache  # noqa: F401
from samples.own_robots import FRAMES, TASKS, assert_resumes
from samples.robots import Make

from aegis_cli import recipes
from aegis_cli.common.errors import AegisError
from aegis_cli.continual import dry_run, evaluate, loop, plain, probe, robots, train
from aegis_cli.models import backbones
from aegis_cli.publishing import export
from aegis_cli.recipes import to_yaml
from aegis_cli.training import checkpoint

pytestmark = pytest.mark.usefixtures("frame_cache")

METHODS = ("igsp", "isolated-lora")
HALF = torch.bfloat16


@pytest.fixture
def half(real: Make, hf_folder: Callable[[str], Path]) -> Make:
    """A recipe with a Hugging Face backbone in half precision."""
    return partial(real, backbone=str(hf_folder("paligemma")), weights="bf16", steps=4)


# --- what has which type --------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("precision", ["float32", "bf16"])
def test_the_vlm_is_rounded_and_stays_while_what_learns_is_wide(
    method: str, precision: str, half: Make, tmp_path: Path
) -> None:
    recipe = half(method, precision=precision)
    run = robots.build(recipe, tmp_path / "run")
    original = backbones.load(recipe.backbone)
    assert run.fingerprint == original.fingerprint()
    begun = dry_run._Begun.at(run, 0)
    begun.ended()
    training = dry_run._Begun.at(run, 1).training
    learning = {name: p.detach().clone() for name, p in run.learning().items()}
    assert {p.dtype for p in learning.values()} == {torch.float32}
    assert {p.dtype for p in run.model.expert.parameters()} == {torch.float32}
    for step in range(2):
        loop.take(run, training, step, training.fetch(step))
    moved = [not torch.equal(p, learning[name]) for name, p in run.learning().items()]
    assert any(moved) and any(".experts." in n and n.startswith("backbone.") for n in learning)
    frozen = {n: p for n, p in run.model.backbone.named_parameters() if not robots.is_added(n)}
    wanted = dict(original.named_parameters())
    assert len(frozen) == len(wanted)
    for name, parameter in frozen.items():
        assert parameter.dtype == HALF
        assert torch.equal(parameter, wanted[name.replace(".base.", ".")].to(HALF)), name


def test_a_dry_run_finds_half_the_weights(half: Make, tmp_path: Path) -> None:
    wide, narrow = (
        dry_run.run(half("isolated-lora", weights=weights), tmp_path / "run")
        for weights in ("float32", "bf16")
    )
    saved = wide.memory_mb["weights"] - narrow.memory_mb["weights"]
    vlm = sum(p.numel() for p in backbones.load(narrow.backbone).parameters())
    assert saved == pytest.approx(2 * vlm / 1e6, rel=1e-6)
    assert wide.tasks[TASKS[1]]["trainable"] == narrow.tasks[TASKS[1]]["trainable"]


# --- the same wherever it is loaded ---------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_a_run_is_measured_again_as_it_was_trained(method: str, half: Make, tmp_path: Path) -> None:
    report = train.run(half(method), tmp_path / "run")
    assert report.scores.forgetting == 0 and report.errors[0][0] == report.errors[1][0]
    run = robots.load_to_act(tmp_path / "run")
    assert HALF in {p.dtype for p in run.model.backbone.parameters()}
    again = probe.run(tmp_path / "run")
    assert again.errors == report.errors and again.vqa == report.vqa
    for number, task in enumerate(TASKS):
        found = evaluate.run(tmp_path / "run", task, frames=FRAMES)
        assert found.relative_error == pytest.approx(report.errors[-1][number], rel=1e-5)


def test_interrupted_and_resumed_it_ends_in_the_same_bytes(
    half: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(robots, "CALIBRATION_FRAMES", 6)  # measuring routers takes the most time
    assert_resumes(half("igsp"), tmp_path)


def test_an_exported_task_has_its_experts_added_in_float32(half: Make, tmp_path: Path) -> None:
    train.run(half("isolated-lora", lr=0.1), tmp_path / "run")
    run = robots.load_to_act(tmp_path / "run")
    for number, task in enumerate(TASKS):
        run.activate(number)
        demos = robots.robot_demos.load(
            run.recipe, number, run.model.backbone, run.out, lambda _: None
        )
        batch = demos.batch(demos.validation[:2], 4)
        noise = run.policies[number].draw_noise(2, torch.Generator().manual_seed(0))
        seen = batch.images, batch.instructions, batch.proprio, noise
        wanted = run.policies[number].act_from(*seen)
        merged = plain.policy(robots.load_to_act(tmp_path / "run"), number)
        assert {p.dtype for p in merged.parameters()} == {torch.float32}
        # The run computes in half precision, which rounds by up to 0.4 %.
        scale = wanted.abs().max()
        torch.testing.assert_close(
            merged.act_from(*seen) / scale, wanted / scale, rtol=0, atol=0.05
        )
        export.run(tmp_path / "run", tmp_path / task, task=task, dtype="float32")
        exported, _ = checkpoint.load_policy(tmp_path / task)
        torch.testing.assert_close(exported.act_from(*seen), merged.act_from(*seen))


# --- what is refused ------------------------------------------------------------------------------


def test_weights_that_all_learn_stay_wide(
    half: Make, tmp_path: Path, bad: Callable[..., str]
) -> None:
    (tmp_path / "robot.yaml").write_text(to_yaml(half("sequential")))
    says = ("train.weights: bf16 with train.method: sequential", "igsp or isolated-lora")
    bad("train", tmp_path / "robot.yaml", "--out", tmp_path / "run", says=says)


def test_the_embedded_backbone_stays_wide(real: Make, tmp_path: Path) -> None:
    with pytest.raises(AegisError, match=r"train\.weights: bf16 with the embedded backbone"):
        train.run(real("igsp", weights="bf16"), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_runs_that_began_before_there_was_the_key_are_the_same_runs(real: Make) -> None:
    assert "weights" not in recipes.training_part(real("igsp"))["train"]
    assert recipes.training_part(real("igsp", weights="bf16"))["train"]["weights"] == "bf16"
