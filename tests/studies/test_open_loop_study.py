"""Studies of policies that cannot be rolled out: judged and tuned by their open-loop error."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from samples import studies
from samples.command import refused
from samples.lerobot import edit_info, episodes, save

from aegis_cli.cli import render
from aegis_cli.common import files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Warned, ignore
from aegis_cli.data import demonstrations
from aegis_cli.evaluation.bootstrap import Units, crossed_interval
from aegis_cli.recipes import StudyRecipe, study_cells
from aegis_cli.studies import study
from aegis_cli.studies.policy_cells import OpenLoop

pytestmark = pytest.mark.usefixtures("frame_cache")

BOTH = ("top", "wrist")


def own_robot(folder: Path, backbone: Path, count: int, **changes: Any) -> dict[str, Any]:
    """The keys of a study of policies that cannot be rolled out, which holds out three of ten."""
    recorded = [replace(e, instruction="go to the red pad") for e in episodes(count, ("wrist",))]
    shared = studies.raw(backbone)["shared"]
    shared["demos"] = {"path": str(save(folder, recorded))}
    shared["train"]["validation_share"] = 0.3
    tuning = {name: value for name, value in studies.TUNING.items() if name != "task"}
    return studies.raw(backbone, **{"shared": shared, "tasks": None, "tuning": tuning, **changes})


def test_values_are_chosen_by_the_error_on_episodes_that_judge_nobody(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The compared seeds hold out different episodes from each other, and none of those."""
    studies.fake_bench(monkeypatch)
    knob = {"naive": {"method": "naive", "tune": {"train.backbone_lr": [1e-3, 1e-2]}}}
    keys = own_robot(tmp_path / "arm", tiny_folder, 20, variants=knob, keep_runs=True)
    report = study.run(study_cells.load(studies.write(tmp_path, keys)), tmp_path / "runs")
    assert all(p.success is None and p.open_loop_error is not None for p in report.tuning)
    assert report.tuning_task == "arm" and [p.chosen for p in report.tuning].count(True) == 1
    runs = tmp_path / "runs" / "small"
    tuned = [files.load_json(p) for p in runs.glob("tuning/*/*/evaluate-validation.json")]
    judged = [files.load_json(p) for p in sorted(runs.glob("arm/*/*/evaluate.json"))]
    assert len(tuned) == len(judged) == 2 and not list(runs.glob("tuning/*/*/evaluate.json"))
    assert judged[0]["episodes"] != judged[1]["episodes"]
    held = {episode for one in judged for episode in one["episodes"]}
    for one in tuned:
        assert one["episodes"] and not held & {*one["episodes"]} and not one["trained_on"]
    errors = [one["relative_error"] for one in tuned]
    assert sorted(errors) == sorted(p.open_loop_error for p in report.tuning)
    said = io.StringIO()
    Console(file=said, width=160).print(render.study(report))
    assert "episodes of arm that judge no compared policy" in " ".join(said.getvalue().split())
    assert "small: arm" in said.getvalue() and "reach" not in said.getvalue()


def test_further_seeds_may_leave_other_episodes_to_tune_on(
    tiny_folder: Path, tmp_path: Path
) -> None:
    """A value chosen on an episode that now serves for judging would be chosen again."""
    keys = own_robot(tmp_path / "d", tiny_folder, 20)
    found = []
    for seeds in ([0, 1], [0, 1], [0, 1, 2]):
        recipe = study_cells.load(studies.write(tmp_path, {**keys, "seeds": seeds}))
        kind = study.kind_of(recipe)
        runner = kind.make_runner(tmp_path / "runs", ignore)
        found.append([runner.key(c) for own in study.trials(kind).values() for _, c in own])
    assert found[0] == found[1] and not {*found[0]} & {*found[2]}


def test_values_are_not_chosen_where_no_episode_is_left_or_acting_is_not_one_figure(
    aegis: Any, tiny_folder: Path, tmp_path: Path
) -> None:
    """Before any work; one camera of a simulated task can be rolled out."""
    keys = own_robot(tmp_path / "few", tiny_folder, 3)
    for seeds, fix in (((0, 1), "set tuning.seed to 100"), (range(9), "compare fewer seeds")):
        path = studies.write(tmp_path, {**keys, "seeds": list(seeds)})
        err = refused(aegis("run", path, "--out", tmp_path / "runs"))
        assert "no episode of" in err and fix in err
    folder = save(tmp_path / "d", episodes(4, BOTH))
    assert demonstrations.playable_task(folder, "wrist", "reach") is None
    keys["shared"]["demos"] = {"path": str(folder), "camera": "wrist"}
    other = save(tmp_path / "other", episodes(4, BOTH))
    edit_info(other, lambda info: info.update(robot_type="aegis/reach"))
    assert demonstrations.playable_task(other, "wrist", "reach") == "reach"
    assert demonstrations.playable_task(other, BOTH, "reach") is None
    simulated = {"method": "naive", "set": {"demos.path": str(other)}}
    variants = {**keys["variants"], "simulated": simulated}
    path = studies.write(tmp_path, {**keys, "variants": variants})
    err = refused(aegis("run", path, "--out", tmp_path / "runs"))
    assert f"'tuning' with demonstrations in '{folder}'" in err and not (tmp_path / "runs").exists()


