"""Two guarded processes train one model as one process does with the batches of both."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch
from samples.guard import IMAGE, LAYERS, batch, make, measured, task_loss, vector
from torch import Tensor, multiprocessing
from torch import distributed as dist
from torch.nn.parallel import DistributedDataParallel

from aegis_cli import Guard
from aegis_cli.common.errors import AegisError
from aegis_cli.guard import accumulation

WORLD, STEPS = 2, 3


def begin(rank: int, folder: str) -> None:
    os.environ["GLOO_SOCKET_IFNAME"] = "lo"
    torch.set_num_threads(1)
    dist.init_process_group(
        "gloo", init_method=f"file://{folder}/store", rank=rank, world_size=WORLD
    )


def train_together(rank: int, folder: str, path: Path) -> None:
    """What one of the processes runs."""
    begin(rank, folder)
    model = make()
    with pytest.raises(AegisError, match="2 processes without process_group="):
        Guard(model, path, LAYERS)
    guard = Guard(model, path, LAYERS, process_group=dist.group.WORLD)
    copy = DistributedDataParallel(model)
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-2)
    for index in range(STEPS):
        seed = WORLD * index + rank
        with guard.watch(batch(seed)[2], IMAGE):
            loss = task_loss(copy, seed)
        guard.backward(loss)
        guard.step(optimizer)
        optimizer.zero_grad()
    torch.save((vector(model), guard.ledger.tensors()), Path(folder) / f"{rank}.pt")
    dist.destroy_process_group()


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


def lack_one(rank: int, folder: str) -> None:
    begin(rank, folder)
    parameters = {i: torch.zeros(2) for i in range(3)}
    given = {
        0: torch.full((2,), 1.0 + rank),
        1: torch.full((2,), 4.0) if rank == 0 else None,
        2: None,
    }
    found = accumulation.mean_gradients(given, parameters, dist.group.WORLD)
    assert {i: None if g is None else g.tolist() for i, g in found.items()} == {
        0: [1.5, 1.5],
        1: [2.0, 2.0],
        2: None,
    }
    assert given[0] is not None and given[0].tolist() == [1.0 + rank] * 2
    dist.destroy_process_group()


def test_a_gradient_that_one_process_lacks_counts_as_zero_there(tmp_path: Path) -> None:
    multiprocessing.spawn(lack_one, args=(str(tmp_path),), nprocs=WORLD)
