"""`aegis run` with a study: every cell once, in an order that can be interrupted anywhere.

All cells end in one comparison.
"""

from __future__ import annotations

import dataclasses
import io
import json
import math
import shutil
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from samples.studies import VARIANTS, fake_bench, invent, raw, row, study, vqa_figures, write
from samples.vqa_files import write_jsonl

from aegis_cli.cli import render
from aegis_cli.cli.page import pages
from aegis_cli.common import files, machine, version
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Progress, ignore
from aegis_cli.data.vqa import sets
from aegis_cli.recipes import Recipe, StudyRecipe, study_cells
from aegis_cli.reporting import gather
from aegis_cli.studies import policy_cells, table
from aegis_cli.studies import study as stage
from aegis_cli.studies.cells import CLEARING, Cell, CellStore
from aegis_cli.studies.comparison import StudyReport
from aegis_cli.studies.figures import PolicyFigures
from aegis_cli.studies.policy_cells import PolicyRunner, PolicyStudy, cell_key

TUNED = ["tuning/naive/0.001", "tuning/naive/0.01", "tuning/aegis-update/fixed"]
COMPARED = [f"reach/{name}/{seed}" for seed in (0, 1) for name in ("naive", "aegis-update")]


class Stop(Exception):
    """Stands for the user's Ctrl-C."""


