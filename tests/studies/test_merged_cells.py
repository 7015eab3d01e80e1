"""Cells whose policies are merged between training and measurement."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from samples.small_run import recipe
from samples.training_runs import contents

from aegis_cli import inspection, recipes
from aegis_cli.common import artifacts, files
from aegis_cli.common.events import Progress
from aegis_cli.recipes import Anchor, Merge, Probe, Recipe
from aegis_cli.reporting import compare, gather
from aegis_cli.studies import pipeline, table
from aegis_cli.studies.cells import Cell
from aegis_cli.studies.policy_cells import PolicyRunner, cell_key

Aegis = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def small(tiny_folder: Path) -> Recipe:
    anchor = Anchor(samples=14, batch_size=14, parts=("moments", "inputs", "curvature"))
    return replace(recipe(tiny_folder, ("naive",), backbone_lr=1e-2), anchor=anchor)


def test_a_merge_is_part_of_a_cells_key_and_none_is_not(small: Recipe) -> None:
    def key(merge: Merge) -> str:
        return cell_key(Cell("a", replace(small, merge=merge)), "0" * 64)

    plain = key(Merge())
    assert key(Merge(strength=3.0)) == plain  # without a method it has no effect
    others = [Merge("linear", 0.5), Merge("linear", 0.6), Merge("factors"), Merge("factors", 3.0)]
    keys = {key(merge) for merge in others}
    assert len(keys) == len(others) and plain not in keys


@pytest.mark.parametrize("merge", [Merge("linear", 1.0), Merge("factors", 10.0, frames=20)])
def test_the_merged_policy_is_measured_and_a_second_run_does_nothing(
    merge: Merge, small: Recipe, tmp_path: Path
) -> None:
    merging = replace(small, merge=merge)
    table = pipeline.run(merging, tmp_path)
    folder = tmp_path / "small" / "naive"
    (row,) = table.rows
    said = json.loads((folder / "merged" / "merge.json").read_text())
    assert row.validation_loss == said["validation_loss"]
    assert row.validation_loss != json.loads((folder / "train.json").read_text())["validation_loss"]
    if merge.method == "linear":  # all the way back
        assert row.accuracy == row.baseline_accuracy
    events: list[Progress] = []
    before = contents(tmp_path / "small")
    pipeline.run(merging, tmp_path, on_event=events.append)
    assert contents(tmp_path / "small") == before
    stages = {event.stage for event in events}
    assert "naive/merge (up to date)" in stages and "naive/train" not in stages


@pytest.fixture(scope="module")
def job(small: Recipe, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A job with one method, merged half-way back."""
    folder = tmp_path_factory.mktemp("merged")
    pipeline.run(replace(small, merge=Merge("linear", 0.5)), folder)
    return folder / "small"


def test_the_figures_lie_in_the_run_whose_weights_they_are_of(job: Path) -> None:
    row = table.load(job).rows[0]
    trained, merged = inspection.run(job / "naive"), inspection.run(job / "naive/merged")
    assert (trained.method, merged.method) == ("naive", "naive, merged")
    assert not trained.probes and not trained.rollouts and trained.gate is None
    assert trained.facts["merged_into"] == str(job / "naive/merged")
    assert trained.validation_loss == files.load_json(job / "naive/train.json")["validation_loss"]
    assert merged.validation_loss == merged.facts["merge"]["validation_loss"] == row.validation_loss
    assert merged.probes[0].figures["accuracy"] == row.accuracy
    assert [one.figures["success"] for one in merged.rollouts] == [
        row.success_seen,
        row.success_held_out,
    ]
    told = artifacts.read_header(job / "naive/merged/checkpoints/last/expert.safetensors").meta
    assert told["merge"]["validation_loss"] == row.validation_loss


def test_a_job_stands_for_what_was_merged(job: Path, aegis: Aegis) -> None:
    row = table.load(job).rows[0]
    (compared,) = compare.run([job]).rows
    assert (compared.run, compared.method) == (str(job / "naive/merged"), "naive, merged")
    assert compared.accuracy == row.accuracy and compared.validation_loss == row.validation_loss
    film = job / "naive/merged/reach.mp4"
    film.write_bytes(b"film")
    assert [video.name for video in gather.run(job).videos] == ["naive/merged/reach.mp4"]
    film.unlink()
    (told,) = gather.run(job).runs
    assert (told.label, told.path) == ("naive, merged", str(job / "naive/merged"))
    assert told.train["step_s"] == row.step_s and told.anchor is not None
    assert any(str(job / "demos.safetensors") in command for command in told.commands)
    shown = " ".join(aegis("inspect", job)[1].split())
    assert "naive, merged" in shown and "merged by linear, strength 0.5" in shown
    assert aegis("report", job)[0] == 0


