"""Paired differences between runs, against values computed by hand."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from samples.command import refused
from samples.reports import open_loop, probe, rollout, write_job

from aegis_cli.common import files
from aegis_cli.common.estimates import estimate
from aegis_cli.data.vqa.metrics import Graded, drop_interval, mean_loss_interval, wilson_interval
from aegis_cli.data.vqa.questions import Question
from aegis_cli.evaluation import results
from aegis_cli.evaluation.probe import by_image
from aegis_cli.reporting import compare
from aegis_cli.reporting.paired import Difference, PairedRun

KEPT = ("correct_per_image", "lost_per_image")


@pytest.fixture
def job(tmp_path: Path) -> Path:
    """Two runs, `naive` and `aegis`, whose probes and rollouts keep nothing of single questions."""
    return write_job(tmp_path)


def ask(run: Path, correct: Sequence[int], counts: Sequence[int], **changes: Any) -> None:
    """Write a probe with this many correct answers about each image, all correct before."""
    found = probe("color") | {
        "accuracy": sum(correct) / sum(counts),
        "questions": sum(counts),
        "correct_per_image": list(correct),
        "lost_per_image": [asked - right for asked, right in zip(counts, correct, strict=True)],
        "questions_per_image": list(counts),
        "images": None,
    }
    files.save_json(run / "probe.json", found | changes)


def play(
    run: Path, outcomes: str, colors: str = "seen", changes: dict[str, Any] | None = None
) -> None:
    figures = {"outcomes": outcomes, "episodes": len(outcomes)}
    found = rollout(colors, outcomes.count("1") / len(outcomes)) | figures
    files.save_json(run / f"rollout-{colors}.json", found | (changes or {}))


def evaluate(run: Path, errors: Sequence[float], steps: Sequence[int], **changes: Any) -> None:
    each = [
        {"episode": i, "frames": 5, "steps": n, "relative_error": error, "hold_error": None}
        for i, (error, n) in enumerate(zip(errors, steps, strict=True))
    ]
    found = open_loop(*range(len(errors)), episode_errors=each)
    results.keep(run, "evaluate-validation-arm", found | changes, {"path": "/arm"})


def differences(job: Path) -> PairedRun:
    (found,) = compare.run([job]).paired
    return found


def mean(found: Difference | None) -> float:
    assert found is not None
    return found.mean


def width(found: Difference | None) -> float:
    assert found is not None and found.interval is not None
    return found.interval[1] - found.interval[0]


def graded(correct: Sequence[bool], image_of: Sequence[int]) -> list[Graded]:
    question = Question("color", "what", "red")
    return [
        Graded(question, "", bool(right), 1.0, image)
        for right, image in zip(correct, image_of, strict=True)
    ]


# --- the figures ----------------------------------------------------------------------------------


def test_differences_are_those_of_the_figures(job: Path) -> None:
    ask(job / "naive", [3, 0, 2, 1], [4, 3, 2, 3])
    ask(job / "aegis", [4, 1, 0, 3], [4, 3, 2, 3])
    play(job / "naive", "110100")
    play(job / "aegis", "111101")
    play(job / "naive", "0011", "held-out")
    play(job / "aegis", "0001", "held-out")
    evaluate(job / "naive", [0.5, 0.25], [10, 30])
    evaluate(job / "aegis", [0.25, 0.5], [10, 30])
    found = differences(job)
    assert mean(found.vqa_points) == pytest.approx(100 * (8 - 6) / 12)
    assert mean(found.success_seen_points) == pytest.approx(100 * (5 - 3) / 6)
    assert mean(found.success_held_out_points) == pytest.approx(-25.0)
    assert mean(found.open_loop_error) == pytest.approx((10 * -0.25 + 30 * 0.25) / 40)
    rows = {row.method: row for row in compare.run([job]).rows}
    shares = 100 * (rows["aegis"].accuracy - rows["naive"].accuracy)  # type: ignore[operator]
    assert mean(found.vqa_points) == pytest.approx(shares)


def test_an_interval_of_episodes_is_that_of_pairs(job: Path) -> None:
    play(job / "naive", "1101001100")
    play(job / "aegis", "1111011100")
    expected = mean_loss_interval(np.array([0, 0, 1, 0, 0, 1, 0, 0, 0, 0]), range(10))
    found = differences(job).success_seen_points
    assert found is not None and found.interval == pytest.approx([100 * end for end in expected])


def test_an_interval_over_images_is_that_of_their_questions(job: Path) -> None:
    """It is known from sums alone: which of an image's questions differ changes it hardly."""
    rng = np.random.default_rng(3)
    image_of = np.repeat(np.arange(150), rng.integers(1, 8, 150))
    hard = rng.random(150)[image_of]
    first, second = (rng.random(len(image_of)) > share * hard for share in (0.6, 0.4))
    before, after = graded(first, image_of.tolist()), graded(second, image_of.tolist())
    for run, answers in (("naive", before), ("aegis", after)):
        kept = by_image(answers, None, None)
        ask(job / run, kept["correct_per_image"], kept["questions_per_image"])
    found = differences(job).vqa_points
    assert found is not None and found.interval is not None
    low, high = drop_interval(after, before)  # what the second has more
    assert mean(found) == pytest.approx(100 * (second.mean() - first.mean()))
    assert found.interval == pytest.approx((100 * low, 100 * high), abs=0.05 * width(found))


