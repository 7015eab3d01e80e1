"""Several processes train what one trains, whatever their number and whatever the method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.parallel_runs import Job, run_together
from samples.training_runs import metrics

from aegis_cli.common import artifacts
from aegis_cli.methods import METHODS
from aegis_cli.recipes import Recipe

Make = Callable[..., Job]
BATCH = 8  # three processes have 2, 3 and 3 frames of it


@pytest.fixture(scope="module")
def make(recipe: Recipe, demos_file: Path, anchor_file: Path) -> Make:
    def job(method: str, out: Path, **settings: Any) -> Job:
        changed = replace(recipe.train, batch_size=BATCH, **settings)
        options = replace(recipe.cotrain, batch_size=BATCH)
        wanted = replace(recipe, train=changed, cotrain=options)
        return Job(wanted, method, demos_file, anchor_file, out)

    return job


def assert_same_training(one: Path, other: Path) -> None:
    """Losses, leaks and the ledger agree as far as rounding lets them."""
    for here, there in zip(metrics(one), metrics(other), strict=True):
        for name in here.keys() - {"data_s", "update_s", "step_s", "samples_per_s"}:
            assert here[name] == pytest.approx(there[name], rel=1e-5, abs=1e-7), name
    rows, its = (
        artifacts.load(out / "ledger.safetensors", "ledger").tensors for out in (one, other)
    )
    for name, values in rows.items():
        torch.testing.assert_close(values, its[name], rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("count", [2, 3])
def test_processes_train_what_one_trains(make: Make, tmp_path: Path, count: int) -> None:
    jobs = [make(method, tmp_path / "several" / method) for method in METHODS]
    run_together(count, jobs)
    for job in jobs:
        alone = replace(job, out=tmp_path / "alone" / job.method)
        alone.run()
        assert_same_training(job.out, alone.out) if job.method != "maps" else None


@pytest.mark.parametrize("count", [2, 3])
def test_fsdp(make: Make, tmp_path: Path, count: int) -> None:
    jobs = [
        make(m, tmp_path / "several" / m, parallel="fsdp") for m in METHODS if METHODS[m].shards
    ]
    run_together(count, jobs)
    for job in jobs:
        alone = replace(job, out=tmp_path / "alone" / job.method)
        alone.run()
