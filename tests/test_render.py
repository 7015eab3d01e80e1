"""Progress and tables, as text."""

from __future__ import annotations

import io
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bars

from aegis_cli.events import Progress
from aegis_cli.render.progress import Lines, Live
from aegis_cli.render.tables import pipeline, pretrain, probe


# --- progress --------------------------------------------------------------------------------------------------


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def lines_of(events: list[tuple[float, Progress]]) -> list[str]:
    file, clock = io.StringIO(), Clock()
    show = Lines(file, clock)
    for clock.now_s, event in events:
        show(event)
    return file.getvalue().splitlines()


def test_lines_are_throttled_and_carry_rate_and_remaining_time():
    lines = lines_of([(0.5 * i, Progress("train", i, 1000, "steps", {"loss": 1 / (i + 1)})) for i in range(1001)])
    assert lines[0] == "train: 0/1,000 steps (0 %), loss 1"
    assert lines[1] == "train: 20/1,000 steps (2 %), 2 steps/s, 8m10s left, loss 0.04762"
    assert lines[-1] == "train: 1,000/1,000 steps (100 %), 2 steps/s, took 8m20s, loss 0.000999"
    assert len(lines) == 51  # one every 10 s of 500 s, and the first


def test_a_fast_stage_prints_a_tenth_at_a_time_but_not_more_than_a_line_a_second():
    assert len(lines_of([(0.03 * i, Progress("probe", i, 100, "batches")) for i in range(101)])) == 4
    assert len(lines_of([(0.2 * i, Progress("probe", i, 100, "batches")) for i in range(101)])) == 11


def test_the_rate_after_a_resume_counts_only_new_steps():
    assert "1 steps/s, 6m40s left" in lines_of([(0, Progress("t", 500, 1000, "steps")), (100, Progress("t", 600, 1000, "steps"))])[-1]


def test_the_rate_forgets_a_slow_start():
    events = [(0.0, 0), (60.0, 1), *((60.0 + i, 1 + 10 * i) for i in range(1, 60))]
    assert "10 steps/s" in lines_of([(t, Progress("t", n, 1000, "steps")) for t, n in events])[-1]


def test_a_stage_that_begins_anew_is_shown_anew():
    events = [(0.0, Progress("probe", 5, 5, "batches")), (0.1, Progress("probe", 1, 5, "batches"))]
    assert [line[:11] for line in lines_of(events)] == ["probe: 5/5 ", "probe: 1/5 "]


def test_bars_show_stage_share_and_metrics():
    file = io.StringIO()
    console = Console(file=file, force_terminal=True, width=120)
    with Bars(TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[figures]}"), console=console) as bars:
        live = Live(bars, Clock())
        live(Progress("train", 3, 4, "steps"))
        live(Progress("train", 4, 4, "steps"))
        live(Progress("train", 1, 4, "steps", {"loss": 0.5}))
    assert [(t.description, t.completed) for t in bars.tasks] == [("train", 4), ("train", 1)]
    assert "loss 0.5" in file.getvalue()


# --- tables ------------------------------------------------------------------------------------------------------


def text_of(table: Any) -> str:
    console = Console(file=io.StringIO(), width=200)
    console.print(table)
    return console.file.getvalue()


def test_the_summary_table_has_a_row_a_method_and_dashes_for_unknowns():
    row = dict(accuracy=0.932, drop_points=1.25, cross_entropy=0.21, success_seen=0.9, success_held_out=None, w2=12.5,
               energy_shed=0.0123, step_time_ratio=1.5, validation_loss=0.4)  # fmt: skip
    rows = [SimpleNamespace(method=m, **row) for m in ("naive", "aegis")]
    text = text_of(pipeline(SimpleNamespace(name="n", rows=rows, baseline_accuracy=0.95, majority_accuracy=0.3, out="runs/n")))
    cells = [line.split() for line in text.splitlines()]
    assert ["aegis", "93.2", "1.25", "0.210", "90.0", "-", "12.5", "1.23", "1.50", "0.4000"] in cells
    assert "VQA 95.0 %" in text and "commonest answer: 30.0 %" in text and "runs/n" in text


@dataclass(frozen=True)
class ProbeLike:
    families: dict[str, Any]
    layers: tuple[Any, ...]
    accuracy: float = 0.5
    interval: tuple[float, float] = (0.45, 0.55)
    drop_points: float | None = None


def test_the_probe_table_lists_families_and_layers():
    family = SimpleNamespace(accuracy=0.8, interval=(0.75, 0.85), questions=1200, majority=0.25, baseline_accuracy=None)
    report = ProbeLike(families={"colour": family}, layers=(SimpleNamespace(layer=0, w2=1.5),))
    cells = [line.split() for line in text_of(probe(report)).splitlines()]
    assert ["colour", "1,200", "80.0", "75.0", "to", "85.0", "25.0", "-"] in cells
    assert ["0", "1.5"] in cells
    assert ["accuracy", "50.0", "%"] in cells and ["interval", "45.0", "to", "55.0", "%"] in cells and ["drop", "-"] in cells


def test_the_pretraining_table_lists_families():
    cells = [line.split() for line in text_of(pretrain(ProbeLike(families={"colour": 0.9312}, layers=()))).splitlines()]
    assert ["colour", "93.1"] in cells
