"""Measurements in a run's folder: kept complete, read back, separate from those of `aegis run`."""

from __future__ import annotations

import contextlib
import os
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from samples.reports import open_loop, probe, rollout, write_job

from aegis_cli import recipes
from aegis_cli.common import files, locks
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Warned
from aegis_cli.evaluation import results
from aegis_cli.evaluation.results import Result


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_job(tmp_path) / "naive"


def test_what_is_kept_is_read_back_after_that_of_aegis_run(run: Path) -> None:
    found = probe("shape", 1)
    path = results.keep(run, "probe-scenes", found, {"questions": 40})
    assert path == run / "results" / "probe-scenes.json"
    first, second = results.probes(run)
    assert (first.name, first.settings) == ("probe", {})
    assert (second.name, second.settings) == ("probe-scenes", {"questions": 40})
    assert second.figures == found


def test_a_probe_that_was_repeated_is_told_once(run: Path) -> None:
    again = results.probes(run)[0].figures
    asked = {"vqa": "scenes", "questions": 40, "seed": 0}
    results.keep(run, "probe-scenes", again, asked)
    assert [found.name for found in results.probes(run)] == ["probe"]
    results.keep(run, "probe-scenes", {**again, "accuracy": 0.25}, asked)
    assert len(results.probes(run)) == 2
    for settings in ({**asked, "vqa": "easy-vqa"}, {**asked, "max_drop": 5.0, "gate": "mean"}):
        results.keep(run, "probe-scenes", {**again, "passed": True}, settings)
        assert len(results.probes(run)) == 2


def test_a_repeated_probe_adds_what_it_alone_knows(run: Path) -> None:
    layer = {"layer": "layers.0", "w2": 0.5, "baseline_w2": None}
    first = files.load_json(run / "probe.json") | {"layers": [layer]}
    files.save_json(run / "probe.json", first)
    known = [layer | {"baseline_w2": 0.25}]
    results.keep(run, "probe-scenes", {**first, "layers": known}, {"vqa": "scenes"})
    (found,) = results.probes(run)
    assert (found.name, found.settings, found.figures["layers"]) == ("probe", {}, known)


def test_a_later_one_replaces_it_and_leaves_that_of_aegis_run(run: Path) -> None:
    before = (run / "rollout-seen.json").read_bytes()
    for success in (0.25, 0.5):
        results.keep(run, "rollout-seen", rollout("seen", success), {"seed": 1})
    assert [r.figures["success"] for r in results.rollouts(run)] == [0.75, 0.5, 0.5]
    assert (run / "rollout-seen.json").read_bytes() == before


def test_a_rollout_that_was_repeated_is_told_once_as_it_was_found_last(run: Path) -> None:
    again = rollout("seen", 0.25)
    path = results.keep(run, "rollout-reach-seen", again, {"seed": 0, "replan": 4})
    assert path is not None
    assert [r.figures["success"] for r in results.rollouts(run)] == [0.25, 0.5]
    os.utime(path, (0, 0))  # as if `aegis run` had measured it afterwards
    assert [r.figures["success"] for r in results.rollouts(run)] == [0.75, 0.5]


@pytest.mark.parametrize(
    ("settings", "changes", "said"),
    [
        ({"seed": 1, "replan": 4}, {}, ("seed 0", "seed 1")),
        ({"seed": 0, "replan": 2}, {}, ("replan 4", "replan 2")),
        ({"seed": 0, "ensemble": 0.01}, {}, ("no ensemble", "ensemble 0.01")),
        ({"seed": 0, "delay": 2, "guided": False}, {}, ("no delay", "delay 2")),
        ({"seed": 0, "delay": 0, "guided": True}, {}, ("no delay", "delay 0, guided")),
        ({"seed": 0}, {"episodes": 8}, ("", "")),  # which the tables show anyway
    ],
)
def test_a_rollout_that_was_played_otherwise_says_how(
    settings: dict[str, float], changes: dict[str, int], said: tuple[str, str], run: Path
) -> None:
    results.keep(run, "rollout-seen", rollout("seen", 0.25) | changes, settings)
    first, second, held_out = results.rollouts(run)
    assert (first.figures["success"], second.figures["success"]) == (0.75, 0.25)
    apart = results.told_apart([first.played, second.played, held_out.played])
    assert tuple(apart) == (*said, said[0])


