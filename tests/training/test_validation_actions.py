"""Held-out actions predicted during training: their error is shown, and training is unchanged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from samples import lerobot
from samples.graphs import compiled_graphs
from samples.training_runs import (
    SETTINGS,
    STEPS,
    TIMES,
    Start,
    Told,
    assert_resumes,
    metrics,
    stop_at,
    told,
)

from aegis_cli import recipes
from aegis_cli.common import files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Progress
from aegis_cli.common.ranks import Ranks
from aegis_cli.evaluation import kept_figures, open_loop
from aegis_cli.evaluation.open_loop import OpenLoopReport
from aegis_cli.inspection import folders
from aegis_cli.recipes import Kfac, Recipe
from aegis_cli.reporting import gather
from aegis_cli.training import checkpoint, dry_run, train, validation_actions

COUNT = 9
FIGURES = {"action_error", "action_error_low", "action_error_high"}
PREDICTING = replace(SETTINGS, validate_actions=COUNT, validation_share=0.4)


@pytest.fixture(scope="module")
def predicting(recipe: Recipe) -> Recipe:
    """A proximal step of `kfac` covers four steps, and a validation falls within them."""
    return replace(recipe, train=PREDICTING, kfac=Kfac(every=4))


def without(recipe: Recipe) -> Recipe:
    return replace(recipe, train=replace(recipe.train, validate_actions=None))


def of_report(report: OpenLoopReport) -> dict[str, float]:
    """The figures from `aegis evaluate`'s report that are in a line of metrics."""
    assert report.relative_error is not None and report.relative_interval is not None
    low, high = report.relative_interval
    found = {
        "action_error": report.relative_error,
        "action_error_low": low,
        "action_error_high": high,
    }
    return found if report.hold_error is None else found | {"action_hold": report.hold_error}


def of_metrics(line: dict[str, float]) -> dict[str, float]:
    return {name: value for name, value in line.items() if name.startswith("action_")}


@pytest.fixture(scope="module")
def predicting_run(
    predicting: Recipe, start: Start, tmp_path_factory: pytest.TempPathFactory
) -> Told:
    """A run of `naive` that predicts."""
    return told(start, "naive", predicting, tmp_path_factory.mktemp("predicting") / "run")


@pytest.mark.parametrize("method", ["naive", "kfac", "lora"])
def test_training_does_not_notice_them(
    method: str, predicting: Recipe, predicting_run: Told, start: Start, tmp_path: Path
) -> None:
    predicts, plain = tmp_path / "predicts", tmp_path / "plain"
    if method == "naive":
        predicts = predicting_run.out
    else:
        start(method, predicts, recipe=predicting)
    start(method, plain, recipe=without(predicting))
    assert metrics(predicts, TIMES | FIGURES) == metrics(plain, TIMES)
    for name in ("backbone/model.safetensors", "expert.safetensors"):
        one, other = (checkpoint.last(run) / name for run in (predicts, plain))
        assert one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize(
    ("method", "changes"),
    [
        ("naive", {}),
        ("naive", {"ema_decay": 0.6}),
        ("naive", {"normalization": "quantiles"}),
        # More than exist: `aegis evaluate` takes all of them too.
        ("naive", {"validate_actions": 10_000}),
        # Its terms are merged, and averaged.
        ("lora", {}),
        ("lora", {"ema_decay": 0.6}),
    ],
    ids=str,
)
def test_the_figures_are_those_of_evaluate_on_the_checkpoint(
    method: str,
    changes: dict[str, Any],
    predicting: Recipe,
    start: Start,
    demos_file: Path,
    tmp_path: Path,
) -> None:
    settings = replace(PREDICTING, checkpoint_every=3, **changes)
    start(method, tmp_path / "run", recipe=replace(predicting, train=settings))
    count, lines = settings.validate_actions, metrics(tmp_path / "run")
    early = open_loop.run(tmp_path / "run" / "checkpoints" / "000003", demos_file, frames=count)
    late = open_loop.run(tmp_path / "run", demos_file, frames=count)
    assert late.split == "validation" and len(late.episodes) > 1
    assert of_metrics(lines[2]) == pytest.approx(of_report(early), rel=1e-4)
    assert of_metrics(lines[-1]) == pytest.approx(of_report(late), rel=1e-4)
    assert early.relative_error != pytest.approx(late.relative_error, rel=1e-3)


