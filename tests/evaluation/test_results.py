"""Measurements in a run's folder: kept whole, read back, apart from those of `aegis run`."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from samples.reports import probe, rollout, write_job

from aegis_cli.common import files, locks
from aegis_cli.common.errors import AegisError
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


def test_a_later_one_replaces_it_and_leaves_that_of_aegis_run(run: Path) -> None:
    before = (run / "rollout-seen.json").read_bytes()
    for success in (0.25, 0.5):
        results.keep(run, "rollout-seen", rollout("seen", success), {"episodes": 4})
    assert [r.figures["success"] for r in results.rollouts(run)] == [0.75, 0.5, 0.5]
    assert (run / "rollout-seen.json").read_bytes() == before


def test_one_of_a_checkpoint_is_kept_under_its_step_and_is_no_figure_of_the_run(run: Path) -> None:
    at = run / "checkpoints" / "000006"
    (at / "backbone").mkdir()
    (at / "expert.safetensors").touch()
    path = results.keep(at, "probe-scenes", probe("shape"), {})
    assert path is not None and path.name == "probe-scenes-000006.json"
    assert [result.name for result in results.probes(run)] == ["probe"]


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


def test_two_processes_do_not_write_at_once(run: Path) -> None:
    with locks.alone(run / "results"), pytest.raises(AegisError, match="being written to"):
        results.keep(run, "probe-scenes", probe("shape"), {})


def test_what_chose_a_knob_is_no_result(run: Path) -> None:
    files.save_json(run / "probe-validation.json", probe("shape"))
    assert [result.name for result in results.probes(run)] == ["probe"]


def verdict(*drops: float, max_drop: float | None = None, passed: bool | None = None):
    probes = [Result("probe", {"drop_points": drop, "passed": passed}, {}) for drop in drops]
    return results.gate(probes, max_drop)


def test_a_gate_passes_if_every_probe_does() -> None:
    assert verdict(0.1, 0.2) is None and verdict(max_drop=1.0) is None
    assert verdict(0.1, 0.5, max_drop=0.5) is True
    assert verdict(0.1, 0.6, max_drop=0.5) is False
    assert verdict(0.1, passed=False) is False and verdict(9.0, max_drop=0.5, passed=True) is True
