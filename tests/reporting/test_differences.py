"""Differences between runs besides their methods, which a comparison reports."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from samples.reports import write_job

from aegis_cli.common import artifacts
from aegis_cli.common.events import Event, Warned
from aegis_cli.recipes import Demos, Probe, Rollout, Train
from aegis_cli.reporting import compare, differences


def changed_run(folder: Path, digest: str = "a" * 64, steps: int = 6, **changes: Any) -> Path:
    """A run that differs from others in some of its inputs."""
    run = write_job(folder, **changes) / "naive"
    header = artifacts.load(run / "ledger.safetensors", "ledger")
    inputs, meta = {"demos": digest, "backbone": "b" * 64}, header.header.meta
    artifacts.save(run / "ledger.safetensors", "ledger", header.tensors, meta=meta, inputs=inputs)
    with (run / "metrics.jsonl").open("a") as file:
        file.write(json.dumps({"step": steps, "loss": 1.0}) + "\n")
    return run


@pytest.mark.parametrize(
    ("changes", "name", "says"),
    [
        ({}, None, ""),
        ({"digest": "c" * 64}, "demonstrations", "differ in demonstrations: their"),
        ({"demos": Demos(only="0-3")}, "episodes", "differ in episodes (all; 0-3)"),
        (
            {"train": Train(batch_size=16, validation_share=0.2)},
            "share held out",
            "share held out (0.05; 0.2)",
        ),
        ({"seed": 3}, "seed", "differ in seed (0; 3)"),
        ({"train": Train(batch_size=16, chunk=4)}, "chunk", "differ in chunk (8; 4)"),
        ({"steps": 9}, "steps", "differ in steps (6; 9)"),
        ({"train": Train(batch_size=7)}, "batch size", "differ in batch size (16; 7)"),
        ({"probe": Probe(seed=2)}, "questions", "(40 of scenes; 40 of scenes, seed 2)"),
        ({"probe": Probe(ask="{} Please.")}, "questions", "asked as '{} Please.'"),
        (
            {"rollout": Rollout(seed=4, colors=("seen",))},
            "rollout",
            "(4 episodes of reach, seed 0, replan 4; 4 episodes of reach, seed 4, replan 4)",
        ),
    ],
)
def test_what_runs_differ_in_beside_their_methods_is_told_in_one_line(
    changes: dict[str, Any], name: str | None, says: str, tmp_path: Path
) -> None:
    told: list[Event] = []
    runs = [changed_run(tmp_path / "a", train=Train(batch_size=16))]
    runs.append(changed_run(tmp_path / "b", **{"train": Train(batch_size=16), **changes}))
    found = compare.run(runs, told.append)
    assert list(found.differs) == [name] * (name is not None)
    warned = [event.text for event in told if isinstance(event, Warned)]
    texts = [text for text in warned if text.startswith("the runs differ")]
    assert len(texts) == bool(says) and all(says in text for text in texts)


def test_a_fact_that_is_not_known_of_a_run_is_no_difference() -> None:
    facts = [{"seed": 1, "demonstrations": None}, {"seed": 2, "demonstrations": "a"}]
    assert differences.between(facts) == {"seed": [1, 2]} and differences.between([]) == {}


@pytest.mark.parametrize("other", [{}, {"seed": 1}])
def test_validation_losses_of_other_frames_have_no_best(
    other: dict[str, Any], aegis, tmp_path: Path
) -> None:
    runs = [changed_run(tmp_path / "a"), changed_run(tmp_path / "b", **other)]
    for number, run in enumerate(runs):
        with (run / "metrics.jsonl").open("a") as file:
            file.write(json.dumps({"step": 6, "validation_loss": 0.25 + number}) + "\n")
    out = aegis("compare", *runs)[1]
    assert ("*0.2500" in out) == (not other) and "0.2500" in out
