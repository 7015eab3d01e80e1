"""`aegis report`: a self-contained page, with the figures of `--json`."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
from dataclasses import asdict, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
import yaml
from samples.command import refused
from samples.reports import HOSTILE, METHODS, open_loop, probe, rollout, write_job
from samples.studies import found

from aegis_cli.cli.page import pages
from aegis_cli.cli.page.cursor import At
from aegis_cli.cli.render.studies import _notes
from aegis_cli.common import files
from aegis_cli.evaluation import results
from aegis_cli.recipes import Train
from aegis_cli.studies.comparison import POLICY_BAR
from aegis_cli.studies.metrics import bar
from aegis_cli.studies.tuning import PolicyPoint

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)


class Page(HTMLParser):
    """The elements of a page, and its figures: path in the document, value, and text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.figures: list[tuple[str, str, str]] = []
        self.said = ""
        self._open: dict[str, str | None] | None = None
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag == "data":
            self._open = dict(attrs)

    def handle_data(self, data: str) -> None:
        self.said += data
        if self._open is not None:
            path, value = str(self._open["data-path"]), str(self._open["value"])
            self.figures.append((path, value, data))
            self._open = None


def at(document: Any, pointer: str) -> Any:
    """The value at a JSON pointer."""
    for word in pointer.split("/")[1:]:
        word = word.replace("~1", "/").replace("~0", "~")
        document = document[int(word)] if isinstance(document, list) else document[word]
    return document


def check_figures(page: Page, document: Any) -> None:
    """Every figure of the page equals the document's, rounded."""
    assert len(page.figures) > 10
    for path, value, shown in page.figures:
        exact = at(document, path)
        assert json.loads(value) == exact, path
        said = float(shown.replace(",", ""))
        # A share is shown in percent, and large figures with three digits.
        rounding = max(0.051, 0.0051 * abs(exact))
        assert min(abs(said - exact), abs(said - 100 * exact)) <= rounding, path


def reported(aegis: Any, folder: Path) -> tuple[Page, Any]:
    """The page of a folder, and the output of `--json` when it was written."""
    code, out, err = aegis("report", folder, "--json")
    assert code == 0 and f"report: {folder / 'report.html'}" in err
    return Page((folder / "report.html").read_text(encoding="utf-8")), json.loads(out)


@pytest.fixture
def job(tmp_path: Path) -> Path:
    return write_job(tmp_path)


def test_figures_of_a_job_are_those_of_json(aegis, job: Path) -> None:
    page, document = reported(aegis, job)
    assert document["kind"] == "job" and [r["method"] for r in document["runs"]] == [*METHODS]
    check_figures(page, document)
    paths = {path for path, _, _ in page.figures}
    assert {
        "/table/rows/1/drop_points",
        "/runs/0/probes/0/figures/families/color/accuracy",
        "/runs/1/probes/0/figures/layers/1/w2",
        "/runs/1/rollouts/0/figures/interval/1",
        "/runs/1/energy_shed_mean",
    } <= paths


def test_the_page_tells_what_an_automatic_precision_was(aegis, job: Path) -> None:
    path = job / "naive" / "machine.json"
    assert "Precisionauto" in reported(aegis, job / "naive")[0].said  # an earlier Aegis lacked it
    files.save_json(path, files.load_json(path) | {"precision": "float32"})
    assert "Precisionfloat32 (auto)" in reported(aegis, job / "naive")[0].said


@pytest.mark.parametrize(
    ("settings", "shown"),
    [
        ({}, "0.0003 and 0.001 of the expert, up over 100 steps, down to 10 % along a cosine"),
        (
            {"warmup": 0, "schedule": "linear", "final_lr_share": 0.0},
            "0.0003 and 0.001 of the expert, down to 0 % along a line",
        ),
        (
            {"schedule": "constant"},
            "0.0003 and 0.001 of the expert, up over 100 steps, then constant",
        ),
    ],
)
def test_the_page_tells_how_learning_rates_go_on(settings: dict[str, Any], shown: str) -> None:
    train = Train(backbone_lr=3e-4, expert_lr=1e-3, **settings)
    assert pages._rates(At(asdict(train))) == shown


