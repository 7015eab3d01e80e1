"""`aegis scores`: the tables of VLMEvalKit, compared question by question."""

from __future__ import annotations

import csv
import io
import json
import math
import random
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import openpyxl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from aegis_cli.cli.app import app
from aegis_cli.common import tables
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Progress, Warned
from aegis_cli.evaluation import harness_scores, question_log

RUN, LATER = "T20260131-120000", "T20260201-090000"
JUDGED = "exact_matching_result"  # what `ImageMCQDataset.evaluate_heuristic` appends to the name
Row = dict[str, Any]


def asked(count: int, first: int = 0) -> list[Row]:
    """Rows as `infer_data_job` writes them: the benchmark's columns, then the prediction."""
    return [
        {
            "index": first + number,
            "question": f"What is in picture {number}?",
            "A": "a cat",
            "B": number,
            "answer": "A",
            "category": None,
            "prediction": "A. a cat",
        }
        for number in range(count)
    ]


def judged(verdicts: Sequence[Any], column: str = "hit", **more: Sequence[Any]) -> list[Row]:
    """The same rows with the columns that a judge appends."""
    added = {column: verdicts, **more}
    return [
        {**row, **{name: values[number] for name, values in added.items()}}
        for number, row in enumerate(asked(len(verdicts)))
    ]


def write(path: Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    """A table as pandas writes it, in the format of its suffix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    names = list(rows[0]) if rows else ["index", "prediction", "hit"]
    cells = [[row[name] for name in names] for row in rows]
    if path.suffix == ".xlsx":
        book = openpyxl.Workbook()
        for line in [names, *cells]:
            book.active.append([str(cell) if isinstance(cell, list) else cell for cell in line])
        book.save(path)
    elif path.suffix == ".json":
        path.write_text(json.dumps(rows, indent=4), encoding="utf-8")
    else:
        with open(path, "w", newline="", encoding="utf-8") as file:
            comma = "\t" if path.suffix == ".tsv" else ","
            csv.writer(file, delimiter=comma, quoting=csv.QUOTE_ALL).writerows([names, *cells])
    return path


def evaluation(
    model: Path,
    benchmark: str,
    rows: Sequence[Mapping[str, Any]],
    kind: str = JUDGED,
    suffix: str = ".tsv",
    run: str = RUN,
) -> Path:
    """The files of one evaluation in a model's folder: predictions, verdicts, a summary."""
    folder = model / run
    begin = f"{model.name}_{benchmark}"
    predictions = [
        {name: row[name] for name in list(row)[: list(row).index("prediction") + 1]} for row in rows
    ]
    write(folder / f"{begin}{suffix}", predictions)
    write(folder / f"{begin}_acc.csv", [{"split": "none", "Overall": 0.5}])
    (folder / f"{begin}_{kind}.pkl").write_bytes(b"never read")
    return write(folder / f"{begin}_{kind}{suffix}", rows)


def lmms(folder: Path, task: str, values: Sequence[float]) -> None:
    path = folder / "models__x" / f"20260101_120000_samples_{task}.jsonl"
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [
        {"doc_id": number, "input": "q", "target": "a", "hit": value}
        for number, value in enumerate(values)
    ]
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))


def heard(events: Sequence[Any]) -> str:
    return "\n".join(event.text for event in events if isinstance(event, Warned))


def refused(before: Path, after: Path, max_drop: float | None = None) -> str:
    with pytest.raises(AegisError) as raised:
        harness_scores.run(before, after, max_drop)
    return str(raised.value)


@pytest.fixture
def two(tmp_path: Path) -> tuple[Path, Path]:
    """Two evaluations of ten questions, one of which is lost."""
    evaluation(tmp_path / "base", "MMStar", judged([1] * 9 + [0]))
    evaluation(tmp_path / "tuned", "MMStar", judged([0] + [1] * 8 + [0]))
    return tmp_path / "base", tmp_path / "tuned"


def table_of(model: Path) -> Path:
    return next(model.rglob(f"*_{JUDGED}.*sv"))


# --- figures --------------------------------------------------------------------------------------


