"""Settings that may change when a run is resumed, because they change no step but by rounding."""

from __future__ import annotations

import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.training_runs import SETTINGS, STEPS, Start, contents, metrics, stop_at
from torch import nn

from aegis_cli import recipes
from aegis_cli.common import artifacts, interrupts
from aegis_cli.common.errors import AegisError, Diverged
from aegis_cli.common.events import Event, OnEvent, Progress, Warned
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.recipes import Recipe
from aegis_cli.training import checkpoint, folder, loading, step


def cut(start: Start, method: str, out: Path, **changes: Any) -> None:
    """A run that is killed after step 3, so that its last checkpoint is that of step 2."""
    with pytest.raises(KeyboardInterrupt):
        start(method, out, on_event=stop_at(3, KeyboardInterrupt()), **changes)


def signal_at(done: int) -> OnEvent:
    def on_event(event: Event) -> None:
        if isinstance(event, Progress) and (event.stage, event.done) == ("train", done):
            signal.raise_signal(signal.SIGTERM)

    return on_event


def texts(told: list[Event]) -> list[str]:
    return [event.text for event in told if isinstance(event, Warned)]


def last_bytes(out: Path) -> dict[str, bytes | str]:
    return {name: value for name, value in contents(out).items() if f"/{STEPS:06d}/" in name}


