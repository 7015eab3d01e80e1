"""Open-loop errors: their values for known predictions, and the episodes they are taken on."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import torch
from samples import lerobot
from samples.training_runs import SETTINGS

from aegis_cli import inspection
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Warned
from aegis_cli.data import demonstrations, record
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.data.selection import Selection
from aegis_cli.evaluation import open_loop, results
from aegis_cli.evaluation.open_loop import OpenLoopReport
from aegis_cli.models import lerobot_folder
from aegis_cli.models.policy import Policy
from aegis_cli.publishing import export
from aegis_cli.publishing.card import AEGIS, LEROBOT
from aegis_cli.recipes import Demos, Recipe
from aegis_cli.training import checkpoint, train

FORMS = (AEGIS, LEROBOT)
CHUNK = 3
LENGTHS = (4, 2, 5)


def recorded(names: tuple[str, ...] = (), positions: tuple[str, ...] = ()) -> Demonstrations:
    """Three episodes of two actions each; the second action never changes."""
    count = sum(LENGTHS)
    starts = torch.tensor([0, *LENGTHS]).cumsum(0)
    actions = torch.stack([torch.arange(count) ** 2 / 10.0, torch.full((count,), 7.0)], dim=1)
    tensors = {"proprio": actions + 0.5, "actions": actions, "episode_starts": starts}
    episode_of = torch.repeat_interleave(torch.arange(3), torch.tensor(LENGTHS))
    every = torch.arange(count)
    task_of = torch.zeros(count, dtype=torch.int64)
    return Demonstrations(
        None,
        (torch.zeros(count, 64, 64, 3, dtype=torch.uint8),),
        tensors,
        ["go"],
        task_of,
        episode_of,
        every,
        every,
        "",
        action_names=names,
        proprio_names=positions,
    )


EVERY = torch.arange(sum(LENGTHS))
SPREAD = np.array([2.0, 0.0])  # in training, where the second action never changed either


def entries(shown: Demonstrations) -> np.ndarray:
    """The first action of all steps of all chunks that lie within their episodes."""
    actions, is_pad = shown.chunks(EVERY, CHUNK)
    return actions[..., 0][~is_pad].double().numpy()


def test_exact_predictions_have_no_error() -> None:
    shown = recorded()
    found = open_loop.compare(shown, EVERY, shown.chunks(EVERY, CHUNK)[0], SPREAD)
    assert found.relative_error == 0 and [d.rmse for d in found.dimensions] == [0, 0]
    assert [d.mae for d in found.dimensions] == [0, 0]
    assert {step.relative_error for step in found.horizon} == {0}


def test_the_trainings_mean_action_has_a_relative_error_of_one_on_what_was_trained_on() -> None:
    shown = recorded()
    trained = shown.tensors["actions"].double()
    found = open_loop.compare(
        shown, EVERY, trained.mean(0).expand(len(EVERY), 1, 2), np.array(shown.action_std)
    )
    first, still = found.dimensions
    assert found.relative_error == pytest.approx(1) and first.relative_error == pytest.approx(1)
    assert first.rmse == pytest.approx(trained[:, 0].std(unbiased=False)) == first.training_std
    assert still.relative_error is None and still.training_std == 0  # it never varied


def test_an_action_that_rests_in_the_evaluated_frames_weighs_no_more_than_another() -> None:
    """The error of one held-out episode is in units of all training data."""
    shown = recorded()
    actions, _ = shown.chunks(EVERY, CHUNK)
    found = open_loop.compare(shown, EVERY, actions + 0.5, np.array([2.0, 1.0]))
    moved, rested = found.dimensions
    assert rested.constant_rmse == 0 and rested.relative_error == pytest.approx(0.25)
    assert moved.relative_error == pytest.approx(0.0625)
    assert found.relative_error == pytest.approx((0.25 + 0.0625) / 2)


def test_errors_are_those_of_the_definition() -> None:
    shown = recorded()
    actions, is_pad = shown.chunks(EVERY, CHUNK)
    off = torch.randn(actions.shape, generator=torch.Generator().manual_seed(0))
    found = open_loop.compare(shown, EVERY, actions + off, SPREAD)
    first = found.dimensions[0]
    own = (actions + off - actions)[..., 0].double()[~is_pad].numpy()
    assert first.mae == pytest.approx(np.abs(own).mean(), rel=1e-5)
    assert first.rmse == pytest.approx(np.sqrt((own**2).mean()), rel=1e-5)
    assert first.relative_error == pytest.approx((own**2).mean() / SPREAD[0] ** 2, rel=1e-5)
    assert first.constant_rmse == pytest.approx(entries(shown).std(), rel=1e-5)
    low, high = found.relative_interval
    assert low < found.relative_error < high


def test_what_lies_past_an_episodes_end_does_not_count() -> None:
    shown = recorded()
    actions, is_pad = shown.chunks(EVERY, CHUNK)
    wild = torch.where(is_pad[..., None], torch.tensor(1e6), actions)
    found = open_loop.compare(shown, EVERY, wild, SPREAD)
    assert found.relative_error == 0
    assert [s.frames for s in found.horizon] == [11, 8, 5] == (~is_pad).sum(0).tolist()


def test_a_step_that_no_episode_is_long_enough_for_is_left_out() -> None:
    shown = recorded()
    at = torch.tensor([4, 5])  # the episode of two frames
    found = open_loop.compare(shown, at, shown.chunks(at, CHUNK)[0], SPREAD)
    assert [s.step for s in found.horizon] == [1, 2]
    assert len(found.dimensions[0].rmse_by_step) == 2
    assert found.relative_interval is None and found.episodes == [1]


def test_the_control_rate_is_that_of_the_demonstrations(own_run: Path, demos_file: Path) -> None:
    predicted = recorded().chunks(EVERY, CHUNK)[0]
    for fps in (None, 30.0):
        shown = dataclasses.replace(recorded(), fps=fps)
        assert open_loop.compare(shown, EVERY, predicted, SPREAD).fps == fps
    known = demonstrations.load(demos_file, None, 0).fps
    assert known is not None
    assert open_loop.run(own_run, demos_file).to_json()["fps"] == known


@pytest.mark.parametrize(
    ("names", "positions", "held"),
    [
        (("a.pos", "b.pos"), ("a.pos", "b.pos"), True),
        (("dx", "dy"), ("x", "y"), False),
        (("", ""), ("", ""), False),
        ((), (), False),
        (("axes",), ("axes",), False),  # one name stands for all
        (("a.pos", "a.pos"), ("a.pos", "a.pos"), True),  # of two arms
    ],
)
def test_the_current_position_is_compared_with_where_actions_are_positions(
    names: tuple[str, ...], positions: tuple[str, ...], held: bool
) -> None:
    shown = recorded(names, positions)
    found = open_loop.compare(shown, EVERY, shown.chunks(EVERY, CHUNK)[0], SPREAD)
    assert (found.hold_error is not None) == held
    assert all((d.hold_rmse is not None) == held for d in found.dimensions)
    if held:
        assert found.dimensions[1].hold_rmse == pytest.approx(0.5)


@pytest.mark.parametrize("order", [[0, 1, 2, 3], [3, 1, 2, 0]])
def test_a_robot_may_tell_more_than_the_positions_that_actions_take(order: list[int]) -> None:
    names = ("a.pos", "b.pos", "effort.a", "effort.b")
    shown = recorded(("a.pos", "b.pos"), tuple(names[i] for i in order))
    positions = shown.tensors["proprio"]
    more = torch.cat([positions, torch.full_like(positions, 100.0)], dim=1)[:, order]
    shown = dataclasses.replace(shown, tensors={**shown.tensors, "proprio": more})
    found = open_loop.compare(shown, EVERY, shown.chunks(EVERY, CHUNK)[0], SPREAD)
    alone = recorded(("a.pos", "b.pos"), ("a.pos", "b.pos"))
    expected = open_loop.compare(alone, EVERY, alone.chunks(EVERY, CHUNK)[0], SPREAD)
    assert found.hold_error == expected.hold_error is not None
    assert found.dimensions[1].hold_rmse == pytest.approx(0.5)


@pytest.mark.parametrize(("error", "warned"), [(0.2, False), (0.25, True), (0.6, True)])
def test_a_policy_that_is_no_better_than_standing_still_is_told(error: float, warned: bool) -> None:
    names = ("a.pos", "b.pos")
    found = open_loop.compare(
        recorded(names, names), EVERY, recorded().chunks(EVERY, CHUNK)[0], SPREAD
    )
    seen: list[Event] = []
    report = dataclasses.replace(found, relative_error=error, hold_error=0.25)
    open_loop._warn_of_standing_still(report, seen.append)
    open_loop._warn_of_standing_still(dataclasses.replace(report, hold_error=None), seen.append)
    assert len(seen) == warned


@pytest.mark.parametrize(("factor", "warned"), [(1.0, False), (5.0, False), (57.3, True)])
def test_actions_that_may_be_in_other_units_are_told(factor: float, warned: bool) -> None:
    found = open_loop.compare(recorded(), EVERY, recorded().chunks(EVERY, CHUNK)[0], SPREAD)
    own = [dataclasses.replace(d, constant_rmse=d.training_std * factor) for d in found.dimensions]
    for dimensions in (own, [dataclasses.replace(own[0], training_std=0.0), *own]):
        seen: list[Event] = []
        report = dataclasses.replace(found, dimensions=dimensions)
        open_loop._warn_of_other_units(report, seen.append)
        assert len(seen) == warned


def test_dimensions_without_a_name_have_a_number() -> None:
    assert open_loop.action_names(recorded()) == ["action 0", "action 1"]
    assert open_loop.action_names(recorded(("a", ""))) == ["a", "action 1"]
    assert open_loop.action_names(recorded(("only",))) == ["action 0", "action 1"]


def of_instructions(texts: list[str], of_episodes: list[int]) -> Demonstrations:
    """The three episodes, each with the instruction of that number among the texts."""
    text_of = torch.repeat_interleave(torch.tensor(of_episodes), torch.tensor(LENGTHS))
    return dataclasses.replace(recorded(), instructions=texts, instruction_of=text_of)


def test_each_instruction_has_its_own_error_and_the_worst_comes_first() -> None:
    shown = of_instructions(["lift", "push"], [0, 1, 0])
    actions, _ = shown.chunks(EVERY, CHUNK)
    pushed = shown.episode_of == 1
    off = torch.where(pushed[:, None, None], torch.tensor(2.0), torch.tensor(1.0))
    found = open_loop.compare(shown, EVERY, actions + off, SPREAD)
    worst, best = found.instructions
    assert (worst.instruction, worst.episodes, worst.frames) == ("push", 1, 2)
    assert (best.instruction, best.episodes, best.frames) == ("lift", 2, 9)
    assert worst.relative_error == pytest.approx(1) and best.relative_error == pytest.approx(0.25)
    assert worst.relative_interval is None and best.relative_interval is not None
    # Entries of the chunks: 3 of `push` and 12 + 9 of `lift`, in which no step is padding.
    assert found.relative_error == pytest.approx((3 * 1 + 21 * 0.25) / 24)


def test_the_errors_of_single_episodes_have_the_error_of_all_as_their_mean_over_steps() -> None:
    shown = recorded(("a", "b"), ("a", "b"))
    off = (1 + shown.episode_of)[:, None, None] / 4
    found = open_loop.compare(shown, EVERY, shown.chunks(EVERY, CHUNK)[0] + off, SPREAD)
    own = found.episode_errors
    assert [one.episode for one in own] == found.episodes and len(own) == len(LENGTHS)
    assert [one.frames for one in own] == list(LENGTHS)
    steps = sum(one.steps for one in own)
    for name in ("relative_error", "hold_error"):
        whole = sum(one.steps * getattr(one, name) for one in own) / steps
        assert whole == pytest.approx(getattr(found, name))
    assert len({one.relative_error for one in own}) == len(own)
    assert [one["episode"] for one in found.kept()["episode_errors"]] == found.episodes


def test_one_instruction_has_the_figures_of_all_frames() -> None:
    shown = recorded(("a", "b"), ("a", "b"))
    found = open_loop.compare(shown, EVERY, shown.chunks(EVERY, CHUNK)[0] + 0.5, SPREAD)
    (only,) = found.instructions
    for figure in ("frames", "relative_error", "relative_interval", "hold_error"):
        assert getattr(only, figure) == getattr(found, figure) is not None


def test_a_text_that_is_listed_twice_is_one_instruction() -> None:
    shown = of_instructions(["go", "go"], [0, 1, 0])
    found = open_loop.compare(shown, EVERY, shown.chunks(EVERY, CHUNK)[0], SPREAD)
    assert [(one.instruction, one.episodes) for one in found.instructions] == [("go", 3)]


def test_instructions_without_an_error_are_in_the_order_of_their_frames() -> None:
    shown = of_instructions(["b", "a"], [0, 1, 0])
    found = open_loop.compare(shown, EVERY, shown.chunks(EVERY, CHUNK)[0], np.zeros(2))
    assert [(one.instruction, one.relative_error) for one in found.instructions] == [
        ("b", None),
        ("a", None),
    ]


def test_a_run_keeps_the_error_of_each_instruction(own_run: Path, demos_file: Path) -> None:
    found = open_loop.run(own_run, demos_file, range(8), keep=True)
    assert len(found.instructions) > 1
    assert sum(one.frames for one in found.instructions) == found.frames
    errors = [one.relative_error for one in found.instructions]
    assert errors == sorted(errors, reverse=True)
    (kept,) = results.open_loops(own_run)
    assert kept.figures["instructions"] == found.to_json()["instructions"]


# --- which episodes -------------------------------------------------------------------------------


def episodes_of(demos: Demonstrations, frames: torch.Tensor) -> list[int]:
    return sorted(set(demos.episode_of[frames].tolist()))


def test_by_default_it_is_the_runs_own_validation_split(naive_run: Path, demos_file: Path) -> None:
    trained = demonstrations.load(demos_file, SETTINGS.validation_share, 0)
    found = open_loop.run(naive_run, demos_file)
    assert (found.split, found.trained_on) == (open_loop.VALIDATION, [])
    assert found.episodes == episodes_of(trained, trained.validation)
    assert found.frames == len(trained.validation)
    assert not set(found.episodes) & set(episodes_of(trained, trained.train))
    assert {d.unit for d in found.dimensions} == {open_loop.FULL_ACTION}
    assert [d.name for d in found.dimensions] == ["dx", "dy"]


def test_episodes_that_were_trained_on_are_said(naive_run: Path, demos_file: Path) -> None:
    held_out = open_loop.run(naive_run, demos_file).episodes
    found = open_loop.run(naive_run, demos_file, episodes=[3, 1, *held_out, 3])
    assert found.split == open_loop.CHOSEN
    assert found.episodes == sorted({1, 3, *held_out})
    assert found.trained_on == sorted({1, 3} - set(held_out)) != []


def test_of_other_data_all_episodes_are_taken(naive_run: Path, tmp_path: Path) -> None:
    record.run("reach", 1, 7, tmp_path / "one.safetensors", workers=1)
    found = open_loop.run(naive_run, tmp_path / "one.safetensors")
    assert (found.split, found.episodes, found.trained_on) == (open_loop.OTHER, [0], [])
    assert found.relative_interval is None  # one episode says nothing about others


def test_episodes_that_an_earlier_run_has_learned_from_are_told(
    naive_run: Path, demos_file: Path, recipe: Recipe, tmp_path: Path
) -> None:
    """For a run that started with another's policy, and for one that started with that run."""
    other, last = tmp_path / "other.safetensors", naive_run
    record.run("reach", 3, 7, other, workers=1)
    for name in ("second", "third"):
        expert = dataclasses.replace(recipe.expert, start=str(last))
        begun = dataclasses.replace(recipe, backbone=str(last), expert=expert)
        last = tmp_path / name
        train.run(begun, "naive", other, None, last)
    held_out = open_loop.run(naive_run, demos_file).episodes
    for chosen, told in ((None, True), (held_out, False), ([*held_out, 1], True)):
        events: list[Event] = []
        found = open_loop.run(last, demos_file, chosen, frames=8, on_event=events.append)
        known = [event.text for event in events if isinstance(event, Warned)]
        learned = len({*range(8), *held_out} if chosen is None else chosen) - len(held_out)
        assert found.trained_on == [] and len(known) == told
        assert not told or f"{learned} of these" in known[0] and str(naive_run) in known[0]
    # On the data of all three the first has nothing to say.
    events = []
    open_loop.run(last, other, on_event=events.append)
    assert not any("trained on by" in e.text for e in events if isinstance(e, Warned))


