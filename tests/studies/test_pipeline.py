"""`aegis run`: a stage's inputs decide whether it runs again; an interrupted run resumes."""

from __future__ import annotations

import io
import json
import re
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from rich.console import Console
from samples import studies as study_samples
from samples.small_run import flipped, recipe
from samples.tiny import make_tiny
from samples.vqa_files import picture, write_jsonl
from samples.vqa_files import row as line

from aegis_cli import recipes
from aegis_cli.cli import render
from aegis_cli.common import artifacts, files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Progress, Warned
from aegis_cli.core import moment_sums
from aegis_cli.core.moment_sums import TraceOnly
from aegis_cli.data import record
from aegis_cli.data.vqa import easy, sets
from aegis_cli.data.vqa.questions import FAMILIES
from aegis_cli.data.vqa.words import wide_vocabulary
from aegis_cli.models.backbones import load
from aegis_cli.recipes import Anchor, Cotrain, Demos, Probe, Recipe
from aegis_cli.reporting import gather
from aegis_cli.studies import pipeline, policy_cells, table

METHODS = ("naive", "aegis")
PER_METHOD = {"train": 2, "probe": 2, "rollout": 4}  # two methods, two sets of colours
COLUMNS = {
    "method",
    "accuracy",
    "drop_points",
    "cross_entropy",
    "success_seen",
    "success_held_out",
    "wrong_target",
    "w2",
    "energy_shed",
    "step_s",
    "step_time_ratio",
    "validation_loss",
    "baseline_accuracy",
}


@pytest.fixture(scope="module")
def small(tiny_folder: Path) -> Recipe:
    return recipe(tiny_folder, METHODS)