def probe_of(drop: float | None, passed: bool | None = None, drift: bool = False):
    """A probe with or without its drop, its gate's verdict and its drift."""
    layers = [{"layer": "layers.0", "w2": 12.5}] if drift else []
    return probe("shape") | {"drop_points": drop, "passed": passed, "layers": layers}


def test_a_probe_without_a_drop_is_kept_beside_an_earlier_gate_which_comes_first(run: Path) -> None:
    told: list[Event] = []
    results.keep_if_possible(run, "probe-scenes", probe_of(2.0, passed=False), {}, told.append)
    assert not told
    results.keep_if_possible(run, "probe-scenes", probe_of(None), {}, told.append)
    _, first, second = results.probes(run)
    assert (first.name, first.figures["drop_points"]) == ("probe-scenes", 2.0)
    assert (second.name, second.figures["drop_points"]) == ("probe-scenes-with-accuracy", None)
    assert results.gate([first, second], recipes.Probe()) is False
    (warned,) = told
    assert isinstance(warned, Warned) and "which also tells the drop and the gate" in warned.text


def test_probes_that_each_tell_what_the_other_does_not_are_both_kept(run: Path) -> None:
    results.keep(run, "probe-scenes", probe_of(2.0, passed=True), {})
    results.keep(run, "probe-scenes", probe_of(2.0, drift=True), {})
    names = [found.name for found in results.probes(run)]
    assert names == ["probe", "probe-scenes", "probe-scenes-with-drop-drift"]


def test_a_probe_replaces_all_that_tell_no_more(run: Path) -> None:
    for found in (probe_of(None), probe_of(2.0, passed=True), probe_of(3.0), probe_of(None)):
        results.keep(run, "probe-scenes", found, {})
    assert len(results.probes(run)) == 4
    results.keep(run, "probe-scenes", probe_of(5.0, passed=False, drift=True), {})
    assert [found.figures["drop_points"] for found in results.probes(run)[1:]] == [5.0]


def test_a_probe_of_an_earlier_checkpoint_is_replaced_whatever_it_told(run: Path) -> None:
    results.keep(run, "probe-scenes", probe_of(2.0, passed=True), {})
    link = run / "checkpoints" / "last"
    link.unlink()
    link.symlink_to(checkpoint_at(run, 9).name)
    path = results.keep(run, "probe-scenes", probe_of(None), {})
    assert path is not None and path.name == "probe-scenes.json"


def checkpoint_at(run: Path, step: int) -> Path:
    at = run / "checkpoints" / f"{step:06d}"
    (at / "backbone").mkdir(parents=True)
    (at / "expert.safetensors").touch()
    return at


def test_one_of_an_earlier_checkpoint_is_kept_under_its_step_and_is_no_figure_of_the_run(
    run: Path,
) -> None:
    path = results.keep(checkpoint_at(run, 3), "probe-scenes", probe("shape"), {})
    assert path is not None and path.name == "probe-scenes-000003.json"
    assert [result.name for result in results.probes(run)] == ["probe"]


def test_one_of_the_last_checkpoint_is_one_of_the_run(run: Path) -> None:
    assert results.keep(checkpoint_at(run, 6), "probe-scenes", probe("a"), {}) == results.keep(
        run, "probe-scenes", probe("b", 1), {}
    )
    assert [r.figures["accuracy"] for r in results.probes(run)] == [0.8, pytest.approx(0.7)]


def test_a_run_that_was_trained_further_has_not_what_was_measured_before(run: Path) -> None:
    results.keep(run, "probe-scenes", probe("shape"), {})
    results.keep(run, "rollout-x-seen", rollout("seen", 0.25), {"seed": 1})
    before = len(results.probes(run)), len(results.rollouts(run))
    link = run / "checkpoints" / "last"
    link.unlink()
    link.symlink_to(checkpoint_at(run, 9).name)
    assert (len(results.probes(run)), len(results.rollouts(run))) == (before[0] - 1, before[1] - 1)
    assert results.steps_measured_before(run) == [6]
    results.keep(run, "probe-scenes", probe("shape"), {})
    assert len(results.probes(run)) == before[0]


