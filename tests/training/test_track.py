"""Trackers get every line of metrics.jsonl, change nothing, and are refused if missing."""

from __future__ import annotations

import io
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from samples.training_runs import Start, assert_same_run, metrics, stop_at

from aegis_cli import recipes
from aegis_cli.common import media
from aegis_cli.common.errors import AegisError
from aegis_cli.evaluation import probe, rollout
from aegis_cli.recipes import Recipe
from aegis_cli.studies import pipeline
from aegis_cli.training import dry_run, track, train


def tracked(recipe: Recipe, *names: str) -> Recipe:
    return replace(recipe, train=replace(recipe.train, track=names))


class StandIn:
    """A tracker's module that records its calls."""

    def __init__(self) -> None:
        self.begun: dict[str, Any] = {}
        self.lines: list[tuple[int, dict[str, float]]] = []
        self.finished = False

    def init(self, **options: Any) -> SimpleNamespace:
        self.begun = options
        return SimpleNamespace(log=self.log, finish=self.finish)

    def log(self, figures: dict[str, float], step: int) -> None:
        self.lines.append((step, figures))

    def finish(self) -> None:
        self.finished = True


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Replace a tracker with the stand-in."""

    def put(name: str) -> StandIn:
        found = StandIn()
        monkeypatch.setitem(sys.modules, name, found)
        monkeypatch.setattr(track, "find_spec", lambda _: object())
        return found

    return put


@pytest.mark.parametrize("name", ["trackio", "wandb"])
def test_a_tracker_gets_every_line_of_the_log(
    name: str, stand_in: Any, recipe: Recipe, start: Start, tmp_path: Path
) -> None:
    tracker = stand_in(name)
    out = tmp_path / "job" / "naive"
    start("naive", out, recipe=tracked(recipe, name))
    lines = metrics(out)
    assert [{"step": step, **figures} for step, figures in tracker.lines] == lines
    assert tracker.finished and tracker.begun["name"] == "job-naive"
    assert tracker.begun["config"]["train"]["steps"] == recipe.train.steps
    assert not [key for key in tracker.begun["config"]["train"] if "leak" in key]  # retired
    assert {"loss", "lr_backbone", "data_s", "step_s"} <= {k for x in lines for k in x}


def test_weights_and_biases_stays_offline_unless_told(
    stand_in: Any, recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracker = stand_in("wandb")
    for told, mode in ((None, "offline"), ("online", "online")):
        monkeypatch.delenv("WANDB_MODE", raising=False)
        if told:
            monkeypatch.setenv("WANDB_MODE", told)
        with track.following(tracked(recipe, "wandb"), tmp_path, 0):
            assert tracker.begun["mode"] == mode and tracker.begun["dir"] == str(tmp_path)


def test_tensorboards_files_hold_the_log(recipe: Recipe, start: Start, tmp_path: Path) -> None:
    accumulators = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    start("aegis", tmp_path, recipe=tracked(recipe, "tensorboard"))
    events = accumulators.EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    lines = metrics(tmp_path)
    logged = {name for line in lines for name in line} - {"step"}
    assert set(events.Tags()["scalars"]) == logged and "energy_shed" in logged
    for name in logged:
        found = [(event.step, event.value) for event in events.Scalars(name)]
        expected = [(line["step"], line[name]) for line in lines if name in line]
        assert [step for step, _ in found] == [step for step, _ in expected]
        assert [value for _, value in found] == pytest.approx([value for _, value in expected])


@pytest.mark.parametrize("cut", [1, 3])  # before the first checkpoint, and after it
def test_tensorboard_shows_each_step_of_a_run_once_that_was_ended_and_begins_again(
    recipe: Recipe, start: Start, tmp_path: Path, cut: int
) -> None:
    accumulators = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    watched = tracked(recipe, "tensorboard")
    with pytest.raises(RuntimeError):
        start("naive", tmp_path, recipe=watched, on_event=stop_at(cut, RuntimeError("killed")))
    start("naive", tmp_path, recipe=watched, resume=True)
    track.tell(watched, tmp_path, "probe-scenes", {"accuracy": 0.5}, step=6)
    events = accumulators.EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [event.step for event in events.Scalars("loss")] == [1, 2, 3, 4, 5, 6]
    assert len(events.Scalars("probe-scenes/accuracy")) == 1


def test_a_tracked_run_has_the_same_weights_and_goes_on_untracked(
    stand_in: Any, recipe: Recipe, start: Start, naive_run: Path, tmp_path: Path
) -> None:
    tracker = stand_in("trackio")
    with pytest.raises(KeyboardInterrupt):
        watched = tracked(recipe, "trackio")
        start("naive", tmp_path, recipe=watched, on_event=stop_at(3, KeyboardInterrupt()))
    assert tracker.finished
    start("naive", tmp_path, resume=True)
    # Only the recipe at the start tells them apart.
    (tmp_path / "recipe.yaml").write_bytes((naive_run / "recipe.yaml").read_bytes())
    assert_same_run(tmp_path, naive_run)


def test_tracking_is_part_of_no_record(recipe: Recipe) -> None:
    watched = tracked(recipe, "wandb")
    assert recipes.training_part(watched) == recipes.training_part(recipe)
    assert recipes.changed(watched.train) == recipes.changed(recipe.train)


def test_a_missing_tracker_is_refused_before_any_work(
    recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)  # LeRobot's environment has it
    watched, out = tracked(recipe, "wandb"), tmp_path / "run"
    calls = (
        lambda: train.run(watched, "naive", tmp_path, None, out),
        lambda: dry_run.run(watched, "naive", tmp_path, None, out),
        lambda: pipeline.run(watched, out),
    )
    for call in calls:
        with pytest.raises(AegisError, match="wandb, which is not installed") as caught:
            call()
        assert "pip install wandb" in caught.value.fix and "aegis-vla[track]" in caught.value.fix
    assert not out.exists()


def test_another_name_is_no_tracker(aegis: Any, tmp_path: Path) -> None:
    path = tmp_path / "r.yaml"
    path.write_text("name: r\ntrain:\n  track: [mlflow]\n")
    code, _, err = aegis("inspect", path)
    assert code == 2 and "tensorboard, trackio, wandb" in err


# --- what is measured later -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def report() -> dict[str, Any]:
    """The parts of a probe and a rollout that trackers receive."""
    families = {"color": {"accuracy": 0.5, "questions": 4, "interval": [0.1, 0.9]}}
    return {"accuracy": 0.5, "passed": True, "drop_interval": [0.0, 1.0], "families": families}


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "x.mp4"
    frame = np.zeros((32, 32, 3), np.uint8)
    media.save_video([media.Clip("x", [media.Moment(frame, str(i)) for i in range(3)])], path)
    return path


@pytest.mark.parametrize("name", ["trackio", "wandb"])
def test_a_tracker_gets_figures_tables_and_videos(
    name: str, stand_in: Any, recipe: Recipe, report: dict[str, Any], video: Path, tmp_path: Path
) -> None:
    tracker = stand_in(name)
    tracker.Table = lambda columns, data: ("table", columns, data)
    tracker.Video = lambda path: ("video", path)
    shown = {**report, "video": str(video)}
    track.tell(tracked(recipe, name), tmp_path, "probe-scenes", shown, 6)
    ((step, found),) = tracker.lines
    assert step == 6 and tracker.finished
    assert found == {
        "probe-scenes/accuracy": 0.5,
        "probe-scenes/table": ("table", ["", "accuracy", "questions"], [["color", 0.5, 4]]),
        "probe-scenes/video": ("video", str(video)),
    }


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_tensorboard_shows_a_table_and_a_moving_image(
    suffix: str, recipe: Recipe, report: dict[str, Any], video: Path, tmp_path: Path
) -> None:
    accumulators = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    if suffix == ".gif":
        video.with_suffix(".gif").write_bytes(media.as_gif(video)[0])
    shown = {**report, "video": str(video.with_suffix(suffix))}
    track.tell(tracked(recipe, "tensorboard"), tmp_path, "probe", shown, 6)
    events = accumulators.EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert events.Scalars("probe/accuracy")[0].value == 0.5
    (text,) = events.Tensors("probe/table/text_summary")
    assert b"| color | 0.5 | 4 |" in text.tensor_proto.string_val[0]
    (image,) = events.Images("probe/video")
    assert image.encoded_image_string[:3] == b"GIF"
    with Image.open(io.BytesIO(image.encoded_image_string)) as moving:
        assert moving.n_frames > 1 and moving.size == (image.width, image.height)


def test_probes_and_rollouts_of_a_tracked_run_reach_its_tracker(
    stand_in: Any, recipe: Recipe, start: Start, tmp_path: Path
) -> None:
    tracker, out = stand_in("trackio"), tmp_path / "run"
    tracker.Table = lambda columns, data: data
    start("naive", out, recipe=tracked(recipe, "trackio"))
    tracker.lines.clear()
    rollout.run(out, None, 1, "seen", keep=True)
    probe.run(str(out), "scenes", 7, None, None, None, keep=True)
    steps, lines = zip(*tracker.lines, strict=True)
    assert set(steps) == {recipe.train.steps}
    assert "rollout-seen/success" in lines[0]
    assert len(lines[1]["probe-scenes/table"]) > 1


def test_a_run_is_measured_where_its_tracker_is_not_installed(
    recipe: Recipe, report: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(track, "find_spec", lambda _: None)
    track.tell(tracked(recipe, "wandb"), tmp_path, "probe", report, 6)