@given(
    pairs=st.lists(
        st.tuples(st.sampled_from((0, 1, 0.25)), st.sampled_from((0, 1, 0.25))),
        min_size=1,
        max_size=30,
    )
)
def test_figures_are_those_of_the_equal_folder_of_lmms_eval(
    tmp_path_factory: pytest.TempPathFactory, pairs: list[tuple[float, float]]
) -> None:
    folder = tmp_path_factory.mktemp("scores")
    for name, verdicts in zip(("a", "b"), zip(*pairs, strict=True), strict=True):
        evaluation(folder / "kit" / name, "MMStar", judged(verdicts))
        lmms(folder / "lmms" / name, "MMStar", verdicts)
    found, same = (
        harness_scores.run(folder / kind / "a", folder / kind / "b", 5.0, "upper").to_json()
        for kind in ("kit", "lmms")
    )
    (score,), (twin,) = found["scores"], same["scores"]
    assert score.pop("metric") == f"hit, {JUDGED}" and twin.pop("metric") == "hit"
    assert score == twin
    assert {key: found[key] for key in ("passed", "left_out")} == {
        key: same[key] for key in ("passed", "left_out")
    }


def test_drop_and_interval_are_those_computed_by_hand(two: tuple[Path, Path]) -> None:
    (found,) = harness_scores.run(*two).scores
    assert (found.task, found.questions, found.before, found.after) == ("MMStar", 10, 0.9, 0.8)
    assert found.drop_points == pytest.approx(10.0)
    z, n = 1.959964, 10
    middle, half = (
        (0.1 + z**2 / (2 * n)) / (1 + z**2 / n),
        z * math.sqrt(0.1 * 0.9 / n + z**2 / (4 * n**2)) / (1 + z**2 / n),
    )
    most_won = z**2 / n / (1 + z**2 / n)  # Wilson's upper end for none of ten
    low = 0.1 - math.hypot(0.1 - (middle - half), most_won)
    assert found.drop_interval == pytest.approx((100 * low, 100 * (middle + half)), abs=1e-3)


@pytest.mark.parametrize("suffix", tables.SUFFIXES)
def test_every_format_has_the_same_figures(
    two: tuple[Path, Path], tmp_path: Path, suffix: str
) -> None:
    evaluation(tmp_path / "other" / "base", "MMStar", judged([1] * 9 + [0]), suffix=suffix)
    found = harness_scores.run(tmp_path / "other" / "base", two[1])
    assert found.scores == harness_scores.run(*two).scores


def test_the_order_of_rows_does_not_matter(tmp_path: Path) -> None:
    draw = random.Random(0)
    verdicts = [[draw.random() for _ in range(200)] for _ in range(2)]
    for name, own in zip(("a", "b"), verdicts):
        evaluation(tmp_path / "in-order" / name, "MMVet", judged(own, "score"), "gpt-4-turbo")
        rows = judged(own, "score")
        draw.shuffle(rows)
        evaluation(tmp_path / "mixed" / name, "MMVet", rows, "gpt-4-turbo")
    found, mixed = (
        harness_scores.run(tmp_path / kind / "a", tmp_path / kind / "b").scores
        for kind in ("in-order", "mixed")
    )
    assert found == mixed and found[0].metric == "score, gpt-4-turbo"


@pytest.mark.parametrize("suffix", tables.SUFFIXES)
def test_truth_values_are_verdicts(tmp_path: Path, suffix: str) -> None:
    """Judges of yes/no benchmarks append `score`, the truth of answer == extracted."""
    rows = [[True, False, True, True], [True, False, False, True]]
    for name, right in zip(("a", "b"), rows):
        extracted = ["Yes"] * 4
        own = [
            {**row, "extracted": word, "score": one}
            for row, word, one in zip(asked(4), extracted, right)
        ]
        evaluation(tmp_path / name, "POPE", own, "auxmatch", suffix)
    (found,) = harness_scores.run(tmp_path / "a", tmp_path / "b").scores
    assert (found.metric, found.before, found.after) == ("score, auxmatch", 0.75, 0.5)


