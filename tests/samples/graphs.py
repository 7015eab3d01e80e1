"""Whether a training keeps what it computed.

A graph that outlives its step costs its activations, once per step.
"""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn


def outputs_kept(work: Callable[[], object]) -> tuple[int, int]:
    """How many outputs of modules with a graph `work` made, and how many are left after it."""
    made: list[weakref.ref[Tensor]] = []

    def note(module: nn.Module, given: Any, output: Any) -> None:
        if isinstance(output, Tensor) and output.requires_grad:
            made.append(weakref.ref(output))

    hook = nn.modules.module.register_module_forward_hook(note)
    try:
        work()
    finally:
        hook.remove()
    gc.collect()
    return len(made), sum(output() is not None for output in made)


class Keeper(nn.Module):
    """What must be found: a hook on an output that holds the output."""

    def forward(self, x: Tensor) -> Tensor:
        y = 2 * x
        y.register_hook(lambda gradient: gradient * y.new_ones(()))
        return y


def backward_through(module: nn.Module) -> None:
    x = torch.ones(2, requires_grad=True)
    module(3 * x).sum().backward()
