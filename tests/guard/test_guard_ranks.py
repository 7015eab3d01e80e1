"""Two guarded processes train a model like one process that has the batches of both."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from samples import processes
from samples.guard import (
    IMAGE,
    LAYERS,
    anchors_by_method,
    batch,
    make,
    task_loss,
    vector,
)
from samples.ranks import (
    METHODS,
    PARTS,
    STEPS,
    WORLD,
    know_sharded_norms,
    lack_one,
    train_together,
)
from torch import Tensor

from aegis_cli import Guard


def train_alone(path: Path, parts: int = 1, **options: Any) -> tuple[Tensor, dict[str, Tensor]]:
    """The same with the batches of both processes, one after the other, before each step."""
    model = make()
    guard = Guard(model, path, **options)
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-2)
    for index in range(STEPS):
        count = WORLD * parts
        for seed in range(count * index, count * (index + 1)):
            with guard.watch(batch(seed)[2], IMAGE):
                loss = task_loss(model, seed)
            guard.backward(loss / count)
        guard.step(optimizer)
        optimizer.zero_grad()
    guard.remove()
    return vector(model), guard.ledger.tensors()


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Path]]:
    """The folder with the results of two processes, and the anchors."""
    folder = tmp_path_factory.mktemp("trained")
    paths = anchors_by_method(folder)
    processes.start(train_together, (str(folder), paths), WORLD)
    return folder, paths


WAYS = [(method, way) for method in METHODS for way in ("ddp", "fsdp")]
# In a plain loop over sharded weights, or with an optimizer that shards its states.
WAYS += [(method, way) for method in ("nullspace", "kfac") for way in ("automatic", "zero")]


@pytest.mark.parametrize(("method", "way"), WAYS)
def test_processes_do_what_one_does_with_the_batches_of_all(
    trained: tuple[Path, dict[str, Path]], method: str, way: str
) -> None:
    folder, paths = trained
    (one, rows), (other, its) = (
        torch.load(folder / f"{method}-{way}-{rank}.pt") for rank in range(WORLD)
    )
    alone, expected = train_alone(paths[method], method=method, **METHODS[method])
    assert torch.equal(one, other) and (alone - vector(make())).norm() > 0.1
    torch.testing.assert_close(one, alone, rtol=1e-9, atol=1e-9)
    if method == "aegis":
        assert (expected["ta"] < 0).any()  # otherwise nothing would have been projected
    for name, values in expected.items():
        assert torch.equal(rows[name], its[name])
        torch.testing.assert_close(rows[name], values, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("sends_each", [False, True])
def test_processes_that_send_each_or_the_last_of_a_steps_passes_do_what_one_does(
    trained: tuple[Path, dict[str, Path]], sends_each: bool
) -> None:
    """This includes buckets that DistributedDataParallel rebuilds in the second pass."""
    folder, paths = trained
    (one, rows), (other, its) = (
        torch.load(folder / f"aegis-parts-{sends_each}-{rank}.pt") for rank in range(WORLD)
    )
    alone, expected = train_alone(paths["aegis"], PARTS, layers=LAYERS)
    assert torch.equal(one, other)
    torch.testing.assert_close(one, alone, rtol=1e-9, atol=1e-9)
    assert (expected["ta"] < 0).any()  # otherwise nothing would have been projected
    for name in ("tt", "ta", "aa", "w2"):
        assert torch.equal(rows[name], its[name])
        torch.testing.assert_close(rows[name], expected[name], rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("automatic", [False, True])
@pytest.mark.parametrize("method", ["nullspace", "kfac"])
def test_sharded_gradients_may_be_summed_by_the_last_of_a_steps_passes(
    trained: tuple[Path, dict[str, Path]], method: str, automatic: bool
) -> None:
    folder, paths = trained
    one, other = (
        torch.load(folder / f"{method}-late-{automatic}-{rank}.pt")[0] for rank in range(WORLD)
    )
    alone, _ = train_alone(paths[method], PARTS, method=method, **METHODS[method])
    assert torch.equal(one, other)
    torch.testing.assert_close(one, alone, rtol=1e-9, atol=1e-9)


def test_norms_of_a_familys_own_class_are_known_where_they_are_sharded(tmp_path: Path) -> None:
    processes.start(know_sharded_norms, (str(tmp_path),), WORLD)


def test_a_gradient_that_one_process_lacks_counts_as_zero_there(tmp_path: Path) -> None:
    processes.start(lack_one, (str(tmp_path),), WORLD)
