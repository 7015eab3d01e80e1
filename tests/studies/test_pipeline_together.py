"""`aegis run` by two processes gives the results of a single process."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.parallel_runs import Failing, Piping, run_together
from samples.small_run import recipe
from samples.training_runs import TIMES, metrics

from aegis_cli.common import artifacts, files
from aegis_cli.recipes import Probe, Recipe, Rollout, to_yaml
from aegis_cli.studies import pipeline
from aegis_cli.training.train import LEDGER

METHOD = "aegis"
OF_TIME = ("step_s", "step_time_ratio")


@dataclass(frozen=True)
class Told:
    """The output of each job's processes, by their numbers."""

    first: list[dict[str, Any]]
    again: list[dict[str, Any]]
    refused: list[dict[str, Any]]
    failed: list[dict[str, Any]]
    root: Path


@pytest.fixture(scope="module")
def small(tiny_folder: Path) -> Recipe:
    return replace(recipe(tiny_folder, (METHOD,)), rollout=Rollout(episodes=1, colors=("seen",)))


@pytest.fixture(scope="module")
def told(small: Recipe, tmp_path_factory: pytest.TempPathFactory) -> Told:
    """A recipe run by two processes, run again, and then with something that must fail."""
    out = tmp_path_factory.mktemp("together")
    wrong = replace(small, probe=Probe(vqa="questions/typo.jsonl"))
    gated = out / "gated.yaml"
    gated.write_text(to_yaml(replace(small, probe=replace(small.probe, max_drop=0.0))))
    wanted = {"first": small, "again": small, "refused": wrong}
    jobs = {name: Piping(each, out / "runs", out / name) for name, each in wanted.items()}
    failing = Failing(gated, out / "gate", out / "failed")
    run_together(2, [*jobs.values(), failing])
    found = {}
    for name in (*jobs, "failed"):
        found[name] = [files.load_json(out / name / f"{rank}.json") for rank in (0, 1)]
    return Told(**found, root=out / "runs")


@pytest.fixture(scope="module")
def alone(small: Recipe, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same recipe, run by one process."""
    root = tmp_path_factory.mktemp("alone")
    pipeline.run(small, root)
    return root


def assert_near(here: Any, there: Any) -> None:
    """Equal, with numbers equal up to rounding."""
    if isinstance(here, dict):
        assert here.keys() == there.keys()
        for name in here.keys() - set(OF_TIME):
            assert_near(here[name], there[name])
    elif isinstance(here, list):
        assert len(here) == len(there)
        for one, other in zip(here, there, strict=True):
            assert_near(one, other)
    elif isinstance(here, float):
        assert here == pytest.approx(there, rel=1e-4, abs=1e-6)
    else:
        assert here == there


def test_two_processes_find_what_one_finds(told: Told, alone: Path) -> None:
    table = files.load_json(alone / "small" / "table.json")
    for report in told.first:
        assert_near(report["report"]["rows"], table["rows"])
    here, there = told.root / "small" / METHOD, alone / "small" / METHOD
    for one, other in zip(metrics(here, TIMES), metrics(there, TIMES), strict=True):
        assert one == pytest.approx(other, rel=1e-5, abs=1e-7)
    rows, its = (artifacts.load(run / LEDGER, "ledger").tensors for run in (here, there))
    torch.testing.assert_close(rows["aa"], its["aa"], rtol=1e-4, atol=1e-9)
    assert (rows["aa"].sum(1) > 0).all()


def test_the_files_are_those_of_one_process(told: Told, alone: Path) -> None:
    def names(root: Path) -> set[str]:
        return {str(path.relative_to(root)) for path in root.rglob("*")}

    assert names(told.root) == names(alone)


def test_the_first_speaks_and_all_have_the_report(told: Told) -> None:
    first, other = told.first
    assert first["report"] == other["report"]
    assert {"demos", "anchor", f"{METHOD}/train"} <= set(first["events"]) and not other["events"]


def test_a_second_run_does_nothing(told: Told) -> None:
    done = [stage for stage in told.again[0]["events"] if stage not in ("small", METHOD)]
    assert done and all(stage.endswith(" (up to date)") for stage in done)
    assert told.again[1]["report"] == told.again[0]["report"] == told.first[0]["report"]


def test_what_one_process_made_is_up_to_date_for_two(told: Told, small: Recipe) -> None:
    """And the other way round: the records do not contain the number of processes."""
    stages: list[str] = []
    pipeline.run(small, told.root, lambda event: stages.append(event.stage))
    assert all(stage in ("small", METHOD) or "(up to date)" in stage for stage in stages)


def test_what_is_wrong_is_the_same_for_all(told: Told) -> None:
    for end in told.refused:
        kind, found, *_ = end["error"]
        assert kind == "AegisError" and re.search("typo", found)


def test_a_gate_fails_for_all_after_the_first_has_said_so(told: Told) -> None:
    first, other = told.failed
    assert first["code"] == other["code"] == 1
    assert "gate failed: aegis dropped more than probe.max_drop 0 points" in first["printed"]
    assert first["printed"].index("report: ") < first["printed"].index("gate failed")
    assert not other["printed"]


def test_a_study_is_refused(aegis: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    code, _, said = aegis("run", "ablations", "--out", tmp_path)
    assert code == 2 and "--workers N" in said
    assert not any(tmp_path.iterdir())
