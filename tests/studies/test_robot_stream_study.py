"""`aegis run` with a study of a robot stream: every cell once, with its seed's own data.

Its figures are those of the streams themselves.
"""

from __future__ import annotations

import copy
import dataclasses
import json
import statistics
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from samples.robots import Make
from samples.vqa_files import write_jsonl

from aegis_cli.common import files, version
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import ignore
from aegis_cli.continual import train
from aegis_cli.continual.report import vqa_scores
from aegis_cli.core.accuracy_matrix import SeenScores
from aegis_cli.recipes import RobotStreamRecipe, RobotStreamStudyRecipe, load_training, study_cells
from aegis_cli.recipes.strict_yaml import dump
from aegis_cli.studies import comparison, robot_stream_cells
from aegis_cli.studies import study as stage
from aegis_cli.studies.cells import Cell, CellStore
from aegis_cli.studies.figures import Divergence, RobotStreamFigures
from aegis_cli.studies.robot_stream_cells import RobotStreamRunner, RobotStreamStudy
from aegis_cli.studies.tuning import ROBOT_STREAM_RULE, RobotStreamPoint, choose

Aegis = Callable[..., tuple[int, str, str]]
TASKS = ("reach", "point")
VARIANTS: dict[str, Any] = {
    "sequential": {"method": "sequential"},
    "isolated-lora": {"method": "isolated-lora", "set": {"isolated_lora.rank": 2}},
}


def raw(backbone: Path | str, **changes: Any) -> dict[str, Any]:
    """The keys of a study that takes seconds; `changes` replace top-level keys."""
    train_keys = {"steps": 4, "batch_size": 4, "chunk": 20, "flow_samples": 2, "warmup": 1}
    keys = {
        "kind": "robot-stream-study",
        "name": "small",
        "tasks": list(TASKS),
        "seeds": [3, 4],
        "per_seed": ["demos", "questions", "episodes"],
        "shared": {
            "backbone": str(backbone),
            "demos": {"episodes": 3},
            "train": {**train_keys, "lr": 1e-2, "precision": "float32"},
            "expert": {"width": 16, "mlp_ratio": 1},
            "rollout": {"episodes": 1, "replan": 20},
            "probe": {"questions": 20},
        },
        "variants": VARIANTS,
    }
    return copy.deepcopy({name: v for name, v in (keys | changes).items() if v is not None})


def write(folder: Path, keys: dict[str, Any]) -> Path:
    path = folder / "study.yaml"
    path.write_text(dump(keys))
    return path


def study(folder: Path, backbone: Path | str = "embedded", **changes: Any) -> Any:
    """The study as read from a file."""
    loaded = study_cells.load(write(folder, raw(backbone, **changes)))
    assert isinstance(loaded, RobotStreamStudyRecipe)
    return loaded


def figures(**changes: Any) -> RobotStreamFigures:
    """Figures of two tasks by hand."""
    plain: dict[str, Any] = {
        "method": "igsp",
        "success": ((0.5,), (0.25, 0.75)),
        "average": 0.5,
        "last": 0.5,
        "forgetting": 0.25,
        "vqa": (0.9, 0.8, 0.7),
        "cross_entropy": (0.1, 0.2, 0.3),
        "parameters": 100,
        "trained_mean": 50.0,
        "reuse": None,
        "minutes": 2.0,
    }
    return RobotStreamFigures(**plain | changes)


# --- really learned ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(
    tiny_folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Any, Path, list[Path]]:
    """A complete run of a study, its folder, and the recordings that it made; read-only."""
    folder = tmp_path_factory.mktemp("study")
    asked = study(folder, tiny_folder, keep_runs=True)
    report = stage.run(asked, folder)
    return report, folder / "small", sorted((folder / "small").glob("demos-*.safetensors"))


