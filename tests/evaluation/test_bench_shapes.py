"""The benchmark of real shapes, on small ones and in this process."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from rich.console import Console
from samples.shapes import small

from aegis_cli.cli import render
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Progress
from aegis_cli.evaluation import bench_shapes
from aegis_cli.evaluation.peaks import peak_of
from aegis_cli.methods.base import Parts
from aegis_cli.methods.stepper import Stepper
from aegis_cli.models.backbones import shapes

NAME = "smolvlm2-256m"


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The small shape, measured in this process; returns the names of what was measured."""
    asked: list[str] = []

    def in_this_process(_: object, work: Callable[..., Any], *arguments: Any) -> Any:
        asked.append(work.__name__)
        return bench_shapes._unless_full(work, *arguments)[0]

    monkeypatch.setitem(shapes.SHAPES, NAME, small(NAME))
    monkeypatch.setattr(bench_shapes._Processes, "run", in_this_process)
    return asked


def shown(report: bench_shapes.ShapeReport) -> str:
    file = io.StringIO()
    Console(file=file, width=160).print(render.bench_shape(report))
    return file.getvalue()


def test_each_method_and_each_part_that_it_reads_has_its_costs(here: list[str]) -> None:
    events: list[Progress] = []
    found = bench_shapes.run(
        NAME,
        ["nullspace", "aegis", "lora"],
        turns=1,
        overrides=["train.precision=float32", "expert.width=16"],
        on_event=events.append,
    )
    assert here == ["_measure_part"] * 2 + ["_measure_method"] * 4
    assert list(found.methods) == ["naive", "lora", "aegis", "nullspace"]
    assert list(found.anchor) == ["inputs", "moments"]
    assert [(e.done, e.total) for e in events] == [(i, 6) for i in range(1, 7)]
    # What an interruption would lose is reported as soon as it is known.
    assert events[-1].metrics["nullspace s"] == found.methods["nullspace"].step_s
    naive, aegis = found.methods["naive"], found.methods["aegis"]
    assert naive.step_time == naive.peak_memory == 1 and naive.mfu is None
    assert naive.step_s is not None and aegis.step_s is not None
    assert aegis.step_time == aegis.step_s / naive.step_s
    # The second backward pass goes only through the backbone.
    assert aegis.tflop is not None and naive.tflop is not None
    assert 1 < aegis.tflop / naive.tflop < 5 / 3
    # Of these, only nullspace has work between the passes that is timed separately.
    assert naive.own_share is None is aegis.own_share
    constrained = found.methods["nullspace"]
    assert constrained.own_share is not None
    assert 0 < constrained.own_share < constrained.step_time
    assert found.anchor["inputs"].question_s > 0 and found.anchor["inputs"].megabytes > 0
    assert found.batch_size == 2 and found.tokens == 4 + 7  # an image's tokens, and the words
    assert found.precision == "float32" and found.clock == "cpu" and found.assumed is None
    assert json.loads(json.dumps(found.to_json()))["methods"]["naive"]["step_time"] == 1
    assert "peak not known" in shown(found) and "CPU seconds" in shown(found)


@pytest.mark.usefixtures("quick_workers")
def test_on_a_cpu_each_measurement_has_a_process_of_its_own() -> None:
    with bench_shapes._Processes() as processes:
        found = {processes.run(os.getpid), processes.run(os.getpid), os.getpid()}
    assert len(found) == 3


def test_what_does_not_fit_has_dashes_and_the_rest_goes_on(
    here: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    real = bench_shapes._measure_method

    def full(recipe: Any, *rest: Any) -> Any:
        if recipe.train.method == "lora":
            raise torch.OutOfMemoryError("no more")
        return real(recipe, *rest)

    monkeypatch.setattr(bench_shapes, "_measure_method", full)
    found = bench_shapes.run(NAME, ["lora"], 2, 1, ["expert.width=16"])
    assert found.methods["lora"] == bench_shapes.StepCost()
    assert "out of memory" in shown(found)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("smolvlm3",), "the shape 'smolvlm3'"),
        ((NAME, ["adamant"]), "method 'adamant'"),
        ((NAME, (), 2, 1, ["train.speed=1"]), "train.speed"),
    ],
)
def test_bad_arguments_are_refused_before_any_work(
    arguments: tuple[Any, ...], message: str, here: list[str]
) -> None:
    with pytest.raises(AegisError, match=message):
        bench_shapes.run(*arguments)
    assert here == []


def test_a_shape_that_cannot_fit_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_shapes.memory, "free", lambda _: 10**9)
    with pytest.raises(AegisError, match="need 4.1 GB to train"):
        bench_shapes.run(NAME)


def test_the_peak_is_that_of_the_device_and_its_type() -> None:
    found = peak_of("NVIDIA H100 80GB HBM3", bf16=True)
    assert found is not None and (found.device, found.tflops) == ("H100", 989.0)
    slower = peak_of("NVIDIA H100 PCIe", bf16=False)
    assert slower is not None and (slower.tflops, slower.dtype) == (51.0, "float32")
    assert peak_of("NVIDIA A10G", bf16=True) is None  # not the A10
    assert peak_of("Radeon", bf16=True) is None


def test_mfu_counts_what_training_needs() -> None:
    naive = bench_shapes._Measured(2.0, 100, flop=10**12)
    twice = bench_shapes._Measured(4.0, 110, flop=3 * 10**12)
    peak = peak_of("NVIDIA H100", bf16=True)
    found = bench_shapes._cost(twice, naive, peak)
    assert found.mfu == pytest.approx(10**12 / (4 * 989e12))
    assert (found.step_time, found.peak_memory) == (2.0, 1.1)


def test_all_that_a_method_does_between_the_passes_is_timed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By a clock that only these parts and the passes advance; the passes do not count."""
    now = [0.0]

    def spend(seconds: float, result: Any = None) -> Callable[..., Any]:
        def work(*_: Any) -> Any:
            now[0] += seconds
            return result

        return work

    slowed: dict[Any, float] = {torch.zeros(1): 0.5}
    parts = Parts(
        pull=spend(1.0), shares=spend(2.0, slowed), constrain=spend(4.0), begin=spend(8.0)
    )
    model = torch.nn.Linear(1, 1)
    run = SimpleNamespace(parts=parts, stepper=Stepper(model, parts))
    monkeypatch.setattr(run.stepper, "_copies", spend(16.0, {}))

    def turn() -> None:
        run.parts.pull()
        assert run.parts.shares() is slowed
        run.stepper.step(1, spend(100.0), {})

    monkeypatch.setattr(bench_shapes, "_now", lambda: now[0])
    assert bench_shapes._own_seconds(run, turn) == 31.0 and now[0] == 131.0
    naive = SimpleNamespace(parts=Parts(), stepper=None)
    assert bench_shapes._own_seconds(naive, turn) is None and now[0] == 131.0