def test_sets_of_one_name_in_two_folders_are_two_results(run: Path) -> None:
    for place, drop in (("home", 0), ("kitchen", 1), ("home", 2)):
        results.keep(run, "probe-q.jsonl", probe("shape", drop), {"path": f"/{place}/q.jsonl"})
    kept = {r.settings["path"]: r.figures["drop_points"] for r in results.probes(run)[1:]}
    assert kept == {"/home/q.jsonl": 30.0, "/kitchen/q.jsonl": 20.0}


def test_demonstrations_of_one_name_in_two_folders_are_two_results(run: Path) -> None:
    for place, error in (("home", 0.25), ("kitchen", 0.5), ("home", 0.75)):
        found, settings = open_loop(3, error=error), {"path": f"/{place}/arm"}
        results.keep(run, "evaluate-validation-arm", found, settings)
    kept = {r.settings["path"]: r.figures["relative_error"] for r in results.open_loops(run)}
    assert kept == {"/home/arm": 0.75, "/kitchen/arm": 0.5}


def test_errors_on_held_out_episodes_come_first_and_only_those_of_the_last_checkpoint(
    run: Path,
) -> None:
    results.keep(run, "evaluate-chosen-arm", open_loop(1, split="chosen"), {})
    results.keep(run, "evaluate-validation-arm", open_loop(3), {})
    assert [r.figures["split"] for r in results.open_loops(run)] == ["validation", "chosen"]
    link = run / "checkpoints" / "last"
    link.unlink()
    link.symlink_to(checkpoint_at(run, 9).name)
    assert results.open_loops(run) == []


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, "2 held-out episodes of datasets/arm"),
        ({"episodes": [4]}, "1 held-out episode of datasets/arm"),
        ({"data": "/home/somebody/arm"}, "2 held-out episodes of arm"),
        (
            {"split": "chosen", "trained_on": [1]},
            "2 chosen episodes of datasets/arm, 1 of them trained on",
        ),
        (
            {"split": "other data"},
            "2 episodes of datasets/arm, which is other data than the training's",
        ),
    ],
)
def test_it_is_said_which_episodes_an_error_is_of(changes: dict[str, object], said: str) -> None:
    assert results.evaluated_on({**open_loop(1, 2), **changes}) == said


def kept_with(run: Path, name: str, found: dict[str, Any], **settings: Any) -> list[str]:
    """The texts of the warnings while a measurement is kept."""
    told: list[Event] = []
    results.keep_if_possible(run, name, found, settings, told.append)
    return [event.text for event in told if isinstance(event, Warned)]


def test_an_evaluation_of_fewer_frames_does_not_replace_one_of_more(run: Path) -> None:
    name, asked = "evaluate-validation-arm", {"path": "/home/arm", "episodes": None, "seed": 0}
    many, few = open_loop(1, 3, error=1.25, frames=120), open_loop(1, error=1.5, frames=8)
    assert kept_with(run, name, many, **asked, frames=1000) == []
    (told,) = kept_with(run, name, few, **asked, frames=8)
    assert told.endswith("which is of 120 frames and not of 8")
    assert [found.figures for found in results.open_loops(run)] == [many]
    beside = run / "results" / f"{name}-of-8-frames.json"
    assert files.load_json(beside)["relative_error"] == 1.5
    newer = {**many, "relative_error": 1.75}
    assert kept_with(run, name, newer, **asked, frames=1000) == []
    assert [found.figures for found in results.open_loops(run)] == [newer]
    assert not beside.exists()


def test_few_frames_of_other_episodes_are_shown_too(run: Path) -> None:
    for episodes, frames in (([1, 3], 120), ([5], 8)):
        found = open_loop(*episodes, split="chosen", frames=frames)
        kept_with(run, "evaluate-chosen-arm", found, path="/home/arm", episodes=episodes)
    assert [found.figures["frames"] for found in results.open_loops(run)] == [120, 8]


