"""`aegis run --dry-run`: it says what the job then does, and writes nothing."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from samples import studies as study_samples
from samples.command import refused
from samples.small_run import flipped, recipe
from samples.training_runs import contents

from aegis_cli import recipes
from aegis_cli.common import memory
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Progress
from aegis_cli.recipes import Anchor, Demos, Merge, Probe, Recipe
from aegis_cli.studies import pipeline, plan, study
from aegis_cli.studies.plan import JobPlan, StudyPlan

Aegis = Callable[..., tuple[int, str, str]]
METHODS = ("naive", "aegis")
SKIPPED = " (up to date)"


@pytest.fixture(scope="module")
def small(tiny_folder: Path) -> Recipe:
    return recipe(tiny_folder, METHODS)


@pytest.fixture(scope="module")
def finished(small: Recipe, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A root folder in which the recipe was run once; never modified."""
    root = tmp_path_factory.mktemp("planned")
    pipeline.run(small, root)
    return root


@pytest.fixture
def root(finished: Path, tmp_path: Path) -> Path:
    """A copy of it that tests may change."""
    return Path(shutil.copytree(finished, tmp_path / "runs", symlinks=True))


def due(found: JobPlan) -> dict[str, str]:
    """The reason for each stage that would run."""
    return {one.stage: one.due for one in found.stages if one.due is not None}


def job(wanted: Recipe, root: Path, **options: Any) -> JobPlan:
    """The plan; nothing is written for it."""
    before = contents(root)
    found = plan.run(wanted, root, **options)
    assert contents(root) == before and isinstance(found, JobPlan)
    return found


def skipped(wanted: Recipe, root: Path) -> set[str]:
    """The stages that a job reports as up to date while it runs."""
    events: list[Event] = []
    pipeline.run(wanted, root, events.append)
    told = [e.stage for e in events if isinstance(e, Progress) and e.stage.endswith(SKIPPED)]
    return {stage.removesuffix(SKIPPED) for stage in told}


