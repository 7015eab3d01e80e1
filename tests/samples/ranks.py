"""What the processes of a distributed test run; each process finds these by their module."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch import distributed as dist
from torch.distributed.fsdp import fully_shard
from torch.nn.parallel import DistributedDataParallel

from aegis_cli import Guard
from aegis_cli.common.errors import AegisError
from aegis_cli.common.ranks import whole
from aegis_cli.guard import process_groups
from aegis_cli.models import structure
from samples.guard import IMAGE, LAYERS, Vlm, batch, make, task_loss, vector

WORLD, STEPS = 2, 3
PARTS = 2  # passes per step, if it has several
METHODS: dict[str, dict[str, Any]] = {
    "aegis": {"layers": LAYERS},
    "nullspace": {"vision": "vision", "energy": 0.9, "every": 2},
    "kfac": {"protect": ("maps",)},
}


def begin(rank: int, folder: str) -> None:
    os.environ["GLOO_SOCKET_IFNAME"] = "lo"
    torch.set_num_threads(1)
    dist.init_process_group(
        "gloo", init_method=f"file://{folder}/store", rank=rank, world_size=WORLD
    )


def train_together(rank: int, folder: str, paths: dict[str, Path]) -> None:
    """What each process runs: every method's guard, on whole and on sharded weights."""
    begin(rank, folder)
    with pytest.raises(AegisError, match="2 processes without process_group="):
        Guard(make(), paths["aegis"], LAYERS)
    for name in METHODS:
        for way, share in (("ddp", _copied), ("fsdp", _sharded)):
            found = _trained(rank, name, paths[name], share)
            torch.save(found, Path(folder) / f"{name}-{way}-{rank}.pt")
        if name == "aegis":
            for sends_each in (False, True):
                found = _trained_in_parts(rank, paths[name], sends_each)
                torch.save(found, Path(folder) / f"aegis-parts-{sends_each}-{rank}.pt")
            with pytest.raises(AegisError, match="sharded weights and a second backward pass"):
                _trained(rank, name, paths[name], _sharded, automatic=True)
        else:
            found = _trained(rank, name, paths[name], _sharded, automatic=True)
            torch.save(found, Path(folder) / f"{name}-automatic-{rank}.pt")
            found = _trained(rank, name, paths[name], _copied, automatic=True, shares_states=True)
            torch.save(found, Path(folder) / f"{name}-zero-{rank}.pt")
            for automatic in (False, True):
                found = _trained_late(rank, name, paths[name], automatic)
                torch.save(found, Path(folder) / f"{name}-late-{automatic}-{rank}.pt")
    dist.barrier()  # neither leaves while the other may still communicate with it
    dist.destroy_process_group()


def _trained(
    rank: int,
    method: str,
    path: Path,
    share: Callable[[Vlm], tuple[Vlm, nn.Module]],
    automatic: bool = False,
    shares_states: bool = False,
) -> tuple[Tensor, dict[str, Tensor]]:
    """All weights after some steps, and the ledger.

    Args:
        shares_states: whether each process keeps the optimizer states of only some parameters.
    """
    model, called = share(make())
    world = dist.group.WORLD
    guard = Guard(model, path, method=method, process_group=world, **METHODS[method])
    optimizer: torch.optim.Optimizer = torch.optim.AdamW(model.parameters(), lr=1e-2)
    if shares_states:
        # Importing it warns, which is an error except in processes started for this.
        from torch.distributed.optim import ZeroRedundancyOptimizer

        optimizer = ZeroRedundancyOptimizer(model.parameters(), torch.optim.AdamW, lr=1e-2)
    if automatic:
        guard.automatic()
        for index in range(STEPS):
            task_loss(called, WORLD * index + rank).backward()
            optimizer.step()
            optimizer.zero_grad()
    for index in range(0 if automatic else STEPS):
        seed = WORLD * index + rank
        with guard.watch(batch(seed)[2], IMAGE):
            loss = task_loss(called, seed)
        guard.backward(loss)
        guard.step(optimizer)
        optimizer.zero_grad()
    guard.remove()
    weights = torch.cat([whole(p.detach()).flatten() for p in model.parameters()])
    return weights, guard.ledger.tensors()