def test_a_quick_look_replaces_more_frames_of_an_earlier_checkpoint(run: Path) -> None:
    name, asked = "evaluate-validation-arm", {"path": "/home/arm"}
    kept_with(run, name, open_loop(1, frames=120), **asked)
    link = run / "checkpoints" / "last"
    link.unlink()
    link.symlink_to(checkpoint_at(run, 9).name)
    assert kept_with(run, name, open_loop(1, frames=8), **asked) == []
    assert [found.figures["frames"] for found in results.open_loops(run)] == [8]


def test_a_rollout_of_fewer_episodes_does_not_replace_one_of_more(run: Path) -> None:
    asked = {"task": "reach", "colors": "seen", "seed": 7, "replan": 4}
    for episodes in (300, 3):
        found = rollout("seen", 0.25) | {"episodes": episodes}
        kept_with(run, "rollout-seen", found, **asked, episodes=episodes)
    shown = [found.figures["episodes"] for found in results.rollouts(run)]
    assert shown == [4, 300, 4]  # two of them are by `aegis run`
    found = rollout("seen", 0.25) | {"episodes": 3}  # which was played in another way
    kept_with(run, "rollout-seen", found, **asked, episodes=3, delay=2, guided=False)
    assert [found.figures["episodes"] for found in results.rollouts(run)] == [4, 300, 3, 4]


def test_a_probe_of_fewer_questions_does_not_replace_one_of_more(run: Path) -> None:
    for questions in (76, 12):
        found = probe_of(2.0) | {"questions": questions}
        told = kept_with(run, "probe-scenes", found, vqa="scenes", questions=questions)
    assert told and told[0].endswith("which is of 76 questions and not of 12")
    assert [found.figures["questions"] for found in results.probes(run)] == [40, 76]
    # It tells a verdict that the larger one lacks.
    for passed in (True, None):
        gated = probe_of(2.0, passed=passed) | {"questions": 12}
        kept_with(run, "probe-scenes", gated, vqa="scenes", questions=12)
    shown = [(found.figures["questions"], found.figures["passed"]) for found in results.probes(run)]
    assert shown == [(40, None), (76, None), (12, True)]


@pytest.mark.parametrize("other", [{"seed": 3}, {"ask": "Answer: {}"}, {"path": "/home/b.jsonl"}])
def test_fewer_questions_that_were_asked_for_otherwise_are_shown_too(
    run: Path, other: dict[str, Any]
) -> None:
    asked = {"vqa": "q", "path": "/home/q.jsonl", "seed": 0, "ask": "{}"}
    for questions, changed in ((76, {}), (12, other), (9, {})):
        found = probe_of(2.0) | {"questions": questions}
        kept_with(run, "probe-q", found, **{**asked, **changed}, questions=questions)
    shown = [found.figures["questions"] for found in results.probes(run)]
    assert sorted(shown[1:], reverse=True) == [76, 12]


def test_few_frames_under_other_names_are_shown_too(run: Path) -> None:
    for frames, rename in ((120, None), (8, {"top": "front"})):
        found, renamed = open_loop(1, frames=frames), {} if rename is None else {"rename": rename}
        kept_with(run, f"evaluate-validation-arm{frames}", found, path="/home/arm", **renamed)
    assert {found.figures["frames"] for found in results.open_loops(run)} == {120, 8}


def test_paths_that_are_not_utf8_are_kept_and_read_back(run: Path) -> None:
    name = os.fsdecode(b"caf\xe9")
    for place, drop in (("home", 0), ("kitchen", 1), ("home", 2)):
        settings = {"path": f"/{place}/{name}"}
        results.keep(run, "probe-x", probe("shape", drop) | {"w2_between": name}, settings)
    results.keep(run, "rollout-seen", rollout("seen", 0.5) | {"video": f"{name}.gif"}, {})
    kept = {r.settings["path"]: r.figures["drop_points"] for r in results.probes(run)[1:]}
    assert kept == {"/home/caf\\udce9": 30.0, "/kitchen/caf\\udce9": 20.0}
    assert "caf\\udce9.gif" in [played.figures["video"] for played in results.rollouts(run)]


@pytest.mark.parametrize("name", ["probe-okvqa_validation.jsonl", "probe-questions-validation"])
def test_a_set_may_be_called_validation(run: Path, name: str) -> None:
    results.keep(run, name, probe("shape"), {})
    assert len(results.probes(run)) == 2