def test_of_the_runs_own_data_that_has_grown_the_new_episodes_have_to_be_chosen(
    recipe: Recipe, frame_cache: Path, tmp_path: Path
) -> None:
    """Most of its episodes were trained on, and would make the policy look better."""
    made = [dataclasses.replace(e, instruction=lerobot.TEXTS[0]) for e in lerobot.episodes(8)]
    data = lerobot.save(tmp_path / "arm", made[:6])
    train.run(recipe, "naive", data, None, tmp_path / "run")
    shutil.rmtree(data)
    lerobot.save(data, made)
    for run in (tmp_path / "run", checkpoint.last(tmp_path / "run")):
        said = refusal(run, data)
        assert "is not as it was" in said and "now there are 8" in said and "--episodes 7" in said
    found = open_loop.run(tmp_path / "run", data, episodes=[6, 7])
    assert (found.split, found.episodes) == (open_loop.CHOSEN, [6, 7])
    elsewhere = shutil.copytree(data, tmp_path / "copy")
    assert open_loop.run(tmp_path / "run", elsewhere).split == open_loop.OTHER


def test_the_frames_are_spread_and_at_most_as_many_as_asked(
    naive_run: Path, demos_file: Path
) -> None:
    found = open_loop.run(naive_run, demos_file, episodes=range(8), frames=9)
    assert found.frames == 9 and found.horizon[0].frames == 9