@pytest.fixture(scope="module")
def finished(small: Recipe, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A root folder in which the recipe was run once; never modified."""
    root = tmp_path_factory.mktemp("pipeline")
    pipeline.run(small, root)
    return root


@pytest.fixture
def root(finished: Path, tmp_path: Path) -> Path:
    """A copy of it that tests may change."""
    return Path(shutil.copytree(finished, tmp_path / "runs", symlinks=True))


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """The number of times that each stage did its work."""
    counted: Counter[str] = Counter()
    for module, name, label in (
        (record, "run", "demos"),
        (policy_cells.measure, "run", "anchor"),
        (policy_cells.train, "run", "train"),
        (policy_cells.probe, "compare", "probe"),
        (policy_cells.rollout, "run", "rollout"),
    ):
        monkeypatch.setattr(module, name, counting(getattr(module, name), counted, label))
    return counted


def counting(work: Callable[..., Any], counted: Counter[str], label: str) -> Callable[..., Any]:
    def call(*args: Any, **kwargs: Any) -> Any:
        counted[label] += 1
        return work(*args, **kwargs)

    return call


def content(folder: Path) -> dict[str, bytes]:
    return {
        str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()
    }


def up_to_date(events: list[Progress]) -> set[str]:
    return {
        e.stage.removesuffix(" (up to date)") for e in events if e.stage.endswith(" (up to date)")
    }


ALL = {
    "demos",
    "anchor",
    *(f"{m}/{s}" for m in METHODS for s in ("train", "probe", "rollout seen", "rollout held-out")),
}


# --- the first run -------------------------------------------------------------------------------


def test_files_stand_where_the_recipe_says(finished: Path) -> None:
    folder = finished / "small"
    assert {p.name for p in folder.iterdir()} == {
        "demos.safetensors",
        "anchor.safetensors",
        "table.json",
        "stages.json",
        "stages",
        *METHODS,
    }
    inside = {
        "recipe.yaml",
        "ledger.safetensors",
        "metrics.jsonl",
        "machine.json",
        "inputs.json",
        "checkpoints",
        "train.json",
        "probe.json",
    }
    for method in METHODS:
        assert {p.name for p in (folder / method).iterdir()} == inside | {
            "rollout-seen.json",
            "rollout-held-out.json",
        }
        assert recipes.load(folder / method / "recipe.yaml").train.method == method


def test_the_table_is_what_the_stages_found(finished: Path) -> None:
    table = files.load_json(finished / "small" / "table.json")
    assert table["name"] == "small" and 0 <= table["majority_accuracy"] <= 1
    assert [row["method"] for row in table["rows"]] == list(METHODS)
    for row in table["rows"]:
        assert set(row) >= COLUMNS
        read = lambda name: files.load_json(finished / "small" / row["method"] / f"{name}.json")  # noqa: E731
        trained, probed = read("train"), read("probe")
        assert (row["accuracy"], row["cross_entropy"]) == (
            probed["accuracy"],
            probed["cross_entropy"],
        )
        assert row["drop_points"] == probed["drop_points"] and probed["questions"] == 14
        assert (
            row["w2"] == pytest.approx(sum(x["w2"] for x in probed["layers"]) / 2) and row["w2"] > 0
        )
        assert row["success_seen"] == read("rollout-seen")["success"]
        assert row["success_held_out"] == read("rollout-held-out")["success"]
        assert row["wrong_target"] == read("rollout-seen")["wrong_target"]
        assert (row["step_s"], row["validation_loss"]) == (
            trained["step_s"],
            trained["validation_loss"],
        )
    naive, aegis_row = table["rows"]
    assert naive["step_time_ratio"] == 1 and naive["energy_shed"] is None
    assert (
        aegis_row["step_time_ratio"] == pytest.approx(aegis_row["step_s"] / naive["step_s"])
        and aegis_row["energy_shed"] >= 0
    )
    assert table["baseline_accuracy"] == probed["baseline_accuracy"]


def test_through_the_command_line(aegis, small: Recipe, root: Path, tmp_path: Path) -> None:
    path = tmp_path / "r.yaml"
    path.write_text(recipes.to_yaml(small))
    code, out, err = aegis("run", path, "--out", root, "--json")
    assert code == 0 and err.count("(up to date)") == len(ALL)
    assert f"report: {root / 'small' / 'report.html'}" in err
    assert "</html>" in (root / "small" / "report.html").read_text(encoding="utf-8")
    assert json.loads(out) == files.load_json(root / "small" / "table.json") | {
        "out": str(root / "small")
    }
    code, out, _ = aegis("run", path, "--out", root)
    assert code == 0 and all(re.search(rf"(?m)^ *{method} ", out) for method in METHODS)
    saved = (root / "small" / "table.md").read_text()
    assert (
        all(f"\n| {method} |" in saved for method in METHODS)
        and out.split()[-2:] == saved.split()[-2:]
    )
    assert aegis("inspect", root / "small") == (0, out, "")
    code, _, err = aegis("inspect", root / "small", "--plot", tmp_path / "x.png")
    assert code == 2 and "a table without a plot" in err and not (tmp_path / "x.png").exists()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"backbone": "models/typo"}, "models/typo"),
        (
            {"methods": ("naive", "cotrain"), "cotrain": Cotrain(vqa="questions/typo.jsonl")},
            "questions/typo.jsonl",
        ),
        ({"probe": Probe(vqa="questions/typo.jsonl")}, "questions/typo.jsonl"),
        ({"demos": Demos(path="demos/typo.safetensors")}, "demos/typo.safetensors"),
    ],
)
def test_a_missing_input_is_found_before_any_work(
    changes: dict[str, Any], says: str, small: Recipe, tmp_path: Path
) -> None:
    events: list[Progress] = []
    with pytest.raises(AegisError, match=says):
        pipeline.run(replace(small, **changes), tmp_path / "runs", events.append)
    assert not events and not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"task": "point"}, "demonstrations of 'reach'"),
        ({"demos": Demos(camera="top")}, "demos.camera without demos.path"),
    ],
)
def test_demonstrations_that_do_not_fit_are_found_before_any_work(
    changes: dict[str, Any], says: str, small: Recipe, demos_file: Path, tmp_path: Path
) -> None:
    recipe = replace(small, **{"demos": Demos(path=str(demos_file)), **changes})
    with pytest.raises(AegisError, match=says):
        pipeline.run(recipe, tmp_path / "runs")
    assert not (tmp_path / "runs").exists()


def test_a_question_that_the_backbone_cannot_read_is_found_before_any_work(
    small: Recipe, tmp_path: Path
) -> None:
    name = next(
        name
        for name in (f"images/{i}.png" for i in range(99))
        if sets.share(name) in sets.PARTS["probe"]
    )
    path = write_jsonl(tmp_path, 0, extra=[json.dumps(line(name, question="is it a zeppelin"))])
    picture(0).save(tmp_path / name)
    with pytest.raises(AegisError, match="zeppelin"):
        pipeline.run(replace(small, probe=Probe(vqa=str(path), questions=14)), tmp_path / "runs")
    assert not (tmp_path / "runs").exists()


def test_a_gate_fails_after_the_tables_are_written(
    aegis, small: Recipe, root: Path, tmp_path: Path
) -> None:
    path = tmp_path / "r.yaml"
    path.write_text(recipes.to_yaml(replace(small, methods=("naive",))))
    changed = root / "small/naive/probe.json"
    for drop, code in ((1.0000000000000009, 0), (1.1, 1)):
        aegis(
            "run", path, "--out", root, "--set", "probe.max_drop=1"
        )  # so that the probe is up to date
        invented = json.dumps(files.load_json(changed) | {"drop_points": drop})
        stamp = root / "small/stages/naive.json"
        before = files.sha256_file(changed)
        changed.write_text(invented)
        stamp.write_text(stamp.read_text().replace(before, files.sha256_file(changed)))
        got, out, err = aegis("run", path, "--out", root, "--set", "probe.max_drop=1")
        assert got == code and out.count(" naive ") == 1
        assert ("gate failed: naive dropped more than probe.max_drop 1 points" in err) == bool(code)
        assert files.load_json(root / "small/table.json")["gate_failed"] == ["naive"] * code


@pytest.mark.parametrize("key", ["backbone", "expert.start"])
def test_a_job_does_not_begin_with_a_run_of_its_own_which_it_would_remove(
    key: str, small: Recipe, root: Path
) -> None:
    """As when a recipe was copied for a second training and kept its name."""
    run = root / "small" / METHODS[0]
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    other = replace(small, seed=small.seed + 1)
    if key == "backbone":
        other = replace(other, backbone=str(run))
    else:
        other = replace(other, expert=replace(other.expert, start=str(run)))
    with pytest.raises(AegisError, match=f"{key}: .* the folder of this job"):
        pipeline.run(other, root)
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before


# --- several sets of questions -------------------------------------------------------------------


SETS = ("scenes", "easy-vqa")


@pytest.fixture(scope="module")
def two_sets(tmp_path_factory: pytest.TempPathFactory) -> tuple[Recipe, Path]:
    """A recipe with an anchor on easy-VQA alone and probes on both sets, run once."""
    folder = tmp_path_factory.mktemp("two-sets")
    make_tiny(words=wide_vocabulary()).save(folder / "backbone")
    made = recipe(folder / "backbone", ("naive",))
    made = replace(
        made,
        anchor=replace(made.anchor, vqa="easy-vqa"),
        probe=replace(made.probe, vqa=SETS),
    )
    pipeline.run(made, folder / "runs")
    return made, folder / "runs"


def test_each_set_of_questions_is_probed_on_its_own(two_sets: tuple[Recipe, Path]) -> None:
    folder = two_sets[1] / "small"
    assert artifacts.read_header(folder / "anchor.safetensors").meta["vqa"] == "easy-vqa"
    (row,) = files.load_json(folder / "table.json")["rows"]
    first, second = (files.load_json(folder / "naive" / f"{n}.json") for n in ("probe", "probe-2"))
    assert set(row["others"]) == {"easy-vqa"}
    for figures, probed in ((row, first), (row["others"]["easy-vqa"], second)):
        for key in ("accuracy", "drop_points", "cross_entropy", "baseline_accuracy"):
            assert figures[key] == probed[key]
        assert figures["w2"] == pytest.approx(sum(x["w2"] for x in probed["layers"]) / 2)
    assert set(first["families"]) == set(FAMILIES) and first["w2_between"] == "easy-vqa and scenes"
    assert set(second["families"]) <= set(easy.FAMILIES) and second["w2_between"] is None
    shown = io.StringIO()
    Console(file=shown, width=120).print(render.pipeline(table.load(folder)))
    assert "Asked easy-vqa" in shown.getvalue()


def test_a_second_run_of_several_sets_does_nothing(
    two_sets: tuple[Recipe, Path], calls: Counter[str]
) -> None:
    pipeline.run(*two_sets)
    assert not calls


@pytest.mark.parametrize("gate", ["mean", "upper"])
@pytest.mark.parametrize(("own", "other", "passes"), [(0, 0, True), (2, 0, False), (0, 2, False)])
def test_the_gate_holds_every_set_to_its_limit(
    own: float, other: float, passes: bool, gate: str
) -> None:
    """By the mean, or by the upper end of the interval, which is higher."""
    shift = 0.0 if gate == "mean" else -5.0

    def held(drop: float) -> dict[str, Any]:
        return {"drop_points": drop + shift, "drop_interval": (drop - 9.0, drop)}

    kept = study_samples.row(recipe("x"), **held(own))
    others = {"easy-vqa": study_samples.vqa_figures(**held(other))}
    settings = Probe(max_drop=1.0, gate=gate)
    assert pipeline._past(replace(kept, others=others), settings) != passes
    assert not pipeline._past(replace(kept, others=others), replace(settings, max_drop=None))


def test_a_gate_of_a_recipe_does_not_ask_again_what_was_asked_without_one() -> None:
    """Existing records of probes are from before the key."""
    settings = Probe(max_drop=1.0)
    assert "gate" not in policy_cells._probe_settings(settings)
    assert policy_cells._probe_settings(replace(settings, gate="upper"))["gate"] == "upper"


# --- what runs again -----------------------------------------------------------------------------


def test_a_second_run_does_nothing(
    small: Recipe, root: Path, calls: Counter[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(policy_cells.backbones, "load", lambda _: pytest.fail("a model was loaded"))
    monkeypatch.setattr(
        policy_cells.sets, "load_scenes", lambda *_, **__: pytest.fail("scenes were rendered")
    )
    before, events = content(root), []
    first = files.load_json(root / "small" / "table.json")
    report = pipeline.run(small, root, events.append)
    assert not calls and up_to_date(events) == ALL
    after = content(root)
    assert {k: v for k, v in after.items() if k != "small/table.json"} == {
        k: v for k, v in before.items() if k != "small/table.json"
    }
    assert json.loads(json.dumps(report.to_json())) == first | {"out": str(root / "small")}


def test_more_rollout_episodes_rerun_only_the_rollouts(
    small: Recipe, root: Path, calls: Counter[str]
) -> None:
    pipeline.run(replace(small, rollout=replace(small.rollout, episodes=3)), root)
    assert calls == {"rollout": 4}
    assert files.load_json(root / "small" / "aegis" / "rollout-seen.json")["episodes"] == 3


def test_more_questions_rerun_only_the_probes(
    small: Recipe, root: Path, calls: Counter[str]
) -> None:
    pipeline.run(replace(small, probe=replace(small.probe, questions=21)), root)
    assert calls == {"probe": 2}
    assert files.load_json(root / "small" / "naive" / "probe.json")["questions"] == 21


def test_what_is_asked_after_the_training_stands_in_each_runs_own_recipe(
    small: Recipe, root: Path, calls: Counter[str], aegis
) -> None:
    trained = {m: content(root / "small" / m / "checkpoints") for m in METHODS}
    now = replace(small, methods=("aegis", "naive"), probe=Probe(questions=14, max_drop=90.0))
    said = list[Event]()
    pipeline.run(now, root, said.append)
    assert calls == {"probe": 2}
    warned = [event.text for event in said if isinstance(event, Warned)]
    assert sum("can hardly lose what it does not know" in text for text in warned) == 2
    for method in METHODS:
        run = root / "small" / method
        assert content(run / "checkpoints") == trained[method]
        kept = recipes.load(run / "recipe.yaml")
        assert kept == replace(now, train=replace(now.train, method=method))
    code, _, err = aegis("probe", root / "small" / "naive", "--questions", 14)
    assert code == 0 and "the gate is at a drop of 90 points, the recipe's probe.max_drop" in err
    (again,) = gather.run(root / "small").commands
    assert again.startswith(f"aegis run {root / 'small' / 'aegis' / 'recipe.yaml'} ")
    before, events = content(root / "small" / "naive"), list[Event]()
    pipeline.run(now, root, events.append)
    assert up_to_date(events) == ALL and content(root / "small" / "naive") == before


def test_a_run_that_was_cut_goes_on_to_the_same_weights_by_a_recipe_that_asks_otherwise(
    small: Recipe, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    naive = replace(small, methods=("naive",))

    def cut(event: Event) -> None:
        if isinstance(event, Progress) and event.stage == "naive/train" and event.done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pipeline.run(naive, tmp_path / "cut", cut)
    pipeline.run(replace(naive, probe=Probe(questions=21, max_drop=90.0)), tmp_path / "cut")
    run = tmp_path / "cut/small/naive"
    assert content(run / "checkpoints") == content(root / "small/naive/checkpoints")
    assert recipes.load(run / "recipe.yaml").probe == Probe(questions=21, max_drop=90.0)


def test_other_steps_rerun_all_but_demonstrations_and_anchor(
    small: Recipe, root: Path, calls: Counter[str]
) -> None:
    pipeline.run(replace(small, train=replace(small.train, steps=3)), root)
    assert calls == PER_METHOD
    checkpoints = root / "small" / "naive" / "checkpoints"
    assert sorted(p.name for p in checkpoints.iterdir()) == [
        "000002",
        "000003",
        "last",
    ]  # nothing from the old run
    assert (checkpoints / "last").resolve().name == "000003"


def test_an_option_of_one_method_reruns_that_method(
    small: Recipe, root: Path, calls: Counter[str]
) -> None:
    pipeline.run(replace(small, aegis=replace(small.aegis, weighting="variance")), root)
    assert calls == {"train": 1, "probe": 1, "rollout": 2}


def test_a_new_method_leaves_the_others_alone(
    small: Recipe, root: Path, calls: Counter[str]
) -> None:
    report = pipeline.run(replace(small, methods=("stop-gradient", "aegis")), root)
    assert calls == {"train": 1, "probe": 1, "rollout": 2}
    assert [row.method for row in report.rows] == ["stop-gradient", "aegis"]
    assert [row.step_time_ratio for row in report.rows] == [None, None]  # no naive for comparison
    assert report.rows[0].drop_points == 0


def test_another_backbone_reruns_all_but_the_demonstrations(
    small: Recipe, root: Path, calls: Counter[str], tmp_path: Path
) -> None:
    make_tiny(seed=5).save(tmp_path / "other")
    pipeline.run(replace(small, backbone=str(tmp_path / "other")), root)
    assert calls == PER_METHOD | {"anchor": 1}


def test_other_demonstrations_rerun_all_but_the_anchor(
    small: Recipe, root: Path, calls: Counter[str]
) -> None:
    events: list[Any] = []
    pipeline.run(replace(small, demos=replace(small.demos, seed=1)), root, events.append)
    assert calls == PER_METHOD | {"demos": 1}
    told = {e.stage: e.text for e in events if isinstance(e, Warned) and "again" in e.text}
    assert told.keys() == {f"{method}/train" for method in METHODS}
    said = f"'{root / 'small/naive'}' was trained with a different demos: training it again"
    assert told["naive/train"] == said


def test_an_anchor_on_robot_frames_is_measured_anew_with_the_demonstrations(
    small: Recipe, tmp_path: Path, calls: Counter[str]
) -> None:
    """Its distance to the probe's questions is in the probe's report; the table shows no drift."""
    frames = replace(small.anchor, source="demos", parts=("moments",))
    shown = replace(small, methods=("aegis",), anchor=frames)
    report = pipeline.run(shown, tmp_path)
    folder = tmp_path / "small"
    header = artifacts.read_header(folder / "anchor.safetensors")
    assert header.inputs == {"demos": files.sha256_file(folder / "demos.safetensors")}
    probed = files.load_json(folder / "aegis" / "probe.json")
    assert probed["w2_between"] == "robot frames of demos.safetensors and scenes"
    assert probed["layers"] and report.rows[0].w2 is None
    calls.clear()
    pipeline.run(shown, tmp_path)
    assert not calls
    pipeline.run(replace(shown, demos=replace(small.demos, seed=1)), tmp_path)
    assert calls == {"demos": 1, "anchor": 1, "train": 1, "probe": 1, "rollout": 2}


# --- damage and interruption ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("victim", "again"),
    [
        ("demos.safetensors", {"demos": 1}),  # the new bytes are equal, so nothing else has changed
        ("anchor.safetensors", {"anchor": 1}),
        ("naive/probe.json", {"probe": 1}),
        ("aegis/rollout-held-out.json", {"rollout": 1}),
    ],
)
@pytest.mark.parametrize("deleted", [True, False])
def test_a_lost_or_changed_output_is_made_again(
    victim: str,
    again: dict[str, int],
    deleted: bool,
    small: Recipe,
    root: Path,
    calls: Counter[str],
) -> None:
    path = root / "small" / victim
    before = path.read_bytes()
    path.unlink() if deleted else path.write_bytes(flipped(before))
    pipeline.run(small, root)
    assert calls == again
    assert path.read_bytes() == before or path.suffix == ".json"  # reports contain times


def test_overwrite_runs_every_stage_again_to_the_same_bytes(
    small: Recipe, root: Path, finished: Path, calls: Counter[str]
) -> None:
    pipeline.run(small, root, overwrite=True)
    assert {stage: calls[stage] for stage in PER_METHOD} == PER_METHOD
    before, after = content(finished), content(root)
    assert before.keys() == after.keys()
    tensors = [name for name in before if name.endswith(".safetensors")]
    assert tensors and all(before[name] == after[name] for name in tensors)
    calls.clear()
    pipeline.run(small, root)
    assert not calls


@pytest.mark.parametrize("name", ["backbone/model.safetensors", "expert.safetensors", "train.json"])
@pytest.mark.parametrize("deleted", [True, False])
def test_a_damaged_run_is_trained_again_to_the_same_bytes(
    name: str, deleted: bool, small: Recipe, root: Path, finished: Path, calls: Counter[str]
) -> None:
    method = "naive"
    path = root / "small" / method / ("" if name == "train.json" else "checkpoints/last") / name
    if deleted:
        path.unlink()
    elif name == "backbone/model.safetensors":
        model = load(str(path))
        with torch.no_grad():
            model.words.weight.mul_(2)
        model.save(path.parent)  # valid, but not what was trained
    else:
        path.write_bytes(flipped(path.read_bytes()))
    pipeline.run(small, root)
    assert calls["train"] == 1 and calls["demos"] == calls["anchor"] == 0
    for part in ("backbone/model.safetensors", "expert.safetensors"):
        place = Path("small") / method / "checkpoints" / "last" / part
        assert (root / place).read_bytes() == (finished / place).read_bytes()
    calls.clear()
    pipeline.run(small, root)
    assert not calls


def test_a_run_that_was_trained_by_hand_is_left_alone(small: Recipe, root: Path) -> None:
    """It is in the place of one of the recipe's methods, without a sign of `aegis run`."""
    (root / "small/stages/naive.json").unlink()
    before = content(root / "small/naive")
    with pytest.raises(AegisError, match="not empty") as caught:
        pipeline.run(small, root)
    assert content(root / "small/naive") == before and "mv " in caught.value.fix


@pytest.mark.parametrize(
    ("name", "methods"),
    [("notes.txt", METHODS), ("checkpoints/best", METHODS[:1]), ("plots/energy.png", METHODS[:1])],
)
def test_a_run_with_files_of_the_users_own_is_moved_aside(
    small: Recipe, root: Path, name: str, methods: tuple[str, ...]
) -> None:
    """Changed settings start a new run, but a user's notes are not removed with the old one."""
    own = root / "small" / "naive" / name
    own.parent.mkdir(exist_ok=True)
    own.write_text("weeks of work")
    before = content(root / "small/naive")
    events: list[Progress] = []
    longer = replace(small, methods=methods, train=replace(small.train, steps=3))
    pipeline.run(longer, root, events.append)
    (aside,) = (path for path in (root / "small").iterdir() if path.name.startswith("naive."))
    assert content(aside) == before
    assert any(f"moved {aside.name} aside" in event.stage for event in events)
    assert not list((root / "small").glob("aegis.*"))


class Stop(Exception):
    """Stands for the user's Ctrl-C."""


def test_an_interrupted_training_goes_on(
    small: Recipe, tmp_path: Path, finished: Path, calls: Counter[str]
) -> None:
    seen: list[Progress] = []

    def stop(event: Progress) -> None:
        if event.stage == "aegis/train" and event.done == 3:
            raise Stop

    with pytest.raises(Stop):
        pipeline.run(small, tmp_path, stop)
    calls.clear()
    pipeline.run(small, tmp_path, seen.append)
    # From the checkpoint of step 2.
    assert [e.done for e in seen if e.stage == "aegis/train"] == [2, 3, 4]
    assert {"demos", "anchor", "naive/train", "naive/rollout seen"} <= up_to_date(seen)
    assert calls == {"train": 1, "probe": 1, "rollout": 2}
    for name in (
        "checkpoints/last/backbone/model.safetensors",
        "checkpoints/last/expert.safetensors",
        "ledger.safetensors",
    ):
        assert (tmp_path / "small/aegis" / name).read_bytes() == (
            finished / "small/aegis" / name
        ).read_bytes()


def test_interrupted_before_the_first_checkpoint_begins_anew(
    small: Recipe, tmp_path: Path, finished: Path
) -> None:
    def stop(event: Progress) -> None:
        if event.stage == "naive/train":
            raise Stop

    with pytest.raises(Stop):
        pipeline.run(small, tmp_path, stop)
    report = pipeline.run(small, tmp_path)
    name = "small/naive/checkpoints/last/backbone/model.safetensors"
    assert (tmp_path / name).read_bytes() == (finished / name).read_bytes() and len(
        report.rows
    ) == 2


def test_a_run_interrupted_under_other_settings_is_not_continued(
    small: Recipe, root: Path, calls: Counter[str]
) -> None:
    other = replace(small, train=replace(small.train, expert_lr=5e-3))

    def stop(event: Event) -> None:
        if isinstance(event, Progress) and event.stage == "naive/train" and event.done == 3:
            raise Stop

    with pytest.raises(Stop):
        pipeline.run(other, root, stop)
    events: list[Event] = []
    pipeline.run(small, root, events.append)
    steps = [e.done for e in events if isinstance(e, Progress) and e.stage == "naive/train"]
    assert steps == [0, 1, 2, 3, 4]
    assert (
        recipes.load(root / "small" / "naive" / "recipe.yaml").train.expert_lr
        == small.train.expert_lr
    )


# --- the verdict ---------------------------------------------------------------------------------


def figured(**of: tuple[float, float | None]) -> list[Any]:
    """Rows of methods with their drops in points and their success."""
    plain = study_samples.row(Recipe(name="x"))
    return [
        replace(
            plain,
            method=name.replace("_", "-"),
            drop_points=drop,
            drop_interval=(drop - 0.3, drop + 0.3),
            success_seen=success,
        )
        for name, (drop, success) in of.items()
    ]


def opened(**of: tuple[float, float]) -> list[Any]:
    """Rows of methods that cannot be rolled out, with their drops and open-loop errors."""
    drops = figured(**{name: (drop, None) for name, (drop, _) in of.items()})
    errors = [error for _, error in of.values()]
    return [replace(row, open_loop_error=e) for row, e in zip(drops, errors, strict=True)]


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        (
            opened(naive=(14, 0.2), lora=(1, 0.3), kfac=(0.5, 0.25), aegis=(15, 0.1)),
            "kfac lost 0.5 points of VQA where naive lost 14.0, at an open-loop error of 0.250 "
            "where naive has 0.200 (one seed)",
        ),
        (
            [replace(r, hold_error=0.125) for r in opened(naive=(14, 0.2), kfac=(0.5, 0.25))],
            "0.250 where naive has 0.200 and a robot that holds its position 0.125 (one seed)",
        ),
        (
            figured(naive=(14, 0.95), stop_gradient=(0, 0.6), kfac=(0.5, 0.9)),
            "kfac lost 0.5 points",
        ),
        (figured(naive=(14, 0.95), kfac=(7.1, 0.9), aegis=(18, 0.9)), "No method here kept VQA"),
        (figured(naive=(0.4, 0.95), kfac=(0, 0.9)), "little to protect"),
        (figured(aegis=(3, 0.9), kfac=(1, 0.9)), ""),
        (figured(naive=(3, None), kfac=(1, None)), ""),
    ],
)
def test_the_verdict_says_what_the_table_does(rows: list[Any], says: str) -> None:
    found = pipeline.verdict(rows)
    assert says in found and bool(says) == bool(found)


