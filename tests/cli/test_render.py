"""Progress and tables, as text."""

from __future__ import annotations

import dataclasses
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console, Group
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bars
from rich.table import Column
from rich.text import Text
from samples.studies import found

from aegis_cli.cli import render
from aegis_cli.cli.render import frontier
from aegis_cli.cli.render.layout import fixed, marked, number, percent, plain_table
from aegis_cli.cli.render.markdown import markdown
from aegis_cli.cli.render.open_loops import open_loop
from aegis_cli.cli.render.progress import Lines, Live, _warning
from aegis_cli.cli.render.studies import shown_as, study
from aegis_cli.cli.render.tables import (
    facts,
    pairs,
    pipeline,
    pretrain,
    probe,
    validation_actions,
    validation_rollout,
)
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Progress, Warned
from aegis_cli.evaluation.open_loop import (
    DimensionError,
    InstructionError,
    OpenLoopReport,
    StepError,
)
from aegis_cli.evaluation.results import Result
from aegis_cli.inspection.report import Bin, InspectReport, LayerEnergy, SiteSpectrum
from aegis_cli.merging.merge import MergePoint, MergeReport
from aegis_cli.models.acting import PartSuccess, RolloutReport
from aegis_cli.pretraining.vlm import PretrainReport, Scores
from aegis_cli.studies.comparison import POLICY_BAR
from aegis_cli.studies.metrics import Column as Declared
from aegis_cli.studies.metrics import bar

# --- progress -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Words:
    said: str


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def lines_of(events: list[tuple[float, Event]]) -> list[str]:
    file, clock = io.StringIO(), Clock()
    show = Lines(file, clock)
    for clock.now_s, event in events:
        show(event)
    return file.getvalue().splitlines()


def test_lines_are_throttled_and_carry_rate_and_remaining_time():
    lines = lines_of(
        [(0.5 * i, Progress("train", i, 1000, "steps", {"loss": 1 / (i + 1)})) for i in range(1001)]
    )
    assert lines[0] == "train: 0/1,000 steps (0 %), loss 1"
    assert lines[1] == "train: 20/1,000 steps (2 %), 2 steps/s, 8m10s left, loss 0.04762"
    assert lines[-1] == "train: 1,000/1,000 steps (100 %), 2 steps/s, took 8m20s, loss 0.000999"
    assert len(lines) == 51  # one every 10 s of 500 s, and the first


def test_a_fast_stage_prints_a_tenth_at_a_time_but_not_more_than_a_line_a_second():
    assert (
        len(lines_of([(0.03 * i, Progress("probe", i, 100, "batches")) for i in range(101)])) == 4
    )
    assert (
        len(lines_of([(0.2 * i, Progress("probe", i, 100, "batches")) for i in range(101)])) == 11
    )


def test_the_rate_after_a_resume_counts_only_new_steps():
    assert (
        "1 steps/s, 6m40s left"
        in lines_of(
            [(0, Progress("t", 500, 1000, "steps")), (100, Progress("t", 600, 1000, "steps"))]
        )[-1]
    )


def test_the_rate_forgets_a_slow_start():
    events = [(0.0, 0), (60.0, 1), *((60.0 + i, 1 + 10 * i) for i in range(1, 60))]
    assert "10 steps/s" in lines_of([(t, Progress("t", n, 1000, "steps")) for t, n in events])[-1]


def test_the_last_rate_is_that_of_the_whole_stage():
    events = [(0.0, 0), (60.0, 1), *((60.0 + i, 1 + 10 * i) for i in range(1, 61))]
    last = lines_of([(t, Progress("t", n, 601, "steps")) for t, n in events])[-1]
    assert last == "t: 601/601 steps (100 %), 5.01 steps/s, took 2m00s"


def test_what_is_finished_at_once_has_no_rate():
    for seconds, rate in [(0.004, ""), (1.0, ", 500 questions/s")]:
        events = [(0.0, Progress("q", 1, 501, "questions"))]
        events.append((seconds, Progress("q", 501, 501, "questions")))
        took = f"took {seconds:.0f}s"
        assert lines_of(events)[-1] == f"q: 501/501 questions (100 %){rate}, {took}"


def test_a_single_unit_has_no_rate():
    events = [(7.0 * done, Progress("train (loading)", done, 1, "model")) for done in (0, 1)]
    assert lines_of(events)[-1] == "train (loading): 1/1 model (100 %), took 7s"