def test_episodes_of_which_no_frame_was_read_are_not_reported(
    naive_run: Path, demos_file: Path
) -> None:
    found = open_loop.run(naive_run, demos_file, episodes=range(8), frames=3)
    assert len(found.episodes) == found.frames == 3
    assert set(found.trained_on) <= set(found.episodes)
    assert sum(one.episodes for one in found.instructions) >= len(found.episodes)


def test_an_action_that_hardly_varies_beside_its_mean_is_judged_by_how_it_varies(
    recipe: Recipe, demos_file: Path, tmp_path: Path
) -> None:
    """For example an encoder's ticks; the policy only centres it, since its scale is rounding."""
    saved = artifacts.load(demos_file, "demos")
    actions = saved.tensors["actions"].clone()
    actions[:, 0] = 5000 + 0.3 * actions[:, 0] / actions[:, 0].std()
    data = tmp_path / "arm.safetensors"
    meta = saved.header.meta
    artifacts.save(data, "demos", saved.tensors | {"actions": actions}, seed=0, meta=meta)
    train.run(recipe, "naive", data, None, tmp_path / "run")
    found, _ = evaluated(tmp_path / "run", data)
    assert found.dimensions[0].training_std == pytest.approx(0.3, rel=0.2)


def test_it_is_the_same_every_time_and_whatever_the_batch_size(
    naive_run: Path, demos_file: Path
) -> None:
    def measured(**options: Any) -> dict[str, Any]:
        return open_loop.run(naive_run, demos_file, episodes=[0, 1], **options).to_json()

    once, small, other = measured(), measured(batch_size=3), measured(seed=1)
    assert json.dumps(once) == json.dumps(measured())
    assert small["relative_error"] == pytest.approx(once["relative_error"], rel=1e-4)
    assert other["relative_error"] != once["relative_error"]
    assert "traces" not in once


