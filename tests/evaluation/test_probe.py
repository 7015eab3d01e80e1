"""The probe: what a VLM loses is reported as a drop, as drift and as an exit code."""

from __future__ import annotations

import io
import itertools
import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console
from samples.command import refused
from samples.small_run import recipe, teach
from samples.tiny import make_tiny
from samples.vqa_files import write_jsonl

from aegis_cli.anchors import measure
from aegis_cli.anchors import moments as anchor_moments
from aegis_cli.cli.render import tables
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Warned
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.moments import empty, merge
from aegis_cli.data.vqa.dataset import load_scenes
from aegis_cli.data.vqa.gate import MEAN, UPPER
from aegis_cli.data.vqa.metrics import Graded, wilson_interval
from aegis_cli.data.vqa.questions import FAMILIES, Question
from aegis_cli.evaluation import probe, results
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.backbones.embedded import EmbeddedVLM
from aegis_cli.recipes import Anchor as Settings
from aegis_cli.recipes import Recipe
from aegis_cli.training import train

QUESTIONS = 42


@pytest.fixture(scope="module")
def taught(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A VLM that knows most answers of the probe set."""
    folder = tmp_path_factory.mktemp("taught")
    teach(make_tiny(), load_scenes("probe", QUESTIONS, probe.PROBE_SEED), steps=60).save(folder)
    return folder


@pytest.fixture(scope="module")
def broken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same VLM with new random weights: everything is forgotten."""
    folder = tmp_path_factory.mktemp("broken")
    make_tiny(seed=1).save(folder)
    return folder


@pytest.fixture(scope="module")
def own_anchor(taught: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("anchor") / "anchor.safetensors"
    measure.run(str(taught), Settings(samples=140, parts=("moments",)), path)
    return path


def asked_of(
    target: Path,
    baseline: Path | None = None,
    moments: Path | None = None,
    max_drop: float | None = None,
) -> probe.ProbeReport:
    return probe.run(
        str(target),
        "scenes",
        QUESTIONS,
        None if baseline is None else str(baseline),
        moments,
        max_drop,
    )


def test_a_backbone_against_itself_drops_nothing(taught: Path, own_anchor: Path) -> None:
    report = asked_of(taught, taught, own_anchor, 0.0)
    bound = (
        100 * wilson_interval(0, report.questions)[1]
    )  # this few questions cannot show that it is the same
    assert (report.drop_points, report.passed) == (
        0,
        True,
    ) and report.drop_interval == pytest.approx((-bound, bound))
    assert 0.6 < report.accuracy == report.baseline_accuracy < 1
    assert report.cross_entropy == report.baseline_cross_entropy
    assert report.questions == QUESTIONS
    low, high = wilson_interval(round(report.accuracy * QUESTIONS), QUESTIONS)
    assert report.interval[0] <= low < high <= report.interval[1]  # images have several questions


def test_families_add_up(taught: Path) -> None:
    report = asked_of(taught, taught)
    assert (
        set(report.families) == set(FAMILIES)
        and sum(f.questions for f in report.families.values()) == QUESTIONS
    )
    assert sum(
        f.accuracy * f.questions for f in report.families.values()
    ) / QUESTIONS == pytest.approx(report.accuracy)
    assert all(
        f.interval[0] <= f.accuracy <= f.interval[1] and f.baseline_accuracy == f.accuracy
        for f in report.families.values()
    )
    assert sum(
        f.majority * f.questions for f in report.families.values()
    ) / QUESTIONS == pytest.approx(report.majority)


def test_a_broken_model_drops_and_drifts(taught: Path, broken: Path, own_anchor: Path) -> None:
    itself, lost = asked_of(taught, taught, own_anchor), asked_of(broken, taught, own_anchor, 50.0)
    assert (
        lost.drop_points == pytest.approx(100 * (itself.accuracy - lost.accuracy))
        and lost.drop_points > 50
    )
    low, high = lost.drop_interval
    assert low < lost.drop_points < high
    assert lost.passed is False and lost.cross_entropy > 2 * itself.cross_entropy
    assert (
        lost.baseline_accuracy == itself.accuracy
        and lost.baseline_cross_entropy == itself.cross_entropy
    )
    assert [x.layer for x in lost.layers] == ["layers.0", "layers.1"]
    for near, far in zip(itself.layers, lost.layers, strict=True):
        # Other scenes are close, another model is far away.
        assert 0 <= near.w2 < far.w2 / 3
        assert near.baseline_w2 == far.baseline_w2 == near.w2


def test_w2_against_the_very_same_questions_is_zero(tiny: EmbeddedVLM) -> None:
    asked = load_scenes("probe", QUESTIONS)
    image, text = anchor_moments.measure(tiny, asked.batches(8), QUESTIONS)
    assert [x.w2 for x in probe.drift(tiny, asked, Anchor(image, text), 64)] == pytest.approx(
        [0, 0], abs=1e-9
    )
    both = [merge(i, t) for i, t in zip(image, text, strict=True)]
    moved = [
        replace(m, mean=m.mean + 2, var=(m.var.sqrt() + 1) ** 2) for m in both
    ]  # W2^2 = 32 (2^2 + 1^2)
    nothing = [empty(len(m.mean)) for m in both]
    assert [x.w2 for x in probe.drift(tiny, asked, Anchor(moved, nothing), 64)] == pytest.approx(
        [160, 160]
    )


def test_an_anchor_of_prompts_without_images_is_compared_with_text_tokens_alone(
    tiny: EmbeddedVLM,
) -> None:
    asked = load_scenes("probe", QUESTIONS)
    _, text = anchor_moments.measure(tiny, asked.batches(8), QUESTIONS)
    nothing = [empty(len(m.mean)) for m in text]
    found = probe.drift(tiny, asked, Anchor(nothing, text), 64)
    assert [x.w2 for x in found] == pytest.approx([0, 0], abs=1e-9)


def test_an_anchor_without_moments_is_refused_before_any_question(
    taught: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(probe.anchor_file, "load", lambda *_: Anchor())
    monkeypatch.setattr(probe, "ask", lambda *_: pytest.fail("a question was asked"))
    with pytest.raises(AegisError, match="without moments"):
        asked_of(taught, moments=Path("an.anchor"))


def test_w2_grows_with_the_perturbation_and_at_the_perturbed_layer(
    taught: Path, own_anchor: Path, tmp_path: Path
) -> None:
    from aegis_cli.models.backbones import load

    def drift(size: float) -> list[float]:
        model = load(str(taught))
        with torch.no_grad():
            model.layers[1].out.weight.add_(
                size * torch.randn(model.layers[1].out.weight.shape, generator=torch.manual_seed(0))
            )
        model.save(tmp_path / str(size))
        return [x.w2 for x in asked_of(tmp_path / str(size), taught, own_anchor).layers]

    still, a_little, much = drift(0.0), drift(0.2), drift(1.0)
    assert still[0] == a_little[0] == much[0]  # the first layer runs before the change
    assert still[1] < a_little[1] < much[1]


def test_a_drift_between_two_sets_of_questions_says_so(
    taught: Path, own_anchor: Path, demos_file: Path, tmp_path: Path
) -> None:
    assert probe.two_sets(own_anchor, "scenes") is None
    assert probe.two_sets(own_anchor, "mine.jsonl") == "scenes and mine.jsonl"
    frames = tmp_path / "frames.safetensors"
    measure.run(
        str(taught),
        Settings(samples=20, source="demos", parts=("moments",)),
        frames,
        demos=demos_file,
    )
    assert probe.two_sets(frames, "scenes") == "robot frames of reach.safetensors and scenes"
    assert asked_of(taught, taught, frames).w2_between == probe.two_sets(frames, "scenes")
    report = asked_of(taught, taught, own_anchor)
    assert report.w2_between is None
    shown = io.StringIO()
    for between in (None, "scenes and mine.jsonl"):
        Console(file=shown, width=200).print(tables.probe(replace(report, w2_between=between)))
    assert (
        shown.getvalue().count("scenes and mine.jsonl") == shown.getvalue().count("w2 between") == 1
    )


def test_models_alone_are_compared_without_a_digest_of_their_weights(
    taught: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For billions of weights it takes as long as many answers."""
    monkeypatch.delattr(Backbone, "fingerprint")
    assert asked_of(taught, taught).drop_points == 0


def test_without_baseline_and_anchor_there_is_no_drop_and_no_drift(taught: Path) -> None:
    report = asked_of(taught)
    assert (report.drop_points, report.drop_interval, report.baseline_accuracy, report.passed) == (
        None,
    ) * 4
    assert report.layers == [] and all(
        f.baseline_accuracy is None for f in report.families.values()
    )


def test_the_anchor_is_the_baselines(taught: Path, broken: Path, own_anchor: Path) -> None:
    assert asked_of(broken, taught, own_anchor).layers  # the model under test need not own it
    with pytest.raises(AegisError, match="are not those of") as caught:
        asked_of(taught, broken, own_anchor)
    # The names that the user gave, and a command for each way on.
    assert f"'{taught}', whose weights are not those of '{broken}'" in caught.value.found
    assert f"--baseline {taught}" in caught.value.fix
    assert f"aegis anchor --backbone {broken} --vqa=scenes" in caught.value.fix
    with pytest.raises(AegisError, match="are not those of") as caught:
        asked_of(broken, moments=own_anchor)
    assert caught.value.fix.endswith(f"--baseline {taught}")


def test_batch_size_does_not_show(taught: Path) -> None:
    reports = [
        probe.run(str(taught), "scenes", QUESTIONS, None, None, None, batch_size=size)
        for size in (5, 64)
    ]
    assert reports[0].accuracy == reports[1].accuracy
    assert reports[0].cross_entropy == pytest.approx(reports[1].cross_entropy, rel=1e-5)


def graded(correct: str) -> list[Graded]:
    return [
        Graded(Question("color", str(i), "red"), "red", c == "1", 1.0, image=i)
        for i, c in enumerate(correct)
    ]


def test_the_drops_interval_is_of_paired_differences() -> None:
    """By hand: one of ten lost and none won.

    With one question per image, all ten images count: Wilson's intervals are 0.0179 to 0.4042 and
    0 to 0.2775.
    """
    report = probe.compare(graded("0111111100"), graded("1111111100"), [], None)
    assert report.drop_points == pytest.approx(10)
    low, high = wilson_interval(1, 10)
    none = wilson_interval(0, 10)[1]
    expected = 10 - 100 * math.hypot(0.1 - low, none), 100 * high
    assert report.drop_interval == pytest.approx(expected)
    assert high == pytest.approx(0.4042, abs=1e-4)
    # the same accuracies, but other questions: one lost, none won, against two lost and one won
    swapped = probe.compare(graded("0011111110"), graded("1111111100"), [], None)
    assert swapped.drop_points == pytest.approx(10)
    assert swapped.drop_interval[1] > report.drop_interval[1]


@pytest.mark.parametrize(("max_drop", "passed"), [(None, None), (9.9, False), (10.1, True)])
def test_the_gate(max_drop: float | None, passed: bool | None) -> None:
    report = probe.compare(graded("0111111111"), graded("1111111111"), [], max_drop)
    assert report.passed is passed
    with pytest.raises(AegisError, match="--baseline"):
        probe.compare(graded("01"), None, [], 5.0)


@pytest.mark.parametrize(("max_drop", "passed"), [(40.4, False), (40.5, True)])
def test_a_gate_on_the_upper_end_limits_that_of_the_interval(max_drop: float, passed: bool) -> None:
    """One of ten is lost: the drop is 10 points, and the interval ends at 40.42."""
    before, after = graded("1111111100"), graded("0111111100")
    report = probe.compare(after, before, [], max_drop, gate=UPPER)
    assert report.passed is passed
    assert probe.compare(after, before, [], max_drop, gate=MEAN).passed is True


@pytest.mark.parametrize(("lost", "passed"), [(20, True), (21, False)])
def test_a_drop_exactly_on_the_gates_border_passes(lost: int, passed: bool) -> None:
    """20 of 2000 are 1 point, whatever floating point says."""
    report = probe.compare(graded("0" * lost + "1" * (2000 - lost)), graded("1" * 2000), [], 1.0)
    assert report.drop_points > 1.0 and report.passed is passed


@pytest.mark.parametrize("gate", [MEAN, UPPER])
@pytest.mark.parametrize(
    ("before", "after", "max_drop", "warns"),
    [
        ("11", "11", 1.0, True),
        ("1" * 2000, "1" * 2000, 1.0, False),
        ("1" * 40, "1" * 40, 5.0, True),
        ("1" * 40, "1" * 40, 20.0, False),
        ("1" * 40, "0" * 40, 5.0, False),  # far past the gate
        ("1" * 40, "1" * 40, 0.0, False),  # no number of questions would suffice
        ("1" * 40, "1" * 40, None, False),
    ],
)
def test_a_gate_that_the_questions_cannot_tell_is_warned_of(
    before: str, after: str, max_drop: float | None, warns: bool, gate: str
) -> None:
    report = probe.compare(graded(after), graded(before), [], max_drop, gate=gate)
    seen: list[Event] = []
    probe.warn_of_few_questions(
        report.questions, report.drop_interval, max_drop, "probe", seen.append
    )
    assert bool(seen) is warns
    if seen:
        (warned,) = seen
        assert isinstance(warned, Warned) and f"{len(before)} questions" in warned.text


def test_a_gate_of_two_questions_is_warned_of(taught: Path) -> None:
    seen: list[Event] = []
    probe.run(str(taught), "scenes", 2, str(taught), None, 1.0, on_event=seen.append)
    said = [event.text for event in seen if isinstance(event, Warned)]
    assert any("2 questions measure the drop to ±65.76 points" in text for text in said)


def test_a_gain_passes_any_gate() -> None:
    report = probe.compare(graded("11"), graded("01"), [], 0.0)
    assert report.drop_points == -50 and report.passed is True


# --- through the command line --------------------------------------------------------------------


def test_a_run_is_compared_with_the_model_it_began_from(
    aegis, naive_run: Path, anchor_file: Path, recipe: Recipe, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    shutil.copytree(naive_run, run, symlinks=True)  # since measurements are kept in it
    asked = ("--questions", 30, "--json")
    named = ("--baseline", recipe.backbone)
    ways = [("--max-drop", 100), ("--anchor", anchor_file), named, ()]
    found = []
    for way in ways:
        code, out, err = aegis("probe", run / "checkpoints/last", *way, *asked)
        assert code == 0 and (f"the baseline is '{recipe.backbone}'" in err) == (way is not named)
        found.append(json.loads(out))
    for report in found:
        assert report["baseline_accuracy"] == found[2]["baseline_accuracy"] is not None
    assert found[1]["layers"][0]["baseline_w2"] is not None
    code, out, err = aegis("probe", run, "--baseline", "none", *asked)
    alone = json.loads(out)
    assert code == 0 and alone["baseline_accuracy"] is None and "baseline" not in err
    assert alone["accuracy"] == found[0]["accuracy"] and alone["asked"]["baseline"] is None


def test_a_run_whose_model_is_gone_or_another_now_is_measured_alone(
    aegis, taught: Path, broken: Path, demos_file: Path, tmp_path: Path
) -> None:
    vlm, run = tmp_path / "vlm", tmp_path / "run"
    shutil.copytree(taught, vlm)
    train.run(recipe(vlm), "naive", demos_file, None, run)
    given = ("probe", run, "--questions", 30, "--json")
    assert json.loads(aegis(*given)[1])["drop_points"] is not None
    shutil.rmtree(vlm)
    shutil.copytree(broken, vlm)
    code, out, err = aegis(*given)
    assert code == 0 and json.loads(out)["drop_points"] is None
    assert f"'{vlm}' is no longer the model that '{run}' began from" in err
    code, out, _ = aegis(*given, "--max-drop", 100)  # a gate needs a drop
    assert code == 0 and json.loads(out)["drop_points"] is not None
    shutil.rmtree(vlm)
    code, out, err = aegis(*given)
    assert code == 0 and json.loads(out)["drop_points"] is None
    assert f"only the accuracy is measured, and no drop: '{vlm}'" in err
    assert aegis(*given, "--max-drop", 100)[0] == 2


def test_without_a_baseline_the_gate_of_the_recipe_is_left_out(
    aegis, taught: Path, demos_file: Path, tmp_path: Path
) -> None:
    settings, run = recipe(taught), tmp_path / "run"
    settings = replace(settings, probe=replace(settings.probe, max_drop=0.0))
    train.run(settings, "naive", demos_file, None, run)
    given = ("probe", run, "--questions", 30, "--baseline", "none", "--json")
    code, out, _ = aegis(*given)
    assert code == 0 and json.loads(out)["passed"] is None
    assert "--max-drop without a baseline" in refused(aegis(*given, "--max-drop", 1))


def test_json_and_exit_codes(aegis, taught: Path, broken: Path, own_anchor: Path) -> None:
    given = (
        "--baseline",
        taught,
        "--anchor",
        own_anchor,
        "--questions",
        QUESTIONS,
        "--max-drop",
        "0.5",
        "--json",
    )
    code, out, _ = aegis("probe", taught, *given)
    assert code == 0
    code, out, err = aegis("probe", broken, *given)
    assert code == 1 and "gate failed: a drop of" in err and "Traceback" not in err
    report = json.loads(out)
    assert {"accuracy", "cross_entropy", "drop_points", "families", "layers", "questions"} <= set(
        report
    )
    assert (
        report["passed"] is False
        and report["drop_points"] > 50
        and report["questions"] == QUESTIONS
    )
    assert [set(layer) for layer in report["layers"]] == 2 * [
        {"layer", "w2", "baseline_w2"}
    ] and report["layers"][0]["w2"] > 0
    assert (
        set(report["families"]) == set(FAMILIES)
        and len(report["families"]["where"]["interval"]) == 2
    )


def test_a_run_folder_is_probed_at_its_last_checkpoint(
    taught: Path, own_anchor: Path, demos_file: Path, tmp_path: Path
) -> None:
    from aegis_cli.models.backbones import load

    run = tmp_path / "run"
    train.run(recipe(taught, backbone_lr=0.1), "naive", demos_file, None, run)
    report = asked_of(run, taught, own_anchor)
    assert report.drop_points > 0 and report.layers[0].w2 > 0
    last = run / "checkpoints" / "last"
    assert last.resolve().name == "000004"
    assert (
        report
        == asked_of(last, taught, own_anchor)
        == asked_of(last / "backbone", taught, own_anchor)
        == asked_of(last / "backbone" / "model.safetensors", taught, own_anchor)
    )
    assert isinstance(load(str(run)), EmbeddedVLM)
    earlier = last.with_name("000002")
    assert (
        report
        != asked_of(earlier, taught, own_anchor)
        == asked_of(earlier / "backbone", taught, own_anchor)
    )


def test_a_model_that_knows_less_than_the_commonest_answers_is_told(
    aegis, taught: Path, broken: Path
) -> None:
    said = {}
    for model in (taught, broken):
        given = ("probe", model, "--baseline", model, "--questions", QUESTIONS)
        code, _, said[model] = aegis(*given, "--json")
        assert code == 0
    assert "can hardly lose" not in said[taught]
    assert "can hardly lose" in said[broken] and "--ask" in said[broken]


def test_whoever_says_how_questions_are_asked_is_not_advised_to(aegis, broken: Path) -> None:
    given = ("probe", broken, "--questions", QUESTIONS, "--ask", "is {}")
    code, _, err = aegis(*given, "--json")
    said = " ".join(err.split())
    assert code == 0 and "can hardly lose" in said
    assert "--ask" not in said and "They were asked as 'is {}'" in said


def test_it_is_asked_as_is_said(aegis, taught: Path, tmp_path: Path) -> None:
    out = tmp_path / "said.jsonl"
    given = ("probe", taught, "--questions", 7, "--predictions", out)
    code, _, err = aegis(*given, "--ask", "what {}")
    assert code == 0, err
    lines = out.read_text(encoding="utf-8").splitlines()
    assert all(json.loads(line)["question"].startswith("what ") for line in lines)
    code, _, err = aegis(*given, "--ask", "no place")
    assert code == 2 and "a text with one {}" in err


def test_progress_tells_the_baselines_answers_from_the_models(taught: Path, broken: Path) -> None:
    seen: list[Event] = []
    probe.run(str(broken), "scenes", 20, str(taught), None, None, on_event=seen.append)
    asking = [event.stage for event in seen if event.stage.startswith("probe")]
    one_by_one = [stage for stage, _ in itertools.groupby(asking)]
    assert one_by_one == ["probe (loading)", "probe", "probe baseline"]


def test_a_baseline_that_the_run_did_not_begin_from_is_told(
    taught: Path, broken: Path, demos_file: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    train.run(recipe(taught), "naive", demos_file, None, run)
    said: dict[Path, list[str]] = {}
    for baseline in (taught, broken):
        seen: list[Event] = []
        probe.run(str(run), "scenes", 20, str(baseline), None, None, on_event=seen.append)
        said[baseline] = [event.text for event in seen if isinstance(event, Warned)]
    assert said[taught] == []
    assert "is not the model that" in said[broken][0]


def test_a_run_that_begins_with_another_run_is_held_against_the_vlm(
    taught: Path, demos_file: Path, tmp_path: Path, aegis: Any
) -> None:
    """The model from which it started has already lost what the first run cost."""
    first, second = tmp_path / "first", tmp_path / "second"
    train.run(recipe(taught), "naive", demos_file, None, first)
    train.run(recipe(first), "stop-gradient", demos_file, None, second)
    assert [origin.name for origin in results.origins(second)] == [str(first), str(taught)]
    said: dict[Path, list[str]] = {}
    for baseline in (taught, first):
        seen: list[Event] = []
        probe.run(str(second), "scenes", 20, str(baseline), None, None, on_event=seen.append)
        said[baseline] = [event.text for event in seen if isinstance(event, Warned)]
    assert said == {taught: [], first: []}
    command = ("probe", second, "--questions", "20", "--max-drop", "100", "--json")
    code, out, err = aegis(*command)
    asked = json.loads(out)["asked"]
    assert code == 0 and f"'{taught}'" in err and f"by way of {first}" in err
    assert asked["baseline"] == str(taught) and asked["target"] == str(second)
    assert (asked["vqa"], asked["questions"], asked["gate"]) == ("scenes", 20, "mean")
    for measured_on in (first, taught):  # an anchor belongs to one of them
        anchor = tmp_path / f"{measured_on.name}.safetensors"
        measure.run(str(measured_on), Settings(samples=20, parts=("moments",)), anchor)
        code, out, err = aegis("probe", second, "--questions", "20", "--anchor", anchor, "--json")
        assert code == 0 and json.loads(out)["asked"]["baseline"] == str(measured_on), err


def test_a_run_in_the_place_of_its_own_backbone_begins_from_itself_once(
    taught: Path, demos_file: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    train.run(recipe(taught), "naive", demos_file, None, run)
    said = (run / "recipe.yaml").read_text(encoding="utf-8")
    (run / "recipe.yaml").write_text(said.replace(str(taught), str(run)), encoding="utf-8")
    assert [origin.name for origin in results.origins(run)] == [str(run)]


def test_a_drift_between_two_prompts_says_so(taught: Path, tmp_path: Path) -> None:
    anchor = tmp_path / "anchor.safetensors"
    measure.run(str(taught), Settings(samples=20, ask="what {}", parts=("moments",)), anchor)
    seen: list[Event] = []
    report = probe.run(str(taught), "scenes", 20, str(taught), anchor, None, on_event=seen.append)
    assert report.w2_between == "scenes as 'what {}' and as '{}'"
    assert any("--ask 'what {}'" in event.text for event in seen if isinstance(event, Warned))
    assert probe.two_sets(anchor, "scenes", "what {}") is None


def test_a_run_is_asked_the_questions_that_its_recipe_names(
    aegis, taught: Path, demos_file: Path, tmp_path: Path
) -> None:
    asked = write_jsonl(tmp_path, 24)
    settings = recipe(taught)
    settings = replace(settings, probe=replace(settings.probe, vqa=(str(asked), "scenes")))
    run = tmp_path / "run"
    train.run(settings, "naive", demos_file, None, run)
    for target in (run, run / "checkpoints" / "last"):
        code, text, err = aegis("probe", target, "--json")
        assert code == 0 and str(asked) in err and "--vqa scenes" in err
        assert json.loads(text)["questions"] < 24 * 3
    kept = [path.name for path in (run / "results").iterdir()]
    assert kept == ["probe-set.jsonl.json"]  # the last checkpoint is the run
    code, text, _ = aegis("probe", run, "--vqa", "scenes", "--questions", 8, "--json")
    assert code == 0 and json.loads(text)["questions"] == 8


def test_a_run_is_held_to_the_gate_of_its_recipe_on_the_questions_that_it_names(
    aegis, taught: Path, broken: Path, demos_file: Path, tmp_path: Path
) -> None:
    settings = recipe(broken)
    settings = replace(settings, probe=replace(settings.probe, max_drop=0.0))
    run = tmp_path / "run"
    train.run(settings, "stop-gradient", demos_file, None, run)
    given = ("probe", run, "--questions", 40, "--json")
    code, text, err = aegis(*given)
    assert code == 0 and f"the baseline is '{broken}'" in err
    assert json.loads(text)["passed"] is True
    worse = ("--baseline", taught)
    code, text, err = aegis(*given, *worse)
    assert code == 1 and "more than the recipe's probe.max_drop 0" in err
    assert "the gate is at a drop of 0 points, the recipe's probe.max_drop\n" in err
    assert aegis(*given, *worse, "--max-drop", 100)[0] == 0
    other = write_jsonl(tmp_path, 24)
    code, text, _ = aegis(*given, "--vqa", other)
    assert code == 0 and json.loads(text)["passed"] is None


def test_a_run_is_asked_as_many_questions_as_its_recipe_says_and_the_same_ones(
    aegis, taught: Path, demos_file: Path, tmp_path: Path
) -> None:
    settings = recipe(taught)
    settings = replace(settings, probe=replace(settings.probe, questions=9, seed=7))
    run, out = tmp_path / "run", tmp_path / "said.jsonl"
    train.run(settings, "naive", demos_file, None, run)

    def asked(model: Path, *options: object) -> list[str]:
        code, _, err = aegis("probe", model, "--predictions", out, *options)
        assert code == 0, err
        return [json.loads(line)["question"] for line in out.read_text().splitlines()]

    own = asked(run)
    assert own == asked(taught, "--questions", 9, "--seed", 7) and len(own) == 9
    assert asked(run, "--seed", 0) == asked(taught, "--questions", 9) != own
    assert len(asked(run, "--questions", 5)) == 5


def test_predictions_do_not_replace_a_runs_own_files(
    aegis, taught: Path, demos_file: Path, tmp_path: Path
) -> None:
    train.run(recipe(taught), "naive", demos_file, None, run := tmp_path / "run")
    before = (run / "recipe.yaml").read_bytes()
    for target in (run, run / "checkpoints" / "last"):
        code, _, err = aegis("probe", target, "--predictions", run / "recipe.yaml")
        assert code == 2 and "which this command also reads or writes" in err
    given = ("probe", taught, "--baseline", run, "--predictions", run / "recipe.yaml")
    code, _, err = aegis(*given)
    assert code == 2 and "which this command also reads or writes" in err
    assert (run / "recipe.yaml").read_bytes() == before
    for _ in range(2):  # an earlier probe's predictions are replaced
        code, _, err = aegis("probe", run, "--questions", 7, "--predictions", run / "said.jsonl")
        assert code == 0, err


def test_another_seed_asks_other_questions(aegis, taught: Path, tmp_path: Path) -> None:
    asked = {}
    for name, options in {"plain": (), "0": ("--seed", 0), "7": ("--seed", 7)}.items():
        out = tmp_path / f"{name}.jsonl"
        code, _, err = aegis("probe", taught, "--questions", 40, "--predictions", out, *options)
        assert code == 0, err
        lines = [json.loads(line) for line in out.read_text().splitlines()]
        asked[name] = [(line["question"], line["reference"]) for line in lines]
    assert asked["plain"] == asked["0"] != asked["7"] and len(asked["7"]) == 40


def test_stop_gradient_keeps_every_answer(
    taught: Path, own_anchor: Path, demos_file: Path, tmp_path: Path
) -> None:
    settings = recipe(taught, methods=("stop-gradient",))
    train.run(replace(settings, seed=3), "stop-gradient", demos_file, None, tmp_path / "run")
    report, before = (
        asked_of(tmp_path / "run", taught, own_anchor, 0.0),
        asked_of(taught, taught, own_anchor),
    )
    assert report.passed and report.drop_points == 0 and report.layers == before.layers