def test_open_loop_errors_are_on_the_page_with_what_they_are_of(aegis, job: Path) -> None:
    evaluated = open_loop(1, 2, split="chosen", trained_on=[2])
    results.keep(job / "naive", "evaluate-chosen-arm", evaluated, {})
    page, document = reported(aegis, job)
    check_figures(page, document)
    place = "/runs/0/open_loops/0/figures"
    shown = {path for path, _, _ in page.figures}
    assert {f"{place}/relative_error", f"{place}/relative_interval/1", f"{place}/frames"} <= shown
    assert page.said.count("2 chosen episodes of datasets/arm, 1 of them trained on") == 1
    said = "Open-loop error on 2 chosen episodes of datasets/arm, 1 of them trained on"
    assert said in reported(aegis, job / "naive")[0].said


def test_the_table_of_a_job_has_the_open_loop_error_of_what_cannot_be_rolled_out(
    aegis, job: Path
) -> None:
    table = files.load_json(job / "table.json")
    for row, error in zip(table["rows"], (0.125, 0.375), strict=True):
        row |= dict.fromkeys(("success_seen", "success_held_out", "wrong_target"))
        row["open_loop_error"], row["hold_error"] = error, 0.25
    files.save_json(job / "table.json", table)
    page, document = reported(aegis, job)
    check_figures(page, document)
    shown = {path: text for path, _, text in page.figures}
    assert shown["/table/rows/0/open_loop_error"] == "0.125"
    assert shown["/table/rows/1/open_loop_error"] == "0.375"
    assert shown["/table/rows/0/hold_error"] == "0.250"
    assert "/table/rows/0/success_seen" not in shown
    assert "Open-loop error" in page.said and "is not a success rate" in page.said
    assert "open-loop error on held-out episodes" in page.said  # below the chart of all methods
    assert f"{table['rows'][0]['method']} has the least open-loop error: 0.125." in page.said


def test_the_success_in_each_suite_is_on_the_page(aegis, job: Path) -> None:
    """Papers report LIBERO's four suites one by one."""
    parts = {
        "libero/spatial": {"success": 0.5, "interval": [0.25, 0.75], "episodes": 3},
        "libero/goal": {"success": 0.0, "interval": [0.0, 0.5], "episodes": 1},
    }
    played = rollout("seen", 0.375) | {"task": "libero/all", "colors": None, "suites": parts}
    results.keep(job / "naive", "rollout-seen-libero", played, {})
    page, document = reported(aegis, job / "naive")
    check_figures(page, document)
    place = "/rollouts/1/figures/suites/libero~1spatial"
    assert document["rollouts"][1]["figures"]["suites"] == parts
    shown = {path for path, _, _ in page.figures}
    assert {f"{place}/success", f"{place}/interval/1", f"{place}/episodes"} <= shown
    assert "libero/spatial, of these" in page.said and "libero/goal, of these" in page.said


def test_the_worst_instructions_of_an_open_loop_error_are_on_the_page(aegis, job: Path) -> None:
    entry = {"episodes": 2, "frames": 30, "relative_interval": [0.5, 1.5], "hold_error": 0.25}
    many = [
        {"instruction": f"put {HOSTILE} {i}", "relative_error": 1.0 - i / 100, **entry}
        for i in range(12)
    ]
    evaluated = open_loop(1, 2, instructions=many)
    results.keep(job / "naive", "evaluate-validation-arm", evaluated, {})
    page, document = reported(aegis, job / "naive")
    check_figures(page, document)
    assert document["open_loops"][0]["figures"]["instructions"] == many
    place = "/open_loops/0/figures/instructions"
    shown = {path for path, _, _ in page.figures}
    assert {f"{place}/0/relative_error", f"{place}/9/relative_interval/1"} <= shown
    assert f"{place}/10/relative_error" not in shown
    assert "the worst 10 of 12 instructions" in page.said


def test_figures_of_a_run_are_those_of_json(aegis, job: Path) -> None:
    page, document = reported(aegis, job / "aegis")
    assert document["kind"] == "run" and document["label"] == "aegis"
    check_figures(page, document)
    assert "aegis train" in page.said and "aegis rollout NEW_FOLDER" in page.said