@pytest.mark.parametrize("suffix", tables.SUFFIXES)
@pytest.mark.parametrize(
    ("benchmark", "matches", "expected"),
    [
        ("TextVQA_VAL", [[1, 0.3333333333333333, 1], [0.0, 0.0, 0.0]], [7 / 9, 0.0]),
        ("GQA_TestDev_Balanced", [[1.0], [0.0]], [1.0, 0.0]),
        ("ChartQA_TEST", [[True, False], [False, False]], [1.0, 0.0]),
        # Distances: the nearest reference counts, and distances above a half count as 0.
        ("DocVQA_VAL", [[0.9, 0.2], [0.6, 0.51]], [0.8, 0.0]),
        ("InfoVQA_VAL", [[0.5, 1.0], [0.0]], [0.5, 1.0]),
    ],
)
def test_matches_count_as_vlmevalkit_counts_them(
    tmp_path: Path,
    benchmark: str,
    matches: list[list[Any]],
    expected: list[float],
    suffix: str,
) -> None:
    means = [sum(own) / len(own) for own in matches]
    for name, shown in (("a", matches), ("b", matches[::-1])):
        # `eval_score` of DocVQA is a mean of distances, not a score.
        rows = judged(shown, "eval_match", eval_score=means)
        evaluation(tmp_path / name, benchmark, rows, "results", suffix)
    (found,) = harness_scores.run(tmp_path / "a", tmp_path / "b").scores
    assert found.metric == "eval_match, results"
    assert found.before == pytest.approx(sum(expected) / 2)


def test_a_fall_of_docvqa_is_a_drop(tmp_path: Path) -> None:
    """Its matches are distances, so they rise if the answers become worse."""
    for name, distance in (("a", 0.0), ("b", 1.0)):
        rows = judged([[distance]] * 20, "eval_match", eval_score=[distance] * 20)
        evaluation(tmp_path / name, "DocVQA_VAL", rows, "results")
    report = harness_scores.run(tmp_path / "a", tmp_path / "b", 50.0)
    assert report.passed is False and report.scores[0].drop_points == pytest.approx(100)