def test_a_trace_is_what_the_policy_would_do_along_the_episode(
    naive_run: Path, demos_file: Path
) -> None:
    found = open_loop.run(naive_run, demos_file, episodes=[2], traced=True)
    demos = demonstrations.load(demos_file, None, 0)
    own = demos.tensors["actions"][demos.episode_of == 2].numpy()
    (trace,) = found.traces
    assert (trace.episode, trace.replan) == (2, 2)
    np.testing.assert_array_equal(trace.recorded, own)
    assert trace.predicted.shape == own.shape and np.isfinite(trace.predicted).all()


def test_of_a_lerobot_folder_it_is_the_split_of_the_cameras_that_were_trained_on(
    recipe: Recipe, frame_cache: Path, tmp_path: Path
) -> None:
    made = lerobot.episodes(6, cameras=("top", "side"))
    known = [dataclasses.replace(e, instruction="go to the red pad") for e in made]
    data = lerobot.save(tmp_path / "arm", known)
    seen = dataclasses.replace(recipe, demos=Demos(camera="side"))
    train.run(seen, "naive", data, None, tmp_path / "run")
    trained = demonstrations.load(data, SETTINGS.validation_share, 0, Selection("side"))
    found = open_loop.run(tmp_path / "run", data)
    assert found.split == open_loop.VALIDATION
    assert found.episodes == episodes_of(trained, trained.validation)
    assert [(d.name, d.unit) for d in found.dimensions] == [("dx", None), ("dy", None)]
    report = export.run(tmp_path / "run", tmp_path / "policy")
    assert report.pictures == ("observation.images.side",)
    exported = open_loop.run(tmp_path / "policy", data, episodes=found.episodes)
    assert exported.split == open_loop.CHOSEN
    assert exported.relative_error == pytest.approx(found.relative_error)