def test_an_interval_of_errors_is_students_over_episodes(job: Path) -> None:
    errors, others = [0.5, 0.25, 0.75, 0.4], [0.4, 0.3, 0.5, 0.1]
    evaluate(job / "naive", errors, [20] * 4)
    evaluate(job / "aegis", others, [20] * 4)
    expected = estimate([b - a for a, b in zip(errors, others, strict=True)])
    found = differences(job).open_loop_error
    assert found is not None and found.interval == pytest.approx(expected.interval)
    assert mean(found) == pytest.approx(expected.mean)
    evaluate(job / "naive", [0.5], [20])
    evaluate(job / "aegis", [0.25], [20])
    assert differences(job).open_loop_error == Difference(-0.25, None)


def test_pairs_that_agree_have_a_narrower_interval(job: Path) -> None:
    """The same successes, once in the same episodes and once in others."""
    play(job / "naive", "1" * 20 + "0" * 20)
    play(job / "aegis", "1" * 24 + "0" * 16)
    alike = differences(job).success_seen_points
    play(job / "aegis", "0" * 16 + "1" * 24)
    apart = differences(job).success_seen_points
    assert mean(alike) == mean(apart) == pytest.approx(10.0)
    ends = [wilson_interval(successes, 40) for successes in (20, 24)]
    unpaired = 100 * float(np.hypot(*(high - low for low, high in ends)))
    assert width(alike) < 0.6 * unpaired < 0.9 * width(apart)