def test_a_rollout_that_was_repeated_stands_once_and_another_with_what_tells_it_apart(
    aegis, job: Path
) -> None:
    results.keep(job / "naive", "rollout-seen", rollout("seen", 0.75), {"seed": 0})
    page, document = reported(aegis, job)
    assert len(document["runs"][0]["rollouts"]) == 2 and "Played with" not in page.said
    results.keep(job / "naive", "rollout-seen", rollout("seen", 0.25), {"seed": 3})
    page, document = reported(aegis, job)
    check_figures(page, document)
    played = [one["played"]["seed"] for one in document["runs"][0]["rollouts"]]
    assert played == [0, 3, 0] and "Played with" in page.said and "seed 3" in page.said
    alone, _ = reported(aegis, job / "naive")
    assert "Success %, seen colours, reach, 4 episodes, seed 3" in alone.said
    assert "Success %, held-out colours, reach" not in alone.said
    shown = aegis("inspect", job / "naive")[1]
    assert "Played with" in shown and "seed 3" in shown


def test_the_commands_of_a_run_ask_and_play_by_its_seeds(aegis, job: Path) -> None:
    run = next(path.parent for path in sorted(job.glob("*/recipe.yaml")))
    keys = yaml.safe_load((run / "recipe.yaml").read_text())
    assert not any("--seed" in line for line in _commands(aegis, run))
    keys["probe"]["seed"], keys["rollout"]["seed"] = 5, 6
    (run / "recipe.yaml").write_text(yaml.safe_dump(keys))
    seeds = {line.split()[1]: line for line in _commands(aegis, run)}
    assert "--seed 5" in seeds["probe"] and "--seed 6" in seeds["rollout"]


def test_the_commands_of_a_run_ask_each_set_as_its_recipe_does(aegis, job: Path) -> None:
    run = next(path.parent for path in sorted(job.glob("*/recipe.yaml")))
    keys = yaml.safe_load((run / "recipe.yaml").read_text())
    ask = "{} Answer 'yes' or \"no\"."
    asked = {"vqa": ["scenes", "data/q.jsonl"], "skip_bad": True, "ask": ask, "questions": 7}
    keys["probe"] |= asked
    (run / "recipe.yaml").write_text(yaml.safe_dump(keys))
    probes = [shlex.split(line) for line in _commands(aegis, run) if "aegis probe" in line]
    assert [words[words.index("--vqa") + 1] for words in probes] == asked["vqa"]
    for words in probes:
        assert "--skip-bad" in words and words[words.index("--ask") + 1] == ask
        assert words[words.index("--questions") + 1] == "7"


def _commands(aegis, run: Path) -> list[str]:
    return json.loads(aegis("report", run, "--json")[1])["commands"]


def test_an_anchor_that_no_training_read_is_what_the_drift_is_measured_against(
    aegis, job: Path
) -> None:
    naive, read = job / "naive", job / "aegis"
    page, document = reported(aegis, naive)
    assert document["anchor"] == {"measured_on": "a file given to aegis probe", "read": False}
    assert "it measures the drift, and no training used it" in page.said
    train, asked, *_ = document["commands"]
    assert "--anchor" not in train and "--anchor" in asked
    page, document = reported(aegis, read)
    assert document["anchor"]["read"] is True and "no training used it" not in page.said
    assert "--anchor" in document["commands"][0]
    files.save_json(read / "inputs.json", {"demos": ["/data/a.sft"], "anchor": "/data/mine.sft"})
    told = reported(aegis, read)[1]["anchor"]["measured_on"]
    assert told.startswith("'mine.sft' with sha256 ")
    files.save_json(naive / "train.json", {"method": "naive"})
    _, document = reported(aegis, naive)
    assert document["anchor"]["measured_on"] == "3,000 questions of scenes"


def test_an_anchor_that_nothing_used_is_not_told(aegis, job: Path) -> None:
    naive = job / "naive"
    (naive / "probe.json").unlink()
    page, document = reported(aegis, naive)
    assert document["anchor"] is None and "Anchor" not in page.said
    assert not any("--anchor" in command for command in document["commands"])


def test_a_page_loads_nothing_and_runs_nothing(aegis, job: Path) -> None:
    (job / "film.gif").write_bytes(b"GIF89a")
    page, _ = reported(aegis, job)
    names = {tag for tag, _ in page.tags}
    assert not names & {"script", "iframe", "object", "embed", "base", "form"}
    sources = [v for _, a in page.tags for k, v in a.items() if k in ("src", "href", "data")]
    assert sources and all(str(source).startswith("data:") for source in sources)
    assert not [k for _, attributes in page.tags for k in attributes if k.startswith("on")]
    assert "url(" not in (job / "report.html").read_text() and "@import" not in page.said
    assert any(tag == "img" and a["alt"] == "film.gif" for tag, a in page.tags)