def test_any_name_of_questions_becomes_a_file_of_the_folder(run: Path) -> None:
    path = results.keep(run, "probe-../../x y.jsonl", probe("shape"), {})
    assert path is not None and path.parent == run / "results"
    assert path.name == "probe-.._.._x_y.jsonl.json"


def test_nothing_is_kept_of_what_is_no_run(tmp_path: Path) -> None:
    assert results.keep(Path("embedded"), "probe-scenes", {}, {}) is None
    assert results.keep(tmp_path, "probe-scenes", {}, {}) is None
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_nothing_is_kept_in_a_folder_that_may_not_be_written_to(run: Path) -> None:
    run.chmod(0o555)
    assert results.keep(run, "probe-scenes", {}, {}) is None
    run.chmod(0o755)


def test_two_processes_do_not_write_at_once(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And if a result could not be kept, it was measured nevertheless."""
    monkeypatch.setattr(results, "_PATIENCE_S", 0.0)
    told: list[Event] = []
    with locks.alone(run / "results"):
        with pytest.raises(AegisError, match="being written to"):
            results.keep(run, "probe-scenes", probe("shape"), {})
        results.keep_if_possible(run, "probe-scenes", probe("shape"), {}, told.append)
    (warned,) = told
    assert isinstance(warned, Warned) and "not kept" in warned.text and warned.stage == "probe"


def test_one_waits_for_another_that_writes(run: Path) -> None:
    with contextlib.ExitStack() as other:
        other.enter_context(locks.alone(run / "results"))
        threading.Timer(0.5, other.close).start()
        assert results.keep(run, "probe-scenes", probe("shape"), {}) is not None


def test_what_chose_a_knob_is_no_result(run: Path) -> None:
    for name in ("probe-validation", "probe-validation-2"):
        files.save_json(run / f"{name}.json", probe("shape"))
    assert [result.name for result in results.probes(run)] == ["probe"]


def verdict(*drops: float, max_drop: float | None = None, passed: bool | None = None):
    probes = [Result("probe", {"drop_points": drop, "passed": passed}, {}) for drop in drops]
    return results.gate(probes, recipes.Probe(max_drop=max_drop))


@pytest.mark.parametrize(("gate", "passes"), [("mean", True), ("upper", False)])
def test_a_recipe_says_what_of_a_drop_its_gate_limits(gate: str, passes: bool) -> None:
    found = Result("probe", {"drop_points": 0.4, "drop_interval": [-0.2, 1.0]}, {})
    settings = recipes.Probe(max_drop=0.5, gate=gate)
    assert results.gate([found], settings) is passes
    assert results.gate([found], replace(settings, max_drop=1.0)) is True


def test_a_gate_passes_if_every_probe_does() -> None:
    assert verdict(0.1, 0.2) is None and verdict(max_drop=1.0) is None
    assert verdict(0.1, 0.5, max_drop=0.5) is True
    assert verdict(0.1, 0.6, max_drop=0.5) is False
    assert verdict(0.1, passed=False) is False and verdict(9.0, max_drop=0.5, passed=True) is True


def test_what_the_recipe_no_longer_asks_for_is_no_result(run: Path) -> None:
    """If a job's recipe then has fewer question sets and colours, earlier files remain."""
    files.save_json(run / "probe-2.json", probe("shape", 1))
    assert len(results.probes(run)) == 1 and len(results.rollouts(run)) == 2
    recipe = results.recipe_of(run)
    two = replace(recipe, probe=replace(recipe.probe, vqa=("scenes", "easy-vqa")))
    (run / "recipe.yaml").write_text(recipes.to_yaml(two))
    sets = [results.question_set(found, two) for found in results.probes(run)]
    assert sets == ["scenes", "easy-vqa"]
    seen = replace(recipe, rollout=replace(recipe.rollout, colors=("seen",)))
    (run / "recipe.yaml").write_text(recipes.to_yaml(seen))
    assert [found.figures["colors"] for found in results.rollouts(run)] == ["seen"]
    results.keep(run, "rollout-held-out", rollout("held-out", 0.25), {"seed": 0})
    assert [found.figures["colors"] for found in results.rollouts(run)] == ["seen", "held-out"]
