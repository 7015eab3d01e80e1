"""`aegis scores`: samples of lmms-eval and lm-evaluation-harness, compared question by question."""

from __future__ import annotations

import json
import random
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from aegis_cli.cli.app import app
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Progress, Warned
from aegis_cli.data.vqa.metrics import mean_loss_interval
from aegis_cli.evaluation import harness_scores, question_log

DATE, LATER = "20260101_120000", "20260102_120000"


def rows_of(metrics: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """Lines as lmms-eval 0.7.3 writes them."""
    count = len(next(iter(metrics.values())))
    return [
        {
            "doc_id": number,
            "target": "red",
            "filtered_resps": "red",
            "token_counts": [None],
            "doc_hash": "74234e98",
            **{name: values[number] for name, values in metrics.items()},
            "input": f"what is in picture {number}?",
        }
        for number in range(count)
    ]


def lmms(folder: Path, task: str, rows: Sequence[Mapping[str, Any]], date: str = DATE) -> Path:
    """A task's samples in a model's folder, in lmms-eval's layout."""
    path = folder / "models__x" / f"{date}_samples_{task}.jsonl"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def lm_eval(folder: Path, task: str, rows: Sequence[Mapping[str, Any]]) -> Path:
    """A task's samples as lm-evaluation-harness 0.4.13 writes them."""
    path = folder / "models__x" / f"samples_{task}_2026-01-01T12-00-00.123456.jsonl"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def filtered(number: int) -> dict[str, Any]:
    """A line with the filter name "none", which stands for no filter."""
    return {"doc_id": number, "filter": "none", "exact_match": 1.0}


def heard(events: list[Any]) -> str:
    return "\n".join(event.text for event in events if isinstance(event, Warned))


@pytest.fixture
def two(tmp_path: Path) -> tuple[Path, Path]:
    """Two evaluations of ten questions, one of which is lost."""
    right = [1.0] * 9 + [0.0]
    lmms(tmp_path / "before", "textvqa_val", rows_of({"exact_match": right}))
    lmms(tmp_path / "after", "textvqa_val", rows_of({"exact_match": [0.0, *right[1:]]}))
    return tmp_path / "before", tmp_path / "after"


scores_of_questions = st.lists(
    st.tuples(st.sampled_from((0.0, 0.3, 0.6, 1.0)), st.sampled_from((0.0, 0.3, 0.6, 1.0))),
    min_size=1,
    max_size=40,
)


@given(pairs=scores_of_questions)
def test_the_drop_is_the_mean_of_what_each_question_lost(
    tmp_path_factory: pytest.TempPathFactory, pairs: list[tuple[float, float]]
) -> None:
    folder = tmp_path_factory.mktemp("scores")
    before, after = zip(*pairs, strict=True)
    lmms(folder / "a", "t", rows_of({"exact_match": before}))
    lmms(folder / "b", "t", rows_of({"exact_match": after}))
    (found,) = harness_scores.run(folder / "a", folder / "b").scores
    assert found.questions == len(pairs)
    assert found.before == pytest.approx(sum(before) / len(before))
    assert found.after == pytest.approx(sum(after) / len(after))
    assert found.drop_points == pytest.approx(100 * (found.before - found.after), abs=1e-9)
    low, high = found.drop_interval
    assert -100 <= low <= found.drop_points + 1e-9 and found.drop_points - 1e-9 <= high <= 100


@pytest.mark.parametrize("kept", (0.5, 0.9, 0.99))
def test_the_interval_of_fractional_losses_holds_the_truth_often_enough(kept: float) -> None:
    # Half of the questions that change lose a third, a quarter all, a quarter win two thirds.
    rng = np.random.default_rng(0)
    sizes, shares = (0.0, 1 / 3, 1.0, -2 / 3), (kept, *((1 - kept) * np.array((0.5, 0.25, 0.25))))
    truth = float(np.dot(sizes, shares))
    held = 0
    for _ in range(400):
        losses = rng.choice(sizes, size=300, p=shares)
        low, high = mean_loss_interval(losses, range(300))
        held += low <= truth <= high
    assert held / 400 >= 0.94


def test_both_harnesses_are_read(tmp_path: Path) -> None:
    rows = [
        {
            "doc_id": number,
            "doc": {"question": "q"},
            "target": 0,
            "arguments": {},
            "resps": [],
            "filtered_resps": [],
            "filter": chosen,
            "metrics": ["exact_match"],
            "prompt_hash": f"p{number}",
            "exact_match": float(chosen == "strict"),
        }
        for number in range(4)
        for chosen in ("none", "strict")
    ]
    lm_eval(tmp_path / "a", "gsm8k", rows)
    lm_eval(tmp_path / "b", "gsm8k", rows)
    found = harness_scores.run(tmp_path / "a", tmp_path / "b").scores
    assert [(s.task, s.metric, s.before, s.questions) for s in found] == [
        ("gsm8k", "exact_match", 0.0, 4),
        ("gsm8k", "exact_match, strict", 1.0, 4),
    ]


def test_several_filters_of_lmms_eval_are_told_by_their_order(tmp_path: Path) -> None:
    # Its lines do not name the filter: gsm8k has a line per question for each of the two.
    right = [1.0, 0.0, 1.0, 0.0]
    strict, flexible = (rows_of({"exact_match": v}) for v in (right, [1.0] * 4))
    lmms(tmp_path / "a", "gsm8k", [*strict, *flexible])
    lmms(tmp_path / "b", "gsm8k", [*strict, *strict])
    found = harness_scores.run(tmp_path / "a", tmp_path / "b").scores
    assert [(s.metric, s.questions, s.before, s.after) for s in found] == [
        ("exact_match", 4, 0.5, 0.5),
        ("exact_match, filter 2", 4, 1.0, 0.5),
    ]


def test_a_task_of_which_nothing_is_compared_is_told_and_listed(two: tuple[Path, Path]) -> None:
    noted = [{"id": "validation_Art_1", "answer": "A", "parsed_pred": "B"}] * 3
    for folder in two:
        lmms(folder, "mmmu_val", rows_of({"mmmu_acc": noted}))
    events = list[Any]()
    report = harness_scores.run(*two, max_drop=50.0, on_event=events.append)
    assert report.left_out == ["mmmu_val"]
    why = "mmmu_acc is left out: not one number per question"
    assert report.why_left_out == {"mmmu_val": why}
    assert "mmmu_val: not compared, and --max-drop does not judge" in heard(events)


@pytest.mark.parametrize("key", ("score", "is_correct", "correct"))
def test_what_a_task_notes_of_each_question_is_its_score(tmp_path: Path, key: str) -> None:
    noted = [{"question_id": 7, key: right} for right in (True, False, True)]
    for name in ("a", "b"):
        lmms(tmp_path / name, "pope", rows_of({"pope_accuracy": noted, "pope_recall": noted}))
    (found,) = harness_scores.run(tmp_path / "a", tmp_path / "b").scores
    # The second metric is equal for every question.
    assert (found.metric, found.before) == ("pope_accuracy", pytest.approx(2 / 3))


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ([{"answer": "A"}, {"answer": "B"}], "not one number per question"),
        ([float("nan"), 1.0], "not one number per question"),
        ([10**400, 1.0], "not one number per question"),
        ([0.0, 7.0], "from 0 to 7, which are not shares"),
    ],
)
def test_what_is_no_share_is_left_out_by_name(tmp_path: Path, values: Any, why: str) -> None:
    for name in ("a", "b"):
        lmms(tmp_path / name, "t", rows_of({"odd": values, "exact_match": [1.0, 0.0]}))
    events: list[Any] = []
    report = harness_scores.run(tmp_path / "a", tmp_path / "b", on_event=events.append)
    assert [score.metric for score in report.scores] == ["exact_match"]
    assert f"t: odd is left out: {why}" in heard(events)