def test_texts_of_artifacts_are_no_markup(aegis, tmp_path: Path) -> None:
    job = write_job(tmp_path, family=HOSTILE.replace("\x1b", ""), backbone=HOSTILE)
    page, document = reported(aegis, job)
    check_figures(page, document)
    assert "script" not in {tag for tag, _ in page.tags}
    text = (job / "report.html").read_text(encoding="utf-8")
    assert "<script" not in text and "\x1b" not in text
    assert page.said.count("<script>alert('x')</script>") >= 3


def test_a_folder_whose_name_is_not_utf8_has_a_page(aegis, tmp_path: Path) -> None:
    """Python represents such a byte as half of a surrogate pair, which UTF-8 cannot encode."""
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    folder.mkdir()
    files.save_json(folder / "table.json", found(("naive", "x")).to_json())
    code, _, err = aegis("report", folder)
    assert code == 0 and r"caf\udce9" in err
    text = (folder / "report.html").read_text(encoding="utf-8")
    assert r"caf\udce9" in text


def test_a_large_film_is_linked(aegis, job: Path) -> None:
    with open(job / "film #1.mp4", "wb") as film:
        film.truncate(9_000_000)
    page, _ = reported(aegis, job)
    assert ("a", {"href": "film%20%231.mp4"}) in page.tags
    assert (job / "report.html").stat().st_size < 1_000_000


def test_a_page_elsewhere_links_the_film_where_it_lies(aegis, job: Path, tmp_path: Path) -> None:
    with open(job / "film.mp4", "wb") as film:
        film.truncate(9_000_000)
    (tmp_path / "elsewhere").mkdir()
    aegis("report", job, "--out", tmp_path / "elsewhere" / "x.html")
    text = (tmp_path / "elsewhere" / "x.html").read_text(encoding="utf-8")
    (link,) = re.findall(r'href="([^"]*film.mp4)"', text)
    assert (tmp_path / "elsewhere" / link).resolve() == (job / "film.mp4").resolve()


def test_what_only_a_later_probe_has_is_on_the_page(aegis, job: Path) -> None:
    """The first probe was measured without an anchor, and on other questions."""
    run = job / "naive"
    (run / "probe.json").unlink()
    less = probe("shape") | {"layers": [], "wrong": []}
    results.keep(run, "probe-a", less, {"vqa": "a"})
    results.keep(run, "probe-b", probe("color"), {"vqa": "b"})
    page, _ = reported(aegis, run)
    assert "Drift per layer" in page.said and "Wrong answers" in page.said
    assert "VQA accuracy on a" in page.said


@pytest.mark.parametrize("missing", ["layers", "families", "baseline_accuracy", "drop_points"])
def test_what_an_older_version_did_not_write_is_left_out(aegis, job: Path, missing: str) -> None:
    path = job / "naive" / "probe.json"
    left = {name: value for name, value in files.load_json(path).items() if name != missing}
    files.save_json(path, left | {"drop_interval": None})
    for command in ("inspect", "report"):
        assert aegis(command, job / "naive")[0] == 0
    assert aegis("compare", job)[0] == 0


# --- several runs ---------------------------------------------------------------------------------


def compared(aegis: Any, *runs: Path | str) -> tuple[Page, Any]:
    """The page of several runs, and the output of `--json` when it was written."""
    out = Path(runs[0]).parent / "compared.html"
    code, said, err = aegis("report", *runs, "--out", out, "--json")
    assert code == 0, err
    return Page(out.read_text(encoding="utf-8")), json.loads(said)


def played(run: Path, outcomes: str) -> None:
    path = run / "rollout-seen.json"
    found = files.load_json(path) | {"outcomes": outcomes, "episodes": len(outcomes)}
    files.save_json(path, found)