@pytest.fixture(scope="module")
def small(tiny_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> StudyRecipe:
    return study(tmp_path_factory.mktemp("recipe"), tiny_folder)


@pytest.fixture(scope="module", autouse=True)
def bench_calls() -> Iterator[list[list[str]]]:
    with pytest.MonkeyPatch.context() as patch:
        yield fake_bench(patch)


@pytest.fixture(scope="module")
def finished(
    small: StudyRecipe, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, StudyReport]:
    """A root folder with one complete run of the study, really trained, and its report."""
    root = tmp_path_factory.mktemp("studies")
    return root, stage.run(small, root)


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The run folders of the trainings that take place."""
    places: list[str] = []
    work = policy_cells.train.run

    def run(*args: Any, **kwargs: Any) -> Any:
        places.append("/".join(Path(args[4]).parts[-3:]))
        return work(*args, **kwargs)

    monkeypatch.setattr(policy_cells.train, "run", run)
    return places


def without_place(report: StudyReport) -> dict[str, Any]:
    return json.loads(json.dumps(dataclasses.asdict(dataclasses.replace(report, out=""))))


# --- real trainings ------------------------------------------------------------------------------


def test_a_study_trains_every_cell_and_keeps_no_checkpoints(
    finished: tuple[Path, StudyReport],
) -> None:
    folder, report = finished[0] / "small", finished[1]
    assert (report.finished, report.cells) == (7, 7)
    assert len(files.load_json(folder / "cells.json")) == 7 + 2  # and two variants' step costs
    runs = {str(p.parent.relative_to(folder)) for p in folder.rglob("train.json")}
    assert runs == {*TUNED, *COMPARED}
    assert (
        not list(folder.rglob("checkpoints")) and (folder / "reach/naive/1/metrics.jsonl").exists()
    )
    assert (
        len(list(folder.glob("demos-reach-*.safetensors")))
        == len(list(folder.glob("anchor-*.safetensors")))
        == 1
    )
    assert files.load_json(folder / "table.json") == json.loads(json.dumps(report.to_json()))


def test_a_study_that_is_known_writes_its_table_once(
    small: StudyRecipe, finished: tuple[Path, StudyReport], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once, after the costs: every earlier table would have the same cells."""
    written: list[int] = []
    write_table = stage._write

    def counted(kind: Any, store: CellStore, *rest: Any) -> Any:
        written.append(store.done)
        return write_table(kind, store, *rest)

    monkeypatch.setattr(stage, "_write", counted)
    assert without_place(stage.run(small, finished[0])) == without_place(finished[1])
    assert written == [7]


def test_the_comparison_is_of_what_the_stages_found(finished: tuple[Path, StudyReport]) -> None:
    folder, report = finished[0] / "small", finished[1]
    (task,) = report.tasks
    assert [r.variant for r in task.results] == list(VARIANTS)
    for result in task.results:
        probes = [
            files.load_json(folder / f"reach/{result.variant}/{seed}/probe.json") for seed in (0, 1)
        ]
        trainings = [
            files.load_json(folder / f"reach/{result.variant}/{seed}/train.json") for seed in (0, 1)
        ]
        assert result.drop_points.mean == pytest.approx(
            statistics.fmean(p["drop_points"] for p in probes)
        )
        assert result.validation_loss.mean == pytest.approx(
            statistics.fmean(t["validation_loss"] for t in trainings)
        )
        assert (
            result.drop_points.runs == 2
            and task.baseline_accuracy == probes[0]["baseline_accuracy"]
        )
    naive, other = task.results
    assert trainings[0]["validation_loss"] != trainings[1]["validation_loss"]  # the seeds differ
    assert naive.bar is None and naive.seen_gain_points is None and naive.energy_shed is None
    assert (
        other.bar is not None and other.seen_gain_points.runs == 2 and other.energy_shed.mean >= 0
    )
    assert other.step_time == 1.12 and naive.knob == "train.backbone_lr"


def test_tuning_uses_the_validation_split_and_its_choice_is_compared(
    finished: tuple[Path, StudyReport],
) -> None:
    folder, report = finished[0] / "small", finished[1]
    assert [(p.variant, p.value) for p in report.tuning] == [
        ("naive", 0.001),
        ("naive", 0.01),
        ("aegis-update", None),
    ]
    assert [sum(p.chosen for p in report.tuning if p.variant == name) for name in VARIANTS] == [
        1,
        1,
    ]
    value = next(p.value for p in report.tuning if p.variant == "naive" and p.chosen)
    assert report.tasks[0].results[0].value == value
    assert f"backbone_lr: {value}\n" in (folder / "reach/naive/0/recipe.yaml").read_text()
    for label in TUNED:
        names = {p.name for p in (folder / label).glob("*.json")}
        measured = {"train.json", "probe-validation.json", "rollout-validation-seen.json"}
        assert names == measured | {"machine.json", "inputs.json"}


def test_a_finished_study_is_told_from_its_cells_alone(
    small: StudyRecipe,
    finished: tuple[Path, StudyReport],
    tiny_folder: Path,
    tmp_path: Path,
    trained: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """cells.json is on another machine, where the backbone has another path.

    Nothing is rendered, loaded or trained.
    """
    monkeypatch.setattr(policy_cells.backbones, "load", lambda _: pytest.fail("a model was loaded"))
    monkeypatch.setattr(
        policy_cells.sets, "load_scenes", lambda *_, **__: pytest.fail("scenes were rendered")
    )
    monkeypatch.setattr(policy_cells.gl, "check", lambda: pytest.fail("OpenGL was needed"))
    (tmp_path / "small").mkdir()
    shutil.copy(finished[0] / "small" / "cells.json", tmp_path / "small")
    shutil.copytree(tiny_folder, tmp_path / "moved")
    moved = dataclasses.replace(small, shared=small.shared | {"backbone": str(tmp_path / "moved")})
    assert without_place(stage.run(moved, tmp_path)) == without_place(finished[1])
    assert trained == [] and {p.name for p in (tmp_path / "small").iterdir()} == {
        "cells.json",
        "table.json",
    }


def test_overwrite_measures_every_cell_again(
    small: StudyRecipe,
    finished: tuple[Path, StudyReport],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shutil.copytree(finished[0] / "small", tmp_path / "small", symlinks=True)
    trained = invent(monkeypatch)
    again = stage.run(small, tmp_path, overwrite=True)
    cells = files.load_json(tmp_path / "small" / "cells.json")
    # Invented cells have no code. They may choose another value than the measured cells did, which
    # are kept unless others have taken their place.
    invented = [cell for cell in cells.values() if cell["code"] is None]
    assert len(trained) == again.cells == len(invented) == finished[1].cells
    assert [task.task for task in again.tasks] == [task.task for task in finished[1].tasks]


def test_an_interrupted_study_goes_on_to_the_same_table(
    small: StudyRecipe, finished: tuple[Path, StudyReport], tmp_path: Path, trained: list[str]
) -> None:
    def stop(event: Progress) -> None:
        if event.stage == "reach/aegis-update/0/train" and event.done == 3:
            raise Stop

    with pytest.raises(Stop):
        stage.run(small, tmp_path, stop)
    assert trained == [*TUNED, *COMPARED[:2]]
    partial = files.load_json(tmp_path / "small" / "table.json")
    assert (partial["finished"], [r["variant"] for r in partial["tasks"][0]["results"]]) == (
        4,
        ["naive"],
    )
    trained.clear()
    shutil.rmtree(tmp_path / "small" / "tuning")
    events: list[Progress] = []
    assert without_place(stage.run(small, tmp_path, events.append)) == without_place(finished[1])
    assert trained == COMPARED[1:]
    # From the checkpoint of step 2.
    assert [e.done for e in events if e.stage == "reach/aegis-update/0/train"] == [2, 3, 4]


def test_while_the_knobs_are_tuned_the_table_is_of_the_values_so_far(
    aegis, small: StudyRecipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    invent(monkeypatch, stop_after=2)
    with pytest.raises(KeyboardInterrupt):
        stage.run(small, tmp_path)
    code, out, err = aegis("inspect", tmp_path / "small", "--plot", tmp_path / "so-far.png")
    assert code == 0, err
    assert (
        "small: tuning" in out
        and "2 of 7 trainings are finished" in out
        and "no variant is named naive" not in out
    )
    assert [line.split()[:2] for line in out.splitlines() if line.startswith(" naive")] == [
        ["naive", "0.001"],
        ["naive", "0.01"],
    ]
    assert (tmp_path / "so-far.png").read_bytes().startswith(b"\x89PNG")
    points = table.load(tmp_path / "small").tuning
    assert [(p.variant, p.value, p.chosen) for p in points] == [
        ("naive", 0.001, False),
        ("naive", 0.01, False),
    ]


@pytest.mark.parametrize("part", ["validation", "probe"])
def test_questions_that_cannot_be_used_end_the_study_before_its_first_training(
    part: str, tiny_folder: Path, tmp_path: Path, trained: list[str]
) -> None:
    """This includes those of the comparison, which comes after all tuning."""
    path, shared = write_jsonl(tmp_path / "vqa"), raw(tiny_folder)["shared"]
    lines = path.read_text().splitlines(keepends=True)
    path.write_text(
        "".join(
            line for line in lines if sets.share(json.loads(line)["image"]) not in sets.PARTS[part]
        )
    )
    shared["probe"]["vqa"] = str(path)
    with pytest.raises(AegisError, match=f"no usable question for the {part}"):
        stage.run(study(tmp_path, tiny_folder, shared=shared), tmp_path / "out")
    assert trained == [] and not list((tmp_path / "out").rglob("*.safetensors"))


# --- which cells, and in which order -------------------------------------------------------------


def test_cells_come_seed_by_seed_after_the_tuning(
    tmp_path: Path, tiny_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    labels = invent(monkeypatch)
    report = stage.run(study(tmp_path, tiny_folder, tasks=["reach", "point"]), tmp_path)
    assert labels[:3] == TUNED
    assert labels[3:] == [
        f"{task}/{name}/{seed}"
        for seed in (0, 1)
        for task in ("reach", "point")
        for name in VARIANTS
    ]
    assert [t.task for t in report.tasks] == [
        "reach",
        "point",
    ] and report.finished == report.cells == len(labels)


@pytest.mark.parametrize("done", range(7))
def test_a_study_cut_anywhere_loses_nothing(
    done: int, small: StudyRecipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = invent(monkeypatch, stop_after=done)
    with pytest.raises(KeyboardInterrupt):
        stage.run(small, tmp_path)
    path = tmp_path / "small" / "cells.json"
    assert len(files.load_json(path) if path.exists() else {}) == done
    second = invent(monkeypatch)
    resumed = stage.run(small, tmp_path)
    assert [*first, *second] == [*TUNED, *COMPARED]
    invent(monkeypatch)
    assert without_place(resumed) == without_place(stage.run(small, tmp_path / "elsewhere"))


@pytest.mark.parametrize("reached", ["kept", "half removed", "removed"])
def test_what_a_killed_study_left_of_a_measured_cell_is_removed(
    reached: str, small: StudyRecipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clear = PolicyRunner.clear

    def killed(self: PolicyRunner, label: str) -> None:
        last = self.folder / label / "checkpoints" / "last"
        (last.with_name("000002") / "backbone").mkdir(parents=True)
        if reached == "half removed":
            last.rmdir()
        if reached == "removed":
            clear(self, label)
        raise Stop

    first = invent(monkeypatch)
    monkeypatch.setattr(PolicyRunner, "clear", killed)
    with pytest.raises(Stop):
        stage.run(small, tmp_path)
    folder = tmp_path / "small"
    assert len(files.load_json(folder / "cells.json")) == len(first) == 1
    assert bool(list(folder.rglob("checkpoints"))) == (reached != "removed")

    monkeypatch.setattr(PolicyRunner, "clear", clear)
    again = invent(monkeypatch)
    stage.run(small, tmp_path)
    assert [*first, *again] == [*TUNED, *COMPARED]  # the cell counts as measured
    assert not list(folder.rglob("checkpoints")) and not (folder / CLEARING).exists()


def test_a_study_killed_before_its_cell_was_kept_removes_nothing(
    small: StudyRecipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(self: CellStore, key: str, found: Any) -> None:
        raise Stop

    invent(monkeypatch)
    monkeypatch.setattr(CellStore, "keep", killed)
    with pytest.raises(Stop):
        stage.run(small, tmp_path)
    folder = tmp_path / "small"
    assert (folder / CLEARING).exists()
    CellStore(PolicyStudy(small), folder, ignore).finish_clearing()
    assert [str(path.parent.relative_to(folder)) for path in folder.rglob("checkpoints")] == [
        TUNED[0]
    ]


def test_checkpoints_that_were_kept_on_request_stay_when_the_request_is_withdrawn(
    tiny_folder: Path, small: StudyRecipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    invent(monkeypatch)
    stage.run(study(tmp_path, tiny_folder, keep_runs=True), tmp_path)
    stage.run(small, tmp_path)
    assert len(list(tmp_path.rglob("checkpoints"))) == len([*TUNED, *COMPARED])


@pytest.mark.parametrize(
    "content", ["[]", "broken", '{"cell": 1, "run": "a"}', '{"cell": "a", "run": "../b"}']
)
def test_a_damaged_note_of_a_run_being_removed_is_refused(
    content: str, small: StudyRecipe, tmp_path: Path
) -> None:
    (tmp_path / "small").mkdir()
    (tmp_path / "small" / CLEARING).write_text(content)
    with pytest.raises(AegisError, match=CLEARING):
        stage.run(small, tmp_path)


def changed(name: str, **keys: Any) -> dict[str, Any]:
    return {"variants": {**VARIANTS, name: {**VARIANTS.get(name, {}), **keys}}}


@pytest.mark.parametrize(
    ("changes", "again"),
    [
        ({}, []),
        (
            changed("aegis-update", set={"aegis.projects": "both"}),
            [TUNED[2], COMPARED[1], COMPARED[3]],
        ),
        (
            changed("second", method="lora"),
            ["tuning/second/fixed", "reach/second/0", "reach/second/1"],
        ),
        ({"seeds": [1, 2]}, ["reach/naive/2", "reach/aegis-update/2"]),
        (
            {"tasks": ["reach", "point"]},
            [f"point/{name}/{seed}" for seed in (0, 1) for name in VARIANTS],
        ),
        ({"tuning": {"questions": 21, "episodes": 2}}, TUNED),
        ({"keep_runs": True}, []),
    ],
)
def test_only_cells_that_a_change_concerns_are_trained_again(
    changes: dict[str, Any],
    again: list[str],
    small: StudyRecipe,
    tiny_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    invent(monkeypatch)
    stage.run(small, tmp_path)
    shutil.rmtree(tmp_path / "small" / "reach")
    shutil.rmtree(tmp_path / "small" / "tuning")
    labels = invent(monkeypatch)
    stage.run(study(tmp_path, tiny_folder, **changes), tmp_path)
    assert labels == again


def test_a_method_is_a_ceiling_by_its_options(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    invent(monkeypatch)
    asking = {"method": "insulate", "set": {"insulate.vqa_weight": 0.1}}
    plain = {"method": "insulate"}
    variants = {**VARIANTS, "plain": plain, "asking": asking, "cotrain": {"method": "cotrain"}}
    report = stage.run(study(tmp_path, tiny_folder, variants=variants), tmp_path)
    judged = {r.variant: r.bar is not None for r in report.tasks[0].results}
    assert judged == {
        "naive": False,
        "aegis-update": True,
        "plain": True,
        "asking": False,
        "cotrain": False,
    }


def test_a_cell_is_known_by_the_questions_that_it_trains_on(
    tiny_folder: Path, tmp_path: Path
) -> None:
    path = write_jsonl(tmp_path / "vqa")
    own = {"insulate.vqa": str(path)}
    variants = {
        "asking": {"method": "insulate", "set": {**own, "insulate.vqa_weight": 0.1}},
        "plain": {"method": "insulate", "set": own},
    }
    made = study(tmp_path, tiny_folder, variants=variants, tuning=None)
    cells = {name: Cell(name, study_cells.cell(made, name, "reach", 0)) for name in variants}

    def keys() -> dict[str, str]:
        runner = policy_cells.PolicyRunner(tmp_path, ignore)
        return {name: runner.key(cell) for name, cell in cells.items()}

    before = keys()
    path.write_text(path.read_text().replace('"red"', '"green"'))
    after = keys()
    assert before["asking"] != after["asking"] and before["plain"] == after["plain"]


def test_equal_cells_of_two_variants_are_trained_once(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    labels = invent(monkeypatch)
    twins = {
        name: {"method": "lora", "set": {"lora.rank": rank}}
        for name, rank in (("a", 16), ("b", 16), ("c", 2))
    }
    report = stage.run(
        study(tmp_path, tiny_folder, variants=twins, tuning=None, seeds=[0]), tmp_path
    )
    assert labels == ["reach/a/0", "reach/c/0"]
    assert (
        report.finished == 3
        and report.tasks[0].results[0].accuracy == report.tasks[0].results[1].accuracy
    )


def test_a_study_without_tuning_has_its_own_tasks_only(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`demos.drop_below` is for suite tasks: a recipe with any other task would be refused."""
    labels, task = invent(monkeypatch), "suite/cartpole-balance"
    shared = raw(tiny_folder)["shared"]
    shared["demos"]["drop_below"] = 0.25
    fixed = {"naive": {"method": "naive"}}
    stage.run(
        study(tmp_path, tiny_folder, tasks=[task], shared=shared, variants=fixed, tuning=None),
        tmp_path,
    )
    assert labels == [f"{task}/naive/{seed}" for seed in (0, 1)]


def test_checkpoints_are_kept_on_request(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    invent(monkeypatch)
    stage.run(study(tmp_path, tiny_folder, keep_runs=True), tmp_path)
    assert {
        str(p.parent.relative_to(tmp_path / "small")) for p in tmp_path.rglob("checkpoints")
    } == {*TUNED, *COMPARED}


def test_a_key_tells_all_that_shapes_a_row_and_nothing_else(small: StudyRecipe) -> None:
    base = Cell("a/b/0", study_cells.cell(small, "aegis-update", "reach", 0))
    recipe = base.recipe

    def replace(part: str, **keys: Any) -> Recipe:
        return dataclasses.replace(
            recipe, **{part: dataclasses.replace(getattr(recipe, part), **keys)}
        )

    same = [
        dataclasses.replace(recipe, name="other", backbone="elsewhere"),
        replace("lora", rank=3),
        replace("nullspace", energy=0.5),
    ]
    other = [
        dataclasses.replace(recipe, seed=1),
        dataclasses.replace(recipe, task="point"),
        replace("train", steps=5),
        replace("train", method="naive"),
        replace("aegis", restoration=0.5),
        replace("demos", episodes=5),
        replace("expert", width=8),
        replace("anchor", samples=15),
        replace("probe", questions=15),
        replace("rollout", episodes=3),
        replace("rollout", replan=2),
    ]
    key = cell_key(base, "0" * 64)
    assert {cell_key(Cell("c", recipe), "0" * 64) for recipe in same} == {key}
    keys = {cell_key(Cell("a/b/0", recipe), "0" * 64) for recipe in other}
    keys |= {
        cell_key(dataclasses.replace(base, validation=True), "0" * 64),
        cell_key(base, "1" * 64),
    }
    assert len(keys | {key}) == len(other) + 3


# --- costs, and files that others wrote ----------------------------------------------------------


def test_costs_are_measured_once_and_of_new_variants_only(
    small: StudyRecipe,
    tiny_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    bench_calls: list[list[str]],
) -> None:
    invent(monkeypatch)
    bench_calls.clear()
    stage.run(small, tmp_path)
    invent(monkeypatch)
    stage.run(study(tmp_path, tiny_folder, **changed("second", method="lora")), tmp_path)
    assert bench_calls == [["naive", "aegis-update"], ["naive", "second"]]
    bench_calls.clear()
    report = stage.run(
        study(tmp_path, tiny_folder, variants={"aegis": {"method": "aegis"}}, tuning=None), tmp_path
    )
    assert bench_calls == [] and report.tasks[0].results[0].step_time is None


def test_variants_that_train_alike_are_timed_once(
    tiny_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    bench_calls: list[list[str]],
) -> None:
    """Variants that differ only in a merge or a learning rate.

    Another measurement does not replace naive's.
    """
    invent(monkeypatch)
    bench_calls.clear()
    merged = {"method": "naive", "set": {"merge.method": "linear", "merge.strength": 0.4}}
    slower = {"method": "naive", "set": {"train.backbone_lr": 1e-5, "train.expert_lr": 1e-4}}
    variants = {"naive": {"method": "naive"}, "merged": merged, "slower": slower}
    variants["aegis"] = {"method": "aegis"}
    report = stage.run(study(tmp_path, tiny_folder, variants=variants, tuning=None), tmp_path)
    assert bench_calls == [["naive", "aegis"]]
    naive, *others, _ = report.tasks[0].results
    assert {one.step_time for one in others} == {naive.step_time} != {None}


def test_costs_are_kept_with_machine_and_code_and_told_without_measuring(
    small: StudyRecipe,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    bench_calls: list[list[str]],
) -> None:
    invent(monkeypatch)
    report = stage.run(small, tmp_path)
    bench_calls.clear()
    told = stage.told(small, tmp_path / "small" / "cells.json")
    assert bench_calls == [] and told.costs_on == report.costs_on == [machine.name()]
    both = zip(told.tasks[0].results, report.tasks[0].results, strict=True)
    assert all(a.step_time == b.step_time is not None for a, b in both)
    kept = files.load_json(tmp_path / "small" / "cells.json").values()
    assert {one["code"] for one in kept if "step_time" in one} == {version.code()}


@pytest.mark.parametrize("kept", ["another machine", None])
def test_costs_of_another_machine_are_measured_here(
    kept: str | None,
    small: StudyRecipe,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    bench_calls: list[list[str]],
) -> None:
    invent(monkeypatch)
    stage.run(small, tmp_path)
    path = tmp_path / "small" / "cells.json"
    cells = files.load_json(path)
    for one in cells.values():
        if "step_time" in one:
            one["machine"] = kept
    files.save_json(path, cells)
    assert stage.told(small, path).costs_on == ([kept] if kept else [])
    bench_calls.clear()
    assert stage.run(small, tmp_path).costs_on == [machine.name()]
    assert bench_calls == [["naive", "aegis-update"]]


def test_variants_with_anchors_of_their_own_are_timed_with_them(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bench_calls: list[list[str]]
) -> None:
    invent(monkeypatch)
    bench_calls.clear()
    stage.run(
        study(tmp_path, tiny_folder, **changed("few", method="aegis", set={"anchor.samples": 7})),
        tmp_path,
    )
    assert bench_calls == [["naive", "aegis-update"], ["naive", "few"]]


@pytest.mark.parametrize("content", ["[]", "broken", "entry", "number", "nothing"])
def test_cells_that_are_none_are_refused(
    content: str, small: StudyRecipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    invent(monkeypatch)
    stage.run(small, tmp_path)
    path = tmp_path / "small" / "cells.json"
    entries = {"entry": {"accuracy": 1}, "number": 5, "nothing": None}
    if content in entries:
        files.save_json(path, dict.fromkeys(files.load_json(path), entries[content]))
    else:
        path.write_text(content)
    with pytest.raises(AegisError, match="cells.json"):
        stage.run(small, tmp_path)


# --- through the command line --------------------------------------------------------------------


def test_the_command_prints_the_tables_and_draws_the_frontier(
    aegis, tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    invent(monkeypatch)
    path = write(tmp_path, raw(tiny_folder))
    code, out, _ = aegis("run", path, "--out", tmp_path, "--json", "--set", "seeds=[0, 1, 2]")
    assert code == 0 and json.loads(out)["finished"] == 9
    picture = tmp_path / "small" / "frontier.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
    picture.unlink()
    code, out, _ = aegis("run", path, "--out", tmp_path, "--set", "seeds=[0, 1, 2]")
    assert code == 0 and picture.read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "small" / "table.md").read_text().count("\n| aegis-update |") == 3
    assert out.count("\n aegis-update ") == 3 and max(map(len, out.splitlines())) <= 160
    assert aegis("inspect", tmp_path / "small", "--plot", picture) == (0, out, "")
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_what_cannot_be_rolled_out_has_tables_and_a_note_in_place_of_the_frontier(
    aegis, tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    invent(monkeypatch)
    monkeypatch.setattr(
        policy_cells.PolicyRunner,
        "figures",
        lambda self, label, recipe, *_: row(
            recipe, success_seen=None, success_held_out=None, wrong_target=None
        ),
    )
    path = write(tmp_path, raw(tiny_folder, tuning=None, variants={"naive": {"method": "naive"}}))
    code, out, err = aegis("run", path, "--out", tmp_path)
    assert code == 0 and " naive " in out and "no frontier.png" in err and "diverged" in err
    assert not (tmp_path / "small" / "frontier.png").exists()


def test_rows_that_were_measured_are_the_rows_that_come_back(
    small: StudyRecipe, tmp_path: Path
) -> None:
    recipe = study_cells.cell(small, "aegis-update", "reach", 0)
    store = CellStore(PolicyStudy(small), tmp_path, ignore)
    measured = row(recipe, success_held_out=None)
    store.keep("k", measured)
    assert CellStore(PolicyStudy(small), tmp_path, ignore).known("k", PolicyFigures) == measured


def test_cells_from_before_a_column_was_added_are_still_known(
    small: StudyRecipe, tmp_path: Path
) -> None:
    shutil.copy(
        Path(__file__).parent.parent.parent / "recipes" / "results" / "compare.cells.json",
        tmp_path / "cells.json",
    )
    store = CellStore(PolicyStudy(small), tmp_path, ignore)
    rows = [
        store.known(key, PolicyFigures) for key, entry in store.cells.items() if "accuracy" in entry
    ]
    assert rows and all(found.return_share is None and found.success_seen > 0 for found in rows)


def test_a_training_that_diverges_is_a_finding(
    tiny_folder: Path, tmp_path: Path, trained: list[str]
) -> None:
    """The study continues, and records the divergence without trying again."""
    variants = {
        "wild": {"method": "naive", "set": {"train.expert_lr": 1e30, "train.warmup": 0}},
        "naive": {"method": "naive"},
    }
    asked = study(tmp_path, tiny_folder, variants=variants, tuning=None, seeds=[0])
    report = stage.run(asked, tmp_path)
    wild, naive = report.tasks[0].results
    assert (
        wild.diverged == [0]
        and wild.accuracy is None
        and naive.diverged == []
        and naive.accuracy is not None
    )
    assert (report.finished, trained) == (2, ["reach/wild/0", "reach/naive/0"])
    kept = [
        entry
        for entry in files.load_json(tmp_path / "small" / "cells.json").values()
        if "good_steps" in entry
    ]
    assert kept == [{"good_steps": 1}]
    assert without_place(stage.run(asked, tmp_path)) == without_place(report) and len(trained) == 2


@pytest.mark.parametrize("where", ["validation", "probe"])
def test_a_model_whose_figures_are_no_numbers_has_diverged(
    where: str, tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if where == "validation":
        monkeypatch.setattr(policy_cells.train, "validation_loss", lambda *_: math.nan)
    else:
        compare = policy_cells.probe.compare
        monkeypatch.setattr(
            policy_cells.probe,
            "compare",
            lambda *args: dataclasses.replace(compare(*args), cross_entropy=math.inf),
        )
    asked = study(
        tmp_path, tiny_folder, variants={"naive": {"method": "naive"}}, tuning=None, seeds=[0]
    )
    (naive,) = stage.run(asked, tmp_path).tasks[0].results
    assert naive.diverged == [0] and naive.accuracy is None
    assert {"good_steps": 4} in files.load_json(tmp_path / "small" / "cells.json").values()


# --- several sets of questions -------------------------------------------------------------------


def test_each_set_of_questions_has_a_table_and_a_bar_of_its_own(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = raw(tiny_folder, tuning=None)
    keys["shared"]["probe"]["vqa"] = ["scenes", "easy-vqa"]
    keys["variants"] = {
        "naive": {"method": "naive"},
        "kept": {"method": "stop-gradient"},
        "kept-easy": {"method": "stop-gradient", "set": {"anchor.vqa": "easy-vqa"}},
    }
    lost = {"naive": 9.0, "kept": 7.0, "kept-easy": 3.0}
    invent(monkeypatch)
    monkeypatch.setattr(PolicyRunner, "vqa_state", lambda self, recipe: [])
    monkeypatch.setattr(
        PolicyRunner,
        "figures",
        lambda self, label, recipe, validation=False: row(
            recipe, others={"easy-vqa": vqa_figures(drop_points=lost[label.split("/")[1]])}
        ),
    )
    monkeypatch.setattr(PolicyStudy, "prepare", lambda *_: None)
    report = stage.run(study_cells.load(write(tmp_path, keys)), tmp_path / "runs")
    first, second = report.tasks
    assert (first.task, first.vqa) == ("reach", "scenes")
    assert (second.task, second.vqa) == ("reach", "easy-vqa")
    assert {r.variant: r.drop_points.mean for r in second.results} == lost
    assert (second.baseline_accuracy, second.majority_accuracy) == (0.95, 0.5)
    drops = [r.bar.checks[0].passed for t in report.tasks for r in t.results if r.variant == "kept"]
    assert drops == [True, False]  # here stop-gradient loses nothing on the first set
    for one, other in zip(first.results, second.results):
        assert one.success_seen == other.success_seen
    assert table.load(tmp_path / "runs" / "small").tasks == report.tasks
    shown = io.StringIO()
    Console(file=shown, width=160).print(render.study(report))
    assert "small: reach, asked easy-vqa" in shown.getvalue()


def test_policies_that_cannot_be_rolled_out_are_compared_by_their_open_loop_error(
    tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = raw(tiny_folder, tuning=None)
    keys["variants"] = {"naive": {"method": "naive"}, "kept": {"method": "stop-gradient"}}
    errors = {"naive": 0.25, "kept": 0.5}
    invent(monkeypatch)
    acted = dict.fromkeys(("success_seen", "success_held_out", "wrong_target"))
    monkeypatch.setattr(
        PolicyRunner,
        "figures",
        lambda self, label, recipe, validation=False: row(
            recipe, **acted, open_loop_error=errors[label.split("/")[1]], hold_error=0.75
        ),
    )
    monkeypatch.setattr(PolicyStudy, "prepare", lambda *_: None)
    report = stage.run(study_cells.load(write(tmp_path, keys)), tmp_path / "runs")
    (task,) = report.tasks
    assert {r.variant: r.open_loop_error.mean for r in task.results} == errors
    place = tmp_path / "runs" / "small"
    assert table.load(place).tasks == report.tasks
    shown = io.StringIO()
    Console(file=shown, width=160).print(render.study(report))
    header = next(line for line in shown.getvalue().splitlines() if "Drop (points)" in line)
    assert "Open-loop error  Holding's error" in header and "Success" not in header
    said = " ".join(shown.getvalue().split())
    assert "Error - naive's Error - no policy's" in said and "success seen" not in said
    assert "the open-loop error is not a success rate" in said and "no variant can pass" not in said
    bars = {r.variant: r.bar for r in task.results}
    failed = {c.name: c.passed for c in bars["kept"].checks}
    assert failed["open-loop error - naive's"] is not True and bars["naive"] is None
    document = str(pages.page(gather.run(place), place))
    assert (
        "the open-loop error is not a success rate" in document
        and "Holding&#x27;s error" in document
    )
    older = files.load_json(place / "table.json")
    for result in older["tasks"][0]["results"]:
        for name in ("open_loop_error", "hold_error", "open_loop_difference"):
            del result[name]
        del result["open_loop_over_still"]
    files.save_json(place / "table.json", older)  # as written before the figure existed
    assert {r.open_loop_error for r in table.load(place).tasks[0].results} == {None}


def test_one_set_of_questions_has_no_name(finished: tuple[Path, StudyReport]) -> None:
    assert [task.vqa for task in finished[1].tasks] == [None]


def test_values_whose_names_would_be_alike_have_folders_of_their_own() -> None:
    values = ["{} Answer briefly.", "Answer briefly. {}", None, 0.1, "0.1", "layers.*", "layers.?"]
    found = stage._folders(values)
    assert len(set(found)) == len(values) and stage._folders(values[:1] + values[2:4]) == [
        "Answer_briefly.",
        "fixed",
        "0.1",
    ]