def test_data_whose_cameras_are_called_otherwise_wants_them_renamed(
    recipe: Recipe, frame_cache: Path, tmp_path: Path
) -> None:
    """With this command's own option, which chooses no camera."""

    def recorded_by(*cameras: str) -> Path:
        made = lerobot.episodes(6, cameras=cameras)
        known = [dataclasses.replace(e, instruction="go to the red pad") for e in made]
        return lerobot.save(tmp_path / "-".join(cameras), known)

    seen = dataclasses.replace(recipe, demos=Demos(camera="side"))
    train.run(seen, "naive", recorded_by("top", "side"), None, tmp_path / "run")
    data = recorded_by("overhead", "hand")
    said = refusal(tmp_path / "run", data)
    assert "no camera 'side'" in said and "--rename overhead=side" in said
    assert "--set" not in said and "--camera" not in said
    found = open_loop.run(tmp_path / "run", data, rename=(("overhead", "side"),))
    assert found.split == open_loop.OTHER


def test_only_the_episodes_that_are_asked_for_have_to_be_there(
    recipe: Recipe, frame_cache: Path, tmp_path: Path
) -> None:
    """This includes data on which the policy was trained, of which the recipe names some."""
    made = lerobot.episodes(8, smooth=True, size=(64, 64))
    known = [dataclasses.replace(e, instruction="go to the red pad") for e in made]
    data = lerobot.save(tmp_path / "arm", known)
    some = dataclasses.replace(recipe, demos=Demos(only="1-4,6"))
    train.run(some, "naive", data, None, tmp_path / "run")
    found = open_loop.run(tmp_path / "run", data)
    assert found.split == open_loop.VALIDATION and set(found.episodes) < {1, 2, 3, 4, 6}

    def spoil(table: pa.Table) -> pa.Table:
        rows = table.column("action").to_pylist()
        rows[0][1] = float("nan")
        return lerobot.replaced(table, "action", pa.array(rows, table.field("action").type))

    lerobot.edit_table(lerobot.data_files(data)[0], spoil)
    asked = open_loop.run(tmp_path / "run", data, episodes=[1, 5])
    assert (asked.split, asked.episodes) == (open_loop.CHOSEN, [1, 5])
    assert "NaN" in refusal(tmp_path / "run", data, episodes=[0, 5])