def test_a_run_that_was_merged_says_so_to_those_who_take_its_weights(
    job: Path, aegis: Aegis, tmp_path: Path
) -> None:
    trained, merged = job / "naive", job / "naive/merged"
    said = f"what was merged and measured is in '{merged}'"
    commands = [
        ("compare", trained),
        ("export", trained, "--out", tmp_path / "before"),
        ("push", trained, "me/naive", "--dry-run"),
    ]
    for words in commands:
        code, _, err = aegis(*words)
        assert code == 0 and said in " ".join(err.split()), words
    code, _, err = aegis("export", merged, "--out", tmp_path / "after")
    assert code == 0 and said not in err
    assert "Not measured" in (tmp_path / "before" / "README.md").read_text()
    assert "Not measured" not in (tmp_path / "after" / "README.md").read_text()
    assert "not measured: its weights were merged" in " ".join(aegis("inspect", trained)[1].split())


def as_earlier(job: Path) -> None:
    """Write a job like an earlier version, whose merged checkpoints had no loss."""
    merged = job / "naive" / "merged"
    for name in ("merge.json", "probe.json", "rollout-seen.json", "rollout-held-out.json"):
        (merged / name).rename(job / "naive" / name)
    path = job / "table.json"
    files.save_json(path, {k: v for k, v in files.load_json(path).items() if k != "merge"})
    expert = merged / "checkpoints/last/expert.safetensors"
    saved = artifacts.load(expert)
    header = saved.header
    header.meta["merge"]["validation_loss"] = None
    artifacts.save(
        expert,
        header.kind,
        {name: tensor.clone() for name, tensor in saved.tensors.items()},
        seed=header.seed,
        inputs=header.inputs,
        fingerprint=header.fingerprint,
        meta=header.meta,
    )


def test_the_job_of_an_earlier_version_is_read_as_what_it_is(
    job: Path, small: Recipe, tmp_path: Path
) -> None:
    now = compare.run([job]).rows
    copied = tmp_path / "small"
    shutil.copytree(job, copied, symlinks=True)
    as_earlier(copied)
    (row,) = compare.run([copied]).rows
    assert replace(row, run="") == replace(now[0], run="")
    assert not inspection.run(copied / "naive").probes
    pipeline.run(replace(small, merge=Merge("linear", 0.5)), tmp_path)
    assert not (copied / "naive/merge.json").exists()
    assert (copied / "naive/merged/probe.json").exists()
    assert not list((copied / "naive").glob("probe*"))


def test_another_training_takes_the_place_of_one_that_was_merged(
    job: Path, small: Recipe, tmp_path: Path
) -> None:
    shutil.copytree(job, tmp_path / "small", symlinks=True)
    longer = replace(small, train=replace(small.train, steps=3), merge=Merge("linear", 0.5))
    pipeline.run(longer, tmp_path)
    assert (tmp_path / "small/naive/merged/probe.json").exists()
    assert not list((tmp_path / "small").glob("naive.*"))  # nothing in it was somebody else's


def test_another_strength_merges_anew_and_does_not_train(small: Recipe, tmp_path: Path) -> None:
    pipeline.run(replace(small, merge=Merge("linear", 0.3)), tmp_path)
    events: list[Progress] = []
    again = replace(small, merge=Merge("linear", 1.0))
    (row,) = pipeline.run(again, tmp_path, on_event=events.append).rows
    assert row.accuracy == row.baseline_accuracy
    assert "naive/train (up to date)" in {event.stage for event in events}


def test_the_merge_and_the_gate_of_now_stand_in_the_recipes_of_both_runs(
    job: Path, small: Recipe, tmp_path: Path
) -> None:
    shutil.copytree(job, tmp_path / "small", symlinks=True)
    asks = replace(small, merge=Merge("linear", 0.5), probe=Probe(questions=14, max_drop=90.0))
    for merge in (asks.merge, Merge("linear", 1.0)):
        events: list[Progress] = []
        now = replace(asks, merge=merge)
        pipeline.run(now, tmp_path, on_event=events.append)
        assert "naive/train (up to date)" in {event.stage for event in events}
        for run in ("naive", "naive/merged"):
            assert recipes.load(tmp_path / "small" / run / "recipe.yaml") == now
        assert inspection.run(tmp_path / "small/naive/merged").gate is True


def test_where_the_job_no_longer_merges_nobody_is_sent_to_the_merged_run(
    job: Path, small: Recipe, tmp_path: Path, aegis: Aegis
) -> None:
    shutil.copytree(job, tmp_path / "small", symlinks=True)
    pipeline.run(small, tmp_path)
    trained = tmp_path / "small/naive"
    assert table.runs(table.load(tmp_path / "small")) == [trained]
    found = inspection.run(trained)
    assert found.probes and "merged_into" not in found.facts
    code, _, err = aegis("export", trained, "--out", tmp_path / "out")
    assert code == 0 and "merge" not in err
    assert "merge" not in aegis("compare", trained, trained / "merged")[2].replace("merged,", "")


def test_nothing_large_is_left_of_a_measured_cell(small: Recipe, tmp_path: Path) -> None:
    runner = PolicyRunner(tmp_path, lambda _: None)
    runner.figures("a", replace(small, merge=Merge("linear", 0.5)))
    assert (tmp_path / "a" / "merged" / "checkpoints").is_dir()
    runner.clear("a")
    assert not list(tmp_path.rglob("checkpoints"))