def test_a_metric_of_which_less_is_better_is_left_out(tmp_path: Path) -> None:
    for name in ("a", "b"):
        path = lmms(tmp_path / name, "t", rows_of({"wer": [0.5], "exact_match": [1.0]}))
        beside = {"higher_is_better": {"t": {"wer": False, "exact_match": True}}}
        path.with_name(f"{DATE}_results.json").write_text(json.dumps(beside))
    events: list[Any] = []
    report = harness_scores.run(tmp_path / "a", tmp_path / "b", on_event=events.append)
    assert [score.metric for score in report.scores] == ["exact_match"]
    assert "wer is left out: less of it is better" in heard(events)


@pytest.mark.parametrize("beside", ([1], {"higher_is_better": 3}, {"higher_is_better": {"t": []}}))
def test_results_that_do_not_say_what_is_better_leave_the_scores(
    tmp_path: Path, beside: Any
) -> None:
    for name in ("a", "b"):
        path = lmms(tmp_path / name, "t", rows_of({"exact_match": [1.0]}))
        path.with_name(f"{DATE}_results.json").write_text(json.dumps(beside))
    assert len(harness_scores.run(tmp_path / "a", tmp_path / "b").scores) == 1


@pytest.mark.parametrize("named", (5, [], [["exact_match"]]))
def test_a_line_whose_list_of_metrics_is_damaged_is_no_defect(tmp_path: Path, named: Any) -> None:
    for name in ("a", "b"):
        lmms(tmp_path / name, "t", [{**rows_of({"exact_match": [1.0]})[0], "metrics": named}])
    if named == 5:  # then the line's own keys decide
        assert len(harness_scores.run(tmp_path / "a", tmp_path / "b").scores) == 1
    else:
        assert "no question with a score in both" in refused(tmp_path / "a", tmp_path / "b")