def test_a_stage_that_begins_anew_is_shown_anew():
    events = [(0.0, Progress("probe", 5, 5, "batches")), (0.1, Progress("probe", 1, 5, "batches"))]
    assert [line[:11] for line in lines_of(events)] == ["probe: 5/5 ", "probe: 1/5 "]


def test_bars_show_stage_share_and_metrics():
    file = io.StringIO()
    console = Console(file=file, force_terminal=True, width=120)
    with Bars(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[figures]}"),
        console=console,
    ) as bars:
        live = Live(bars, Column(), Clock())
        live(Progress("train", 3, 4, "steps"))
        live(Progress("train", 4, 4, "steps"))
        live(Progress("train", 1, 4, "steps", {"loss": 0.5}))
    assert [(t.description, t.completed) for t in bars.tasks] == [("train", 1)]
    assert "loss 0.5" in file.getvalue()


def test_a_warning_is_shown_whole_and_progress_goes_on():
    warned = Warned("anchor", "the backbone is [sure] of" + " these answers" * 20)
    events = [
        (0.0, Progress("anchor", 1, 3, "questions")),
        (0.1, warned),
        (0.2, Progress("anchor", 3, 3, "questions")),
    ]
    assert lines_of(events)[1] == f"warning: anchor: {warned.text}"
    assert len(lines_of(events)) == 3

    file = io.StringIO()
    with Bars(console=Console(file=file, force_terminal=True, width=60)) as bars:
        live = Live(bars, Column(), Clock())
        live(Progress("anchor", 1, 3, "questions"))
        live(warned)
        assert [task.description for task in bars.tasks] == ["anchor"]
    assert f"warning: anchor: {warned.text}" in file.getvalue()


def test_a_warning_moves_no_cursor() -> None:
    assert _warning(Warned("x", "run \x1b]0;title\x07")) == (r"warning: x: run \x1b]0;title\x07")


def test_a_narrow_terminal_cuts_the_figures_and_not_the_name():
    file, names = io.StringIO(), Column(no_wrap=True)
    figures = Column(no_wrap=True, overflow="ellipsis")
    with Bars(
        TextColumn("{task.description}", table_column=names),
        BarColumn(),
        TextColumn("{task.fields[figures]}", table_column=figures),
        console=Console(file=file, force_terminal=True, width=60),
    ) as bars:
        live = Live(bars, names, Clock())
        live(Progress("stop-gradient/rollout held-out", 1, 1600, "steps", {"success": 0.5}))
        bars.refresh()
    assert "stop-gradient/rollout held-out " in file.getvalue()


def test_finished_bars_become_lines_so_that_the_one_at_work_is_seen():
    """A study has more stages than a terminal has lines, and rich shows the first bars only."""
    file = io.StringIO()
    with Bars(
        TextColumn("{task.description}"),
        console=Console(file=file, force_terminal=True, width=120, height=9),
    ) as bars:
        live = Live(bars, Column(), Clock())
        for i in range(30):
            live(Progress(f"[{i}]/train", 1, 2, "steps"))
            live(Progress(f"[{i}]/train", 2, 2, "steps", {"loss": 0.5}))
        live(Progress("study", 3, 60, "cells"))
        live(Progress("study", 1, 60, "cells"))  # starts again before its end
        bars.refresh()
    assert [(t.description, t.completed) for t in bars.tasks] == [("study", 1)]
    assert (
        file.getvalue().count("/train: 2/2 steps (100 %), took 0s, loss 0.5") == 30
        and "[29]/train: " in file.getvalue()
    )


def test_a_bar_without_an_end_is_there_while_no_stage_is_at_work() -> None:
    """While a model is loaded, between two stages; not on the terminal after the end."""
    stage = TextColumn("{task.description}")
    with Bars(stage, console=Console(file=io.StringIO(), force_terminal=True, width=80)) as bars:
        live = Live(bars, Column(), Clock())
        shown = [[task.description for task in bars.tasks]]
        for done in (0, 1, 2):
            live(Progress("train", done, 2, "steps"))
            shown.append([task.description for task in bars.tasks])
        live.end()
        assert not bars.tasks
    assert shown == [["working"], ["train"], ["train"], ["working"]]


# --- tables ---------------------------------------------------------------------------------------


def text_of(table: Any) -> str:
    console = Console(file=io.StringIO(), width=200)
    console.print(table)
    return console.file.getvalue()