def asked_twice(rows: list[Any], **others: float) -> list[Any]:
    """The same rows, which were also asked other questions and lost these points on them."""
    again = {name.replace("_", "-"): drop for name, drop in others.items()}
    return [
        replace(row, others={"other": SimpleNamespace(drop_points=drop, drop_interval=ends)})
        for row in rows
        for drop in [again[row.method]]
        for ends in [(drop - 0.3, drop + 0.3)]
    ]


@pytest.mark.parametrize(
    ("others", "says"),
    [
        ({"naive": 40, "kfac": 38}, "No method here kept VQA: naive lost 40.0 points"),
        ({"naive": 40, "kfac": 2}, "kfac lost 2.0 points of VQA where naive lost 40.0, each on"),
        ({"naive": 0, "kfac": 0}, "little to protect"),
    ],
)
def test_the_verdict_is_on_the_questions_that_most_was_lost_of(
    others: dict[str, float], says: str
) -> None:
    rows = asked_twice(figured(naive=(0, 0.95), kfac=(0, 0.9)), **others)
    assert says in pipeline.verdict(rows)


@pytest.mark.parametrize(("low", "tells"), [(-4.3, False), (0.0, False), (0.1, True)])
def test_a_loss_that_may_be_none_says_nothing_of_who_kept_vqa(low: float, tells: bool) -> None:
    rows = [
        replace(row, drop_interval=(low, 15.8)) for row in figured(naive=(4.8, 0.9), kfac=(0, 0.9))
    ]
    said = pipeline.verdict(rows)
    assert ("kfac lost 0.0 points" in said) is tells
    assert (f"{low:.1f} to 15.8" in said and "probe.questions" in said) is not tells


