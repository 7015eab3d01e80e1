"""Question sets in files, through the commands: anchors, probes with predictions, recipes."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from samples.small_run import recipe
from samples.vqa_files import row, write_jsonl, write_official

from aegis_cli.anchors import measure
from aegis_cli.cli import question_sets
from aegis_cli.common import artifacts, files
from aegis_cli.common.errors import AegisError
from aegis_cli.data.vqa import sets
from aegis_cli.data.vqa.metrics import bootstrap_interval
from aegis_cli.evaluation import probe, results
from aegis_cli.recipes import ANCHOR_PARTS, Anchor, Probe, Rollout
from aegis_cli.studies import pipeline, policy_cells

IMAGES = 24


@pytest.fixture(scope="module")
def lines(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_jsonl(tmp_path_factory.mktemp("lines"), IMAGES)


def test_a_probe_and_what_it_writes(aegis, lines: Path, tiny_folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "said.jsonl"
    code, text, _ = aegis(
        "probe",
        tiny_folder,
        "--vqa",
        lines,
        "--baseline",
        tiny_folder,
        "--predictions",
        out,
        "--json",
    )
    report, said = json.loads(text), [json.loads(line) for line in out.read_text().splitlines()]
    assert code == 0 and report["questions"] == len(said) == len(
        sets.read(str(lines)).choose("probe", 5000, 0).questions
    )
    assert report["accuracy"] == sum(s["correct"] for s in said) / len(said)
    assert report["soft_accuracy"] == pytest.approx(
        sum(s["soft_accuracy"] for s in said) / len(said)
    )
    assert report["cross_entropy"] == pytest.approx(
        sum(s["cross_entropy"] for s in said) / len(said)
    )
    low, high = report["drop_interval"]
    assert (
        report["baseline_soft_accuracy"] == report["soft_accuracy"]
        and low == -high < 0 == report["drop_points"]
    )
    images = [(int(s["id"].removeprefix("line ")) - 1) // 2 for s in said]
    soft = [s["soft_accuracy"] for s in said]
    assert (
        report["soft_interval"] == list(bootstrap_interval(soft, images))
        and report["interval"][0] <= report["accuracy"] <= report["interval"][1]
        and report["skipped"] == 0
    )
    assert all(
        set(s)
        == {
            "id",
            "question",
            "said",
            "reference",
            "answers",
            "correct",
            "soft_accuracy",
            "cross_entropy",
        }
        for s in said
    )


def test_what_a_probe_of_scenes_says_is_as_it_was(aegis, tiny_folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "said.jsonl"
    code, text, _ = aegis("probe", tiny_folder, "--questions", 14, "--predictions", out)
    said = [json.loads(line) for line in out.read_text().splitlines()]
    assert code == 0 and "soft" not in text and [s["id"] for s in said] == list(range(14))
    assert {s["soft_accuracy"] for s in said} == {None} and all(
        s["answers"] == [s["reference"]] for s in said
    )
    assert all(s["correct"] == (s["said"] == s["reference"]) for s in said)


def test_a_table_names_the_soft_accuracy_and_its_interval(
    aegis, tmp_path: Path, tiny_folder: Path
) -> None:
    code, text, _ = aegis("probe", tiny_folder, "--vqa", write_official(tmp_path))
    shown = {" ".join(line.split()[:2]): line for line in text.splitlines()}
    assert (
        code == 0
        and shown["soft accuracy"].rstrip().endswith("%")
        and " to " in shown["soft interval"]
        and "%" in shown["soft interval"]
    )
    assert any(
        line.split()[:1] == ["number"] for line in text.splitlines()
    )  # the official answer types are families


def test_predictions_do_not_replace_the_questions(
    lines: Path, tiny_folder: Path, tmp_path: Path
) -> None:
    before, model = lines.read_bytes(), str(tiny_folder)
    with pytest.raises(AegisError, match="which this command also reads"):
        probe.run(
            model,
            str(lines),
            10,
            None,
            None,
            None,
            predictions=lines.parent / "images" / ".." / lines.name,
        )
    with pytest.raises(AegisError, match="which this command also reads"):
        probe.run(
            model, str(lines), 10, None, tmp_path / "anchor", None, predictions=tmp_path / "anchor"
        )
    with pytest.raises(AegisError, match="which this command also reads"):
        probe.run(
            "embedded",
            str(lines),
            10,
            model,
            None,
            None,
            predictions=tiny_folder / "model.safetensors",
        )
    with pytest.raises(AegisError, match="no folder"):
        probe.run(
            "nothing", str(lines), 10, None, None, None, predictions=tmp_path / "no" / "said.jsonl"
        )
    assert lines.read_bytes() == before


def test_an_anchor_replaces_nothing_that_it_is_measured_with(
    lines: Path, tiny_folder: Path, tmp_path: Path
) -> None:
    model = Path(shutil.copy(tiny_folder / "model.safetensors", tmp_path))
    before = model.read_bytes(), lines.read_bytes()
    for out in (lines, model):
        with pytest.raises(AegisError, match="--out .*, which this command also reads"):
            measure.run(str(model), Anchor(vqa=str(lines), samples=10, parts=("moments",)), out)
    assert (model.read_bytes(), lines.read_bytes()) == before


def test_an_anchor_of_files_is_a_function_of_their_content(
    lines: Path, tiny_folder: Path, tmp_path: Path
) -> None:
    shutil.copytree(lines.parent, tmp_path / "moved")
    settings = Anchor(vqa=str(lines), samples=10, parts=ANCHOR_PARTS, fisher_samples=4)
    report = measure.run(str(tiny_folder), settings, tmp_path / "a.safetensors")
    moved = measure.run(
        str(tiny_folder),
        replace(settings, vqa=str(tmp_path / "moved" / lines.name)),
        tmp_path / "b.safetensors",
    )
    assert report.sha256 == moved.sha256 and (report.samples, report.skipped) == (10, 0)
    header = artifacts.read_header(tmp_path / "a.safetensors")
    assert header.inputs == {"vqa/set.jsonl": files.sha256_file(lines)}
    assert (header.meta["vqa"], header.meta["samples"]) == ("set.jsonl", 10)
    few = measure.run(
        str(tiny_folder),
        replace(settings, samples=3000, parts=("moments",)),
        tmp_path / "c.safetensors",
    )
    assert (
        few.samples == len(sets.read(str(lines)).choose("anchor", 3000, 0).questions) < 2 * IMAGES
    )
    drift = probe.run(str(tiny_folder), str(lines), 1000, None, tmp_path / "c.safetensors", None)
    assert min(layer.w2 for layer in drift.layers) > 0  # measured on other images


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Which stages ran."""
    count: Counter[str] = Counter()

    def counted(name: str, module: object) -> None:
        original = module.run

        def run(*args: object, **kwargs: object) -> object:
            count[name] += 1
            return original(*args, **kwargs)

        monkeypatch.setattr(module, "run", run)

    stages = {"anchor": "measure", "train": "train", "rollout": "rollout"}
    for name, module in stages.items():
        counted(name, getattr(policy_cells, module))
    asked = probe.ask
    monkeypatch.setattr(
        probe, "ask", lambda *args, **kwargs: count.update(["ask"]) or asked(*args, **kwargs)
    )
    return count