@dataclass(frozen=True)
class Facts:
    memory_mb: dict[str, float]
    disk_free_mb: float
    drop_interval: tuple[float, float]
    cameras: tuple[str, ...]


def test_facts_have_units_and_figures_that_can_be_read():
    lines = text_of(
        facts(Facts({"weights": 12345.6, "gradients": 0.5}, 72041.2, (-0.25, 1.5), ()))
    ).splitlines()
    assert [" ".join(line.split()) for line in lines] == [
        "memory weights 12,346, gradients 0.5 MB",
        "disk free 72,041 MB",
        "drop interval -0.25 to 1.5 points",
    ]


def test_values_of_several_sets_stand_in_brackets_under_names_that_can_be_read() -> None:
    sets = {"arm": {"training_frames": 355, "share": 0.75}, "more": {"training_frames": 90}}
    (line,) = text_of(pairs({"sets": sets})).splitlines()
    assert line.split(maxsplit=1)[1] == (
        "arm (training frames 355, share 0.75), more (training frames 90)"
    )
    (line,) = text_of(pairs({"pictures": [[48, 64], [96, 128]]})).splitlines()
    assert line.split(maxsplit=1)[1] == "48 x 64, 96 x 128"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (1234.5678, "1235"),
        (9999.4, "9999"),
        (-54321.0, "-54,321"),
        (3e12, "3e+12"),
        (1.25e-7, "1.25e-07"),
        (None, "-"),
    ],
)
def test_large_numbers_are_whole_as_long_as_they_can_be_read(value, text):
    assert number(value) == text


def job(rows: list[SimpleNamespace]) -> SimpleNamespace:
    return SimpleNamespace(
        name="n",
        rows=rows,
        baseline_accuracy=0.95,
        majority_accuracy=0.3,
        verdict="",
        merge=None,
        out="runs/n",
    )


def test_the_summary_of_methods_that_cannot_be_rolled_out_has_no_column_of_dashes():
    unknown = ("success_seen", "success_held_out", "wrong_target", "return_share", "energy_shed")
    row = dict.fromkeys((*unknown, "step_time_ratio")) | {"others": {}, "accuracy": 0.9}
    row |= {"drop_points": 1.0, "cross_entropy": 0.2, "w2": 0.1, "validation_loss": 0.4}
    row |= {"open_loop_error": 0.25, "hold_error": None}
    text = text_of(pipeline(job([SimpleNamespace(method="naive", **row)])))
    header = "Method VQA % Drop (points) Cross-entropy (nats) Open-loop error W2² Validation loss"
    lines = [line.split() for line in text.splitlines()]
    assert header.split() in lines
    assert "naive 90.0 1.00 0.200 0.250 0.1 0.4000".split() in lines
    assert "nothing could be rolled out" in text and "holds its position" not in text


def test_the_summary_says_which_methods_are_no_better_than_a_robot_that_stands_still():
    shared = dict.fromkeys(("success_seen", "success_held_out", "wrong_target", "return_share"))
    shared |= dict.fromkeys(("energy_shed", "step_time_ratio", "w2", "validation_loss"))
    shared |= {"others": {}, "accuracy": 0.9, "drop_points": 1.0, "cross_entropy": 0.2}
    errors = {"naive": 0.2, "lora": 0.3, "aegis": 0.5}
    rows = [
        SimpleNamespace(method=method, open_loop_error=error, hold_error=0.3, **shared)
        for method, error in errors.items()
    ]
    text = text_of(pipeline(job(rows)))
    said = (
        "A robot that holds its position has an open-loop error of 0.300; not below it: lora, aegis"
    )
    assert said in text
    assert "error of 0.300\n" in text_of(pipeline(job(rows[:1])))


def test_the_summary_table_has_a_row_a_method_and_dashes_for_unknowns():
    row = dict(
        accuracy=0.932,
        drop_points=1.25,
        cross_entropy=0.21,
        success_seen=0.9,
        success_held_out=None,
        wrong_target=0.02,
        return_share=None,
        open_loop_error=None,
        hold_error=None,
        w2=12.5,
        energy_shed=0.0123,
        step_time_ratio=1.5,
        validation_loss=0.4,
        others={},
    )
    held_out = {"naive": 0.5, "aegis": None}
    rows = [
        SimpleNamespace(**row | {"method": m, "success_held_out": x}) for m, x in held_out.items()
    ]
    text = text_of(pipeline(job(rows)))
    assert "nothing could be rolled out" not in text
    cells = [line.split() for line in text.splitlines()]
    assert [
        "aegis",
        "93.2",
        "1.25",
        "0.210",
        "90.0",
        "-",
        "2.0",
        "12.5",
        "1.23",
        "1.50",
        "0.4000",
    ] in cells
    assert "VQA 95.0 %" in text and "commonest answer: 30.0 %" in text and "runs/n" in text