def test_the_figures_are_those_of_the_streams_alone(
    finished: tuple[Any, Path, list[Path]], tmp_path: Path
) -> None:
    report, folder, _ = finished
    assert report.finished == report.cells == 4 and report.tasks == list(TASKS)
    cells = files.load_json(folder / "cells.json")
    runner = RobotStreamRunner(tmp_path / "keys", ignore)
    for result in report.results:
        alone = []
        for seed in (3, 4):
            recipe = load_training(folder / "stream" / result.variant / str(seed) / "recipe.yaml")
            assert isinstance(recipe, RobotStreamRecipe) and recipe.seed == seed
            one = train.run(recipe, tmp_path / result.variant / str(seed))
            recorded = dataclasses.replace(
                recipe, demos=dataclasses.replace(recipe.demos, paths=None)
            )
            cell = cells[runner.key(Cell("any", recorded))]
            assert cell["success"] == [list(row) for row in one.success]
            assert cell["vqa"] == [each.accuracy for each in one.vqa]
            assert cell["cross_entropy"] == [each.cross_entropy for each in one.vqa]
            alone.append(one)
    told = [cell["cross_entropy"] for cell in cells.values()]
    assert len({tuple(one) for one in told}) == 4  # each has other questions or another training
    for result in report.results:
        alone = [
            train.run(
                load_training(folder / "stream" / result.variant / str(seed) / "recipe.yaml"),
                tmp_path / result.variant / str(seed),
                resume=True,
            )
            for seed in (3, 4)
        ]
        assert result.last.mean == statistics.fmean(one.scores.last for one in alone)
        lost = statistics.fmean(one.vqa[-1].drop_points for one in alone)
        assert result.drop_points.mean == pytest.approx(lost, abs=1e-9)
        assert result.after[-1].drop_points.mean == pytest.approx(lost, abs=1e-9)
        first = [one.success[1][0] for one in alone]
        assert result.after[1].success[0].mean == statistics.fmean(first)
        assert [after.task for after in result.after] == list(TASKS)
        assert [len(after.success) for after in result.after] == [1, 2]


def test_variants_share_the_demonstrations_of_their_seed(
    finished: tuple[Any, Path, list[Path]],
) -> None:
    _, folder, recorded = finished
    assert len(recorded) == 4  # two tasks, two seeds
    used: dict[int, set[tuple[str, ...]]] = {}
    for variant in VARIANTS:
        for seed in (3, 4):
            recipe = load_training(folder / "stream" / variant / str(seed) / "recipe.yaml")
            used.setdefault(seed, set()).add(recipe.demos.paths)
            assert (recipe.probe.seed, recipe.rollout.seed) == (seed, seed)
    assert [len(paths) for paths in used.values()] == [1, 1]
    assert not set(*used[3]) & set(*used[4])