@pytest.mark.usefixtures("frame_cache")
@pytest.mark.parametrize("relative", [False, True], ids=["absolute", "relative"])
def test_a_real_robot_has_its_position_beside_them(
    relative: bool, predicting: Recipe, start: Start, tmp_path: Path
) -> None:
    """Its actions are positions; a policy of actions relative to them is compared the same way."""
    demos = tmp_path / "arm"
    lerobot.save(demos, lerobot.episodes(6, texts=lerobot.READABLE), action_names=("x", "z"))
    own = replace(predicting, train=replace(PREDICTING, relative_actions=relative))
    report = start("naive", tmp_path / "run", recipe=own, demos=demos)
    found = open_loop.run(tmp_path / "run", demos, frames=COUNT)
    line = metrics(tmp_path / "run")[-1]
    assert of_metrics(line) == pytest.approx(of_report(found), rel=1e-4)
    assert line["action_hold"] == found.hold_error
    assert report.validation_actions == {
        "relative_error": line["action_error"],
        "relative_interval": [line["action_error_low"], line["action_error_high"]],
        "hold_error": line["action_hold"],
    }


@pytest.mark.parametrize(
    "changes",
    [{"weights": "bf16-master"}, {"weights": "bf16-master", "freeze": "vision"}],
    ids=str,
)
def test_models_of_the_hub_predict_too(
    changes: dict[str, Any],
    predicting: Recipe,
    start: Start,
    demos_file: Path,
    hf_folder: Callable[[str], Path],
    tmp_path: Path,
) -> None:
    settings = replace(PREDICTING, steps=2, validate_every=2, **changes)
    own = replace(predicting, backbone=str(hf_folder("smolvlm")), train=settings)
    start("naive", tmp_path / "run", recipe=own, anchor=None)
    start("naive", tmp_path / "plain", recipe=without(own), anchor=None)
    for name in ("backbone/model.safetensors", "expert.safetensors"):
        one, other = (checkpoint.last(tmp_path / run) / name for run in ("run", "plain"))
        assert one.read_bytes() == other.read_bytes()
    found = open_loop.run(tmp_path / "run", demos_file, frames=COUNT)
    assert of_metrics(metrics(tmp_path / "run")[-1]) == pytest.approx(of_report(found), rel=1e-3)


