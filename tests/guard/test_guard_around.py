"""What lies around the guarded part of a policy is left to the task alone, sharded or not."""

from __future__ import annotations

from pathlib import Path

import torch
import torch.distributed as dist
from samples import processes
from samples.guard import IMAGE, LAYERS, WIDTH, Vlm, batch, make, measured
from samples.ranks import WORLD, begin
from torch import Tensor, nn
from torch.distributed.fsdp import fully_shard

from aegis_cli import Guard
from aegis_cli.common.ranks import whole
from aegis_cli.methods.backward import second_backward, second_backward_of_rows


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
    """Those of the state's map, after one backward pass."""
    pixels, ids, mask = batch(seed)
    if guard is None:
        (model(pixels, ids, mask) - 1).square().mean().backward()
    else:
        with guard.watch(mask, IMAGE):
            loss = (model(pixels, ids, mask) - 1).square().mean()
        guard.backward(loss)
    return [whole(p.grad) for p in model.before.parameters()]


def test_a_states_map_around_a_sharded_vlm_has_the_tasks_gradient(tmp_path: Path) -> None:
    path = measured(make(), tmp_path / "anchor.safetensors")
    processes.start(compare_sharded, (str(tmp_path), path), WORLD)


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


def test_the_second_pass_adds_to_no_gradient_that_it_was_not_asked_for() -> None:
    """Neither to a leaf of its graph nor to others that are named."""
    inside, before = nn.Parameter(torch.ones(3)), nn.Parameter(torch.ones(3))
    elsewhere = nn.Parameter(torch.ones(2))
    hidden = before * inside * 2
    hidden.sum().backward(retain_graph=True)
    elsewhere.grad = torch.ones(2)
    task = [p.grad.clone() for p in (inside, before, elsewhere)]
    penalty = hidden.square().sum()
    expected = second_backward([[inside]], penalty, retain_graph=True)
    found = second_backward_of_rows([[inside]], penalty, [elsewhere])
    assert torch.equal(found[id(inside)], expected[id(inside)])
    assert all(map(torch.equal, task, [p.grad for p in (inside, before, elsewhere)]))
