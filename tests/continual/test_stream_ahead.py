"""Batches of a robot stream that threads prepare for a GPU: the same results, and no step waits.

Without a GPU, the CPU is taken for one, or the stand-in `samples.second_device` runs the commands.
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from samples import processes
from samples.interrupted import stop
from samples.lerobot import frame_cache  # noqa: F401
from samples.own_robots import TASKS
from samples.robots import STEPS, Make
from samples.second_device import NAME, POSSIBLE, said_there
from samples.training_runs import contents, metrics

from aegis_cli import recipes
from aegis_cli.common import devices, prefetch
from aegis_cli.common.events import Event, Warned
from aegis_cli.continual import dry_run, loop, robots, train
from aegis_cli.models.backbones.embedded import EmbeddedVLM
from aegis_cli.recipes import RobotStreamRecipe, to_yaml

pytestmark = pytest.mark.usefixtures("frame_cache")

METHODS = ("igsp", "sequential")
STEP = "training a step"


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take the CPU for a GPU, for which batches are prepared."""
    monkeypatch.setattr(devices, "reading_stalls", lambda _: True)


@pytest.fixture
def processed(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """The thread in which each batch is processed, and its frames; `STEP` within a step."""
    found: list[tuple[str, int]] = []
    process, take, within = EmbeddedVLM.process, loop.take, threading.local()

    def noted(self: EmbeddedVLM, images: Any, prompts: Any) -> Any:
        place = STEP if getattr(within, "step", False) else threading.current_thread().name
        found.append((place.split("_")[0], len(prompts)))
        return process(self, images, prompts)

    def taken(*given: Any) -> float:
        within.step = True
        try:
            return take(*given)
        finally:
            within.step = False

    monkeypatch.setattr(EmbeddedVLM, "process", noted)
    monkeypatch.setattr(loop, "take", taken)
    return found


# --- the same results -----------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("accumulate", [1, 3])
def test_threads_prepare_every_step_for_the_same_bytes(
    method: str,
    accumulate: int,
    real: Make,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    processed: list[tuple[str, int]],
) -> None:
    recipe = real(method, accumulate=accumulate, augment=("brightness", "affine"), workers=3)
    train.run(recipe, tmp_path / "cpu")
    assert [place for place, _ in processed].count(STEP) >= 2 * STEPS * accumulate
    processed.clear()
    monkeypatch.setattr(devices, "reading_stalls", lambda _: True)
    train.run(recipe, tmp_path / "gpu")
    assert contents(tmp_path / "gpu") == contents(tmp_path / "cpu")
    assert all(place != STEP for place, _ in processed)
    sizes = [frames for place, frames in processed if place == "prefetch"]
    assert sum(sizes) >= 2 * STEPS * 4 and max(sizes[: STEPS * accumulate]) == -(-4 // accumulate)


@pytest.mark.usefixtures("gpu")
def test_routers_are_measured_on_frames_that_are_processed_once(
    real: Make, tmp_path: Path, processed: list[tuple[str, int]]
) -> None:
    run = robots.build(real("igsp", accumulate=2), tmp_path / "run")
    training = dry_run._Begun.at(run, 0).training
    before = len(processed)
    flows = [loop.measure(run, training) for _ in range(2)]
    assert len(processed) == before
    for name, found in flows[0].items():
        assert torch.equal(found.mass, flows[1][name].mass)


@pytest.mark.skipif(not POSSIBLE, reason="this torch takes no device of others' making")
@pytest.mark.parametrize("method", METHODS)
def test_a_stream_on_another_device_takes_the_same_steps(
    method: str, real: Make, tmp_path: Path
) -> None:
    recipe = real(method, accumulate=2, workers=2)
    recipe = dataclasses.replace(recipe, probe=dataclasses.replace(recipe.probe, questions=2))
    told = {}
    for device in ("cpu", NAME):
        folder = tmp_path / device
        folder.mkdir()
        (folder / "robot.yaml").write_text(to_yaml(recipe))
        command = ["train", "robot.yaml", "--out", "run", "--json"]
        if device == "cpu":
            train.run(recipe, folder / "run")
        else:
            processes.alone(said_there, folder, [command], device, "embedded")
        told[device] = metrics(folder / "run", {"seconds", "data_s"})
    assert len(told["cpu"]) == len(told[NAME]) == 2 * (STEPS + 1)
    for own, other in zip(told["cpu"], told[NAME], strict=True):
        assert other == pytest.approx(own, rel=1e-3, abs=1e-6)


# --- the key --------------------------------------------------------------------------------------


@pytest.mark.usefixtures("gpu")
def test_as_many_threads_prepare_as_the_recipe_says(
    real: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []
    workers = prefetch.workers
    monkeypatch.setattr(prefetch, "workers", lambda: asked.append(workers()) or asked[-1])
    train.run(real("igsp", workers=5), tmp_path / "run")
    assert dry_run.run(real("igsp", workers=5), tmp_path / "other").workers == 5
    assert set(asked) == {5}


def test_a_run_goes_on_with_another_number_of_threads(real: Make, tmp_path: Path) -> None:
    train.run(real("igsp"), tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        train.run(
            real("igsp", workers=1),
            tmp_path / "run",
            on_event=partial(stop, f"task 1 {TASKS[0]}", 3),
        )
    train.run(real("igsp", workers=2), tmp_path / "run", resume=True)
    found, whole = contents(tmp_path / "run"), contents(tmp_path / "whole")
    assert found.pop("recipe.yaml") != whole.pop("recipe.yaml") and found == whole
    assert recipes.training_part(real("igsp", workers=2)) == recipes.training_part(real("igsp"))


def test_the_log_says_how_long_steps_waited(
    real: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow_s = 0.2
    fetch = slower(robots.FlowMatchingLoss.fetch, slow_s)
    monkeypatch.setattr(robots.FlowMatchingLoss, "fetch", fetch)
    train.run(real("isolated-lora", log_every=3), tmp_path / "run")
    lines = [line for line in metrics(tmp_path / "run") if "loss" in line]
    assert len(lines) == 2 * STEPS // 3
    assert all(0 <= line["data_s"] <= line["seconds"] for line in lines)
    # Nothing can be done while the first batch of a task is fetched.
    assert all(line["data_s"] > 0.9 * slow_s for line in lines if line["step"] == 3)


# --- the dry run ----------------------------------------------------------------------------------


def slower(real: Callable[..., Any], seconds: float) -> Callable[..., Any]:
    def slowly(*given: Any) -> Any:
        threading.Event().wait(seconds)
        return real(*given)

    return slowly


@pytest.mark.usefixtures("gpu")
@pytest.mark.parametrize("slow_s", [0.0, 0.4])
def test_a_dry_run_says_if_steps_wait_for_their_batches(
    slow_s: float, real: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if slow_s:
        monkeypatch.setattr(EmbeddedVLM, "process", slower(EmbeddedVLM.process, slow_s))
    else:
        monkeypatch.setattr(loop, "take", slower(loop.take, 0.3))
    notes: list[Event] = []
    recipe: RobotStreamRecipe = real("isolated-lora", steps=12, workers=2)
    found = dry_run.run(recipe, tmp_path / "run", on_event=notes.append)
    told = [e.text for e in notes if isinstance(e, Warned) and "train.workers" in e.text]
    assert len(told) == (1 if slow_s else 0)
    for task in found.tasks.values():
        step_s, data_s, prepare_s = (task[name] for name in dry_run.Timed._fields)
        assert step_s is not None and data_s is not None and prepare_s is not None
        assert prepare_s >= slow_s
        if slow_s:
            # Two threads prepare two batches in that time.
            assert 0.7 * slow_s / 2 < step_s < slow_s and 0.2 * step_s < data_s < step_s


def test_on_a_cpu_no_thread_prepares(real: Make, tmp_path: Path) -> None:
    found = dry_run.run(real("igsp"), tmp_path / "run")
    assert found.workers is None
    for task in found.tasks.values():
        step_s, data_s, prepare_s = (task[name] or 0.0 for name in dry_run.Timed._fields)
        assert 0 <= data_s < step_s and prepare_s > 0
