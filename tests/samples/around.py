"""A policy around the VLM of `samples.guard`, guarded by two processes that shard it."""

from __future__ import annotations

from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.distributed.fsdp import fully_shard

from aegis_cli import Guard
from aegis_cli.common.ranks import whole
from samples.guard import IMAGE, LAYERS, WIDTH, Vlm, batch, make
from samples.ranks import begin


class Policy(nn.Module):
    """A map from the robot's state to what the layers read, whose penalty depends on it too."""

    def __init__(self, vlm: Vlm) -> None:
        super().__init__()
        self.vlm = vlm
        self.before = nn.Linear(4, WIDTH, dtype=torch.float64)

    def forward(self, pixels: Tensor, ids: Tensor, mask: Tensor) -> Tensor:
        state = self.before(pixels.flatten(1)[:, :4])
        x = torch.cat([self.vlm.vision(pixels).mT + state[:, None], self.vlm.text.words(ids)], 1)
        for layer in self.vlm.text.layers:
            x = layer(x, ~mask)
        return self.vlm.head(self.vlm.text.norm(x))


def policy() -> Policy:
    torch.manual_seed(0)
    return Policy(make())


def gradients(model: Policy, seed: int, guard: Guard | None) -> list[Tensor]:
    """The gradients of the state's map after one backward pass."""
    pixels, ids, mask = batch(seed)
    if guard is None:
        (model(pixels, ids, mask) - 1).square().mean().backward()
    else:
        with guard.watch(mask, IMAGE):
            loss = (model(pixels, ids, mask) - 1).square().mean()
        guard.backward(loss)
    return [whole(p.grad) for p in model.before.parameters()]


def compare_sharded(rank: int, folder: str, path: Path) -> None:
    """What each process runs."""
    begin(rank, folder)
    found = []
    for is_guarded in (False, True):
        model = policy()
        for layer in model.vlm.text.layers:
            fully_shard(layer)
        fully_shard(model)
        guard = None
        if is_guarded:
            guard = Guard(model, path, LAYERS, part="vlm", process_group=dist.group.WORLD)
        found.append(gradients(model, rank, guard))
    plain, guarded = found
    for expected, own in zip(plain, guarded, strict=True):
        torch.testing.assert_close(own, expected)
    dist.destroy_process_group()