@dataclass(frozen=True)
class ProbeLike:
    families: dict[str, Any]
    layers: tuple[Any, ...]
    accuracy: float = 0.5
    interval: tuple[float, float] = (0.45, 0.55)
    drop_points: float | None = None


def test_the_probe_table_lists_families_and_layers():
    family = SimpleNamespace(
        accuracy=0.8, interval=(0.75, 0.85), questions=1200, majority=0.25, baseline_accuracy=None
    )
    layer = SimpleNamespace(layer=0, w2=1.5, baseline_w2=None)
    report = ProbeLike(families={"colour": family}, layers=(layer,))
    cells = [line.split() for line in text_of(probe(report)).splitlines()]
    assert ["colour", "1,200", "80.0", "75.0", "to", "85.0", "25.0", "-"] in cells
    assert ["0", "1.5"] in cells
    assert ["accuracy", "50.0", "%"] in cells
    assert ["interval", "45.0", "to", "55.0", "%"] in cells
    assert not any(line[:1] == ["drop"] for line in cells)  # for a probe without a baseline
    compared = SimpleNamespace(layer=0, w2=1.5, baseline_w2=0.5)
    said = text_of(probe(dataclasses.replace(report, layers=(compared,))))
    assert ["0", "1.5", "0.5"] in [line.split() for line in said.splitlines()]


def test_validation_episodes_are_a_table_with_their_interval() -> None:
    for acted, row in (
        ({"success": 0.2, "interval": [0.036, 0.624]}, "success % 20.0 3.6 to 62.4"),
        ({"mean_return": 83.25, "return_interval": [70.0, 96.5]}, "mean return 83.25 70 to 96.5"),
        ({"mean_return": 83.25, "return_interval": None}, "mean return 83.25 -"),
    ):
        (table,) = validation_rollout(acted)
        assert row in [" ".join(line.split()) for line in text_of(table).splitlines()]
    assert not list(validation_rollout({}))


def test_errors_of_held_out_actions_are_a_table() -> None:
    def rows(predicted: dict[str, Any]) -> list[str]:
        (table,) = validation_actions(predicted)
        lines = [" ".join(line.split()) for line in text_of(table).splitlines()]
        return [line for line in lines if line][2:]

    told = {"relative_error": 0.25, "relative_interval": [0.125, 0.5], "hold_error": 0.75}
    assert rows(told) == ["the policy's 0.25 0.125 to 0.5", "standing still 0.75"]
    alone = {"relative_error": 0.25, "relative_interval": None, "hold_error": None}
    assert rows(alone) == ["the policy's 0.25 -"]
    assert not list(validation_actions({}))


def test_the_pretraining_table_lists_families():
    alone = PretrainReport(0.5, {"colour": 0.9312}, 0.1, 700, 10, 5, "vlm")
    both = dataclasses.replace(alone, easy_vqa=Scores(0.75, {"exists": 0.8125}, 0.1, 90))
    for report, others in ((alone, False), (both, True)):
        cells = [line.split() for line in text_of(pretrain(report)).splitlines()]
        assert ["colour", "93.1"] in cells and ["accuracy", "50.0", "%"] in cells
        assert (["exists", "81.2"] in cells) == (["accuracy", "75.0", "%"] in cells) == others


# --- studies --------------------------------------------------------------------------------------