def test_a_finished_study_is_told_shown_and_not_run_again(
    finished: tuple[Any, Path, list[Path]],
    tiny_folder: Path,
    aegis: Aegis,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    report, folder, _ = finished

    def refuse(*_: Any) -> None:
        raise AssertionError("a cell was measured again")

    monkeypatch.setattr(RobotStreamRunner, "measure", refuse)
    again = stage.run(study(folder.parent, tiny_folder, keep_runs=True), folder.parent)
    assert again == report
    told = stage.told(study(folder.parent, tiny_folder), folder / "cells.json")
    assert told.results == report.results
    code, out, err = aegis("inspect", folder, "--json")
    assert code == 0 and json.loads(out)["results"][0]["variant"] == "sequential", err
    code, out, err = aegis("inspect", folder, "--wide")
    assert code == 0 and "isolated-lora: task by task" in out and "VQA lost (points)" in out, err
    code, out, err = aegis("report", folder)
    page = (folder / "report.html").read_text()
    assert code == 0 and "Study of a robot stream" in page and "sequential: task by task" in page


@pytest.mark.usefixtures("quick_workers")
def test_processes_find_what_one_finds(
    finished: tuple[Any, Path, list[Path]], tiny_folder: Path, tmp_path: Path
) -> None:
    report, folder, _ = finished
    together = stage.run(study(tmp_path, tiny_folder), tmp_path, workers=2)
    for one, other in zip(report.results, together.results, strict=True):
        assert dataclasses.replace(other, minutes=one.minutes) == one
    cells = [files.load_json(at / "cells.json") for at in (folder, tmp_path / "small")]
    for found in cells:
        for cell in found.values():
            del cell["minutes"]
    assert cells[0] == cells[1]
    assert not (tmp_path / "small" / "stream").exists()  # runs are cleared unless they are kept


def test_the_command_runs_a_study_and_writes_its_tables(
    tiny_folder: Path, tmp_path: Path, aegis: Aegis
) -> None:
    tuned = {"sequential": {"method": "sequential", "tune": {"sequential.lr": [1e-4, 1e-3]}}}
    keys = raw(tiny_folder, seeds=[3], variants=tuned, tuning={"seed": 9})
    code, out, err = aegis("run", write(tmp_path, keys), "--out", tmp_path / "runs")
    folder = tmp_path / "runs" / "small"
    assert code == 0 and "sequential: task by task" in out, err
    assert "Knobs" in out and "highest VQA accuracy after the last task" in " ".join(out.split())
    assert (folder / "table.md").is_file() and (folder / "report.html").is_file()


def test_a_run_is_cleared_without_the_folder_where_another_may_begin(tmp_path: Path) -> None:
    runner = RobotStreamRunner(tmp_path, ignore)
    folder = tmp_path / "stream" / "igsp"
    (folder / "3").mkdir(parents=True)
    (folder / "3.begun").write_text("key")
    runner.clear("stream/igsp/3")
    assert folder.is_dir() and not list(folder.iterdir())
    (folder / "4.begun").write_text("of a process that has just begun")
    runner.tidy(["stream/igsp/3"])
    assert (folder / "4.begun").is_file()
    runner.clear("stream/igsp/4")
    (tmp_path / "stream" / "kept").mkdir()  # not the label of any run
    runner.tidy(["stream/igsp/3", "stream/igsp/4"])
    assert not folder.exists() and (tmp_path / "stream" / "kept").is_dir()


def test_a_file_of_somebody_elses_is_moved_with_its_run_not_removed(tmp_path: Path) -> None:
    runner = RobotStreamRunner(tmp_path, ignore)
    run = tmp_path / "stream" / "igsp" / "3"
    run.mkdir(parents=True)
    (run / "my-notes.txt").write_text("mine")
    runner.clear("stream/igsp/3")
    assert not run.exists()
    assert [p.read_text() for p in (tmp_path / "stream").rglob("my-notes.txt")] == ["mine"]


def test_runs_moved_at_the_same_time_by_the_clock_are_both_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after the clock was set back."""
    monkeypatch.setattr("aegis_cli.training.folder.time.strftime", lambda _: "2026-01-01_120000")
    runner = RobotStreamRunner(tmp_path, ignore)
    run = tmp_path / "stream" / "igsp" / "3"
    for note in ("first", "second", "third"):
        run.mkdir(parents=True)
        (run / "my-notes.txt").write_text(note)
        runner.clear("stream/igsp/3")
    kept = {path.parent.name: path.read_text() for path in tmp_path.rglob("my-notes.txt")}
    name = "3.2026-01-01_120000"
    assert kept == {name: "first", f"{name}-2": "second", f"{name}-3": "third"}


def test_begun_anew_a_study_records_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorded: list[str] = []

    def run(task: str, episodes: int, seed: int, out: Path, *_: Any, **__: Any) -> None:
        recorded.append(task)
        out.write_bytes(b"frames")

    monkeypatch.setattr("aegis_cli.training.up_to_date.record.run", run)
    recipe = RobotStreamStudy(study(tmp_path)).cell("sequential", "stream", 3, None)
    RobotStreamRunner(tmp_path, ignore).demonstrations(recipe)
    RobotStreamRunner(tmp_path, ignore).demonstrations(recipe)
    assert recorded == ["reach", "point"]
    anew = RobotStreamRunner(tmp_path, ignore)
    anew.begin_anew()
    anew.demonstrations(recipe)
    assert recorded == ["reach", "point"] * 2


# --- seeds of a stream ---------------------------------------------------------------------------


@pytest.mark.parametrize("section", ["probe", "rollout"])
def test_a_stream_asks_and_plays_by_the_seeds_of_its_recipe(
    section: str, make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    played: list[int] = []

    def play(*_: Any, seed: int, **__: Any) -> Any:
        played.append(seed)
        return type("Played", (), {"success": 0.0, "return_share": None})

    monkeypatch.setattr("aegis_cli.continual.robot_evaluators.play", play)
    plain = make("sequential")
    changed = dataclasses.replace(getattr(plain, section), seed=7)
    runs = [
        train.build(recipe, tmp_path)
        for recipe in (plain, dataclasses.replace(plain, **{section: changed}))
    ]
    asked = [[q.text for q in run.evaluator._asked.questions] for run in runs]
    for run in runs:
        run.evaluator.tried(0)
    assert (asked[0] != asked[1]) == (section == "probe")
    assert played == ([0, 0] if section == "probe" else [0, 7])


# --- keys ----------------------------------------------------------------------------------------


def test_a_cell_is_another_where_what_shapes_it_is(
    make: Make, tiny_folder: Path, tmp_path: Path
) -> None:
    def key(recipe: RobotStreamRecipe, label: str = "a", validation: bool = False) -> str:
        return RobotStreamRunner(tmp_path, ignore).key(Cell(label, recipe, validation))

    plain = make("igsp")
    paths = plain.demos.paths
    assert paths is not None
    recorded = dataclasses.replace(plain, demos=dataclasses.replace(plain.demos, paths=None))
    copied = [tmp_path / "one.safetensors", tmp_path / "two.safetensors"]
    for path, source in zip(copied, paths, strict=True):
        path.write_bytes(Path(source).read_bytes())
    moved = dataclasses.replace(plain.demos, paths=tuple(map(str, copied)))
    questions = write_jsonl(tmp_path / "questions")
    others = [
        recorded,
        dataclasses.replace(recorded, demos=dataclasses.replace(recorded.demos, seed=1)),
        dataclasses.replace(plain, seed=1),
        dataclasses.replace(plain, tasks=("point", "reach")),
        dataclasses.replace(plain, rollout=dataclasses.replace(plain.rollout, seed=1)),
        dataclasses.replace(plain, probe=dataclasses.replace(plain.probe, vqa=str(questions))),
        dataclasses.replace(plain, igsp=dataclasses.replace(plain.igsp, rank=3)),
        dataclasses.replace(plain, train=dataclasses.replace(plain.train, method="sequential")),
    ]
    keys = [key(plain), key(plain, validation=True), *map(key, others)]
    assert len(set(keys)) == len(keys)
    same = [
        key(plain, "elsewhere"),
        key(dataclasses.replace(plain, demos=moved)),
        key(dataclasses.replace(plain, sequential=type(plain.sequential)(lr=1.0))),
    ]
    assert set(same) == {keys[0]}


def test_a_cell_keeps_what_its_report_says() -> None:
    vqa = vqa_scores([(0.9, 0.1), (0.8, 0.2), (0.6, 0.3)])
    report = SimpleNamespace(
        method="igsp",
        success=((0.5,), (0.25, 0.75)),
        scores=SeenScores(average=0.1, last=0.2, forgetting=0.3),
        vqa=vqa,
        parameters=7,
        trained_mean=5.0,
        reuse=0.4,
        minutes=2.0,
    )
    found = RobotStreamRunner(Path("any"), ignore).figures(report)
    assert (found.average, found.last, found.forgetting) == (0.1, 0.2, 0.3)
    assert found.vqa == (0.9, 0.8, 0.6) and found.cross_entropy == (0.1, 0.2, 0.3)
    assert found.success == report.success and found.parameters == 7 and found.reuse == 0.4
    assert found.trained_mean == 5.0 and found.minutes == 2.0 and found.code == version.code()


# --- tables --------------------------------------------------------------------------------------


def test_means_are_over_seeds_and_differences_are_of_the_same_seed() -> None:
    loras = {("stream", s): figures(last=0.4 + s / 10, parameters=200) for s in (0, 1)}
    found = {
        "isolated-lora": loras,
        "igsp": {("stream", s): figures(last=0.5 + s / 10) for s in (0, 1)},
        "wild": {("stream", 0): Divergence(3), ("stream", 1): figures(vqa=(0.9, 0.9, 0.9))},
    }
    variants = {name: type("V", (), {"method": "igsp", "knob": None}) for name in found}
    lora, igsp, wild = comparison.robot_stream_results(found, variants, {}, TASKS)
    assert lora.last.mean == pytest.approx(0.45) and lora.learned.mean == pytest.approx(0.625)
    assert (
        igsp.last_gain_points.mean == pytest.approx(10) and igsp.last_gain_points.interval is None
    )
    assert igsp.parameters_ratio.mean == 0.5 and lora.last_gain_points.mean == 0
    assert igsp.drop_points.mean == pytest.approx(20) and igsp.accuracy.mean == 0.7
    assert [a.drop_points.mean for a in igsp.after] == pytest.approx([10, 20])
    assert igsp.forgetting.mean == 25 and igsp.reuse is None
    assert wild.diverged == [0] and wild.drop_points.mean == 0 and wild.last.interval is None


def test_seeds_that_came_out_alike_by_chance_have_no_interval() -> None:
    still = {"vqa": (0.9, 0.9, 0.9), "cross_entropy": (0.1, 0.1, 0.1)}
    moved = still | {"method": "sequential", "cross_entropy": (0.1, 0.2, 0.2)}
    found = {
        name: {("stream", s): figures(**keys) for s in (0, 1)}
        for name, keys in {"igsp": still, "sequential": moved}.items()
    }
    variants = {name: type("V", (), {"method": name, "knob": None}) for name in found}
    igsp, moving = comparison.robot_stream_results(found, variants, {}, TASKS)
    assert igsp.last.interval is None and igsp.after[1].success[0].interval is None
    assert igsp.drop_points.interval == (0, 0) == igsp.after[1].drop_points.interval
    assert moving.drop_points.interval is None is moving.after[1].drop_points.interval
    assert igsp.forgetting.interval == (25, 25) and moving.forgetting.interval is None


def test_a_knob_is_chosen_by_success_and_then_by_what_is_known() -> None:
    points = {
        "igsp": [
            RobotStreamPoint("igsp", "igsp", 1, 0.80, 0.5),
            RobotStreamPoint("igsp", "igsp", 2, 0.78, 0.9),  # within three points, and knows more
            RobotStreamPoint("igsp", "igsp", 3, 0.70, 1.0),
            RobotStreamPoint("igsp", "igsp", 4, None, None),
        ]
    }
    assert choose(ROBOT_STREAM_RULE, points, 3.0) == {"igsp": 1}


def test_a_knob_is_tried_on_validation_episodes_with_a_seed_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    variants = {"sequential": {"method": "sequential", "tune": {"sequential.lr": [1e-4, 1e-3]}}}
    asked = study(tmp_path, variants=variants, seeds=[3], tuning={"seed": 9, "within": 3})
    learned: list[tuple[str, int, str, float]] = []

    def measure(self: RobotStreamRunner, cell: Cell) -> RobotStreamFigures:
        recipe = self.learned(cell)
        learned.append((cell.label, recipe.seed, recipe.rollout.split, recipe.sequential.lr))
        return figures(last=recipe.sequential.lr * 100)

    monkeypatch.setattr(RobotStreamRunner, "measure", measure)
    monkeypatch.setattr(RobotStreamRunner, "demonstrations", lambda *_: ("a", "b"))
    report = stage.run(asked, tmp_path)
    assert learned == [
        ("tuning/sequential/0.0001", 9, "validation", 1e-4),
        ("tuning/sequential/0.001", 9, "validation", 1e-3),
        ("stream/sequential/3", 3, "evaluation", 1e-3),
    ]
    assert report.results[0].value == 1e-3 and [p.chosen for p in report.tuning] == [False, True]


def test_a_divergence_is_kept_as_a_finding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RobotStreamRunner, "measure", lambda *_: Divergence(2))
    report = stage.run(study(tmp_path), tmp_path)
    assert [r.diverged for r in report.results] == [[3, 4], [3, 4]]
    assert all(r.last is None and r.after[0].drop_points is None for r in report.results)
    kind = RobotStreamStudy(study(tmp_path))
    assert CellStore(kind, tmp_path / "small", ignore).cells


# --- bad studies ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"tasks": ["reach", "juggle"]}, "juggle"),
        ({"per_seed": ["anchor"]}, "per_seed"),
        ({"seeds": [3], "tuning": {"seed": 3}}, "tuning.seed"),
        ({"variants": {"x": {"method": "nullspace"}}}, "variants.x.method"),
        ({"variants": {"x": {"method": "igsp", "set": {"probe.questions": 3}}}}, "probe.questions"),
        ({"variants": {"x": {"method": "igsp", "set": {"rollout.seed": 3}}}}, "rollout.seed"),
        ({"variants": {"isolated-lora": {"method": "igsp"}}}, "isolated-lora"),
        ({"variants": {"x": {"method": "igsp", "tune": {"igsp.rank": [1, 2]}}}}, "tune"),
        ({"per_seed": [["demos"]]}, "per_seed"),
        ({"per_seed": [{"demos": 1}]}, "per_seed"),
        (
            {"variants": {"x": {"method": "igsp", "set": {"demos.paths": ["a", "b"]}}}},
            "variants.x.set: demos.paths",
        ),
        ({"variants": {"x": {"method": "sequential", "set": {"train.lr": 1}}}}, "sequential.lr"),
        (
            {
                "variants": {"x": {"method": "igsp", "set": {"rollout.seed": 3}}},
                "per_seed": ["demos"],
            },
            "rollout.seed",
        ),
    ],
)
def test_a_bad_study_is_refused_before_any_work(
    changes: dict[str, Any], named: str, tmp_path: Path
) -> None:
    with pytest.raises(AegisError) as caught:
        stage.run(study(tmp_path, **changes), tmp_path / "runs")
    assert named in str(caught.value) and not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("section", "keys"),
    [
        ("rollout", {"split": "validation"}),
        ("demos", {"paths": ["a", "b"]}),
        ("train", {"method": "igsp"}),
    ],
)
def test_what_the_study_gives_each_cell_is_not_shared(
    section: str, keys: dict[str, Any], tmp_path: Path
) -> None:
    made = raw("embedded")
    made["shared"][section] |= keys
    with pytest.raises(AegisError, match=f"{section}.{next(iter(keys))}"):
        study_cells.load(write(tmp_path, made))


def test_a_study_is_written_out_and_read_again(tmp_path: Path) -> None:
    asked = study(tmp_path)
    plain = study_cells.written_out(asked)
    assert "split" not in plain["shared"]["rollout"] and "tasks" not in plain["shared"]
    assert "seed" not in plain["shared"]["demos"]
    (tmp_path / "again.yaml").write_text(dump(json.loads(json.dumps(plain))))
    again = study_cells.load(tmp_path / "again.yaml")
    for seed in (3, 4):
        for name in VARIANTS:
            one, other = (
                RobotStreamStudy(s).cell(name, "stream", seed, None) for s in (asked, again)
            )
            assert one == other


def test_there_is_one_place(tmp_path: Path) -> None:
    assert RobotStreamStudy(study(tmp_path)).places == (robot_stream_cells.PLACE,)