def test_of_a_job_that_has_not_begun_every_stage_would_run(small: Recipe, tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    found = job(small, tmp_path / "runs")
    stages = ["train", "probe", "rollout seen", "rollout held-out"]
    own = [f"{method}/{stage}" for method in METHODS for stage in stages]
    assert [one.stage for one in found.stages] == ["demos", "anchor", *own] == list(due(found))
    commands = [f"aegis {name}" for name in ("demos", "anchor", "train", "probe", "rollout")]
    assert list(dict.fromkeys(one.command for one in found.stages)) == commands
    reasons = due(found)
    assert reasons["demos"] == reasons["anchor"] == "has not run yet"
    assert reasons["naive/train"] == "follows on demos"
    assert reasons["naive/rollout seen"] == "follows on naive/train"
    assert found.trainings == dict.fromkeys(METHODS) and found.hours is None


def test_of_a_finished_job_nothing_would_run_unless_all_shall(
    small: Recipe, finished: Path
) -> None:
    found = job(small, finished)
    assert not due(found) and not found.trainings
    again = job(small, finished, overwrite=True)
    assert due(again)["demos"] == "--overwrite" and len(due(again)) == len(again.stages)


@pytest.mark.parametrize(
    "changes",
    [
        {"probe": Probe(questions=15)},
        {"rollout": {"episodes": 3}},
        {"methods": ("naive", "stop-gradient")},
        {"aegis": {"projects": "update"}},
        {"train": {"steps": 6}},
        {"anchor": Anchor(samples=15, batch_size=14)},
        {"demos": Demos(episodes=5)},
        {"merge": Merge("linear", 0.5)},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_the_job_runs_what_the_plan_says(
    changes: dict[str, Any], small: Recipe, root: Path
) -> None:
    for name, value in changes.items():
        if isinstance(value, dict):
            value = replace(getattr(small, name), **value)
        small = replace(small, **{name: value})
    found = job(small, root)
    would_run, done = due(found), skipped(small, root)
    assert would_run and would_run.keys() | done == {one.stage for one in found.stages}
    assert not would_run.keys() & done
    assert not due(job(small, root))


@pytest.mark.parametrize(
    ("name", "damage", "says"),
    [
        ("naive/probe.json", Path.unlink, "naive/probe.json is missing"),
        ("naive/train.json", lambda path: path.write_text("{}"), "naive/train.json has changed"),
        (
            "anchor.safetensors",
            lambda path: path.write_bytes(flipped(path.read_bytes())),
            "anchor.safetensors has changed",
        ),
    ],
)
def test_a_lost_or_changed_output_is_named(
    name: str, damage: Callable[[Path], Any], says: str, small: Recipe, root: Path
) -> None:
    damage(root / "small" / name)
    reasons = due(job(small, root))
    assert says in reasons.values()


def test_other_keys_are_the_reason(small: Recipe, root: Path) -> None:
    reasons = due(job(replace(small, rollout=replace(small.rollout, episodes=3)), root))
    assert reasons.keys() == {f"{m}/rollout {c}" for m in METHODS for c in ("seen", "held-out")}
    assert all(reason.startswith("what it reads has changed") for reason in reasons.values())


def test_a_training_whose_inputs_are_there_says_what_it_needs(small: Recipe, root: Path) -> None:
    longer = replace(small, train=replace(small.train, steps=9))
    found = job(longer, root)
    assert found.trainings.keys() == set(METHODS)
    told = {method: report for method, report in found.trainings.items() if report is not None}
    assert told.keys() == set(METHODS)
    for method, report in told.items():
        assert (report.method, report.steps) == (method, 9)
        assert report.out == str(root / "small" / method)
        # The training needs memory that the previous one has left to the process.
        assert report.memory_measured_mb is None
        assert report.memory_needed_mb == report.memory_total_mb > 0
        assert report.step_s is not None and report.validation_s is not None
        validations = -(-9 // longer.train.validate_every)
        took = report.step_s * 9 + report.validation_s["loss"] * validations
        assert report.hours == pytest.approx(took / 3600)
    assert found.disk_mb == sum(report.disk_mb for report in told.values()) > 0
    assert found.hours == sum(report.hours or 0 for report in told.values())


def test_a_training_that_was_interrupted_goes_on(small: Recipe, root: Path) -> None:
    longer = replace(small, methods=("naive",), train=replace(small.train, steps=6))

    def stop(event: Event) -> None:
        if isinstance(event, Progress) and event.stage == "naive/train" and event.done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pipeline.run(longer, root, stop)
    report = job(longer, root).trainings["naive"]
    assert report is not None and report.hours is not None
    assert report.step_s is not None and report.validation_s is not None
    # It resumes from the checkpoint after two steps; validations follow after steps 4 and 6.
    left = 4 * report.step_s + 2 * report.validation_s["loss"]
    assert report.hours == pytest.approx(left / 3600)


def test_what_needs_no_anchor_is_told_before_one_is_measured(
    small: Recipe, demos_file: Path, tmp_path: Path
) -> None:
    (tmp_path / "runs").mkdir()
    found = job(replace(small, demos=Demos(path=str(demos_file))), tmp_path / "runs")
    assert [one.stage for one in found.stages][0] == "anchor"
    assert found.trainings["naive"] is not None and found.trainings["aegis"] is None


def test_what_a_job_refuses_its_plan_refuses(small: Recipe, tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    with pytest.raises(AegisError, match="models/typo"):
        job(replace(small, backbone="models/typo"), tmp_path / "runs")


def test_a_run_that_was_trained_by_hand_is_in_the_way_of_plan_and_job(
    small: Recipe, root: Path
) -> None:
    shutil.copytree(root / "small" / "naive", root / "small" / "lora", symlinks=True)
    other = replace(small, methods=("lora",))
    said = []
    for begin in (pipeline.run, plan.run):
        with pytest.raises(AegisError, match="did not begin it") as caught:
            begin(other, root)
        said.append(caught.value.found)
    assert said[0] == said[1]


def test_through_the_command_line(
    aegis: Aegis, small: Recipe, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "r.yaml"
    path.write_text(recipes.to_yaml(replace(small, train=replace(small.train, steps=9))))
    before = contents(root)
    code, out, _ = aegis("run", path, "--out", root, "--dry-run", "--json")
    told = json.loads(out)
    assert code == 0 and told["stages"][0]["due"] is None
    assert told["trainings"]["naive"]["steps"] == 9
    code, out, _ = aegis("run", path, "--out", root, "--dry-run", "--wide")
    assert code == 0 and "8 of 10 stages would run" in out and "follows on naive/train" in out
    monkeypatch.setattr(memory, "free", lambda device: 1000)
    code, _, err = aegis("run", path, "--out", root, "--dry-run")
    assert code == 1 and "gate failed: naive: training needs" in err
    assert contents(root) == before


def test_all_checkpoints_together_have_to_fit(small: Recipe, root: Path) -> None:
    found = job(replace(small, train=replace(small.train, steps=9)), root)
    assert plan.shortage(found) is None
    tight = replace(found, disk_free_mb=found.disk_mb * 0.9)
    assert "all methods" in str(plan.shortage(tight))


# --- studies --------------------------------------------------------------------------------------


def cells(found: StudyPlan) -> dict[str, str | None]:
    return {cell.cell: cell.due for cell in found.cells}


def test_the_cells_of_a_study(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = study_samples.study(tmp_path, tiny_folder)
    asked = study_samples.invent(monkeypatch, stop_after=1)
    study_samples.fake_bench(monkeypatch)
    root = tmp_path / "runs"

    def planned(**options: Any) -> dict[str, str | None]:
        before = contents(root) if root.exists() else None
        found = plan.run(wanted, root, **options)
        assert (contents(root) if root.exists() else None) == before
        assert isinstance(found, StudyPlan)
        assert found.finished == list(cells(found).values()).count(None)
        return cells(found)

    first = planned()
    assert not list(first.values()).count(None)
    assert first["reach/naive/0"] == "follows on the tuning, which chooses its value"
    with pytest.raises(KeyboardInterrupt):
        study.run(wanted, root)
    begun = planned()
    assert [label for label, reason in begun.items() if reason is None] == asked
    monkeypatch.undo()
    asked = study_samples.invent(monkeypatch)
    study_samples.fake_bench(monkeypatch)
    study.run(wanted, root)
    assert {label for label, reason in begun.items() if reason is not None} == set(asked)
    assert set(planned().values()) == {None} and None not in planned(overwrite=True).values()


def test_a_study_through_the_command_line(aegis: Aegis, tiny_folder: Path, tmp_path: Path) -> None:
    path = study_samples.write(tmp_path, study_samples.raw(tiny_folder))
    code, out, _ = aegis("run", path, "--out", tmp_path / "runs", "--dry-run", "--wide")
    assert code == 0 and "7 of 7 cells would be measured" in out
    assert not (tmp_path / "runs").exists()
    assert "models/typo" in refused(
        aegis("run", path, "--dry-run", "--set", "shared.backbone=models/typo")
    )