def test_the_newest_evaluation_counts_and_lone_tasks_are_named(two: tuple[Path, Path]) -> None:
    before, after = two
    lmms(after, "textvqa_val", rows_of({"exact_match": [1.0] * 10}), LATER)
    lmms(after, "pope", rows_of({"pope_accuracy": [1.0]}))
    events: list[Any] = []
    report = harness_scores.run(before, after, on_event=events.append)
    (found,) = report.scores
    assert found.after == 1.0 and found.drop_points == pytest.approx(-10)
    assert f"'{LATER}_samples_textvqa_val.jsonl'" in heard(events)
    assert "left out: pope" in heard(events) and report.left_out == ["pope"]
    assert report.why_left_out == {"pope": f"only '{after}' has scores"}


def test_no_gate_passes_by_a_task_that_the_second_model_was_not_asked(
    two: tuple[Path, Path],
) -> None:
    """Its evaluation may have ended before that task."""
    before, after = two
    lmms(after, "docvqa", rows_of({"anls": [1.0]}))  # only in the second: nothing to judge
    assert harness_scores.run(before, after, max_drop=50).passed
    lmms(before, "pope", rows_of({"pope_accuracy": [1.0]}))
    assert harness_scores.run(before, after).left_out == ["docvqa", "pope"]
    with pytest.raises(AegisError, match="no scores in '.*after' of pope, which '.*before' has"):
        harness_scores.run(before, after, max_drop=50)


def refused(before: Path, after: Path) -> str:
    with pytest.raises(AegisError) as raised:
        harness_scores.run(before, after)
    return str(raised.value)


def test_other_questions_are_refused(two: tuple[Path, Path], tmp_path: Path) -> None:
    rows = rows_of({"exact_match": [1.0] * 10})
    rows[3]["input"] = "quite another question"
    lmms(tmp_path / "asked-otherwise", "textvqa_val", rows)
    assert "question 3 is 'what is in picture 3?'" in refused(two[0], tmp_path / "asked-otherwise")
    lmms(tmp_path / "fewer", "textvqa_val", rows_of({"exact_match": [1.0] * 4}))
    assert "10 and 4 questions, 6 of them in one file" in refused(two[0], tmp_path / "fewer")