def test_a_recipe_with_sets_of_its_own(
    lines: Path, tiny_folder: Path, tmp_path: Path, made: Counter[str]
) -> None:
    """In `aegis run` the anchor and the probe share a file but no image.

    Whatever has changed is measured again.
    """
    place = tmp_path / "place"
    shutil.copytree(lines.parent, place)
    path = place / lines.name
    small = replace(
        recipe(tiny_folder, methods=("naive",)),
        anchor=Anchor(vqa=str(path), samples=14, parts=("moments",)),
        probe=Probe(vqa=str(path), questions=14, skip_bad=True),
        rollout=Rollout(episodes=1, colors=("seen",)),
    )
    first = pipeline.run(small, tmp_path / "runs")
    assert made == {"anchor": 1, "train": 1, "ask": 2, "rollout": 1} and first.rows[0].w2 > 0
    report = files.load_json(tmp_path / "runs" / "small" / "naive" / "probe.json")
    assert (report["questions"], report["skipped"]) == (14, 0) and report[
        "soft_accuracy"
    ] is not None
    made.clear()
    pipeline.run(small, tmp_path / "runs")
    assert not made
    path.write_text(path.read_text() + json.dumps(row("images/0.png", id="more")) + "\n")
    pipeline.run(small, tmp_path / "runs")
    assert made == {
        "anchor": 1,
        "train": 1,
        "ask": 2,
        "rollout": 1,
    }  # everything that identifies the set's content
    made.clear()
    (place / "images" / "0.png").touch()  # its time does not matter
    pipeline.run(small, tmp_path / "runs")
    assert not made
    shutil.copy(place / "images" / "1.png", place / "images" / "0.png")
    pipeline.run(small, tmp_path / "runs")
    assert made["anchor"] == 1 and made["ask"] == 2  # another image: measured again


def test_a_bad_set_stops_a_recipe_before_anything_is_made(
    tiny_folder: Path, tmp_path: Path, made: Counter[str]
) -> None:
    small = replace(recipe(tiny_folder), probe=Probe(vqa=str(tmp_path / "nothing.jsonl")))
    with pytest.raises(AegisError, match="nothing.jsonl', which does not exist"):
        pipeline.run(small, tmp_path / "runs")
    assert not made and not (tmp_path / "runs").exists()


def test_a_set_that_a_shell_would_split_is_quoted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    of_run = replace(recipe("x"), probe=Probe(vqa=("one.jsonl", "my set.jsonl")))
    monkeypatch.setattr(results, "run_of", lambda path: path)
    monkeypatch.setattr(results, "recipe_of", lambda run: of_run)
    assert question_sets.chosen(str(tmp_path), None, None, False, None).vqa == "one.jsonl"
    said = " ".join(capsys.readouterr().err.split())
    assert "asking the questions of 'one.jsonl'" in said and "--vqa 'my set.jsonl'" in said