def test_a_studys_tables_have_a_line_a_variant_with_mean_and_interval() -> None:
    report = found(("naive", "cotrain", "x"))
    text, result = text_of(study(report)), report.tasks[0].results[2]
    lines = [line for line in text.splitlines() if line.startswith(" x ")]
    assert len(lines) == 3 and text.count("\n naive ") == 2  # none against itself
    half = result.success_seen.interval[1] - result.success_seen.mean
    assert (
        f"{100 * result.success_seen.mean:.1f} ±{100 * half:.1f} " in lines[0]
        and "rank 16" in lines[0]
    )
    gain = result.seen_gain_points
    assert (
        lines[1].split()[-2:] == ["1.50", "2.00"]
        and f"{gain.mean:+.1f} ±{gain.interval[1] - gain.mean:.1f} " in lines[2]
    )
    assert lines[2].split()[-3:] == [
        "no",
        "yes",
        "no",
    ]  # too slow, without VQA data, so below the bar
    assert next(line for line in text.splitlines()[::-1] if line.startswith(" cotrain ")).split()[
        -2:
    ] == ["no", "-"]
    assert (
        "1 of 2 trainings" in text
        and "within 3 points" in text
        and "runs/n" in text
        and "VQA drop <= 0.1 points" in text
    )
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 120


def test_a_study_without_naive_or_several_seeds_says_so() -> None:
    text = text_of(study(found(("a", "x"), seeds=1, tuned=False)))
    assert "no variant is named naive" in text and "±" not in text.split("before fine-tuning")[0]
    assert sum(line.startswith(" x ") for line in text.splitlines()) == 2 and "knobs" not in text


def test_a_study_of_naive_alone_has_no_bar_and_says_nothing_of_one() -> None:
    text = text_of(study(found(("naive",), tuned=False)))
    assert "no variant is named naive" not in text and "bar:" not in text


def test_what_diverged_is_said_and_not_drawn() -> None:
    report = found(("naive", "a", "x"), diverged={"a": {1, 4}, "x": set(range(5))})
    lost = dataclasses.replace(
        report.tuning[0], variant="x", value=64, accuracy=None, baseline_accuracy=None, success=None
    )
    report = dataclasses.replace(report, tuning=[lost, *report.tuning])
    text = text_of(study(report))
    assert "a: diverged with seed 1, 4;" in text and "naive: diverged" not in text
    assert next(line for line in text.splitlines() if line.startswith(" x ")).split() == [
        "x",
        "rank",
        "16",
        *5 * "-",
    ]
    figure = frontier._figure(report)
    stars = [line for line in figure.axes[0].lines if line.get_marker() == "*"]
    assert len(stars) == 2
    assert "64" not in [text.get_text() for axis in figure.axes for text in axis.texts]


def test_a_study_that_diverged_altogether_has_tables_and_no_frontier(tmp_path: Path) -> None:
    report = found(
        ("naive", "x"), tuned=False, diverged={"naive": set(range(5)), "x": set(range(5))}
    )
    assert "before fine-tuning: VQA - %" in text_of(study(report))
    assert not render.has_frontier(report) and render.has_frontier(
        found(("naive", "x"), tuned=False)
    )
    with pytest.raises(AegisError, match="no variant with both"):
        render.frontier_plot(report, tmp_path / "frontier.png")
    assert not list(tmp_path.iterdir())


def test_a_view_as_markdown_has_its_titles_tables_and_notes() -> None:
    table = plain_table(("Method", "VQA %"), [("a|b", "97.3"), ("naive", "-")])
    table.title = "Kept"
    view = Group(Text("name", "bold"), table, Group(Text("first line\n  that goes on\nsecond\n")))
    assert markdown(view) == (
        "**name**\n\n**Kept**\n\n| Method | VQA % |\n| --- | ---: |\n| a\\|b | 97.3 |\n| naive "
        "| - |\n\n"
        "first line that goes on\n\nsecond\n"
    )
    with pytest.raises(TypeError, match="neither a table nor a text: a str"):
        markdown("text")


def plain(cells: Sequence[Any]) -> list[str]:
    return [str(cell) for cell in cells]


@pytest.mark.parametrize(
    ("values", "more_is_better", "expected"),
    [
        ([1.0, 3.0, 2.0], True, ["!1.0", "*3.0", "2.0"]),
        ([1.0, 3.0, 2.0], False, ["*1.0", "!3.0", "2.0"]),
        ([1.0, 3.0, 2.0], None, ["1.0", "3.0", "2.0"]),
        ([1.0, None, 2.0], True, ["1.0", "-", "*2.0"]),
        ([1.0, 1.0, 0.5, 0.7], True, ["*1.0", "*1.0", "!0.5", "0.7"]),
        ([1.01, 1.04, 0.5, 0.7], True, ["*1.0", "*1.0", "!0.5", "0.7"]),
        ([1.0, 1.0], True, ["1.0", "1.0"]),
        ([None, None], True, ["-", "-"]),
    ],
)
def test_the_best_and_the_worst_of_a_column_are_marked(
    values: list[float | None], more_is_better: bool | None, expected: list[str]
) -> None:
    cells = ["-" if value is None else f"{value:.1f}" for value in values]
    assert plain(marked(cells, values, more_is_better)) == expected