def test_several_runs_have_one_page_with_what_compares_them_and_a_part_of_each(
    aegis, job: Path
) -> None:
    played(job / "naive", "0" * 30)
    played(job / "aegis", "1" * 30)
    page, document = compared(aegis, job / "naive", job / "aegis")
    check_figures(page, document)
    assert document["kind"] == "comparison"
    assert [run["label"] for run in document["runs"]] == ["naive", "aegis"]
    shown = {path for path, _, _ in page.figures}
    assert {
        "/comparison/rows/1/drop_points",
        "/comparison/rows/0/baseline_accuracy",
        "/comparison/paired/0/success_seen_points/mean",
        "/comparison/paired/0/success_seen_points/interval/1",
        "/runs/1/probes/0/figures/drop_points",
        "/runs/0/probes/0/figures/layers/1/w2",
    } <= shown
    assert "Runs compared" in page.said and "Differences from naive" in page.said
    for run in (job / "naive", job / "aegis"):
        assert f"{run}: Method {run.name} fine-tuned embedded" in page.said
    assert page.said.count("How to repeat it") == page.said.count("Every key of its recipe") == 2
    assert "VQA accuracy lost (points)" in page.said  # the axis of the chart of both
    assert sum(tag == "svg" for tag, _ in page.tags) >= 3  # the chart, curves, drift


def test_a_folder_of_runs_has_a_page_in_it(aegis, job: Path) -> None:
    for name, method in (("a", "aegis"), ("b", "naive")):
        shutil.copytree(job / method, job.parent / "runs" / name, symlinks=True)
    (job.parent / "runs" / "aa").symlink_to("a")  # the same run, which is on the page once
    page, document = reported(aegis, job.parent / "runs")
    check_figures(page, document)
    assert [run["label"] for run in document["runs"]] == ["aegis", "naive"]
    assert document["comparison"]["against"] == str(job.parent / "runs" / "b")


def test_a_page_shows_differences_from_the_chosen_run(aegis, job: Path) -> None:
    for paths in ((job, job / "naive"), (job,)):
        page, document = compared(aegis, *paths, "--against", "aegis")
        check_figures(page, document)
        against = document.get("comparison", document)["against"]
        assert against == str(job / "aegis") and "Differences from aegis" in page.said
    said = refused(aegis("report", job, "--against", "lora"))
    assert "--against lora, which is none of the compared runs" in said
    said = refused(aegis("report", job / "naive", "--against", "aegis"))
    assert "which does not compare runs" in said


def test_runs_of_one_method_have_their_folders_names(aegis, job: Path) -> None:
    shutil.copytree(job / "naive", job / "again", symlinks=True)
    shutil.copytree(job / "naive", job / "deep" / "again", symlinks=True)
    page, document = compared(aegis, job / "naive", job / "again", job / "naive")
    check_figures(page, document)
    assert [run["label"] for run in document["runs"]] == ["naive", "again"]
    _, document = compared(aegis, job / "again", job / "deep" / "again")
    assert [run["label"] for run in document["runs"]] == [run["path"] for run in document["runs"]]


def test_several_folders_have_no_page_without_out(aegis, job: Path) -> None:
    said = refused(aegis("report", job / "naive", job / "aegis"))
    assert "2 folders without --out" in said
    assert f"aegis report {job / 'naive'} {job / 'aegis'} --out compared.html" in said
    assert not list(job.rglob("*.html"))


def test_what_is_no_run_is_not_compared_on_a_page(aegis, job: Path, tmp_path: Path) -> None:
    (tmp_path / "study").mkdir()
    files.save_json(tmp_path / "study" / "table.json", found(("naive", "x")).to_json())
    said = refused(aegis("report", job, tmp_path / "study", "--out", tmp_path / "x.html"))
    assert "is not the run of a policy" in said


def test_runs_that_were_asked_otherwise_are_apart_on_their_page(aegis, job: Path) -> None:
    """Neither in one chart nor in one table of families, whose column of before is of one model."""
    path = job / "aegis" / "probe.json"
    files.save_json(path, files.load_json(path) | {"baseline_accuracy": 0.5, "questions": 41})
    page, document = compared(aegis, job / "naive", job / "aegis")
    check_figures(page, document)
    assert "They differ in questions (40 of scenes; 41 of scenes)" in page.said
    assert "VQA accuracy lost (points)" not in page.said
    files.save_json(path, files.load_json(path) | {"questions": 40})
    page, _ = compared(aegis, job / "naive", job / "aegis")
    assert page.said.count("VQA by family of questions: scenes, 40 questions") == 2


def test_backbones_of_other_depths_have_a_row_each(aegis, job: Path) -> None:
    path = job / "aegis" / "probe.json"
    probed = files.load_json(path)
    layers = [*probed["layers"], {"layer": "layers.2", "w2": 3.0}]
    files.save_json(path, probed | {"layers": layers})
    page, document = compared(aegis, job / "naive", job / "aegis")
    check_figures(page, document)
    assert "layers.2" in page.said