def test_a_study_that_named_a_task_goes_on_where_it_was(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its cells keep their folders, and are found even if the recipe no longer names the task."""
    studies.fake_bench(monkeypatch)
    variants = {"naive": {"method": "naive"}, "kept": {"method": "stop-gradient"}}
    keys = own_robot(tmp_path / "d", tiny_folder, 5, tuning=None, variants=variants)
    named = study_cells.load(studies.write(tmp_path, {**keys, "tasks": ["reach"], "seeds": [0]}))
    events: list[Event] = []
    study.run(named, tmp_path / "runs", events.append)
    told = [e.text for e in events if isinstance(e, Warned) and e.stage == "study"]
    assert len(told) == 1 and "so tasks: [reach] is only a name" in told[0]
    assert (tmp_path / "runs" / "small" / "reach" / "naive" / "0").is_dir()
    later = study_cells.load(studies.write(tmp_path, keys))
    plan = list(study.planned(later, tmp_path / "runs"))
    known = {f"d/{name}/0": True for name in variants} | {f"d/{name}/1": False for name in variants}
    assert dict(plan) == known


def test_each_of_several_sets_counts_alike_however_long_it_is() -> None:
    def report(errors: list[float], steps: list[int], hold: float | None) -> dict[str, Any]:
        whole = sum(s * e for s, e in zip(steps, errors, strict=True)) / sum(steps)
        each = [
            {"episode": 3 * i, "steps": s, "relative_error": e, "hold_error": hold}
            for i, (s, e) in enumerate(zip(steps, errors, strict=True))
        ]
        return {"relative_error": whole, "hold_error": hold, "episode_errors": each}

    reports = {1: report([0.25, 0.5], [30, 10], 0.75), 3: report([1.0], [400], 0.5)}
    found = OpenLoop.of(reports)
    assert found.episodes == ("1/0", "1/3", "3/0") and found.hold == pytest.approx(0.625)
    for whole, errors in ((found.error, found.errors), (found.hold, found.holds)):
        shared = zip(found.weights or (), errors or (), strict=True)
        assert sum(weight * error for weight, error in shared) == pytest.approx(whole)
    assert sum(found.weights or ()) == pytest.approx(1)
    unheld = OpenLoop.of({**reports, 3: report([1.0], [400], None)})
    assert unheld.hold is unheld.holds is None and unheld.errors == found.errors
    older = OpenLoop.of({number: {**one, "episode_errors": []} for number, one in reports.items()})
    assert older.error == found.error and older.errors is older.episodes is None


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("data/arm", "arm"),
        ("data/arm/", "arm"),
        ("owner/arm-pick", "arm-pick"),
        ("data/arm.safetensors", "arm"),
        ("data/my arm!", "my_arm"),
        (["data/left", "data/right"], "left+right"),
        ("data/tuning", "tuning-demos"),
        ("..", "demonstrations"),
        ("ä" * 200, "ä" * 50),
    ],
)
def test_a_study_without_tasks_is_named_by_its_demonstrations(
    path: str | list[str], name: str, tmp_path: Path
) -> None:
    """The recipes of its cells are those of a study with the default task."""
    tuning = {key: value for key, value in studies.TUNING.items() if key != "task"}
    shared = {"demos": {"path": path}}
    keys = studies.raw("embedded", tasks=None, tuning=tuning, shared=shared)
    made, named = (
        study_cells.load(studies.write(tmp_path, one))
        for one in (keys, {**keys, "tasks": ["reach"]})
    )
    assert isinstance(made, StudyRecipe) and isinstance(named, StudyRecipe)
    assert study_cells.places(made) == (name,) and study_cells.places(named) == ("reach",)
    cells = [
        study_cells.cell(one, "naive", at, 1, 1e-3) for one, at in ((made, name), (named, "reach"))
    ]
    assert cells[0] == cells[1]
    assert study_cells.written_out(made)["tasks"] is None


@pytest.mark.parametrize(
    ("changes", "found", "fix"),
    [
        ({"tasks": None}, "no key 'tasks', and no demonstrations", "add the line 'tasks: [reach]'"),
        (
            {"tasks": None, "shared": {"demos": {"path": "arm"}}},
            "tuning.task: reach without tasks",
            "delete tuning.task",
        ),
        ({"max_error_rise": -0.1}, "max_error_rise: -0.1", "its default is 0.02"),
    ],
)
def test_what_a_study_of_demonstrations_lacks_is_refused(
    changes: dict[str, Any], found: str, fix: str, tmp_path: Path
) -> None:
    with pytest.raises(AegisError) as caught:
        study_cells.load(studies.write(tmp_path, studies.raw("embedded") | changes))
    assert found in caught.value.found and fix in caught.value.fix


def test_what_nothing_limits_is_no_share_however_few_units_there_are() -> None:
    """A squared error has no upper limit, so a share's interval does not apply to it."""
    seeds = [Units(np.array([0.4, 0.5, level]), np.ones(3)) for level in (0.6, 0.7)]
    wide, own = crossed_interval(seeds), crossed_interval([replace(s, reach=None) for s in seeds])
    assert wide is not None and own is not None
    assert wide[0] < own[0] and own[0] > 0.3 and own[1] < 0.8 < wide[1]