def test_what_rounds_to_nothing_has_no_sign() -> None:
    values = [-3e-16, 0.0, 1.0]
    assert plain(marked([fixed(v, 2) for v in values], values, False)) == ["*0.00", "*0.00", "1.00"]
    assert [fixed(-0.004, 2), fixed(-0.006, 2), percent(-1e-9)] == ["0.00", "-0.01", "0.0"]


def test_the_best_of_a_column_is_bold_in_markdown() -> None:
    cells = marked(["1", "2", "3"], [1.0, 2.0, 3.0], True)
    table = plain_table(("Method", "VQA %"), zip("abc", cells, strict=True))
    assert markdown(table).endswith("| a | 1 |\n| b | 2 |\n| c | **3** |\n")


def test_wide_tables_stay_whole_on_narrow_terminals(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "30")
    header = [f"Column {i}" for i in range(12)]
    view = lambda _: plain_table(header, [[f"cell{i}" for i in range(12)]])  # noqa: E731
    for wide, parts in ((True, 1), (False, 12)):
        render.show(SimpleNamespace(), view, False, wide)
        lines = capsys.readouterr().out.splitlines()
        shown = [line for line in lines if "cell0" in line]
        assert (len(shown) == 1) is wide and len(shown) <= parts
        assert wide == any("cell5" in line and "cell11" in line for line in shown)


# --- the open-loop error --------------------------------------------------------------------------


def open_loop_report(**changes: Any) -> OpenLoopReport:
    dimension = DimensionError("pan", None, 0.5, 0.75, 1.25, 1.5, 0.875, 0.36, [0.7, 0.8])
    steps = [StepError(h, 40 - h, 0.1 * h, 0.05 * h) for h in range(1, 31)]
    report = OpenLoopReport(
        "arm", "chosen", [3, 4], [4], 19, 30, 0, 0.36, (0.3, 0.42), 0.49, [dimension], steps
    )
    return dataclasses.replace(report, **changes)


def test_what_a_run_knows_of_open_loop_errors_says_which_episodes_they_are_of() -> None:
    figures = {"data": "arm", "split": "validation", "episodes": [1, 2], "trained_on": []}
    figures |= {"relative_error": 0.25, "relative_interval": None, "frames": 1000}
    evaluated = Result("evaluate-validation-arm", figures, {})
    shown = text_of(render.inspect(InspectReport("run", "x", {}, open_loops=(evaluated,))))
    assert re.search(r"2 held-out episodes of arm +0\.250 +- +- +1,000", shown)
    assert "nothing is measured" not in shown


def test_a_long_instruction_is_cut_in_the_table_and_whole_in_json() -> None:
    long = InstructionError("put the cube " * 99, 2, 30, 1.0, (0.5, 1.5), 0.25)
    report = open_loop_report(instructions=[long, *instruction_errors(1)])
    shown = text_of(render.open_loop(report))
    assert "put the cube put" in shown and "…" in shown and shown.count("put the cube") < 9
    assert report.to_json()["instructions"][0]["instruction"] == long.instruction


@pytest.mark.parametrize(("task", "advised"), [("reach", True), (None, False)])
def test_no_rollout_is_advised_of_a_robot_that_is_not_simulated(
    task: str | None, advised: bool
) -> None:
    shown = text_of(render.inspect(InspectReport("run", "x", {"task": task})))
    assert "nothing is measured yet" in shown and "aegis evaluate" in shown
    assert ("aegis rollout" in shown) is advised


def test_a_run_that_has_gone_on_says_which_steps_were_measured() -> None:
    shown = text_of(render.inspect(InspectReport("run", "x", {"measured_before": [200, 220]})))
    assert "measured at steps 200, 220, not at the last checkpoint" in shown
    assert "nothing is measured" not in shown and "measured before" not in shown