def test_a_policy_of_one_camera_takes_that_one_or_another_lone_one_and_chooses_no_other(
    recipe: Recipe, frame_cache: Path, tmp_path: Path
) -> None:
    folders = {}
    for cameras in (("side",), ("front",), ("top", "front"), ("top", "side")):
        made = lerobot.episodes(6, cameras=cameras)
        known = [dataclasses.replace(e, instruction="go to the red pad") for e in made]
        folders[cameras] = lerobot.save(tmp_path / "-".join(cameras), known)
    train.run(recipe, "naive", folders["side",], None, tmp_path / "run")
    assert open_loop.run(tmp_path / "run", folders["front",]).split == open_loop.OTHER
    assert open_loop.run(tmp_path / "run", folders["top", "side"]).split == open_loop.OTHER
    said = refusal(tmp_path / "run", folders["top", "front"])
    assert "observation.images.top" in said and "observation.images.side, as the policy" in said


def test_an_exported_policy_does_not_say_what_it_was_trained_on(
    naive_run: Path, demos_file: Path, tmp_path: Path
) -> None:
    policy, meta = checkpoint.load_policy(naive_run)
    (tmp_path / "policy").mkdir()
    lerobot_folder.write(tmp_path / "policy", policy, meta)
    found = open_loop.run(tmp_path / "policy", demos_file, frames=20)
    same = open_loop.run(naive_run, demos_file, episodes=range(8), frames=20)
    assert (found.split, found.episodes) == (open_loop.UNKNOWN, list(range(8)))
    assert found.relative_error == pytest.approx(same.relative_error)


@pytest.mark.parametrize("form", FORMS)
def test_of_an_exported_policy_the_episodes_may_be_chosen(
    form: str, naive_run: Path, demos_file: Path, tmp_path: Path
) -> None:
    """Even for the data on which it was trained, since the episodes of training are unknown."""
    export.run(naive_run, tmp_path / "policy", form)
    found = open_loop.run(tmp_path / "policy", demos_file, episodes=[6, 2, 6])
    same = open_loop.run(naive_run, demos_file, episodes=[2, 6])
    assert (found.split, found.episodes, found.trained_on) == (open_loop.CHOSEN, [2, 6], [])
    assert found.relative_error == pytest.approx(same.relative_error)
    assert "episode 99 of" in refusal(tmp_path / "policy", demos_file, episodes=[99])


# --- what errors are relative to ------------------------------------------------------------------


@pytest.mark.parametrize(
    "train_as", [{}, {"normalization": "quantiles"}, {"relative_actions": True}]
)
def test_whatever_the_policys_scale_errors_are_relative_to_how_the_trainings_actions_vary(
    train_as: dict[str, Any], recipe: Recipe, demos_file: Path, tmp_path: Path
) -> None:
    same = demonstrations.load(demos_file, SETTINGS.validation_share, 0)
    data = tmp_path / "arm.safetensors"
    saved = artifacts.load(demos_file, "demos")
    meta = dict(saved.header.meta)
    meta["proprio_names"] = [*meta["action_names"], *meta["proprio_names"][2:]]
    artifacts.save(data, "demos", saved.tensors, seed=0, meta=meta)
    changed = dataclasses.replace(recipe, train=dataclasses.replace(recipe.train, **train_as))
    train.run(changed, "naive", data, None, tmp_path / "run")
    found, warned = evaluated(tmp_path / "run", data)
    spread = same.tensors["actions"][same.train].double().std(0, unbiased=False)
    assert [d.training_std for d in found.dimensions] == pytest.approx(spread.tolist())
    assert not warned
    export.run(tmp_path / "run", tmp_path / "policy", LEROBOT)
    exported, _ = evaluated(tmp_path / "policy", data, episodes=found.episodes)
    assert exported.relative_error == pytest.approx(found.relative_error)