@pytest.mark.parametrize(
    "changes", [{"log_every": 4}, {"validate_every": 2, "checkpoint_every": 3}], ids=str
)
def test_what_is_written_how_often_may_change_and_no_weight_does(
    changes: dict[str, int], naive_run: Path, start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    cut(start, "naive", run)
    other = replace(recipe, train=replace(SETTINGS, **changes))
    told: list[Event] = []
    start("naive", run, recipe=other, resume=True, on_event=told.append)
    (said,) = texts(told)
    for name, value in changes.items():
        assert f"train.{name}: {value} instead of {getattr(SETTINGS, name)}" in said
    assert "from those of an uninterrupted run" in said
    assert recipes.load(run / "recipe.yaml").train == replace(other.train, method="naive")
    assert last_bytes(run) == last_bytes(naive_run)
    start("naive", run, recipe=other, resume=True, on_event=told.append)
    assert len(texts(told)) == 1  # the run's own by now


@pytest.mark.parametrize("method", ["naive", "nullspace"])
def test_passes_may_change_where_their_gradients_add_up(
    method: str, whole_run: Callable[[str], Path], start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    cut(start, method, tmp_path)
    other = replace(recipe, train=replace(SETTINGS, accumulate=2))
    told: list[Event] = []
    start(method, tmp_path, recipe=other, resume=True, on_event=told.append)
    assert "train.accumulate: 2 instead of 1. This changes memory" in texts(told)[0]
    wanted = artifacts.load(checkpoint.last(whole_run(method)) / checkpoint.STATE).tensors
    found = artifacts.load(checkpoint.last(tmp_path) / checkpoint.STATE).tensors
    for name in wanted:
        if name.startswith("weight."):
            torch.testing.assert_close(found[name], wanted[name], rtol=1e-3, atol=1e-4, msg=name)


def test_a_key_without_effect_may_change_and_nothing_is_said(
    naive_run: Path, start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    cut(start, "naive", tmp_path, recipe=replace(recipe, train=replace(SETTINGS, leak_every=3)))
    told: list[Event] = []
    start("naive", tmp_path, resume=True, on_event=told.append)
    assert texts(told) == [] and last_bytes(tmp_path) == last_bytes(naive_run)


@pytest.mark.parametrize("method", ["aegis", "distill", "insulate", "cotrain"])
def test_passes_stay_where_a_method_reads_what_is_in_one(
    method: str, start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    cut(start, method, tmp_path)
    before = contents(tmp_path)
    other = replace(recipe, train=replace(SETTINGS, accumulate=2))
    with pytest.raises(AegisError, match="other settings: train.accumulate: 1 there, 2 here"):
        start(method, tmp_path, recipe=other, resume=True)
    assert contents(tmp_path) == before


def test_passes_stay_where_the_backbone_normalises_over_one(
    start: Start, recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load = loading.backbones.load

    def with_averages(name: str) -> Backbone:
        backbone = load(name)
        backbone.stem.norm = nn.BatchNorm2d(3)
        backbone.stem.register_forward_pre_hook(lambda stem, given: stem.norm(*given))
        return backbone

    monkeypatch.setattr(loading.backbones, "load", with_averages)
    cut(start, "naive", tmp_path, anchor=None)
    other = replace(recipe, train=replace(SETTINGS, accumulate=2))
    before = contents(tmp_path) | {"log": (tmp_path / folder.METRICS).read_bytes()}
    with pytest.raises(AegisError, match="normalises over the frames of a pass"):
        start("naive", tmp_path, anchor=None, recipe=other, resume=True)
    assert contents(tmp_path) | {"log": (tmp_path / folder.METRICS).read_bytes()} == before
    start("naive", tmp_path, anchor=None, resume=True)


def test_a_run_that_has_ended_keeps_the_settings_that_it_was_trained_with(
    naive_run: Path, start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    run = Path(shutil.copytree(naive_run, tmp_path / "run", symlinks=True))
    told: list[Event] = []
    other = replace(recipe, train=replace(SETTINGS, accumulate=2, log_every=4))
    start("naive", run, recipe=other, resume=True, on_event=told.append)
    assert texts(told) == [] and contents(run) == contents(naive_run)


def test_a_run_that_is_made_longer_may_change_them_too(
    naive_run: Path, start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    run = Path(shutil.copytree(naive_run, tmp_path / "run", symlinks=True))
    longer = replace(SETTINGS, steps=STEPS + 2, accumulate=2)
    assert start("naive", run, recipe=replace(recipe, train=longer), resume=True).steps == STEPS + 2
    assert recipes.load(run / "recipe.yaml").train.accumulate == 2


def test_a_line_that_was_not_due_before_is_not_missed(
    start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    """After three steps without a line, a run may write them more often, and be killed again."""
    rare = replace(SETTINGS, log_every=5, validate_every=5, checkpoint_every=5)
    with pytest.raises(interrupts.Stopped), interrupts.listening():
        start("naive", tmp_path, recipe=replace(recipe, train=rare), on_event=signal_at(3))
    assert metrics(tmp_path) == []
    often = replace(recipe, train=replace(rare, log_every=2))
    with pytest.raises(KeyboardInterrupt):  # before the next step
        stop = stop_at(3, KeyboardInterrupt())
        start("naive", tmp_path, recipe=often, resume=True, on_event=stop)
    assert metrics(tmp_path) == [] and recipes.load(tmp_path / "recipe.yaml").train.log_every == 2
    start("naive", tmp_path, recipe=often, resume=True)
    assert [line["step"] for line in metrics(tmp_path)] == [4, 5, 6]


def test_nor_after_a_step_that_was_not_finite(
    start: Start, recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rare = replace(SETTINGS, log_every=5, validate_every=5, checkpoint_every=5)
    often = replace(recipe, train=replace(rare, log_every=2))
    compute = step.compute_gradients

    def spoil(*args: Any, index: int, **options: Any) -> step.StepGradients:
        result = compute(*args, index=index, **options)
        return replace(result, loss=torch.tensor(float("nan"))) if index == 3 else result

    with monkeypatch.context() as patched:
        patched.setattr(step, "compute_gradients", spoil)
        with pytest.raises(Diverged):
            start("naive", tmp_path, recipe=replace(recipe, train=rare))
        for _ in range(2):
            with pytest.raises(Diverged):
                start("naive", tmp_path, recipe=often, resume=True)
    start("naive", tmp_path, recipe=often, resume=True)
    assert [line["step"] for line in metrics(tmp_path)] == [4, 5, 6]


def test_a_log_that_was_lost_is_still_missed(start: Start, tmp_path: Path) -> None:
    cut(start, "naive", tmp_path)
    (tmp_path / folder.METRICS).write_text("")
    with pytest.raises(AegisError, match="an empty metrics.jsonl"):
        start("naive", tmp_path, resume=True)
