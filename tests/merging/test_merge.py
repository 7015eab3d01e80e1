"""`aegis merge` through the command line: what it writes, what it chooses, what it refuses."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.command import command, refused
from samples.merges import QUESTIONS, SAMPLES, Place, parameters
from samples.user_folder import leftovers, snapshot
from samples.vqa_files import write_jsonl

from aegis_cli import load_policy
from aegis_cli.anchors import curvature
from aegis_cli.common import artifacts, locks
from aegis_cli.data.vqa.gate import MEAN, UPPER
from aegis_cli.merging.merge import MergePoint, _weakest
from aegis_cli.models import backbones
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.recipes import MERGES
from aegis_cli.training import inputs

Aegis = Callable[..., tuple[int, str, str]]  # words -> exit code, stdout, stderr
STRENGTH = 0.5
SMALL = ("--samples", SAMPLES, "--frames", 16, "--questions", QUESTIONS)


@pytest.fixture
def merge(aegis: Aegis) -> Callable[..., dict[str, Any]]:
    """Merge, and return the report."""

    def call(*words: object, code: int = 0) -> dict[str, Any]:
        found, out, err = aegis("merge", *words, *SMALL, "--json")
        assert found == code, err
        return json.loads(out)

    return call


Merged = Callable[[str], Path]


@pytest.fixture(scope="module")
def merged(merge_place: Place, tmp_path_factory: pytest.TempPathFactory) -> Merged:
    """The run, merged by a method; made once, read-only."""

    @cache
    def made(method: str) -> Path:
        before, folder = snapshot(merge_place.run), tmp_path_factory.mktemp("merged")
        _command(*merging(merge_place, method), "--out", folder / "merged")
        assert snapshot(merge_place.run) == before and not leftovers(folder)
        return folder / "merged"

    return made


def merging(place: Place, method: str) -> tuple[object, ...]:
    """The words of the command that `merged` runs."""
    return "merge", place.run, "--method", method, "--strength", STRENGTH, *SMALL, "--json"


def _command(*words: object) -> None:
    with pytest.raises(SystemExit) as caught, contextlib.redirect_stdout(io.StringIO()):
        command()([str(word) for word in words], prog_name="aegis")
    assert not caught.value.code


def last(run: Path) -> Path:
    return run / "checkpoints" / "last"


# --- what is written ------------------------------------------------------------------------------


@pytest.mark.parametrize("method", MERGES)
def test_a_merged_run_is_a_run_for_every_command(
    method: str, aegis: Aegis, merged: Merged, merge_place: Place, tmp_path: Path
) -> None:
    out = shutil.copytree(merged(method), tmp_path / "merged", symlinks=True)
    code, shown, _ = aegis("inspect", out, "--json")
    said = json.loads(shown)
    assert code == 0 and said["kind"] == "run"
    assert said["facts"]["merge"]["method"] == method
    code, shown, _ = aegis("probe", out, "--baseline", merge_place.base, "--questions", 7, "--json")
    assert code == 0 and json.loads(shown)["questions"] == 7
    assert aegis("rollout", out, "--episodes", 1)[0] == 0
    assert load_policy(out).task == "reach"


@pytest.mark.parametrize("method", ["kfac-shrink", "factors"])
def test_a_curvature_of_sure_answers_is_warned_of(
    method: str,
    aegis: Aegis,
    merge_place: Place,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """And it is measured differently with a temperature."""
    monkeypatch.setattr(curvature, "_SURE", 100.0)
    kept = []
    for temperature in (1, 4):
        words = ("--method", method, "--strength", 1, "--temperature", temperature)
        out = tmp_path / f"{temperature}"
        _, report, told = aegis("merge", merge_place.run, *words, *SMALL, "--out", out, "--json")
        assert ("--temperature 4" in told) == (temperature == 1)
        kept.append(json.loads(report)["kept"])
    assert kept[0] != kept[1]


def test_the_expert_stays_and_the_files_say_what_they_were_made_from(
    merge: Callable[..., Any], merge_place: Place, tmp_path: Path
) -> None:
    merge(merge_place.run, "--strength", 10, "--out", tmp_path / "merged")
    trained, merged = (
        artifacts.load(last(run) / "expert.safetensors", "expert")
        for run in (merge_place.run, tmp_path / "merged")
    )
    assert trained.tensors.keys() == merged.tensors.keys()
    assert all(torch.equal(t, merged.tensors[name]) for name, t in trained.tensors.items())
    assert merged.header.fingerprint != trained.header.fingerprint
    assert merged.header.inputs["tuned"] == trained.header.fingerprint
    assert trained.header.inputs.items() <= merged.header.inputs.items()
    for name in ("recipe.yaml", "metrics.jsonl", "ledger.safetensors", "machine.json"):
        copy = tmp_path / "merged" / name
        assert copy.read_bytes() == (merge_place.run / name).read_bytes()


def test_a_merged_run_shows_what_it_is_and_not_what_it_was_made_of(
    aegis: Aegis, merge: Callable[..., Any], merge_place: Place, tmp_path: Path
) -> None:
    """Its validation loss is the one that the sweep measured for it."""
    out, given = tmp_path / "merged", ("--method", "linear", "--sweep", "0.999")
    report = merge(merge_place.run, *given, "--max-drop", 0, "--out", out)
    (found,) = (p for p in report["points"] if p["strength"] == report["strength"])
    said = json.loads(aegis("inspect", out, "--json")[1])
    loss = found["validation_loss"]
    assert said["validation_loss"] == said["facts"]["validation_loss"] == loss
    assert loss != report["points"][0]["validation_loss"]
    both = json.loads(aegis("compare", merge_place.run, out, "--json")[1])["rows"]
    assert [row["method"] for row in both] == ["naive", "naive, merged"]
    assert both[1]["validation_loss"] == loss != both[0]["validation_loss"]
    assert "naive, merged" in aegis("compare", merge_place.run, out)[1]
    document = json.loads(aegis("report", out, "--json")[1])
    assert document["label"] == "naive, merged" and document["machine"]
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "naive, merged" in page and "linear, strength 0.999" in page
    assert re.search(r"damping 0.01; <data [^>]*>\d+\.\d</data> % of the maps", page)
    assert aegis("export", out, "--out", tmp_path / "policy")[0] == 0
    assert "by naive, merged" in (tmp_path / "policy" / "README.md").read_text(encoding="utf-8")


def test_a_merge_that_measures_nothing_shows_no_validation_loss(
    aegis: Aegis, merge: Callable[..., Any], merge_place: Place, tmp_path: Path
) -> None:
    out = tmp_path / "merged"
    merge(merge_place.run, "--method", "linear", "--strength", 0.5, "--out", out)
    said = json.loads(aegis("inspect", out, "--json")[1])
    assert said["validation_loss"] is None is said["facts"]["validation_loss"]
    assert json.loads(aegis("compare", out, "--json")[1])["rows"][0]["validation_loss"] is None


@pytest.mark.parametrize("method", MERGES)
def test_the_commands_of_a_merged_runs_report_merge_it_so_again(
    method: str, aegis: Aegis, merge: Callable[..., Any], merge_place: Place, tmp_path: Path
) -> None:
    at, out = merge_place.run / "checkpoints" / "000004", tmp_path / "merged"
    given = () if method == "linear" else ("--damping", 0.02)
    merge(at, "--method", method, "--strength", 0.5, *given, "--out", out)
    commands = json.loads(aegis("report", out, "--json")[1])["commands"]
    assert [line.split()[1] for line in commands[:3]] == ["train", "merge", "probe"]
    assert commands[2].split()[2] == "MERGED_FOLDER"
    # As a user types it after training again.
    shutil.copytree(merge_place.run, tmp_path / "NEW_FOLDER", symlinks=True)
    own = {"NEW_FOLDER": f"{tmp_path}/NEW_FOLDER", "MERGED_FOLDER": f"{tmp_path}/again"}
    line = commands[1].replace("DEMOS", str(merge_place.demos))
    for name, path in own.items():
        line = line.replace(name, path)
    assert aegis(*shlex.split(line)[1:])[0] == 0
    again, merged = parameters(tmp_path / "again"), parameters(out)
    assert all(torch.equal(again[name], found) for name, found in merged.items())


@pytest.mark.parametrize("method", MERGES)
def test_the_same_commands_give_the_same_bytes(
    method: str, aegis: Aegis, merged: Merged, merge_place: Place, tmp_path: Path
) -> None:
    first, again = merged(method), tmp_path / "again"
    code, shown, err = aegis(*merging(merge_place, method), "--out", again)
    report = json.loads(shown)
    assert code == 0, err
    assert (report["method"], report["strength"], report["points"]) == (method, STRENGTH, [])
    assert 0 < report["kept"] < 1
    # Their inputs are recorded relative to each of them.
    assert inputs.of(first) == inputs.of(again)
    both = [snapshot(out) for out in (first, again)]
    for found in both:
        found.pop(inputs.NAME, None)
    assert both[0] == both[1]


def test_a_checkpoint_can_be_merged_too(
    merge: Callable[..., Any], aegis: Aegis, merge_place: Place, tmp_path: Path
) -> None:
    at = merge_place.run / "checkpoints" / "000004"
    merge(at, "--method", "linear", "--strength", 0.5, "--out", tmp_path / "merged")
    assert [p.name for p in sorted((tmp_path / "merged" / "checkpoints").iterdir())] == [
        "000004",
        "last",
    ]
    said = json.loads(aegis("inspect", tmp_path / "merged", "--json")[1])
    assert said["facts"]["steps"] == 4


@pytest.mark.parametrize("name", ["merged", "x" * 255])
def test_an_empty_folder_may_be_there(
    name: str, merge: Callable[..., Any], merge_place: Place, tmp_path: Path
) -> None:
    """Its name may be as long as the file system allows."""
    out = tmp_path / name
    out.mkdir()
    merge(merge_place.run, "--method", "linear", "--strength", 0.5, "--out", out)
    assert (last(out) / "backbone" / "model.safetensors").is_file()


# --- weights --------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", MERGES)
def test_strength_0_changes_nothing(
    method: str, merge: Callable[..., Any], merge_place: Place, tmp_path: Path
) -> None:
    out = tmp_path / "merged"
    report = merge(merge_place.run, "--method", method, "--strength", 0, "--out", out)
    trained, merged = parameters(merge_place.run), parameters(out)
    assert report["kept"] == 1 and all(torch.equal(trained[n], merged[n]) for n in trained)


@pytest.mark.parametrize("strength", [0.4, 1.0])
def test_linear_goes_a_share_of_the_way_back_with_every_parameter(
    strength: float, merge: Callable[..., Any], merge_place: Place, tmp_path: Path
) -> None:
    out = tmp_path / "merged"
    report = merge(merge_place.run, "--method", "linear", "--strength", strength, "--out", out)
    assert report["kept"] == pytest.approx(1 - strength, abs=1e-6)
    base, trained, merged = map(parameters, (merge_place.base, merge_place.run, out))
    for name, found in merged.items():
        wanted = strength * base[name] + (1 - strength) * trained[name]
        torch.testing.assert_close(found, wanted, rtol=0, atol=1e-6, msg=name)


@pytest.mark.parametrize("method", [m for m in MERGES if m != "linear"])
def test_a_stronger_merge_keeps_less(
    method: str, merge: Callable[..., Any], merge_place: Place
) -> None:
    report = merge(merge_place.run, "--method", method, "--sweep", "0.3,3,30")
    kept = [point["kept"] for point in report["points"]]
    assert kept[0] == 1 and kept == sorted(kept, reverse=True) and len(set(kept)) == 4


@pytest.mark.parametrize("method", [m for m in MERGES if m != "linear"])
def test_an_anchor_with_the_part_is_as_good_as_measuring_it(
    method: str, aegis: Aegis, merged: Merged, merge_place: Place, tmp_path: Path
) -> None:
    """Except for the eigenvectors, which a file has in float32."""
    words = (*merging(merge_place, method), "--anchor", merge_place.anchor)
    assert aegis(*words, "--out", tmp_path / "given")[0] == 0
    measured, given = parameters(merged(method)), parameters(tmp_path / "given")
    for name, found in given.items():
        torch.testing.assert_close(found, measured[name], rtol=1e-3, atol=1e-4, msg=name)


# --- a sweep --------------------------------------------------------------------------------------


def test_a_sweep_writes_a_frontier_and_no_run(
    aegis: Aegis, merge: Callable[..., Any], merge_place: Place, tmp_path: Path
) -> None:
    plot = tmp_path / "sweep.png"
    report = merge(merge_place.run, "--sweep", "100,1", "--plot", plot)
    assert [point["strength"] for point in report["points"]] == [0, 1, 100]
    assert (report["out"], report["strength"], report["passed"]) == (None, None, None)
    assert report["questions"] == QUESTIONS and report["baseline_accuracy"] == 1
    metrics = (merge_place.run / "metrics.jsonl").read_text().splitlines()
    as_trained = report["points"][0]
    assert as_trained["validation_loss"] == pytest.approx(
        json.loads(metrics[-1])["validation_loss"], rel=1e-5
    )
    assert as_trained["accuracy"] < 1 and as_trained["drop_points"] == pytest.approx(
        100 * (1 - as_trained["accuracy"])
    )
    assert plot.stat().st_size > 5000
    code, shown, _ = aegis("merge", merge_place.run, "--sweep", "1", *SMALL)
    assert code == 0 and "Validation loss" in shown and "validation questions" in shown
    assert [p.name for p in tmp_path.iterdir()] == ["sweep.png"]


def test_max_drop_writes_the_weakest_merge_that_passes(
    merge: Callable[..., Any], merge_place: Place, tmp_path: Path
) -> None:
    out, given = tmp_path / "merged", ("--method", "linear", "--sweep", "0.01,0.999,1")
    report = merge(merge_place.run, *given, "--max-drop", 0, "--out", out)
    assert report["passed"] and report["out"] == str(out)
    passing = [p["strength"] for p in report["points"] if p["drop_points"] <= 0]
    assert report["strength"] == min(passing) and len(passing) < 4
    merged = parameters(out)
    base, trained, share = (
        parameters(merge_place.base),
        parameters(merge_place.run),
        report["strength"],
    )
    for name, found in merged.items():
        wanted = share * base[name] + (1 - share) * trained[name]
        torch.testing.assert_close(found, wanted, rtol=0, atol=1e-6)


def test_what_passes_as_it_is_is_said_not_to_have_moved(
    aegis: Aegis, merge_place: Place, tmp_path: Path
) -> None:
    given = ("--method", "linear", "--sweep", "1", "--max-drop", 100, "--out", tmp_path / "merged")
    code, shown, err = aegis("merge", merge_place.run, *given, *SMALL, "--json")
    assert code == 0 and json.loads(shown)["strength"] == 0
    assert "itself loses no more than 100 points: nothing is moved" in " ".join(err.split())


def test_a_gate_that_the_questions_cannot_tell_is_warned_of(
    aegis: Aegis, merge_place: Place, tmp_path: Path
) -> None:
    given = ("--method", "linear", "--sweep", "1", "--max-drop", 1, "--out", tmp_path / "merged")
    _, _, err = aegis("merge", merge_place.run, *given, *SMALL, "--json")
    assert "too coarsely for a gate at 1" in " ".join(err.split())


def test_a_gate_on_questions_that_the_model_never_knew_is_warned_of(
    aegis: Aegis, run_folder: Path, demos_file: Path, tmp_path: Path
) -> None:
    """An untrained model has nothing to lose, so every strength passes."""
    given = ("--method", "linear", "--sweep", "1", "--max-drop", 0.5, "--out", tmp_path / "merged")
    code, _, err = aegis("merge", run_folder, "--demos", demos_file, *given, "--questions", 14)
    assert code == 0 and "can hardly lose what it does not know" in " ".join(err.split())


def test_a_gate_fails_where_no_strength_passes(
    aegis: Aegis, merge_place: Place, tmp_path: Path
) -> None:
    out, given = tmp_path / "merged", ("--method", "linear", "--sweep", "0.01")
    words = ("merge", merge_place.run, *given, "--max-drop", 0, "--out", out, *SMALL, "--json")
    code, shown, err = aegis(*words)
    report = json.loads(shown)
    assert code == 1 and "gate failed" in err
    assert (report["passed"], report["out"], report["strength"]) == (False, None, None)
    assert not list(tmp_path.iterdir())


def test_the_weakest_that_passes_is_taken_wherever_it_stands() -> None:
    points = [MergePoint(s, 1.0, 1.0, drop, (0.0, 0.0)) for s, drop in ((0, 9), (1, 0.4), (3, 0.6))]
    assert _weakest(points, 0.5, MEAN) == 1 and _weakest(points, 0.4, MEAN) == 1
    assert _weakest(points, 0.1, MEAN) is None and _weakest(points, 10, MEAN) == 0
    assert _weakest(points, None, MEAN) is None


def test_the_upper_end_of_the_drop_can_be_what_is_limited() -> None:
    drops = ((0.0, 9.0, (8.0, 10.0)), (1.0, 0.4, (-0.5, 1.3)), (2.0, 0.3, (-0.1, 0.7)))
    points = [MergePoint(s, 1.0, 0.9, drop, ends) for s, drop, ends in drops]
    assert [_weakest(points, 1.0, gate) for gate in (MEAN, UPPER)] == [1, 2]
    assert _weakest(points, 0.5, UPPER) is None


# --- models without a run -------------------------------------------------------------------------


def test_two_models_of_ours(merge: Callable[..., Any], merge_place: Place, tmp_path: Path) -> None:
    tuned, out = last(merge_place.run) / "backbone", tmp_path / "merged"
    given = ("--base", merge_place.base, "--method", "linear", "--strength", 0.25, "--out", out)
    merge(tuned, *given)
    base, trained, merged = map(parameters, (merge_place.base, tuned, out))
    for name, found in merged.items():
        wanted = 0.25 * base[name] + 0.75 * trained[name]
        torch.testing.assert_close(found, wanted, rtol=0, atol=1e-6)


@pytest.fixture
def moved_norms(merge_place: Place, tmp_path: Path) -> Path:
    """The base with normalisations that have moved, and no map that has."""
    model: Backbone = backbones.load(str(merge_place.base))
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if "norm" in name:
                parameter.add_(0.5)
    model.save(tmp_path / "tuned")
    return tmp_path / "tuned"


@pytest.mark.parametrize("strength", [0.25, 1.0])
def test_linear_moves_back_what_lies_beside_maps_that_have_not_moved(
    strength: float, merge: Callable[..., Any], merge_place: Place, moved_norms: Path
) -> None:
    out = moved_norms.with_name("merged")
    given = ("--base", merge_place.base, "--method", "linear", "--strength", strength)
    report = merge(moved_norms, *given, "--out", out)
    assert report["kept"] == pytest.approx(1 - strength, abs=1e-6)
    base, merged = parameters(merge_place.base), parameters(out)
    assert any("norm" in name for name in merged)
    for name, found in merged.items():
        wanted = base[name] + (0.5 * (1 - strength) if "norm" in name else 0)
        torch.testing.assert_close(found, wanted, rtol=0, atol=1e-6, msg=name)


@pytest.mark.parametrize("method", [m for m in MERGES if m != "linear"])
def test_a_method_for_maps_refuses_a_model_of_which_none_has_moved(
    method: str, aegis: Aegis, merge_place: Place, moved_norms: Path
) -> None:
    out = moved_norms.with_name("merged")
    given = ("--base", merge_place.base, "--method", method, "--strength", 1, "--out", out)
    bad(aegis, moved_norms, *given, says=("no linear map", f"'{method}'", "--method linear"))
    assert not out.exists()


@pytest.mark.parametrize("method", ["inputs", "factors"])
def test_a_model_whose_task_is_questions(
    method: str, merge: Callable[..., Any], merge_place: Place, tmp_path: Path
) -> None:
    task = write_jsonl(tmp_path, images=60)
    tuned, out = last(merge_place.run) / "backbone", tmp_path / "merged"
    words = (tuned, "--base", merge_place.base, "--method", method, "--task-vqa", task)
    report = merge(*words, "--sweep", "1,10", "--max-drop", 100, "--out", out)
    assert report["strength"] == 0 and out.is_dir()
    assert all(0 <= p["task_accuracy"] <= 1 for p in report["points"])
    assert all(p["validation_loss"] is None for p in report["points"])


def test_a_hugging_face_pair(
    merge: Callable[..., Any], aegis: Aegis, hf_folder: Callable[[str], Path], tmp_path: Path
) -> None:
    from samples import hf

    base, tuned = hf_folder("smolvlm"), hf.write("smolvlm", tmp_path / "tuned", seed=1)
    words = (tuned, "--base", base, "--strength")
    line = ("--method", "linear", "--out", tmp_path / "line", "--json")
    code, _, said = aegis("merge", *words, 0.5, *line)
    assert code == 0 and "scenes" not in said  # no question is asked
    pre, post, merged = map(parameters, (base, tuned, tmp_path / "line"))
    for name, found in merged.items():
        torch.testing.assert_close(found, (pre[name] + post[name]) / 2, rtol=0, atol=1e-5)
    card = (tmp_path / "line" / "README.md").read_text()
    assert "merge of strength 0.5" in card
    assert "50.0 % of the displacement of its maps.\n" in card
    report = merge(*words, 1, "--task-vqa", "scenes", "--out", tmp_path / "two-sided")
    assert 0 < report["kept"] < 1
    assert aegis("probe", tmp_path / "two-sided", "--questions", 7)[0] == 0
    assert json.loads(aegis("inspect", tmp_path / "line", "--json")[1])["facts"]["known"]


# --- refusals -------------------------------------------------------------------------------------


def bad(aegis: Aegis, *words: object, says: tuple[str, ...]) -> None:
    err = refused(aegis("merge", *words))
    assert [word for word in says if word not in err] == [], err


def test_options_that_do_not_go_together(aegis: Aegis, merge_place: Place, tmp_path: Path) -> None:
    run, out = merge_place.run, tmp_path / "merged"
    bad(aegis, run, "--method", "factor", "--sweep", "1", says=("factor", "did you mean"))
    says = ("leave out --strength, or --sweep",)
    bad(aegis, run, "--strength", 1, "--sweep", "1", "--out", out, says=says)
    bad(aegis, run, "--strength", 1, says=("--out",))
    bad(aegis, run, "--max-drop", 1, says=("--out",))
    unasked = ("--strength", 0.5, "--out", out, "--vqa", "nonsense.jsonl")
    bad(aegis, run, "--method", "linear", *unasked, says=("--vqa nonsense.jsonl", "linear"))
    bad(aegis, run, "--anchor", merge_place.anchor, *unasked, says=("--vqa", "--anchor"))
    bad(aegis, run, "--out", out, says=("--max-drop", "--strength"))
    bad(aegis, run, "--sweep", "1,,2", says=("1,10,100",))
    bad(aegis, run, "--sweep", "1,-2", says=("0 or more",))
    bad(aegis, run, "--strength", "nan", "--out", out, says=("--strength",))
    bad(aegis, run, "--sweep", "1", "--damping", 0, says=("--damping",))
    bad(aegis, run, "--sweep", "1", "--plot", tmp_path / "a.txt", says=(".png",))
    bad(aegis, run, "--method", "linear", "--strength", 2, "--out", out, says=("0 to 1",))
    assert not list(tmp_path.iterdir())


def test_targets_that_cannot_be_merged(
    aegis: Aegis, merge_place: Place, tiny_folder: Path, tmp_path: Path
) -> None:
    run, tuned = merge_place.run, last(merge_place.run) / "backbone"
    write = ("--method", "linear", "--strength", 0.5, "--out", tmp_path / "merged")
    bad(aegis, "nothing", *write, says=("--base",))
    bad(aegis, "nothing", "--base", merge_place.base, *write, says=("nothing",))
    bad(aegis, tuned, *write, says=("--base",))
    bad(aegis, tuned, "--base", "embedded", *write, says=("shapes", "--base"))
    bad(aegis, tuned, "--base", tuned, *write, says=("the same weights",))
    bad(aegis, run, "--base", tiny_folder, *write, says=("other", "--base"))
    bad(aegis, run, "--task-vqa", "scenes", *write, says=("--task-vqa",))
    given = ("--base", merge_place.base, "--strength", 1, "--out", tmp_path / "merged")
    bad(aegis, tuned, *given, says=("--task-vqa", "linear"))
    bad(aegis, tuned, *given, "--demos", merge_place.demos, says=("--demos",))
    assert not list(tmp_path.iterdir())


def test_anchors_and_demonstrations_that_do_not_fit(
    aegis: Aegis, merge_place: Place, anchor_file: Path, tiny_folder: Path, tmp_path: Path
) -> None:
    moments, other = tmp_path / "moments.safetensors", tmp_path / "demos.safetensors"
    words = ("--parts", "moments", "--samples", 14, "--out", moments)
    assert aegis("anchor", "--backbone", merge_place.base, *words)[0] == 0
    assert aegis("demos", "reach", "--episodes", 3, "--out", other)[0] == 0
    before = snapshot(tmp_path)
    write = ("--strength", 1, "--frames", 20, "--out", tmp_path / "merged")
    for method, part in (("factors", "curvature"), ("inputs", "inputs")):
        given = (merge_place.run, "--method", method, "--anchor", moments, *write)
        bad(aegis, *given, says=(f"without {part}", f"--parts {part}"))
    says = (f"not those of '{merge_place.base}'", "--base", "aegis anchor --backbone")
    bad(aegis, merge_place.run, "--anchor", anchor_file, *write, says=says)
    bad(aegis, merge_place.run, "--demos", other, *write, says=("other demonstrations",))
    alone = tmp_path / "alone"
    shutil.copytree(merge_place.run, alone, symlinks=True)
    (alone / "inputs.json").unlink()  # as for a run that does not say where they are
    (tmp_path / "demos.safetensors").unlink()
    before = snapshot(tmp_path)
    bad(aegis, alone, *write, says=("no demonstrations", "--demos"))
    assert snapshot(tmp_path) == before


def test_a_merged_run_whose_links_were_followed_is_the_same_run(
    merge: Callable[..., Any], aegis: Aegis, merge_place: Place, tmp_path: Path
) -> None:
    merge(merge_place.run, "--method", "linear", "--strength", 0.5, "--out", tmp_path / "merged")
    copied = shutil.copytree(tmp_path / "merged", tmp_path / "copied", symlinks=False)
    facts = [
        json.loads(aegis("inspect", each, "--json")[1])["facts"]
        for each in (tmp_path / "merged", copied)
    ]
    assert facts[0]["steps"] == facts[1]["steps"] == 8


def test_a_merged_run_knows_where_its_inputs_are_seen_from_it(
    merge: Callable[..., Any], merge_place: Place, tmp_path: Path
) -> None:
    """However deeply nested, it may be moved together with them."""
    out = tmp_path / "deep" / "down" / "merged"
    out.parent.mkdir(parents=True)
    merge(merge_place.run, "--method", "linear", "--strength", 0.5, "--out", out)
    said = json.loads((out / "inputs.json").read_text())
    assert said["demos"] == [str(merge_place.demos)]
    (seen,) = said["relative"]["demos"]
    assert (out / seen).resolve() == merge_place.demos.resolve()


def test_a_folder_that_is_not_empty_is_not_replaced(
    aegis: Aegis, merge_place: Place, tmp_path: Path
) -> None:
    (tmp_path / "merged").mkdir()
    (tmp_path / "merged" / "mine").write_text("mine")
    (tmp_path / "file").write_text("mine")
    before = snapshot(tmp_path)
    for name in ("merged", "file"):
        write = ("--method", "linear", "--strength", 0.5, "--out", tmp_path / name)
        bad(aegis, merge_place.run, *write, says=("not empty",))
    assert snapshot(tmp_path) == before


def test_what_a_killed_merge_left_keeps_no_other_from_its_folder(
    merge: Callable[..., Any], merge_place: Place, tmp_path: Path
) -> None:
    for name in (".merged.12345.tmp", ".merged.tmp"):  # the second one is an earlier Aegis' name
        (tmp_path / name / "checkpoints").mkdir(parents=True)
    out = tmp_path / "merged"
    merge(merge_place.run, "--method", "linear", "--strength", 0.5, "--out", out)
    assert {path.name for path in tmp_path.iterdir()} == {"merged", ".merged.tmp"}


def test_a_folder_that_another_process_writes_is_left_to_it(
    aegis: Aegis, merge_place: Place, tmp_path: Path
) -> None:
    write = ("--method", "linear", "--strength", 0.5, "--out", tmp_path / "merged")
    with locks.alone(tmp_path / "merged"):
        bad(aegis, merge_place.run, *write, says=("is being written to by process",))
    assert not list(tmp_path.iterdir())


def test_a_merged_run_is_not_trained_on(
    aegis: Aegis, merge: Callable[..., Any], merge_place: Place, tmp_path: Path
) -> None:
    out = tmp_path / "merged"
    merge(merge_place.run, "--method", "linear", "--strength", 0.5, "--out", out)
    given = ("--demos", merge_place.demos, "--out", out, "--resume")
    err = refused(aegis("train", out / "recipe.yaml", *given))
    assert "aegis merge" in err
    # It is not asked for what it was trained on, but a new run is, whose command names that.
    err = refused(aegis("train", out))
    assert f"aegis merge made from '{merge_place.run}'" in err
    assert "does not record" not in err and f"aegis train {merge_place.run};" in err
    again = f"aegis train {out}/recipe.yaml --demos {merge_place.demos} --set backbone={out}"
    assert f"{again} --set expert.start={out} --out RUN" in err
