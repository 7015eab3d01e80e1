"""The benchmark: it times what the commands run, and says so in ratios. No figure is asserted, only that it is one."""

from __future__ import annotations

from pathlib import Path

import pytest

from aegis_cli.events import Progress
from aegis_cli.methods import METHODS
from aegis_cli.stages import bench


def test_every_method_is_timed_against_naive(tiny_folder: Path) -> None:
    events: list[Progress] = []
    report = bench.run(str(tiny_folder), batch_size=2, repeats=2, on_event=events.append)
    assert set(report.step_time) == set(report.step_s) == set(METHODS)
    assert report.step_time["naive"] == 1 and all(ratio > 0 for ratio in report.step_time.values())
    assert report.step_time["aegis"] == pytest.approx(report.step_s["aegis"] / report.step_s["naive"])
    assert report.anchor_throughput > 0
    assert [e.done for e in events] == [1, 2, 3]