def test_the_page_of_a_job_has_paired_differences_from_naive(aegis, job: Path) -> None:
    played(job / "naive", "0" * 30)
    played(job / "aegis", "1" * 30)
    page, document = reported(aegis, job)
    check_figures(page, document)
    assert document["against"] == str(job / "naive")
    shown = {path: text for path, _, text in page.figures}
    assert shown["/paired/0/success_seen_points/mean"] == "+100.0"
    assert "/paired/0/success_held_out_points/interval/0" in shown
    text = (job / "report.html").read_text(encoding="utf-8")
    assert re.search(r"<strong><data [^>]*>\+100.0</data></strong>", text)
    assert "Another seed may differ by more" in page.said


def test_out_names_the_page(aegis, job: Path, tmp_path: Path) -> None:
    code, out, err = aegis("report", job, "--out", tmp_path / "x.html")
    assert (code, out) == (0, "") and "x.html" in err
    assert (tmp_path / "x.html").is_file() and not (job / "report.html").exists()


def test_a_page_of_another_ending_is_refused(aegis, job: Path, tmp_path: Path) -> None:
    said = refused(aegis("report", job, "--out", tmp_path / "x.pdf"))
    assert "x.html" in said and not list(tmp_path.glob("x.*"))


@pytest.mark.parametrize("command", ["report", "compare"])
def test_a_path_with_nothing_at_it_is_told_as_such(aegis, command: str, tmp_path: Path) -> None:
    code, _, err = aegis(command, tmp_path / "nope")
    assert code == 2 and "nothing is at" in err and "check the path" in err


def test_a_folder_with_nothing_to_report_is_refused(aegis, job: Path) -> None:
    said = refused(aegis("report", job.parent))
    assert f"aegis report {job}" in said
    assert "not a run, job or study" in said


def test_a_job_that_is_not_finished_says_so(aegis, job: Path) -> None:
    (job / "table.json").unlink()
    (job / "stages.json").write_text("{}")
    for command in ("report", "compare", "inspect"):
        said = refused(aegis(command, job))
        assert "is not finished" in said and "run the same aegis run again" in said
        assert f"aegis {command} {job / 'aegis'}" in said


def test_a_study_is_not_compared_as_a_job_that_is_not_finished(aegis, tmp_path: Path) -> None:
    for name in ("stages.json", "cells.json"):
        (tmp_path / name).write_text("{}")
    said = refused(aegis("compare", tmp_path))
    assert "is not finished" not in said and "aegis inspect shows studies" in said


@pytest.mark.parametrize(
    ("name", "changed"),
    [
        ("naive/rollout-seen.json", {"interval": []}),
        ("naive/rollout-seen.json", {"success": {}}),
        ("naive/probe.json", {"families": {"color": 3}}),
        ("naive/machine.json", {"cores": [1]}),
    ],
)
def test_damaged_figures_are_one_error(aegis, job: Path, name: str, changed: Any) -> None:
    path = job / name
    whole = json.loads(path.read_text()) if path.exists() else {}
    path.write_text(json.dumps(whole | changed))
    assert f"{path.name}' is damaged" in refused(aegis("report", job))


def test_a_rollout_of_other_colours_leaves_its_place_empty(aegis, job: Path) -> None:
    path = job / "naive" / "rollout-seen.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"colors": "odd"}))
    reported(aegis, job)


def test_an_unfinished_run_has_a_page_without_what_is_not_measured(aegis, job: Path) -> None:
    for name in ("probe.json", "rollout-seen.json", "rollout-held-out.json", "machine.json"):
        (job / "naive" / name).unlink()
    page, document = reported(aegis, job / "naive")
    assert document["probes"] == [] and document["rollouts"] == []
    assert "Not recorded" in page.said and "VQA by family" not in page.said
    assert any(tag == "svg" for tag, _ in page.tags)


def test_a_run_without_a_line_of_metrics_has_no_heading_for_them(aegis, job: Path) -> None:
    """For example a run that was interrupted before its first line."""
    run, heading = job / "naive", "<h2>Learning</h2>"
    reported(aegis, run)
    assert heading in (run / "report.html").read_text(encoding="utf-8")
    (run / "metrics.jsonl").write_text("")
    reported(aegis, run)
    assert heading not in (run / "report.html").read_text(encoding="utf-8")


