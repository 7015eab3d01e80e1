"""`aegis compare`: one table of several runs, with the figures written by their stages."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from samples.command import refused
from samples.reports import METHODS, open_loop, probe, rollout, write_job

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Warned
from aegis_cli.evaluation import results
from aegis_cli.recipes import Probe
from aegis_cli.reporting import compare
from aegis_cli.training import inputs


@pytest.fixture
def job(tmp_path: Path) -> Path:
    return write_job(tmp_path, probe=Probe(max_drop=15.0))


def test_a_job_stands_for_its_runs(job: Path) -> None:
    found = compare.run([job, job / "naive"])
    assert [row.method for row in found.rows] == [*METHODS, "naive"]
    assert found.rows[0] == found.rows[2]


def test_a_folder_stands_for_the_runs_in_it(job: Path, tmp_path: Path) -> None:
    """Only folders with a checkpoint count; a job, a stream and an artifact are not runs."""
    folder = tmp_path / "runs"
    for name in ("b", "a"):
        shutil.copytree(job / "naive", folder / name, symlinks=True)
    shutil.copytree(job, folder / "job", symlinks=True)
    stream = folder / "stream" / "recipe.yaml"
    stream.parent.mkdir()
    files.write_text(stream, "kind: robot-stream\n")
    for name, recipe in (("pretraining", "kind: pretrain\n"), ("damaged", "- 1\n")):
        (folder / name).mkdir()
        files.write_text(folder / name / "recipe.yaml", recipe)
    begun = folder / "c"
    shutil.copytree(job / "naive", begun, symlinks=True)
    (begun / "ledger.safetensors").unlink()
    events: list[Event] = []
    found = compare.run([folder], events.append)
    assert [row.run for row in found.rows] == [str(folder / "a"), str(folder / "b")]
    warned = [event.text for event in events if isinstance(event, Warned)]
    assert [text for text in warned if "have no checkpoint" in text] == [
        f"left out, because they have no checkpoint yet: {begun}"
    ]
    assert [text for text in warned if "damaged" in text] == warned[:1] and len(warned) == 2


def test_figures_are_those_of_the_jobs_table(job: Path) -> None:
    table = files.load_json(job / "table.json")["rows"]
    same = ("accuracy", "drop_points", "cross_entropy", "success_seen", "success_held_out", "w2")
    same += ("baseline_accuracy", "step_s", "validation_loss")
    for row, expected in zip(compare.run([job]).rows, table, strict=True):
        assert {name: getattr(row, name) for name in same} == {n: expected[n] for n in same}
    assert [row.gate for row in compare.run([job]).rows] == [True, False]


def test_a_run_that_is_not_finished_says_of_how_many_steps(
    aegis, job: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(job)
    assert "not finished" not in aegis("compare", "naive", "aegis")[2]
    recipe = Path("aegis", "recipe.yaml")
    longer = recipe.read_text(encoding="utf-8").replace("steps: 6", "steps: 3000")
    recipe.write_text(longer, encoding="utf-8")
    code, out, err = aegis("compare", "naive", "aegis")
    assert code == 0 and "not finished: aegis, 6 of 3,000 steps" in " ".join(err.split())
    assert "6 of 3,000" in out
    rows = json.loads(aegis("compare", "naive", "aegis", "--json")[1])["rows"]
    assert [(row["steps"], row["planned_steps"]) for row in rows] == [(6, 6), (6, 3000)]
    assert "6 of 3,000" in aegis("inspect", "aegis")[1]
    facts = json.loads(aegis("inspect", "aegis", "--json")[1])["facts"]
    assert (facts["steps"], facts["planned_steps"]) == (6, 3000)
    assert aegis("report", "aegis")[0] == 0
    assert "6 of 3,000 steps" in Path("aegis", "report.html").read_text(encoding="utf-8")


def test_only_a_run_with_its_training_state_is_said_to_go_on(job: Path) -> None:
    """A merged run has none, nor does one whose checkpoints were removed."""
    merged, going, gone = job / "naive", job / "aegis", write_job(job) / "aegis"
    for run in (merged, going, gone):
        recipe = (run / "recipe.yaml").read_text(encoding="utf-8")
        files.write_text(run / "recipe.yaml", recipe.replace("steps: 6", "steps: 3000"))
    for run in (merged, going):
        (run / "checkpoints/last/training_state").mkdir()
        (run / "checkpoints/last/training_state/state.safetensors").touch()
    how = {"method": "linear", "strength": 0.5, "damping": 0.01, "base": "embedded", "kept": 0.5}
    files.save_json(merged / "merge.json", how)
    told: list[Event] = []
    compare.run([merged, going, gone], told.append)
    text = next(event.text for event in told if isinstance(event, Warned))
    _, of_merged, of_going, of_gone = text.replace(": /", "; /").split("; ")
    assert "merged before its training had ended" in of_merged and "aegis train" not in of_merged
    assert of_going == f"{going}, 6 of 3,000 steps (aegis train {going} goes on)"
    assert of_gone == f"{gone}, 6 of 3,000 steps"


def test_what_was_measured_by_hand_counts_where_aegis_run_measured_nothing(job: Path) -> None:
    run = job / "naive"
    for path in (*run.glob("probe*.json"), *run.glob("rollout*.json")):
        path.unlink()
    bare = compare.run([run]).rows[0]
    assert (bare.accuracy, bare.success_seen, bare.gate) == (None, None, None)
    figures = {"task": "x", "colors": None, "success": None, "return_share": 0.5, "episodes": 3}
    results.keep(run, "rollout-seen", figures, {})
    assert compare.run([run]).rows[0].return_share == 0.5


def test_the_set_that_all_runs_were_probed_on_is_compared(job: Path) -> None:
    told: list[Event] = []
    for name, sets in (("naive", ("a", "b")), ("aegis", ("b", "c"))):
        (job / name / "probe.json").unlink()
        for which in sets:
            results.keep(job / name, f"probe-{which}", probe("x", ord(which) - 97), {"vqa": which})
    found = compare.run([job], told.append)
    assert [(row.vqa, row.drop_points) for row in found.rows] == [("b", 20.0)] * 2 and not told


@pytest.mark.parametrize("passed", [True, False, None])
def test_the_gate_is_that_of_the_drop_beside_it(passed: bool | None, job: Path) -> None:
    """The run's first probe is shown; a gate on other questions does not apply to it."""
    run = job / "naive"
    (run / "probe.json").unlink()
    for which, verdict in (("a", passed), ("b", False), ("c", True)):
        figures = probe("x", ord(which) - 97) | {"passed": verdict}
        results.keep(run, f"probe-{which}", figures, {"vqa": which})
    row = compare.run([run]).rows[0]
    assert (row.vqa, row.gate) == ("a", passed)