def test_the_verdict_on_questions_that_the_vlm_could_not_answer_is_no_verdict_on_methods() -> None:
    rows = [
        replace(row, baseline_accuracy=0.0, majority_accuracy=0.3)
        for row in figured(naive=(0, 0.95), kfac=(0, 0.9))
    ]
    said = pipeline.verdict(rows)
    assert said.startswith("The VLM answered 0.0 % of the questions correctly before training")
    assert "30.0 %" in said and "probe.ask" in said


def test_an_anchor_of_answers_that_the_backbone_is_sure_of_is_warned_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Measuring the rest of a map's inputs takes seconds and is not used here.
    monkeypatch.setattr(moment_sums, "make", lambda width, at, *_: TraceOnly(width, at))
    settings = Anchor(samples=60, vqa="easy-vqa", parts=("curvature",))
    events: list[Event] = []
    runner = policy_cells.PolicyRunner(tmp_path, events.append)
    runner.anchor(replace(recipe("embedded-easy", ("kfac",)), anchor=settings))
    said = [event.text for event in events if isinstance(event, Warned)]
    assert any("anchor.temperature 4" in text for text in said)


def test_a_method_that_ends_shows_its_figures(small: Recipe, tmp_path: Path) -> None:
    told: list[Event] = []
    report = pipeline.run(small, tmp_path, told.append)
    events = [event for event in told if isinstance(event, Progress)]
    ended = {e.stage: e.metrics for e in events if e.unit == "method" and e.done}
    assert list(ended) == list(small.methods)
    for row in report.rows:
        assert ended[row.method]["drop"] == row.drop_points
    assert [e.done for e in events if e.unit == "methods"] == [0, 1, 2]