def test_maps_that_share_a_spectrum_are_rows_of_the_table_alone() -> None:
    facts = {"samples": 3, "shared": {"inputs.k_proj": "inputs.q_proj"}}
    shown = text_of(render.inspect(InspectReport("anchor", "x", facts)))
    assert "samples" in shown and "shared" not in shown and "k_proj" not in shown
    first = SiteSpectrum("layers.0.q_proj", "dense", 4, (1, 2, 3), 4)
    other = replace(first, name="layers.0.k_proj", same_as="layers.0.q_proj")
    shown = text_of(render.inspect(InspectReport("anchor", "x", facts, inputs=(first, other))))
    lines = [line.split() for line in shown.splitlines() if "dense" in line]
    assert lines[0][-2:] == ["3", "4"] and lines[1][-3:] == ["3", "with", "q_proj"]


@pytest.mark.parametrize(("step_time", "shown"), [(1.0204, "1.0204 no"), (1.9, "1.90 no")])
def test_a_step_time_beside_its_verdict_has_the_digits_that_decide(
    step_time: float, shown: str
) -> None:
    made = found(("naive", "x"), 5)
    result = replace(made.tasks[0].results[1], step_time=step_time)
    made.tasks[0].results[1] = replace(result, bar=bar(POLICY_BAR, result))
    assert shown in text_of(study(made))


def test_layers_of_which_nothing_learned_are_named_as_train_freeze_takes_them() -> None:
    rows = LayerEnergy("layers.3", 0.1, 0.2, 0.5)
    frozen = tuple(f"layers.{i}" for i in (0, 1, 2, 4, 10, 11))
    told = {"layers": (rows,), "over_time": (Bin(1, 2, 0.1, (0.1,)),)}
    shown = text_of(render.inspect(InspectReport("ledger", "x", {}, frozen=frozen, **told)))
    assert "nothing learned in layers.0-2, layers.4, layers.10-11\n" in shown
    assert "nothing learned" not in text_of(
        render.inspect(InspectReport("ledger", "x", {}, **told))
    )


@pytest.mark.parametrize(("kept", "said"), [(0.0, "0.0 % of the displacement"), (None, None)])
def test_a_merge_all_the_way_back_keeps_none_of_the_displacement(
    kept: float | None, said: str | None
) -> None:
    strength, out = (None, None) if kept is None else (1.0, "merged")
    report = MergeReport(
        "linear", 0.01, "run", "embedded", strength, kept, None, None, out, 0, None
    )
    shown = " ".join(text_of(render.merge(report)).split())
    assert (f"kept {said}" in shown) if said else "kept" not in shown


def test_the_probe_of_a_merge_asks_what_the_sweep_has_asked() -> None:
    """Without its set the command would ask a Hugging Face model about our drawn scenes."""
    point = MergePoint(0.4, 0.6, 0.9, 0.5, (-1.0, 2.0))
    asked: list[tuple[str | None, str | None, str]] = [
        ("my set.jsonl", "{} Be brief.", " --vqa 'my set.jsonl' --ask '{} Be brief.'"),
        ("scenes", "{}", ""),
    ]
    for vqa, ask, said in asked:
        report = MergeReport(
            *("linear", 0.01, "tuned", "vlm", 0.4, 0.6, 1.0, True, "merged", 18, 1.0, (point,)),
            vqa=vqa,
            ask=ask,
        )
        last = text_of(render.merge(report)).splitlines()[-1].strip()
        assert last.endswith(f"aegis probe merged --baseline vlm{said}")


def test_a_merge_is_told_without_what_was_not_measured() -> None:
    merged = {"method": "linear", "strength": 0.5, "validation_loss": None}
    (line,) = text_of(render.inspect(InspectReport("run", "x", {"merge": merged}))).splitlines()[
        2:3
    ]
    assert line.split() == "merge method linear, strength 0.5".split()
    merged["validation_loss"] = 0.25
    assert "validation loss 0.25" in text_of(
        render.inspect(InspectReport("run", "x", {"merge": merged}))
    )


def test_a_single_episode_is_no_number_of_episodes() -> None:
    shown = text_of(open_loop(open_loop_report(episodes=[3])))
    assert re.search(r"^episode +3 *$", shown, re.M) and "episodes " not in shown