# While tracing a graph, torch.compile accesses a field for which PyTorch warns.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
def test_nothing_is_compiled_for_predictions(
    predicting: Recipe,
    start: Start,
    demos_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nor for later steps or validations: everything is compiled before the first of these."""
    graphs, before = compiled_graphs(monkeypatch), []
    figures = validation_actions.ValidationActions.figures

    def noted(*given: Any) -> dict[str, float]:
        before.append(len(graphs))
        return figures(*given)

    monkeypatch.setattr(validation_actions.ValidationActions, "figures", noted)
    settings = replace(PREDICTING, steps=2, validate_every=1, compile=True)
    compiling = replace(predicting, train=settings)
    torch._dynamo.reset()  # an earlier test's graphs would also be used
    start("naive", tmp_path / "run", recipe=compiling)
    assert before == [len(graphs)] * 2 and graphs
    found = open_loop.run(tmp_path / "run", demos_file, frames=COUNT)
    assert of_metrics(metrics(tmp_path / "run")[-1]) == pytest.approx(of_report(found), rel=1e-4)


def test_they_are_predicted_with_every_validation_loss_and_no_other_time(
    predicting_run: Told,
) -> None:
    events, lines = predicting_run.events, metrics(predicting_run.out)
    for line in lines:
        assert ("validation_loss" in line) == FIGURES.issubset(line)
    shown = [e for e in events if isinstance(e, Progress) and e.stage == "actions"]
    # Those of the first time; it was short, so later ones would only add two lines each to a log.
    assert [e.done for e in shown] == sorted(e.done for e in shown) and shown[-1].done == COUNT
    said = [e.metrics for e in events if isinstance(e, Progress) and e.stage == "train"][-1]
    assert said["action error"] == lines[-1]["action_error"]


def test_predictions_that_took_long_are_shown_again(
    predicting: Recipe, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train, "_LONG_S", 0.0)
    events: list[Event] = []
    start("naive", tmp_path / "run", recipe=predicting, on_event=events.append)
    ends = [e for e in events if isinstance(e, Progress) and e.stage == "actions"]
    assert [e.done == e.total for e in ends].count(True) == STEPS // SETTINGS.validate_every


def test_a_run_goes_on_with_the_same_frames(
    predicting: Recipe, predicting_run: Told, start: Start, tmp_path: Path
) -> None:
    whole = predicting_run.out
    assert_resumes(start, "naive", predicting, tmp_path, whole)
    events: list[Event] = []
    cut = tmp_path / "cut"
    report = start("naive", cut, recipe=predicting, resume=True, on_event=events.append)
    # A finished run reports its figures and predicts nothing.
    assert not [e for e in events if getattr(e, "stage", "") == "actions"]
    assert report.validation_actions["relative_error"] == metrics(whole)[-1]["action_error"]


def test_a_run_may_begin_or_cease_to_predict_when_it_goes_on(
    predicting: Recipe, predicting_run: Told, start: Start, tmp_path: Path
) -> None:
    with pytest.raises(KeyboardInterrupt):
        stop = stop_at(4, KeyboardInterrupt())
        start("naive", tmp_path / "run", recipe=without(predicting), on_event=stop)
    start("naive", tmp_path / "run", recipe=predicting, resume=True)
    one, other = (metrics(out, TIMES)[-1] for out in (tmp_path / "run", predicting_run.out))
    assert one == other
    kept = recipes.load(tmp_path / "run" / "recipe.yaml", kind=Recipe)
    assert kept.train.validate_actions == COUNT


def test_inspect_and_the_page_tell_them(predicting_run: Told, tmp_path: Path) -> None:
    run, report = predicting_run.out, predicting_run.report
    found = folders.inspect(run)
    assert found.facts["validation_actions"] == report.validation_actions
    early = folders.inspect(run / "checkpoints" / "000004")
    line = metrics(run)[SETTINGS.validate_every - 1]
    assert early.facts["validation_actions"]["relative_error"] == line["action_error"]
    # `aegis run` keeps the report, and reads it later for its page.
    files.save_json(tmp_path / "train.json", report.to_json())
    kept = kept_figures.read(tmp_path / "train.json", kept_figures.TrainFigures)
    assert kept["validation_actions"] == report.validation_actions
    drawn = gather.run_document(run).metrics
    assert [at["step"] for at in drawn if "action_error" in at] == [3, STEPS]


def test_one_process_predicts_and_the_others_are_told(
    predicting: Recipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Ranks, "_told", lambda *_: {"action_error": 0.5})
    monkeypatch.setattr(validation_actions, "predict", lambda *_: pytest.fail("predicted"))
    nobody: Any = None
    second = validation_actions.ValidationActions(nobody, torch.arange(3), np.ones(2), 4)
    assert second.figures(nobody, Ranks(1, 2), lambda _: None) == {"action_error": 0.5}


def test_one_episode_has_no_interval() -> None:
    line = {"action_error": 0.5, "action_hold": 0.75}
    told = {"relative_error": 0.5, "hold_error": 0.75, "relative_interval": None}
    assert validation_actions.of_line(line) == told
    assert validation_actions.of_line({"step": 3, "loss": 1.0}) == {}


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.usefixtures("frame_cache")
def test_actions_that_never_vary_are_refused_before_the_first_step(
    predicting: Recipe, start: Start, tmp_path: Path
) -> None:
    demos = tmp_path / "arm"
    still = lerobot.episodes(6, texts=lerobot.READABLE)
    for episode in still:
        episode.actions[:] = 1.0
    lerobot.save(demos, still)
    with pytest.raises(AegisError, match="train.validate_actions: 9 with actions that never vary"):
        start("naive", tmp_path / "run", recipe=predicting, demos=demos)
    assert not (tmp_path / "run" / "recipe.yaml").exists()
    with pytest.raises(AegisError, match="never vary"):
        dry_run.run(predicting, "naive", demos, None, tmp_path / "run")


def test_no_record_of_earlier_work_knows_the_key(predicting: Recipe) -> None:
    assert recipes.training_part(predicting) == recipes.training_part(without(predicting))
    assert "validate_actions" not in recipes.recorded(without(predicting).train)