def test_questions_of_one_family_have_one_row(aegis, job: Path) -> None:
    probed = files.load_json(job / "naive" / "probe.json")
    probed["families"] = {"all": next(iter(probed["families"].values()))}
    files.save_json(job / "naive" / "probe.json", probed)
    page, _ = reported(aegis, job / "naive")
    accuracies = [path for path, *_ in page.figures if path.endswith("/baseline_accuracy")]
    assert [path for path in accuracies if "/families/" in path] == accuracies[-1:]


def test_families_stand_side_by_side_only_where_the_same_was_asked(aegis, job: Path) -> None:
    """The second probe of one run has other questions than the second one of another."""
    for method, vqa, family in (("naive", "scenes", "color"), ("aegis", "easy-vqa", "shape")):
        found = {**probe(family), "questions": 14}
        results.keep(job / method, f"probe-{vqa}", found, {"vqa": vqa})
    results.keep(
        job / "naive", "probe-again", {**probe("color"), "questions": 14}, {"vqa": "scenes"}
    )
    page, document = reported(aegis, job)
    check_figures(page, document)
    titles = re.findall(r"VQA by family of questions(: [^A]*)?Accuracy", page.said)
    asked = "scenes, 40 questions", "scenes, 14 questions", "easy-vqa, 14 questions"
    assert sorted(titles) == sorted(
        f": {each}" for each in (*asked, "scenes, 14 questions, asked again")
    )
    runs = {run["label"]: run["question_sets"] for run in document["runs"]}
    assert runs["naive"] == ["scenes"] * 3 and runs["aegis"] == ["scenes", "easy-vqa"]


@pytest.mark.parametrize("seeds", [1, 5])
@pytest.mark.parametrize("diverged", [{}, {"x": {0}}])
def test_figures_of_a_study_are_those_of_json(
    aegis, seeds: int, diverged: dict[str, set[int]], tmp_path: Path
) -> None:
    written = found(("naive", "cotrain", "x"), seeds, diverged=diverged)
    files.save_json(tmp_path / "table.json", written.to_json())
    page, document = reported(aegis, tmp_path)
    assert document["kind"] == "study"
    check_figures(page, document)
    assert "Frontier" in page.said and any(path.endswith("/mean") for path, _, _ in page.figures)


def test_the_farther_ends_of_both_intervals_are_shown(aegis, tmp_path: Path) -> None:
    written = found(("naive", "x"), 5).to_json()
    lost = written["tasks"][0]["results"][1]["drop_points"]
    lost["crossed"] = [lost["interval"][0] - 7, lost["interval"][1] - 1e-3]
    files.save_json(tmp_path / "table.json", written)
    page, document = reported(aegis, tmp_path)
    check_figures(page, document)
    paths = {path for path, _, _ in page.figures}
    place = next(path for path in paths if path.endswith("/results/1/drop_points/mean"))
    place = place.removesuffix("/mean")
    assert {f"{place}/crossed/0", f"{place}/interval/1"} <= paths
    assert not {f"{place}/interval/0", f"{place}/crossed/1"} & paths


def test_each_demand_of_the_bar_shows_the_interval_that_it_is_judged_by(
    aegis, tmp_path: Path
) -> None:
    """A mean alone, beside a verdict on its interval's end, may seem to contradict it."""
    written = found(("naive", "x"), 5).to_json()
    files.save_json(tmp_path / "table.json", written)
    page, document = reported(aegis, tmp_path)
    check_figures(page, document)
    paths = {path for path, _, _ in page.figures}
    barred = next(path for path in paths if path.endswith("/bar/checks/0/value"))
    place = barred.removesuffix("/0/value")
    checks = written["tasks"][0]["results"][1]["bar"]["checks"]
    assert any(check["interval"] for check in checks)
    for number, check in enumerate(checks):
        ends = {f"{place}/{number}/interval/{end}" for end in (0, 1)}
        assert (ends <= paths) is (check["interval"] is not None)


