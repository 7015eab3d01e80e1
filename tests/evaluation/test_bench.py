"""The benchmark times the code that commands run, and reports ratios.

No value is asserted, only that it is a number.
"""

from __future__ import annotations

import dataclasses
import io
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from rich.console import Console
from samples.small_run import recipe

from aegis_cli import Guard
from aegis_cli.cli import render
from aegis_cli.common import memory
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Progress
from aegis_cli.evaluation import bench, bench_runs
from aegis_cli.guard.guard import METHODS as METHODS_OF_GUARD
from aegis_cli.methods import METHODS
from aegis_cli.recipes import Demos


def test_times_are_medians_of_the_rounds_after_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    now, order, events = [0.0], [], []

    def part(name: str, seconds: list[float]) -> Callable[[], None]:
        coming: Iterator[float] = iter(seconds)

        def call() -> None:
            order.append(name)
            now[0] += next(coming)

        return call

    monkeypatch.setattr(bench_runs, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    parts = {"a": part("a", [100, 1, 9, 2]), "b": part("b", [100, 5, 4, 60])}
    ready = {"b": part("ready", [1000] * 4)}  # is not timed
    assert bench_runs.take_turns("x", parts, 3, events.append, ready) == {"a": 2, "b": 5}
    assert order == ["a", "ready", "b"] * 4
    assert [(e.stage, e.done, e.total) for e in events] == [("x", i, 4) for i in (1, 2, 3, 4)]


@pytest.mark.usefixtures("quick_workers")
def test_costs_are_ratios_to_the_entry_named_naive(tiny_folder: Path, anchor_file: Path) -> None:
    small = recipe(tiny_folder)
    large = dataclasses.replace(
        small, train=dataclasses.replace(small.train, method="aegis", batch_size=128)
    )
    events: list[Progress] = []
    costs = bench.compare({"large": large, "naive": small}, anchor_file, events.append, repeats=1)
    assert costs["naive"].step_time == costs["naive"].peak_memory == 1
    assert costs["large"].step_time == pytest.approx(costs["large"].step_s / costs["naive"].step_s)
    assert costs["large"].step_time > 1 and costs["large"].peak_memory > 1  # 32 times the frames
    assert [(e.stage, e.done) for e in events] == [("bench steps", i) for i in (1, 2)] + [
        ("bench memory", i) for i in (1, 2)
    ]


def test_every_method_is_compared_with_naive(
    tiny_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def invented(function: object, recipe: bench.Recipe, *_: Path) -> int:
        assert function is bench.peak_memory
        asked.append(recipe.train.method)
        return 2 if recipe.train.method == "naive" else 3

    monkeypatch.setattr(bench, "in_new_process", invented)  # starting ten processes takes long
    monkeypatch.setattr(bench, "_QUESTIONS", 14)
    report = bench.run(str(tiny_folder), batch_size=2, repeats=1, guard=Guard)
    assert asked == list(METHODS)
    assert (
        list(report.step_time) == list(report.peak_memory) == list(report.step_s) == list(METHODS)
    )
    assert (
        report.step_time["naive"] == report.peak_memory["naive"] == 1
        and report.peak_memory["aegis"] == 1.5
    )
    assert all(ratio > 0 for ratio in report.step_time.values())
    assert report.step_time["aegis"] == pytest.approx(
        report.step_s["aegis"] / report.step_s["naive"]
    )
    assert report.anchor_throughput > 0
    assert report.guard is not None and list(report.guard.step_time) == list(METHODS_OF_GUARD)
    assert report.guard.backward > 0 and all(ratio > 0 for ratio in report.guard.step_time.values())
    assert json.loads(json.dumps(report.to_json())) == report.to_json()


def test_some_methods_are_compared_alone_with_keys_of_ones_own(
    tiny_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[bench.Recipe] = []

    def invented(_: object, recipe: bench.Recipe, *__: Path) -> int:
        asked.append(recipe)
        return 1

    monkeypatch.setattr(bench, "in_new_process", invented)
    keys = ["aegis.refresh=4", "train.batch_size=3"]
    report = bench.run(str(tiny_folder), repeats=1, guard=Guard, chosen=["aegis"], overrides=keys)
    assert list(report.step_time) == [recipe.train.method for recipe in asked] == ["naive", "aegis"]
    assert report.batch_size == 3 and report.guard is None
    assert {(recipe.aegis.refresh, recipe.train.batch_size) for recipe in asked} == {(4, 3)}


@pytest.mark.parametrize(
    ("chosen", "key"),
    [(["nothing"], "aegis.refresh=4"), ([], "aegis.nothing=4"), ([], "train.method=aegis")]
    + [([], "backbone=embedded-easy")],
)
def test_methods_and_keys_of_no_use_are_refused_before_any_work(
    chosen: list[str], key: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench.backbones, "load", lambda _: pytest.fail("a backbone is loaded"))
    with pytest.raises(AegisError):
        bench.run("embedded", chosen=chosen, overrides=[key])


def test_a_step_is_that_of_training(
    tiny_folder: Path, anchor_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[int, object]] = []
    real = bench_runs.train.update
    monkeypatch.setattr(
        bench_runs.train,
        "update",
        lambda run, index, *rest: (calls.append((index, run)), real(run, index, *rest)),
    )
    chosen = recipe(tiny_folder, method="nullspace")
    bench_runs.save_demos(tmp_path, chosen.task)
    steps = bench_runs.stepper(chosen, anchor_file, tmp_path)
    assert steps.in_turn == chosen.nullspace.every > 1  # one projection per turn
    steps.turn(), steps.turn()
    assert [index for index, _ in calls] == list(range(2 * steps.in_turn))
    training = calls[0][1]
    assert training.parts.constrain is not None
    assert training.policy.expert.shape.width == chosen.expert.width


class Invented:
    """Steps that each take `seconds` on a clock, on a machine that slows down."""

    def __init__(self, name: str, seconds: float, in_turn: int, shared: Shared) -> None:
        self.name, self.seconds, self.in_turn, self.shared = name, seconds, in_turn, shared

    def one(self) -> None:
        self.shared.now_s += self.seconds * self.shared.slowness
        self.shared.slowness *= self.shared.drift
        self.shared.taken.append(self.name)


@dataclasses.dataclass
class Shared:
    """A clock, the machine's current slowness, and the order in which steps were taken."""

    drift: float
    now_s: float = 0.0
    slowness: float = 1.0
    taken: list[str] = dataclasses.field(default_factory=list)


@pytest.mark.parametrize("drift", [1.0, 1.002, 0.998])
def test_each_step_is_timed_beside_one_of_the_references(
    drift: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the machine slows down to a third meanwhile, no ratio changes by a thousandth."""
    shared = Shared(drift)
    monkeypatch.setattr(bench_runs, "time", SimpleNamespace(perf_counter=lambda: shared.now_s))
    naive = Invented("naive", 2.0, 1, shared)
    others = {"kfac": Invented("kfac", 2.1, 4, shared), "odd": Invented("odd", 3.0, 3, shared)}
    events: list[Progress] = []
    step_s, ratios = bench_runs.beside("x", naive, others, 27, events.append)
    assert ratios == pytest.approx({"kfac": 1.05, "odd": 1.5}, rel=1e-3)
    assert drift != 1 or step_s == 2
    # Whole turns, and at least the four steps of kfac.
    pair, back = ["kfac", "naive"], ["naive", "kfac"]
    odd, odd_back = ["odd", "naive"], ["naive", "odd"]
    of_a_round = 2 * (pair + back) + 3 * (odd + odd_back)
    assert shared.taken == 28 * of_a_round
    assert [(e.stage, e.done, e.total) for e in events] == [("x", i + 1, 56) for i in range(56)]


@pytest.mark.usefixtures("quick_workers")
def test_naive_alone_is_timed(tiny_folder: Path, anchor_file: Path) -> None:
    costs = bench.compare({"naive": recipe(tiny_folder)}, anchor_file, repeats=1)
    assert list(costs) == ["naive"] and costs["naive"].step_time == 1 and costs["naive"].step_s > 0


def test_a_recipe_that_would_diverge_can_be_timed(
    tiny_folder: Path, anchor_file: Path, tmp_path: Path
) -> None:
    chosen = recipe(tiny_folder, backbone_lr=1e30, expert_lr=1e30, warmup=0)
    bench_runs.save_demos(tmp_path, chosen.task)
    steps = bench_runs.stepper(chosen, anchor_file, tmp_path)
    for _ in range(4):
        steps.turn()
    training, batch = bench_runs.begun(chosen, anchor_file, tmp_path)
    before = [p.detach().clone() for p in training.policy.parameters()]
    bench_runs.train.update(training, 3, batch, bench_runs.train.Window())
    assert all(map(torch.equal, before, training.policy.parameters()))


@pytest.mark.parametrize(
    "changes",
    [{"demos": Demos(path="a folder", camera="top")}, {"task": "suite/cartpole-balance"}],
    ids=["camera", "suite"],
)
def test_whatever_a_recipe_learns_from_its_step_can_be_timed(
    changes: dict[str, Any], tiny_folder: Path, anchor_file: Path, tmp_path: Path
) -> None:
    chosen = dataclasses.replace(recipe(tiny_folder), **changes)
    bench_runs.save_demos(tmp_path, chosen.task)
    bench_runs.stepper(chosen, anchor_file, tmp_path).turn()


# --- processes of their own -----------------------------------------------------------------------


@pytest.mark.usefixtures("quick_workers")
def test_memory_is_not_that_of_the_process_that_asks() -> None:
    size, cpu = 1_000_000_000, torch.device("cpu")
    ballast = bytearray(size)
    assert memory.peak(cpu) > size > bench.in_new_process(memory.peak, cpu) > 0
    del ballast


@pytest.mark.usefixtures("quick_workers")
def test_an_error_in_a_process_comes_back_and_a_death_is_one() -> None:
    with pytest.raises(json.JSONDecodeError):
        bench.in_new_process(json.loads, "{")
    with pytest.raises(AegisError, match="process that measures memory died"):
        bench.in_new_process(os._exit, 1)


@pytest.mark.usefixtures("quick_workers")
def test_a_users_error_in_a_process_comes_back_whole(tmp_path: Path) -> None:
    with pytest.raises(AegisError, match="no backbone at") as raised:
        bench.in_new_process(bench.backbones.locate, str(tmp_path / "none"))
    assert raised.value.fix


# --- what a user sees -----------------------------------------------------------------------------


def test_the_table_has_ratios_and_no_seconds() -> None:
    times, memory, seconds = (
        {"naive": 1.0, "aegis": 1.254},
        {"naive": 1.0, "aegis": 1.5},
        {"naive": 0.123, "aegis": 0.154},
    )
    guard = bench.GuardCost({"aegis": 1.014, "nullspace": 1.0}, 1.71)
    report = bench.BenchReport(0.97, times, memory, seconds, guard, batch_size=32, repeats=9)
    file = io.StringIO()
    Console(file=file, width=160).print(render.bench(report))
    lines = file.getvalue().splitlines()
    assert any(line.split() == ["aegis", "1.25", "1.50"] for line in lines)
    assert "anchor pass: 0.97 x" in file.getvalue() and "0.123" not in file.getvalue()
    assert (
        "aegis 1.01, nullspace 1.00 x the step of aegis train; backward 1.71 x loss.backward()"
        in file.getvalue()
    )