def test_what_holds_no_scores_of_two_models_is_refused(
    two: tuple[Path, Path], tmp_path: Path
) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "no file of samples" in refused(empty, two[1])
    assert "check the path" in refused(tmp_path / "none", two[1])
    assert "before and after" in refused(two[0], two[0])
    lmms(tmp_path / "other", "pope", rows_of({"pope_accuracy": [1.0]}))
    assert "no question with a score in both" in refused(two[0], tmp_path / "other")
    assert "in 2 folders" in refused(tmp_path, two[1])


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("{", "line 11 of"),
        ("[1]", "no question's doc_id"),
        (json.dumps(rows_of({"exact_match": [1.0]})[0]), "question 0 on 2 lines"),
        (json.dumps(filtered(0)), "question 0 a second time"),
    ],
)
def test_damaged_samples_are_refused(two: tuple[Path, Path], line: str, said: str) -> None:
    path = next(two[1].rglob("*.jsonl"))
    path.write_text(path.read_text() + line + "\n")
    assert said in refused(*two)


def test_the_gate_ends_the_command(two: tuple[Path, Path]) -> None:
    def ask(*options: str) -> Any:
        return CliRunner().invoke(app, ["scores", *map(str, two), *options])

    assert ask("--max-drop", "10").exit_code == 0
    lost = ask("--max-drop", "9.9")
    assert lost.exit_code == 1
    assert "textvqa_val (exact_match) dropped more than --max-drop 9.9" in lost.stderr
    # Ten questions give the drop to within dozens of points.
    unsure = ask("--max-drop", "15", "--gate", "upper", "--json")
    assert unsure.exit_code == 1 and json.loads(unsure.stdout)["passed"] is False
    assert "by the upper end of the drop's interval" in unsure.stderr
    assert "10 questions measure the drop" in unsure.stderr


def test_a_large_drop_is_told_from_a_small_one(tmp_path: Path) -> None:
    draw = random.Random(0)
    right = [float(draw.random() < 0.8) for _ in range(2000)]
    worse = [value * (draw.random() < 0.9) for value in right]
    lmms(tmp_path / "a", "t", rows_of({"exact_match": right}))
    lmms(tmp_path / "b", "t", rows_of({"exact_match": worse}))
    report = harness_scores.run(tmp_path / "a", tmp_path / "b", 5.0, "upper")
    assert report.passed is False and report.scores[0].drop_interval[0] > 5
    assert harness_scores.run(tmp_path / "a", tmp_path / "b", 10.0, "upper").passed is True


def test_a_file_without_a_line_is_named(two: tuple[Path, Path]) -> None:
    lmms(two[1], "textvqa_val", [])
    with pytest.raises(AegisError, match=r"no question in .*samples_textvqa_val\.jsonl"):
        harness_scores.run(*two)


def test_a_file_of_another_name_is_not_told_to_have_no_samples(two: tuple[Path, Path]) -> None:
    path = next(two[0].rglob("*.jsonl")).rename(two[0] / "before.jsonl")
    with pytest.raises(
        AegisError, match=r"before\.jsonl', which is not named .*\n.*_samples_TASK\.jsonl"
    ):
        harness_scores.run(path, two[1])


def test_reading_is_told_to_its_end(two: tuple[Path, Path], monkeypatch: Any) -> None:
    monkeypatch.setattr(question_log, "_TOLD_BYTES", 500)
    told: list[Any] = []
    harness_scores.run(*two, on_event=told.append)
    size = sum(path.stat().st_size for each in two for path in each.rglob("*.jsonl"))
    shares = [(event.done, event.total) for event in told if isinstance(event, Progress)]
    assert len(shares) > 2 and shares == sorted(set(shares)) and shares[-1] == (size, size)