def _trained_in_parts(rank: int, path: Path, sends_each: bool) -> tuple[Tensor, dict[str, Tensor]]:
    """The same in a loop that calls nothing of the guard, with a step's gradients in two passes.

    Args:
        sends_each: whether each pass communicates its gradients, which are views of the buckets;
            otherwise the first pass communicates nothing, as in accelerate and the Trainers.
    """
    model = make()
    called = DistributedDataParallel(model, gradient_as_bucket_view=sends_each)
    guard = Guard(model, path, LAYERS, process_group="world")
    guard.automatic(mask="mask", image=lambda _: IMAGE)
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-2)
    for index in range(STEPS):
        for part in range(PARTS):
            last = part == PARTS - 1
            with contextlib.nullcontext() if last or sends_each else called.no_sync():
                seed = WORLD * (PARTS * index + part) + rank
                (task_loss(called, seed) / PARTS).backward()
        optimizer.step()
        optimizer.zero_grad()
    guard.remove()
    return vector(model), guard.ledger.tensors()


def _trained_late(
    rank: int, method: str, path: Path, automatic: bool
) -> tuple[Tensor, dict[str, Tensor]]:
    """Steps over sharded weights in two passes, of which only the last reduces the gradients."""
    model, _ = _sharded(make())
    guard = Guard(model, path, method=method, process_group="world", **METHODS[method])
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-2)
    if automatic:
        guard.automatic()
    for index in range(STEPS):
        for part in range(PARTS):
            model.set_requires_gradient_sync(part == PARTS - 1)  # type: ignore[operator]
            loss = task_loss(model, WORLD * (PARTS * index + part) + rank) / PARTS
            loss.backward() if automatic else guard.backward(loss)
        optimizer.step() if automatic else guard.step(optimizer)
        optimizer.zero_grad()
    guard.remove()
    weights = torch.cat([whole(p.detach()).flatten() for p in model.parameters()])
    return weights, guard.ledger.tensors()


def _copied(model: Vlm) -> tuple[Vlm, DistributedDataParallel]:
    return model, DistributedDataParallel(model)


def _sharded(model: Vlm) -> tuple[Vlm, nn.Module]:
    for layer in model.text.layers:
        fully_shard(layer)
    return fully_shard(model), model


def shard_under_a_guard(rank: int, folder: str, paths: dict[str, Path]) -> None:
    """FSDP2 before a guard is made, and after it."""
    begin(rank, folder)
    methods: dict[str, dict[str, Any]] = {
        "aegis": {"layers": LAYERS, "process_group": dist.group.WORLD},
        "nullspace": {"vision": "vision", "energy": 1.0},
        "kfac": {"protect": ("maps",)},
    }
    for name, options in methods.items():
        model, path = make(), paths[name]
        guard = Guard(model, path, method=name, **options)
        for layer in model.text.layers:
            fully_shard(layer)
        with (
            pytest.raises(AegisError, match=r"text\.layers\.0.*sharded by FSDP"),
            guard.watch(None),
        ):
            task_loss(model, rank)
        with pytest.raises(AegisError, match="sharded by FSDP"):
            guard.backward(task_loss(model, rank))
        guard.remove()
        with pytest.raises(AegisError, match="sharded by FSDP"):
            Guard(model, path, method=name, **options | {"process_group": None})
        with pytest.raises(AegisError, match="not sharded by FSDP2 by rows"):
            Guard(model, path, method=name, **options | {"process_group": dist.group.WORLD})
    with pytest.raises(AegisError, match="sharded by FSDP"):
        Guard.measure(model)
    dist.barrier()  # neither leaves while the other may still communicate with it
    dist.destroy_process_group()


class RmsNorm(nn.Module):
    """As in transformers' families, which each have a class of their own for it."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight, self.eps = nn.Parameter(torch.linspace(0.5, 2, width)), 1e-6

    def forward(self, x: Tensor) -> Tensor:
        return self.weight * (x * torch.rsqrt(x.square().mean(-1, keepdim=True) + self.eps))


def know_sharded_norms(rank: int, folder: str) -> None:
    begin(rank, folder)
    model = nn.Sequential(nn.Linear(6, 6), RmsNorm(6))
    fully_shard(model)
    found = structure.find_maps(model, ()).kinds
    assert found == {"0": "maps", "1": "norms"}
    dist.barrier()  # neither leaves while the other may still communicate with it
    dist.destroy_process_group()


def lack_one(rank: int, folder: str) -> None:
    begin(rank, folder)
    parameters = {i: torch.zeros(2) for i in range(3)}
    given = {
        0: torch.full((2,), 1.0 + rank),
        1: torch.full((2,), 4.0) if rank == 0 else None,
        2: None,
    }
    found = process_groups.mean_gradients(given, parameters, dist.group.WORLD)
    assert {i: None if g is None else g.tolist() for i, g in found.items()} == {
        0: [1.5, 1.5],
        1: [2.0, 2.0],
        2: None,
    }
    assert given[0] is not None and given[0].tolist() == [1.0 + rank] * 2
    dist.barrier()  # neither leaves while the other may still communicate with it
    dist.destroy_process_group()