def test_figures_of_different_questions_are_not_compared_without_a_word(
    aegis, job: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(job)
    (job / "naive" / "probe.json").unlink()
    results.keep(job / "naive", "probe-own", probe("x", 4), {"vqa": "own.jsonl"})
    code, out, err = aegis("compare", "naive", "aegis")
    assert code == 0 and "different questions: own.jsonl, scenes" in err
    line = next(line for line in out.splitlines() if line.startswith(" naive"))
    assert "own.jsonl" in line and "40.0" in line and "!40.0" not in line and "*40.0" not in line


def test_open_loop_errors_on_the_same_episodes_are_compared(
    aegis, job: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(job)
    for number, name in enumerate(("naive", "aegis")):
        own, shared = open_loop(number), open_loop(7, 8, error=0.25 + number, split="chosen")
        results.keep(job / name, "evaluate-validation-arm", own, {"path": "/arm"})
        results.keep(job / name, "evaluate-chosen-arm", shared, {"path": "/arm"})
    found = compare.run([job])
    assert [row.open_loop_error for row in found.rows] == [0.25, 1.25] and found.same_open_loop
    assert {row.open_loop_on for row in found.rows} == {"2 chosen episodes of datasets/arm"}
    _, out, err = aegis("compare", "naive", "aegis")
    assert "*0.250" in out and "1.250" in out and "different frames" not in err
    assert "open-loop error: on 2 chosen episodes of datasets/arm" in out.splitlines()


@pytest.mark.parametrize(
    ("other", "told"),
    [
        ({"episodes": [2]}, "(episodes 2)"),
        ({"seed": 1}, "(seed 1)"),
        ({"trained_on": [1]}, "(trained on 1)"),
        ({"frames": 6}, "(frames 6)"),
    ],
)
def test_open_loop_errors_on_other_frames_are_not_compared_without_a_word(
    other: dict[str, object], told: str, aegis, job: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This holds even if equally many episodes of the same data were held out."""
    monkeypatch.chdir(job)
    for name, own in (("naive", open_loop(1)), ("aegis", {**open_loop(1, error=0.5), **other})):
        results.keep(job / name, "evaluate-validation-arm", own, {"path": "/arm"})
    assert not compare.run([job]).same_open_loop
    _, out, err = aegis("compare", "naive", "aegis")
    assert "0.250" in out and "*0.250" not in out and "!0.500" not in out
    assert "measured on different frames: naive, 1 held-out episode of datasets/arm (" in err
    assert f"{told}; aegis evaluate" in err


@pytest.mark.parametrize("same", [True, False])
def test_what_aegis_run_has_evaluated_is_told_apart_by_where_its_data_lies(
    same: bool, job: Path, tmp_path: Path
) -> None:
    """Its figures name the data like the recipe, which may be any folder's `arm`."""
    places = [tmp_path / "a" / "arm"] * 2 if same else [tmp_path / "a/arm", tmp_path / "b/arm"]
    for name, place in zip(("naive", "aegis"), places):
        files.save_json(job / name / "evaluate.json", open_loop(1))
        inputs.keep(job / name, inputs.Inputs((str(place),), None))
    said: list[Event] = []
    assert compare.run([job], said.append).same_open_loop is same
    warned = " ".join(event.text for event in said if isinstance(event, Warned))
    assert all((f"(in {place})" in warned) is not same for place in places)
    by_hand = open_loop(1)
    results.keep(job / "aegis", "evaluate-validation-arm", by_hand, {"path": str(places[1])})
    (job / "aegis" / "evaluate.json").unlink()
    assert compare.run([job]).same_open_loop is same


@pytest.mark.parametrize(
    ("changed", "same"),
    [({"task": "point"}, False), ({"episodes": 7}, False), ({"wrong_target": 0.5}, True)],
)
def test_success_in_other_episodes_is_shown_without_a_mark(
    changed: dict[str, object], same: bool, aegis, job: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(job)
    path = job / "aegis" / "rollout-seen.json"
    files.save_json(path, files.load_json(path) | {"success": 1.0} | changed)
    assert compare.run([job]).same_episodes is same
    out = aegis("compare", "naive", "aegis")[1]
    assert "100.0" in out and ("*100.0" in out) is same


def test_success_is_that_in_the_runs_own_task(job: Path) -> None:
    """This holds whatever was played last: a policy of LIBERO's plays other suites too."""
    (job / "aegis" / "rollout-seen.json").unlink()
    for name, task, success in (("rollout", "reach", 0.25), ("rollout-point", "point", 1.0)):
        found = rollout("seen", success) | {"task": task}
        settings = {"task": task, "episodes": 4, "colors": "seen", "seed": 0, "replan": 4}
        results.keep(job / "aegis", f"{name}-seen", found, settings)
    assert compare.run([job]).rows[1].success_seen == 0.25


@pytest.mark.parametrize("questions", [40, 41])
def test_answers_to_other_questions_are_shown_without_a_mark(
    questions: int, aegis, job: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(job)
    path = job / "aegis" / "probe.json"
    files.save_json(path, files.load_json(path) | {"questions": questions})
    out = aegis("compare", "naive", "aegis")[1]
    assert "80.0" in out and ("*80.0" in out) == (questions == 40)


@pytest.mark.parametrize("majority", [0.3, 0.4])
def test_two_files_of_one_name_are_two_sets_of_questions(
    majority: float, aegis, job: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Any folder may have its own.jsonl; the most common answers' shares differ by questions."""
    monkeypatch.chdir(job)
    for number, name in enumerate(("naive", "aegis")):
        figures = probe("x", number)
        figures["families"]["x"]["majority"] = majority if number else 0.3
        results.keep(job / name, "probe-own", figures, {"vqa": "own.jsonl", "path": f"/{number}"})
        (job / name / "probe.json").unlink()
    same = majority == 0.3
    found = compare.run([job])
    assert found.same_questions is same and found.question_sets == ["own.jsonl"]
    _, out, err = aegis("compare", "naive", "aegis")
    assert ("*80.0" in out) is same and ("40 of own.jsonl, families of digest" in err) is not same


def test_without_an_evaluation_there_is_no_column_of_it(
    aegis, job: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(job)
    assert "open" not in aegis("compare", "naive", "aegis")[1].lower()


def test_the_command_shows_one_line_a_run(
    aegis, job: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(job)  # long paths would not fit beside the figures
    code, out, _ = aegis("compare", "naive", "aegis")
    first = out.partition("Differences from")[0]
    lines = [line for line in first.splitlines() if line.startswith((" naive", " aegis"))]
    assert code == 0 and len(lines) == 2
    assert "80.0" in lines[0] and "20.00" in lines[1] and "failed" in lines[1]
    assert "Return" not in out  # which none of the runs has
    code, out, _ = aegis("compare", job, "--json")
    assert [row["drop_points"] for row in json.loads(out)["rows"]] == [10.0, 20.0]


def test_marks_are_explained_where_there_are_some(
    aegis, job: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(job)
    assert "* best of its column" in aegis("compare", "naive", "aegis")[1]
    alike = aegis("compare", "naive", "naive")[1]
    assert "naive" in alike and "*" not in alike


def test_what_is_no_run_is_refused(aegis, job: Path, tmp_path: Path) -> None:
    assert "is not the run of a policy" in refused(aegis("compare", job, tmp_path))
    with pytest.raises(AegisError):
        compare.run([tmp_path / "missing"])