def test_open_loop_errors_by_dimension_and_by_some_of_the_steps() -> None:
    shown = text_of(open_loop(open_loop_report()))
    assert re.search(r"relative error +0\.360 \(0\.300 to 0\.420\); hold's 0\.\d+", shown)
    assert re.search(r"trained on +4\b", shown) and "Hold's RMSE" in shown
    assert re.search(r"pan +0\.5 +0\.75 +1\.25 +0\.360 +0\.875", shown)
    steps = [int(m[1]) for m in re.finditer(r"^ +(\d+) +\d+ +\d\.\d+ +\d\.\d+ *$", shown, re.M)]
    assert len(steps) == 16 and (steps[0], steps[-1]) == (1, 30)
    assert "16 of 30 steps ahead" in shown


def test_steps_ahead_are_told_in_seconds_where_the_control_rate_is_known() -> None:
    unknown = text_of(open_loop(open_loop_report()))
    assert "Seconds" not in unknown and not re.search(r"^fps", unknown, re.M)
    shown = text_of(open_loop(open_loop_report(fps=15.0)))
    assert re.search(r"^fps +15 *$", shown, re.M)
    assert re.search(r"Steps ahead +Seconds +Frames +Relative error +Hold's", shown)
    assert re.search(r"^ +3 +0\.200 +37 +0\.300 +0\.150 *$", shown, re.M)


def instruction_errors(count: int) -> list[InstructionError]:
    return [
        InstructionError(f"put {i}", 2, 30, 1.0 - i / 100, (0.5, 1.5), 0.25) for i in range(count)
    ]


def test_open_loop_errors_of_the_worst_instructions_where_there_are_several() -> None:
    one = text_of(open_loop(open_loop_report(instructions=instruction_errors(1))))
    assert "Instruction" not in one
    few = text_of(open_loop(open_loop_report(instructions=instruction_errors(2))))
    assert re.search(r"put 1 +2 +30 +0\.990 +0\.500 to 1\.500 +0\.250", few)
    assert "the worst" not in few
    many = text_of(open_loop(open_loop_report(instructions=instruction_errors(43))))
    assert re.findall(r"put (\d+)", many) == [str(i) for i in range(10)]
    assert "the worst 10 of 43 instructions; --json has all" in many


def test_a_rollouts_colours_and_instructions_are_shown_the_worst_first() -> None:
    parts = {f"go {i}": PartSuccess(i / 12, (0.0, 1.0), 4) for i in range(12, 0, -1)}
    colors = {"blue": PartSuccess(0.75, (0.5, 1.0), 8), "red": PartSuccess(0.25, (0.0, 0.5), 8)}
    report = RolloutReport(
        task="reach",
        success=0.5,
        interval=(0.25, 0.75),
        target_colors=colors,
        instructions=parts,
        episodes=16,
        episodes_per_s=1.0,
    )
    shown = text_of(render.measured(report))
    assert re.search(r"Target.*\n.*\n +red +25\.0.*\n +blue +75\.0", shown)
    assert re.findall(r"^ go (\d+) ", shown, re.M) == [str(i) for i in range(1, 11)]
    assert "the worst 10 of 12 instructions" in shown


def test_what_an_open_loop_report_lacks_has_no_column() -> None:
    dimension = DimensionError("pan", "rad", 0.5, 0.75, 0.0, 0.25, None, None, [0.7])
    bare = open_loop_report(
        trained_on=[],
        relative_error=None,
        relative_interval=None,
        hold_error=None,
        dimensions=[dimension],
        horizon=[StepError(1, 3, None, None)],
    )
    shown = text_of(open_loop(bare))
    assert "Hold" not in shown and "trained on" not in shown and "hold:" not in shown
    assert re.search(r"relative error +-", shown) and re.search(r"pan +rad +0\.5 +0\.75", shown)


def test_lines_end_with_what_can_be_seen_in_colour_too(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "40")
    table = plain_table(["one", "two words and more of them", "three"], [["1", "2", ""]])
    render.show(Words("x"), lambda _: table, as_json=False)
    printed = capsys.readouterr().out
    assert "\x1b[1m" in printed
    seen = re.sub(r"\x1b\[[0-9;]*m", "", printed).splitlines()
    assert seen == [line.rstrip() for line in seen] and len(seen) > 3


@pytest.mark.parametrize(
    ("value", "text"),
    [(-0.06, "-0.1"), (-0.04, "0.0"), (0.0, "0.0"), (0.04, "0.0"), (0.06, "+0.1"), (None, "-")],
)
def test_a_difference_that_rounds_to_nothing_has_no_sign(value: float | None, text: str) -> None:
    assert shown_as(Declared("Gain (points)", 1, signed=True))(value) == text