def test_a_step_time_is_shown_in_the_digits_that_decide(aegis, tmp_path: Path) -> None:
    """1.0204 fails a limit of 1.02, and a failed `1.02` would contradict itself."""
    study = found(("naive", "x"), 5)
    result = study.tasks[0].results[1]
    barred = bar(POLICY_BAR, replace(result, step_time=1.0204))
    study.tasks[0].results[1] = replace(result, step_time=1.0204, bar=barred)
    files.save_json(tmp_path / "table.json", study.to_json())
    page, document = reported(aegis, tmp_path)
    check_figures(page, document)
    place = "/tasks/0/results/1/bar/checks/3/value"
    assert [text for path, _, text in page.figures if path.endswith(place)] == ["1.0204"]


def test_page_and_table_say_what_of_the_bar_was_not_measured(aegis, tmp_path: Path) -> None:
    """For example success, for a robot without a simulator."""
    study = found(("naive", "x"), 5)
    result = replace(study.tasks[0].results[1], seen_gain_points=None)
    barred = bar(POLICY_BAR, result)
    study.tasks[0].results[1] = replace(result, bar=barred)
    files.save_json(tmp_path / "table.json", study.to_json())
    (name,) = (check.name for check in barred.checks if check.value is None)
    said = f"no variant passes the bar, for there is no figure of {name}."
    assert said in reported(aegis, tmp_path)[0].said
    assert f"on reach no variant can pass the bar: no figure of {name}" in " ".join(_notes(study))
    assert "no variant can pass" not in " ".join(_notes(found(("naive", "x"), 5)))


def test_a_study_of_what_is_not_rolled_out_has_its_frontier_and_its_bar(
    aegis, tmp_path: Path
) -> None:
    study = found(("naive", "a", "x"), by_error=True)
    barred = study.tasks[0].results[1].bar
    assert barred is not None
    check = replace(barred.checks[1], value=0.01, interval=(-0.0004, 0.0204), passed=False)
    (task,) = study.tasks
    task.results[1] = replace(
        task.results[1], bar=replace(barred, checks=[barred.checks[0], check, *barred.checks[2:]])
    )
    files.save_json(tmp_path / "table.json", study.to_json())
    page, document = reported(aegis, tmp_path)
    check_figures(page, document)
    assert "open-loop error on held-out episodes" in page.said and "not a success rate" in page.said
    place = "/tasks/0/results/1/bar/checks/1/interval/1"
    # A 0.02 that fails a limit of 0.02 would contradict itself.
    assert [text for path, _, text in page.figures if path.endswith(place)] == ["0.0204"]


def test_a_study_that_still_tunes_has_a_page(aegis, tmp_path: Path) -> None:
    point = PolicyPoint("x", "kfac", 0.1, 0.875, 0.9, 0.5, chosen=True)
    table = replace(found(("naive", "x")), tasks=[], tuning_task="reach", tuning=[point])
    files.save_json(tmp_path / "table.json", table.to_json())
    page, _ = reported(aegis, tmp_path)
    assert "on reach" in page.said and any(tag == "svg" for tag, _ in page.tags)


def test_figures_of_a_stream_are_those_of_json(aegis, tmp_path: Path) -> None:
    finished = Path(__file__).parent.parent / "samples" / "old_runs" / "stream-2e38d13"
    shutil.copytree(finished / "finished", tmp_path / "s")
    page, document = reported(aegis, tmp_path / "s")
    assert document["kind"] == "stream-run"
    rows = document["report"]["oracle"]
    shown = {path: float(value) for path, value, _ in page.figures}
    assert shown == {
        f"/report/oracle/{t}/{i}": share
        for t, row in enumerate(rows)
        for i, share in enumerate(row)
    }


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to open the page in")
def test_chromium_opens_it_without_errors_or_requests(aegis, job: Path, tmp_path: Path) -> None:
    _, document = reported(aegis, job)
    log = tmp_path / "net.json"
    command = [
        *(str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run"),
        *("--disable-background-networking", "--enable-logging=stderr"),
        *("--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={tmp_path / 'profile'}"),
        *(f"--log-net-log={log}", "--dump-dom", (job / "report.html").as_uri()),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0
    assert "CONSOLE" not in done.stderr
    check_figures(Page(done.stdout), document)
    # The browser sends requests of its own to its vendor; none of them comes from the page.
    asked = re.findall(r'"url":"([^"]+)"', log.read_text())
    own = [url for url in asked if not url.startswith(("file:", "data:", "chrome", "devtools"))]
    assert [url for url in own if not re.match(r"https?://[\w.-]*\.?(google|gvt)", url)] == []
