"""The latency is that of single predictions, after the first ones. No value is asserted."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from samples.command import refused
from samples.serving import deployed

from aegis_cli.common.events import Progress
from aegis_cli.serving import latency


def test_the_first_predictions_are_not_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(1000))
    monkeypatch.setattr(latency.time, "perf_counter", lambda: next(clock) ** 2)
    events: list[Progress] = []
    found = latency.seconds(deployed(), 4, events.append)
    assert found == [(2 * i + 1) ** 2 - (2 * i) ** 2 for i in range(3, 7)]
    assert [(e.done, e.total) for e in events] == [(i, 7) for i in range(1, 8)]


def test_policies_of_several_cameras_are_timed_with_all_of_them() -> None:
    class Spy:
        positions, cameras, image_size = 3, ("top", "wrist"), None

        def predict_action_chunk(self, pictures: Any, *_: object) -> None:
            assert {name: p.shape for name, p in pictures.items()} == {
                "top": (224, 224, 3),
                "wrist": (224, 224, 3),
            }

    assert len(latency.seconds(Spy(), 2)) == 2  # type: ignore[arg-type]


def test_bench_reports_the_latency_of_a_run(naive_run: Path, aegis: Any) -> None:
    code, out, _ = aegis("bench", "--latency", naive_run, "--repeats", "3", "--json")
    said = json.loads(out)
    assert (code, said["repeats"], said["chunk"], said["replan"]) == (0, 3, 4, 2)
    assert 0 < said["p50_ms"] <= said["p95_ms"]
    assert said["precision"] == "float32"  # auto, on any processor
    assert said["actions_per_s"] == pytest.approx(2000 / said["p50_ms"])


def test_options_of_training_have_no_place_beside_it(aegis: Any) -> None:
    assert "--batch-size" in refused(aegis("bench", "--latency", "x", "--batch-size", "4"))


@pytest.mark.parametrize("repeats", [0, 10**12])
@pytest.mark.parametrize("beside", [(), ("--latency", "x"), ("--shape", "smolvlm2-256m")])
def test_more_rounds_than_anybody_waits_for_are_refused(
    repeats: int, beside: tuple[str, ...], aegis: Any
) -> None:
    said = refused(aegis("bench", *beside, "--repeats", repeats))
    assert "--repeats" in said and "from 1 to 10,000,000" in said
