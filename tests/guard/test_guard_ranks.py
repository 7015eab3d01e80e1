"""Two guarded processes train one model as one process does with the batches of both."""

from __future__ import annotations

from pathlib import Path

import torch
from samples.guard import IMAGE, LAYERS, batch, make, measured, task_loss, vector
from samples.ranks import STEPS, WORLD, lack_one, train_together
from torch import Tensor, multiprocessing

from aegis_cli import Guard


def train_alone(path: Path) -> tuple[Tensor, dict[str, Tensor]]:
    """The same with the batches of both processes, one after the other, before each step."""
    model = make()
    guard = Guard(model, path, LAYERS)
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-2)
    for index in range(STEPS):
        for seed in range(WORLD * index, WORLD * (index + 1)):
            with guard.watch(batch(seed)[2], IMAGE):
                loss = task_loss(model, seed)
            guard.backward(loss / WORLD)
        guard.step(optimizer)
        optimizer.zero_grad()
    return vector(model), guard.ledger.tensors()


def test_processes_do_what_one_does_with_the_batches_of_all(tmp_path: Path) -> None:
    path = measured(make(), tmp_path / "anchor.safetensors")
    multiprocessing.spawn(train_together, args=(str(tmp_path), path), nprocs=WORLD)
    (one, rows), (other, its) = (torch.load(tmp_path / f"{rank}.pt") for rank in range(WORLD))
    alone, expected = train_alone(path)
    assert torch.equal(one, other) and (alone - vector(make())).norm() > 0.1
    torch.testing.assert_close(one, alone, rtol=1e-9, atol=1e-9)
    assert (expected["ta"] < 0).any()  # else nothing would have been projected
    for name, values in expected.items():
        assert torch.equal(rows[name], its[name])
        torch.testing.assert_close(rows[name], values, rtol=1e-6, atol=1e-12)


def test_a_gradient_that_one_process_lacks_counts_as_zero_there(tmp_path: Path) -> None:
    multiprocessing.spawn(lack_one, args=(str(tmp_path),), nprocs=WORLD)
