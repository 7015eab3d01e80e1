"""The rest of a policy around the guarded part gets only the task's gradient, sharded or not."""

from __future__ import annotations

from pathlib import Path

import torch
from samples import processes
from samples.around import compare_sharded
from samples.guard import make, measured
from samples.ranks import WORLD
from torch import nn

from aegis_cli.methods.backward import second_backward, second_backward_of_rows


def test_a_states_map_around_a_sharded_vlm_has_the_tasks_gradient(tmp_path: Path) -> None:
    path = measured(make(), tmp_path / "anchor.safetensors")
    processes.start(compare_sharded, (str(tmp_path), path), WORLD)


def test_the_second_pass_adds_to_no_gradient_that_it_was_not_asked_for() -> None:
    """It adds neither to a leaf of its graph nor to other named parameters."""
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