def test_equal_runs_differ_by_exactly_nothing(
    aegis, job: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(job)
    for run in (job / "naive", job / "aegis"):
        ask(run, [3, 0, 2], [4, 3, 2])
        play(run, "110100")
        evaluate(run, [0.5, 0.25], [10, 30])
    found = differences(job)
    each = (found.vqa_points, found.success_seen_points, found.open_loop_error)
    assert [mean(one) for one in each] == [0.0] * 3
    assert width(found.vqa_points) > 0 and width(found.success_seen_points) > 0
    for runs in (("naive", "aegis"), ("naive", "naive")):
        out = aegis("compare", *runs)[1]
        assert "0.00 (" in out and "#" not in out and "+0.00 (" not in out


# --- the reference --------------------------------------------------------------------------------


def renamed(job: Path) -> list[Path]:
    """The same runs in a folder that lists `aegis` first."""
    folder = job.parent / "runs"
    for name, method in (("a", "aegis"), ("b", "naive")):
        shutil.copytree(job / method, folder / name, symlinks=True)
    return [folder / "a", folder / "b"]


def test_the_reference_is_the_first_run_or_the_naive_one_of_a_first_folder(job: Path) -> None:
    first, naive = renamed(job)
    found = compare.run([first, naive])
    assert (found.against, [one.run for one in found.paired]) == (str(first), [str(naive)])
    assert compare.run([first.parent]).against == str(naive)
    assert compare.run([first, first.parent]).against == str(first)
    (alone,) = compare.run([first]).rows
    assert alone.run == str(first) and compare.run([first]).against is None


def test_the_others_keep_their_order(job: Path) -> None:
    first, naive = renamed(job)
    found = compare.run([first, naive, job / "aegis", job / "naive"], against=str(job / "aegis"))
    assert found.against == str(job / "aegis")
    assert [one.run for one in found.paired] == [str(first), str(naive), str(job / "naive")]
    assert [row.run for row in found.rows][:2] == [str(first), str(naive)]


def test_another_reference_turns_the_differences_around(job: Path) -> None:
    play(job / "naive", "110100")
    play(job / "aegis", "111101")
    found = differences(job).success_seen_points
    (turned,) = compare.run([job], against="aegis").paired
    assert turned.method == "naive" and found is not None and found.interval is not None
    low, high = found.interval
    other = turned.success_seen_points
    assert mean(other) == -mean(found)
    assert other is not None and other.interval == pytest.approx((-high, -low))


@pytest.mark.parametrize("against", ["lora", "elsewhere/naive"])
def test_a_reference_that_is_no_compared_run_is_refused(aegis, against: str, job: Path) -> None:
    said = refused(aegis("compare", job, "--against", against))
    assert f"--against {against}, which is none of the compared runs" in said
    assert f"{job / 'naive'}, {job / 'aegis'}" in said


def test_a_method_of_two_runs_names_none_of_them(aegis, job: Path) -> None:
    first, naive = renamed(job)
    said = refused(aegis("compare", job, naive, "--against", "naive"))
    assert "the method of 2 runs" in said and f"one of {job / 'naive'}, {naive}" in said
    assert compare.run([job, first], against="naive").against == str(job / "naive")


# --- what is no pair ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [
        {"questions_per_image": [4, 3, 3], "questions": 10},
        {"images": ["a", "b", "c"]},
        {"questions": 10},
        dict.fromkeys(KEPT),  # by an earlier version
    ],
)
def test_answers_to_other_questions_are_no_pairs(changes: dict[str, Any], job: Path) -> None:
    ask(job / "naive", [3, 0, 2], [4, 3, 2])
    ask(job / "aegis", [4, 1, 0], [4, 3, 2])
    assert differences(job).vqa_points is not None
    ask(job / "aegis", [4, 1, 0], [4, 3, 2], **changes)
    assert differences(job).vqa_points is None


@pytest.mark.parametrize("settings", [{"vqa": "scenes", "seed": 5}, {"vqa": "own.jsonl"}])
def test_answers_to_questions_of_another_draw_or_set_are_no_pairs(
    settings: dict[str, Any], job: Path
) -> None:
    for name in ("naive", "aegis"):
        ask(job / name, [3, 0, 2], [4, 3, 2])
    found = files.load_json(job / "aegis" / "probe.json")
    (job / "aegis" / "probe.json").unlink()
    results.keep(job / "aegis", "probe-x", found, {"vqa": "scenes"})
    assert differences(job).vqa_points is not None
    results.keep(job / "aegis", "probe-x", found, settings)
    assert differences(job).vqa_points is None


@pytest.mark.parametrize(
    ("before", "same"),
    [
        ({}, True),
        ({"baseline_cross_entropy": 0.25 * (1 + 1e-7)}, True),  # on another machine
        ({"baseline_accuracy": 0.8}, False),
        ({"baseline_cross_entropy": 0.26}, False),
        ({"baseline_cross_entropy": None}, False),
    ],
)
def test_what_was_lost_is_compared_only_from_the_same_answers_before(
    before: dict[str, Any], same: bool, job: Path
) -> None:
    """Earlier versions kept no other figure of single images."""
    ask(job / "naive", [3, 0, 2], [4, 3, 2])
    ask(job / "aegis", [4, 1, 0], [4, 3, 2])
    exact = differences(job).vqa_points
    for name, correct in (("naive", [3, 0, 2]), ("aegis", [4, 1, 0])):
        changes = before if name == "aegis" else {}
        ask(job / name, correct, [4, 3, 2], correct_per_image=None, **changes)
    assert differences(job).vqa_points == (exact if same else None)


def test_correct_answers_are_compared_whatever_the_backbone_was(job: Path) -> None:
    ask(job / "naive", [3, 0, 2], [4, 3, 2])
    none = {"baseline_accuracy": None, "baseline_cross_entropy": None, "lost_per_image": None}
    ask(job / "aegis", [4, 1, 0], [4, 3, 2], **none)
    assert mean(differences(job).vqa_points) == 0.0