def widths(folder: Path, benchmark: str, rows: Callable[[Sequence[int]], list[Row]]) -> float:
    """The interval's width if of 40 questions every second pair of neighbours is lost."""
    lost = [0 if number // 2 % 2 else 1 for number in range(40)]
    evaluation(folder / "a", benchmark, rows([1] * 40))
    evaluation(folder / "b", benchmark, rows(lost))
    (found,) = harness_scores.run(folder / "a", folder / "b").scores
    assert found.drop_points == pytest.approx(50) and found.questions == 40
    return found.drop_interval[1] - found.drop_interval[0]


def test_one_question_in_several_orders_is_not_several(tmp_path: Path) -> None:
    """A circular benchmark asks again, with 1e6 added to the index."""

    def circular(verdicts: Sequence[int]) -> list[Row]:
        return [
            {**row, "index": number // 2 + 10**6 * (number % 2)}
            for number, row in enumerate(judged(verdicts))
        ]

    def grouped(verdicts: Sequence[int]) -> list[Row]:
        return [{"g_index": number // 2, **row} for number, row in enumerate(judged(verdicts))]

    alone = widths(tmp_path / "alone", "MMStar", judged)
    told = widths(tmp_path / "told", "MMBench_DEV_EN", circular)
    assert told == widths(tmp_path / "grouped", "BLINK", grouped) > 1.2 * alone


def test_questions_of_one_image_are_not_independent(tmp_path: Path) -> None:
    def seen(verdicts: Sequence[int]) -> list[Row]:
        rows = judged(verdicts)
        return [{"image_path": f"{n // 2}.jpg", **row} for n, row in enumerate(rows)]

    alone = widths(tmp_path / "alone", "MME", judged)
    assert widths(tmp_path / "seen", "MME", seen) > 1.2 * alone


def test_indices_are_the_same_as_numbers_and_as_texts(tmp_path: Path) -> None:
    for name, kind in (("a", float), ("b", str)):
        rows = [{**row, "index": kind(row["index"]), "B": kind(row["B"])} for row in judged([1, 0])]
        evaluation(tmp_path / name, "MMStar", rows, suffix=".json")
    (found,) = harness_scores.run(tmp_path / "a", tmp_path / "b").scores
    assert (found.questions, found.before) == (2, 0.5)


# --- folders --------------------------------------------------------------------------------------


def test_a_folder_a_run_and_a_table_are_taken(two: tuple[Path, Path]) -> None:
    for path in two[0].rglob("*.tsv"):
        (two[0] / path.name).symlink_to(path.relative_to(two[0]))
    events: list[Any] = []
    expected = harness_scores.run(*two, on_event=events.append).scores
    assert heard(events) == ""  # a link is not a second evaluation
    assert harness_scores.run(two[0] / RUN, two[1] / RUN).scores == expected
    assert harness_scores.run(table_of(two[0] / RUN), table_of(two[1])).scores == expected


def test_the_newest_evaluation_counts(two: tuple[Path, Path]) -> None:
    evaluation(two[1], "MMStar", judged([1] * 10), run=LATER)
    evaluation(two[1], "MMStar", judged([0] * 10), run="T20250101_G1a2b3c4d")
    events: list[Any] = []
    (found,) = harness_scores.run(*two, on_event=events.append).scores
    assert found.after == 1.0 and f"the newest is read, '{LATER}'" in heard(events)


def test_a_table_is_of_the_longest_name_of_a_benchmark(tmp_path: Path) -> None:
    for name in ("a", "b"):
        evaluation(tmp_path / name, "MMBench_DEV_EN", judged([1, 1]))
        evaluation(tmp_path / name, "MMBench_DEV_EN_V11", judged([1, 0]))
    found = harness_scores.run(tmp_path / "a", tmp_path / "b").scores
    assert [(s.task, s.metric, s.before) for s in found] == [
        ("MMBench_DEV_EN", f"hit, {JUDGED}", 1.0),
        ("MMBench_DEV_EN_V11", f"hit, {JUDGED}", 0.5),
    ]


def test_verdicts_without_predictions_go_by_their_own_name(two: tuple[Path, Path]) -> None:
    for model in two:
        (model / RUN / f"{model.name}_MMStar.tsv").unlink()
    (found,) = harness_scores.run(*two).scores
    assert (found.task, found.metric) == (f"MMStar_{JUDGED}", "hit")


def test_what_is_not_noted_of_each_question_is_left_out_with_the_reason(
    two: tuple[Path, Path],
) -> None:
    for model in two:  # OCRBench leaves predictions and a summary
        write(model / RUN / f"{model.name}_OCRBench.tsv", asked(3))
        evaluation(model, "LLaVABench", judged([9, 4], "score"), "openai_result")
    evaluation(two[1], "POPE", judged([True], "score"), "auxmatch")
    events: list[Any] = []
    report = harness_scores.run(*two, max_drop=50, on_event=events.append)
    assert report.left_out == ["LLaVABench", "OCRBench", "POPE"]
    assert report.why_left_out == {
        "LLaVABench": "score, openai_result is left out: from 4 to 9, which are not shares",
        "OCRBench": "no per-question scores were written",
        "POPE": f"only '{two[1]}' has scores",
    }
    assert "OCRBench: not compared, and --max-drop does not judge it" in heard(events)


def test_a_benchmarks_own_score_is_no_verdict(two: tuple[Path, Path]) -> None:
    """Columns before the prediction existed before anything was judged."""
    for model in two:
        rows = [{"score": 0.5, **row} for row in asked(3)]
        write(model / RUN / f"{model.name}_MathVista.tsv", rows)
    assert harness_scores.run(*two).left_out == ["MathVista"]


def test_other_judges_are_not_compared(two: tuple[Path, Path]) -> None:
    path = table_of(two[1])
    path.rename(path.with_name(path.name.replace("exact_matching", "gpt-4o-mini")))
    evaluation(two[0], "POPE", judged([True], "score"), "auxmatch")
    evaluation(two[1], "POPE", judged([True], "score"), "auxmatch")
    report = harness_scores.run(*two)
    why = "'hit, exact_matching_result' before, 'hit, gpt-4o-mini_result' after"
    assert report.why_left_out == {"MMStar": why}
    assert f"MMStar: {why}" in refused(*two, max_drop=50)


def test_a_judge_of_one_model_alone_is_told(two: tuple[Path, Path]) -> None:
    evaluation(two[0], "MMStar", judged([1] * 10), "gpt-4o-mini_result")
    events: list[Any] = []
    (found,) = harness_scores.run(*two, on_event=events.append).scores
    assert found.metric == f"hit, {JUDGED}"
    assert "MMStar: hit, gpt-4o-mini_result is left out: only" in heard(events)


def test_tables_of_two_benchmarks_are_not_taken_for_one(two: tuple[Path, Path]) -> None:
    """A table without its own predictions belongs to those whose name is a prefix of its name."""
    for model in two:
        rows = [{**row, "question": "Quite another?"} for row in judged([1] * 10)]
        evaluation(model, "MMStar_V2", rows)
        (model / RUN / f"{model.name}_MMStar_V2.tsv").unlink()
    assert "index 0 is one question in" in refused(*two)


def test_no_gate_passes_by_verdicts_that_the_second_model_has_not_got(
    two: tuple[Path, Path],
) -> None:
    for model in two:
        evaluation(model, "POPE", judged([True], "score"), "auxmatch")
    table_of(two[1]).unlink()  # the evaluation ended before it judged them
    assert harness_scores.run(*two).left_out == ["MMStar"]
    assert "no scores in" in refused(*two, max_drop=50)


def test_verdicts_that_tell_nothing_of_the_model_are_counted(two: tuple[Path, Path]) -> None:
    rows = judged([0] + [1] * 8 + [0], log=["Match Log: A. "] * 10)
    rows[0]["prediction"] = "Failed to obtain answer: <class 'RuntimeError'> CUDA out of memory"
    rows[9]["log"] = "Match Log: Failed to predict, thus randomly generate one. . "
    evaluation(two[1], "MMStar", rows)
    events: list[Any] = []
    harness_scores.run(*two, on_event=events.append)
    assert "of 10 questions 1 without an answer, because asking the model failed" in heard(events)
    assert "of 10 questions 1 judged by chance, because the judge had no answer" in heard(events)


def test_reading_is_told_to_its_end(two: tuple[Path, Path], monkeypatch: Any) -> None:
    monkeypatch.setattr(question_log, "_TOLD_BYTES", 500)
    told: list[Any] = []
    harness_scores.run(*two, on_event=told.append)
    size = sum(table_of(model).stat().st_size for model in two)
    progress = [event for event in told if isinstance(event, Progress)]
    opened = [(event.done, event.total) for event in progress if event.unit == "tables opened"]
    assert opened == [(1, 3), (2, 3), (3, 3)] * 2  # predictions, verdicts and a summary
    read = [(event.done, event.total) for event in progress if event.unit == "bytes"]
    assert len(read) == 2 and read[-1] == (size, size)


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize("blank", (None, float("nan"), "", "nan"))
@pytest.mark.parametrize("suffix", tables.SUFFIXES)
def test_a_blank_verdict_is_refused(tmp_path: Path, blank: Any, suffix: str) -> None:
    if blank is not None and suffix == ".xlsx" and blank != blank:
        blank = None  # a workbook has no other way to store it
    for name in ("a", "b"):
        rows = judged([1, 0, blank if name == "b" else 1])
        path = evaluation(tmp_path / name, "MMStar", rows, suffix=suffix)
    said = refused(tmp_path / "a", tmp_path / "b")
    assert f"index 2 of '{path}' has no hit" in said


@pytest.mark.parametrize("cell", ("good", "[1]", "inf", "1e999", 10**400))
def test_a_verdict_that_is_no_number_leaves_its_metric_out(
    two: tuple[Path, Path], cell: Any
) -> None:
    for model in two:
        evaluation(model, "Odd", judged([1, cell]))
    report = harness_scores.run(*two)
    assert report.why_left_out == {"Odd": f"hit, {JUDGED} is left out: not one number per question"}


@pytest.mark.parametrize("cell", ("[]", "[0.5, x]", "[[1], [0]]x", "__import__('os')"))
def test_matches_that_are_no_numbers_leave_their_metric_out(
    two: tuple[Path, Path], cell: str
) -> None:
    for model in two:
        evaluation(model, "TextVQA_VAL", judged(["[1.0]", cell], "eval_match"), "results")
    assert harness_scores.run(*two).left_out == ["TextVQA_VAL"]


def same_index_twice(path: Path) -> None:
    rows = judged([1] * 10)
    rows[4]["index"] = "3.0"
    write(path, rows)


def no_index(path: Path) -> None:
    rows = judged([1] * 10)
    rows[4]["index"] = None
    write(path, rows)


def no_row(path: Path) -> None:
    path.write_text(path.read_text(encoding="utf-8").splitlines()[0] + "\n", encoding="utf-8")


def a_cell_less(path: Path) -> None:
    lines = path.read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join([*lines[:-1], lines[-1].rsplit("\t", 1)[0]]), encoding="utf-8")


def no_text(path: Path) -> None:
    path.write_bytes(b"\xff\xfe\x00\x81" * 9)


def pointer(path: Path) -> None:
    path.unlink()
    path.with_suffix(".xlsx").write_text("version https://git-lfs.github.com/spec/v1\noid x\n")


def garbage(path: Path) -> None:
    path.unlink()
    path.with_suffix(".xlsx").write_bytes(b"PK\x03\x04" + bytes(range(256)))


def cut(path: Path) -> None:
    path.unlink()
    whole = write(path.with_suffix(".xlsx"), judged([1] * 10))
    whole.write_bytes(whole.read_bytes()[:-200])


def no_workbook(path: Path) -> None:
    path.unlink()
    with zipfile.ZipFile(path.with_suffix(".xlsx"), "w") as archive:
        archive.writestr("[Content_Types].xml", "<Types/>")


def no_json(path: Path) -> None:
    path.unlink()
    path.with_suffix(".json").write_text("[{")


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (same_index_twice, "two rows of index 3 in"),
        (no_index, "a row without an index in"),
        (no_row, "no row in"),
        (a_cell_less, "row 11 of"),
        (no_text, "is not a table, or is damaged"),
        (pointer, "is a Git LFS pointer"),
        (garbage, "is not a table, or is damaged"),
        (cut, "is not a table, or is damaged"),
        (no_workbook, "is not a table, or is damaged"),
        (no_json, "is not JSON"),
    ],
)
def test_a_damaged_table_is_one_error_that_names_it(
    two: tuple[Path, Path], damage: Callable[[Path], None], said: str
) -> None:
    path = table_of(two[1])
    damage(path)
    found = CliRunner().invoke(app, ["scores", *map(str, two)])
    assert found.exit_code == 2 and said in " ".join(found.stderr.split())
    assert path.stem in found.stderr.replace("\n", "")
    assert found.stdout == "" and "Traceback" not in found.stderr


@pytest.mark.parametrize(
    ("column", "said"),
    [
        ("question", "question 3 is 'What is in picture 3? A. a cat B. 3'"),
        ("B", "question 3 is"),
        ("answer", "(reference 'A')"),
    ],
)
def test_other_questions_of_the_same_index_are_refused(
    two: tuple[Path, Path], column: str, said: str
) -> None:
    """Two versions of a benchmark have the same indices."""
    rows = judged([1] * 10)
    rows[3][column] = "another"
    evaluation(two[1], "MMStar", rows)
    assert said in refused(*two)
    evaluation(two[1], "MMStar", judged([1] * 4))
    assert "10 and 4 questions, 6 of them in one file" in refused(*two)


def test_what_is_not_of_one_model_and_one_harness_is_refused(
    two: tuple[Path, Path], tmp_path: Path
) -> None:
    assert "tables of 2 models below" in refused(tmp_path, two[1])
    lmms(tmp_path / "lmms", "MMStar", [1.0] * 10)
    mixed = refused(tmp_path / "lmms", two[1])
    assert "output of lmms-eval or lm-evaluation-harness" in mixed
    assert "and of VLMEvalKit in" in mixed
    lmms(two[0], "MMStar", [1.0] * 10)
    assert "lm-evaluation-harness and VLMEvalKit in" in refused(*two)


def test_a_folder_that_was_renamed_is_refused(two: tuple[Path, Path], tmp_path: Path) -> None:
    evaluation(tmp_path / "third", "MMStar", judged([1] * 10), suffix=".xlsx")
    said = refused((tmp_path / "third").rename(tmp_path / "renamed"), two[1])
    assert "does not begin with that of its model's folder" in said


def test_an_index_of_any_length_is_taken(tmp_path: Path) -> None:
    for name in ("a", "b"):
        rows = [{**row, "index": f"{'9' * 5000}{row['index']}"} for row in judged([1, 0])]
        evaluation(tmp_path / name, "MMBench_DEV_EN", rows)
    assert harness_scores.run(tmp_path / "a", tmp_path / "b").scores[0].questions == 2


def test_a_workbook_without_styles_is_read(two: tuple[Path, Path]) -> None:
    """If a file has none, openpyxl warns, but this is not damage."""
    evaluation(two[0], "MMStar", judged([1] * 10), suffix=".xlsx")
    for path in two[0].rglob("*.tsv"):
        path.unlink()
    (path,) = two[0].rglob(f"*{JUDGED}.xlsx")
    whole = zipfile.ZipFile(io.BytesIO(path.read_bytes()))
    bare = '<styleSheet xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"/>'
    with zipfile.ZipFile(path, "w") as archive:
        for name in whole.namelist():
            archive.writestr(name, bare if name == "xl/styles.xml" else whole.read(name))
    assert harness_scores.run(*two).scores[0].before == 1.0


@pytest.mark.parametrize("suffix", (".xlsx", ".tsv"))
def test_empty_rows_and_long_cells_are_taken(tmp_path: Path, suffix: str) -> None:
    length = 200_000 if suffix == ".tsv" else 32_000  # the maximum length of a workbook's cell
    for name in ("a", "b"):
        rows = judged([1, 0, 1])
        rows[0]["prediction"] = "A" * length
        evaluation(tmp_path / name, "MMStar", [*rows, dict.fromkeys(rows[0])], suffix=suffix)
    assert harness_scores.run(tmp_path / "a", tmp_path / "b").scores[0].questions == 3


def test_what_is_not_judged_is_refused(two: tuple[Path, Path]) -> None:
    table_of(two[1]).unlink()
    assert "only predictions in" in refused(*two)
    predictions = next(two[1].rglob("tuned_MMStar.tsv"))
    assert "without a column of verdicts" in refused(two[0], predictions)
    write(predictions, [{"split": "none", "Overall": 0.5}])
    assert "no table with a row for each question" in refused(*two)


def test_a_workbook_without_its_package_names_the_extra(
    two: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluation(two[1], "MMStar", judged([1] * 10), suffix=".xlsx")
    monkeypatch.setattr(tables, "find_spec", lambda name: None)
    assert "pip install 'aegis-vla[benchmarks]'" in refused(*two)


def test_tables_of_other_programs_beside_samples_are_no_harness(tmp_path: Path) -> None:
    for name in ("a", "b"):
        lmms(tmp_path / name, "t", [1.0])
        (tmp_path / name / f"{name}_results.json").write_text('{"results": {}}')
        write(tmp_path / name / f"{name}_mine.csv", [{"x": 1}])
        write(tmp_path / name / "submissions" / "mmbench_results.xlsx", asked(2))
    assert len(harness_scores.run(tmp_path / "a", tmp_path / "b").scores) == 1


# --- the command ----------------------------------------------------------------------------------


def test_the_gate_ends_the_command(two: tuple[Path, Path]) -> None:
    def ask(*options: str) -> Any:
        return CliRunner().invoke(app, ["scores", *map(str, two), *options])

    assert ask("--max-drop", "10").exit_code == 0
    lost = ask("--max-drop", "9.9")
    assert lost.exit_code == 1
    assert f"MMStar (hit, {JUDGED}) dropped more than --max-drop 9.9" in lost.stderr
    unsure = ask("--max-drop", "15", "--gate", "upper", "--json")
    report = json.loads(unsure.stdout)
    assert unsure.exit_code == 1 and report["passed"] is False
    assert report["left_out"] == [] and report["why_left_out"] == {}
    assert report["scores"][0]["drop_points"] == pytest.approx(10)