def test_an_earlier_checkpoint_by_quantiles_is_warned_of(
    named: tuple[Policy, dict[str, Any]], demos_file: Path, tmp_path: Path
) -> None:
    earlier = renamed({"normalization": "quantiles"}, named, tmp_path / "earlier")
    (text,) = warnings_of(earlier, demos_file)
    assert "of an earlier version" in text and "do not compare" in text
    told = renamed({"normalization": "quantiles", "action_std": [1.0, 2.0]}, named, tmp_path / "x")
    found, warned = evaluated(told, demos_file, episodes=[0], frames=2)
    assert [d.training_std for d in found.dimensions] == [1.0, 2.0] and not warned


@pytest.mark.parametrize("wrong", [[1.0], [1.0, -1.0], [1.0, "x"], 1.0])
def test_a_checkpoint_with_a_spread_that_cannot_be_is_refused(
    wrong: Any, named: tuple[Policy, dict[str, Any]], demos_file: Path, tmp_path: Path
) -> None:
    assert "action_std" in refusal(
        renamed({"action_std": wrong}, named, tmp_path / "x"), demos_file
    )


# --- what a run keeps -----------------------------------------------------------------------------


@pytest.fixture
def own_run(naive_run: Path, tmp_path: Path) -> Path:
    shutil.copytree(naive_run, tmp_path / "own", symlinks=True)
    return tmp_path / "own"


def test_a_run_keeps_what_was_found_of_all_dimensions_and_steps_together(
    own_run: Path, demos_file: Path
) -> None:
    found = open_loop.run(own_run, demos_file, keep=True)
    (kept,) = results.open_loops(own_run)
    assert kept.name == f"evaluate-validation-{demos_file.name}"
    left_out = {"dimensions", "horizon"}
    plain = {name: value for name, value in found.to_json().items() if name not in left_out}
    assert kept.figures == json.loads(json.dumps(plain))
    assert kept.settings["path"] == str(demos_file) and kept.settings["episodes"] is None
    again = inspection.run(own_run)
    assert [one.figures for one in again.open_loops] == [kept.figures]


def test_chosen_episodes_are_another_result_than_held_out_ones(
    own_run: Path, demos_file: Path
) -> None:
    open_loop.run(own_run, demos_file, [0, 1, 2], keep=True)
    held_out = open_loop.run(own_run, demos_file, keep=True)
    trained = len({0, 1, 2} - set(held_out.episodes))
    said = [results.evaluated_on(one.figures) for one in results.open_loops(own_run)]
    count, data = len(held_out.episodes), demos_file.name
    assert said[0] == f"{count} held-out episode{'s' * (count != 1)} of {data}"
    assert said[1] == f"3 chosen episodes of {data}, {trained} of them trained on"


def test_an_earlier_checkpoints_error_is_no_figure_of_the_run_and_an_exports_is_kept_nowhere(
    own_run: Path, demos_file: Path, tmp_path: Path
) -> None:
    steps = sorted(p.name for p in (own_run / "checkpoints").iterdir() if p.name.isdigit())
    assert len(steps) > 1
    open_loop.run(own_run / "checkpoints" / steps[0], demos_file, keep=True)
    (path,) = (own_run / "results").glob("*.json")
    assert path.stem.endswith(steps[0]) and not results.open_loops(own_run)
    for form in FORMS:
        export.run(own_run, tmp_path / form, form)
        before = sorted((tmp_path / form).rglob("*"))
        open_loop.run(tmp_path / form, demos_file, [0], keep=True)
        assert sorted((tmp_path / form).rglob("*")) == before


# --- refused --------------------------------------------------------------------------------------


def refusal(*arguments: Any, **options: Any) -> str:
    with pytest.raises(AegisError) as caught:
        open_loop.run(*arguments, **options)
    return str(caught.value)


def test_a_checkpoint_without_its_run_does_not_know_what_it_was_trained_on(
    naive_run: Path, demos_file: Path, tmp_path: Path
) -> None:
    shutil.copytree(naive_run / "checkpoints" / "last", tmp_path / "taken")
    said = refusal(tmp_path / "taken", demos_file)
    assert "outside its run" in said and "--episodes" in said
    other = tmp_path / "other.safetensors"
    record.run("reach", 2, 7, other, workers=1)
    assert open_loop.run(tmp_path / "taken", other).split == open_loop.OTHER
    inside = open_loop.run(naive_run / "checkpoints" / "last", demos_file)
    assert inside.split == open_loop.VALIDATION