@pytest.mark.parametrize(
    "changes", [{"task": "point"}, {"episodes": 7}, {"outcomes": None}, {"outcomes": "11"}]
)
def test_other_episodes_are_no_pairs(changes: dict[str, Any], job: Path) -> None:
    play(job / "naive", "110100")
    play(job / "aegis", "111101")
    assert differences(job).success_seen_points is not None
    play(job / "aegis", "111101", changes=changes)
    assert differences(job).success_seen_points is None


def test_episodes_of_another_seed_are_no_pairs(job: Path) -> None:
    play(job / "naive", "110100")
    (job / "aegis" / "rollout-seen.json").unlink()
    found = rollout("seen", 0.5) | {"outcomes": "111000", "episodes": 6}
    for seed, known in ((0, True), (3, False)):
        results.keep(job / "aegis", "rollout-seen", found, {"seed": seed, "replan": 4})
        assert (differences(job).success_seen_points is not None) is known


@pytest.mark.parametrize(
    "changes",
    [
        {"seed": 1},
        {"frames": 600},
        {"episode_errors": None},
        {"hold_error": 0.4},  # relative to the variance of other demonstrations
    ],
)
def test_errors_on_other_frames_are_no_pairs(changes: dict[str, Any], job: Path) -> None:
    evaluate(job / "naive", [0.5, 0.25], [10, 30])
    evaluate(job / "aegis", [0.25, 0.5], [10, 30])
    assert differences(job).open_loop_error is not None
    evaluate(job / "aegis", [0.25, 0.5], [10, 30], **changes)
    assert differences(job).open_loop_error is None


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("probe.json", {"questions_per_image": [4, 0, 5]}),
        ("probe.json", {"correct_per_image": "310"}),
        ("probe.json", {"correct_per_image": [10**400, 0, 2]}),
        ("rollout-seen.json", {"outcomes": "11x1"}),
    ],
)
def test_what_is_damaged_is_one_error(aegis, name: str, changes: dict[str, Any], job: Path) -> None:
    ask(job / "aegis", [3, 0, 2], [4, 3, 2])
    path = job / "aegis" / name
    files.save_json(path, files.load_json(path) | changes)
    assert f"{name}' is damaged" in refused(aegis("compare", job))


# --- the table ------------------------------------------------------------------------------------


def test_the_table_tells_the_reference_the_marks_and_what_they_do_not_cover(
    aegis, job: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(job)
    play(job / "naive", "0" * 30)
    play(job / "aegis", "1" * 30)
    code, out, _ = aegis("compare", "naive", "aegis")
    said = " ".join(out.split())
    assert code == 0 and "Differences from naive (paired, 95 % interval)" in said
    assert "#+100.0 (" in said and "# the interval excludes 0" in said
    assert "Another seed may differ by more: studies measure that." in said
    assert "VQA (points)" not in said and "-: not measured" not in said
    lines = [line for line in out.splitlines() if line.startswith((" naive", " aegis"))]
    assert len(lines) == 3 and lines[2].startswith(" aegis")


def test_a_dash_is_explained(aegis, job: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(job)
    shutil.copytree(job / "aegis", job / "other", symlinks=True)
    for name in ("naive", "aegis"):
        ask(job / name, [3, 0, 2], [4, 3, 2])
        play(job / name, "110100")
    play(job / "other", "110110")
    out = aegis("compare", "naive", "aegis", "other")[1]
    line = next(line for line in reversed(out.splitlines()) if line.startswith(" other"))
    assert line.split()[1] == "-" and "-: not measured on the same questions or episodes" in out


def test_without_any_pair_there_is_no_second_table(
    aegis, job: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(job)
    play(job / "naive", "110100")
    play(job / "naive", "110100", "held-out")
    assert "Differences" not in aegis("compare", "naive", "aegis")[1]


def test_json_has_every_difference(aegis, job: Path) -> None:
    play(job / "naive", "110100")
    play(job / "aegis", "111101")
    found = json.loads(aegis("compare", job, "--json")[1])
    assert found["against"] == str(job / "naive")
    (one,) = found["paired"]
    assert (one["run"], one["method"]) == (str(job / "aegis"), "aegis")
    low, high = one["success_seen_points"]["interval"]
    assert one["success_seen_points"]["mean"] == pytest.approx(100 / 3) and low < 100 / 3 < high
    assert one["vqa_points"] is None and one["open_loop_error"] is None