def test_demonstrations_of_another_robot_are_refused(naive_run: Path, tmp_path: Path) -> None:
    record.run("point", 2, 0, tmp_path / "point.safetensors", workers=1)
    assert "2 positions and 2 actions" in refusal(naive_run, tmp_path / "point.safetensors")


@pytest.fixture(scope="module")
def named(naive_run: Path) -> tuple[Policy, dict[str, Any]]:
    return checkpoint.load_policy(naive_run)


def renamed(
    names: Mapping[str, list[str]], named: tuple[Policy, dict[str, Any]], folder: Path
) -> Path:
    """The policy with other names in its meta."""
    folder.mkdir()
    lerobot_folder.write(folder, named[0], {**named[1], **names})
    return folder


def test_joints_in_another_order_are_refused(
    named: tuple[Policy, dict[str, Any]], demos_file: Path, tmp_path: Path
) -> None:
    actions = renamed({"action_names": ["dy", "dx"]}, named, tmp_path / "actions")
    said = refusal(actions, demos_file)
    assert "'dy' in another place" in said and "dy, dx, in this order" in said
    names = named[1]["proprio_names"]
    turned = renamed({"proprio_names": names[1:] + names[:1]}, named, tmp_path / "positions")
    assert f"positions {', '.join(names)}" in refusal(turned, demos_file)


def test_another_robot_is_refused_before_any_picture_is_decoded(
    recipe: Recipe, frame_cache: Path, tmp_path: Path
) -> None:
    """Decoding a large data set takes hours."""
    made = lerobot.episodes(6)
    known = [dataclasses.replace(e, instruction="go to the red pad") for e in made]
    data = lerobot.save(tmp_path / "arm", known)
    train.run(recipe, "naive", data, None, tmp_path / "run")
    decoded = sorted(frame_cache.rglob("*"))
    for name, (feature, names, says) in {
        "turned": ("action", ["dy", "dx"], "'dx' in another place"),
        "smaller": ("observation.state", ["x"], "1 positions and 2 actions"),
    }.items():
        other = Path(shutil.copytree(data, tmp_path / name))

        def change(info: dict[str, Any], feature: str = feature, names: list[str] = names) -> None:
            info["features"][feature] |= {"names": names, "shape": [len(names)]}

        lerobot.edit_info(other, change)
        assert says in refusal(tmp_path / "run", other)
        assert sorted(frame_cache.rglob("*")) == decoded


def evaluated(policy: Path, data: Path, **options: Any) -> tuple[OpenLoopReport, list[str]]:
    """The report, and what was warned of."""
    events: list[Event] = []
    found = open_loop.run(policy, data, on_event=events.append, **options)
    return found, [event.text for event in events if isinstance(event, Warned)]


def warnings_of(policy: Path, data: Path) -> list[str]:
    return evaluated(policy, data, episodes=[0], frames=2)[1]


def test_joints_of_other_names_are_warned_of(
    named: tuple[Policy, dict[str, Any]], demos_file: Path, tmp_path: Path
) -> None:
    other = renamed({"action_names": ["left", "dy"]}, named, tmp_path / "other")
    (text,) = warnings_of(other, demos_file)
    assert "are named dx, dy" in text and "trained on left, dy" in text
    without = {n: v for n, v in named[1].items() if n not in ("action_names", "proprio_names")}
    assert warnings_of(renamed({}, (named[0], without), tmp_path / "none"), demos_file) == []
    assert warnings_of(renamed({}, named, tmp_path / "same"), demos_file) == []


def test_another_rate_is_warned_of(
    named: tuple[Policy, dict[str, Any]], demos_file: Path, tmp_path: Path
) -> None:
    (text,) = warnings_of(renamed({"fps": 7.5}, named, tmp_path / "other"), demos_file)
    assert f"{named[1]['fps']:g} frames a second" in text and "trained on 7.5" in text
    without = {name: value for name, value in named[1].items() if name != "fps"}
    assert warnings_of(renamed({}, (named[0], without), tmp_path / "none"), demos_file) == []


@pytest.mark.parametrize("wrong", [[8], [0, 99]])
def test_episodes_that_there_are_not_are_refused(
    wrong: list[int], naive_run: Path, demos_file: Path
) -> None:
    assert f"episode {wrong[-1]} of" in refusal(naive_run, demos_file, episodes=wrong)


def test_a_stream_is_refused(demos_file: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "recipe.yaml").write_text("kind: robot-stream\nname: s\ntasks: [reach, point]\n")
    assert "the run of a stream" in refusal(folder, demos_file)
