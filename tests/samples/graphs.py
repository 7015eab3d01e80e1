"""Whether a training keeps the graphs of its steps, and what it compiles.

A graph that outlives its step costs its activations, once per step.
"""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from aegis_cli.models.backbones.embedded import EmbeddedVLM
from aegis_cli.models.expert import ActionExpert


def outputs_kept(work: Callable[[], object]) -> tuple[int, int]:
    """How many outputs with a graph the modules made during `work`, and how many are left after."""
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


def compiled_graphs(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """A list that receives each graph that a training of the embedded family compiles and runs."""
    found: list[object] = []

    def noted(graph: Any, _: object) -> Any:
        found.append(graph)
        return graph.forward

    for owner, name in ((EmbeddedVLM, "compile_passes"), (ActionExpert, "compile_layers")):
        real = getattr(owner, name)
        monkeypatch.setattr(owner, name, lambda part, real=real: real(part, noted))
    return found


class Keeper(nn.Module):
    """What must be found: a hook on an output that keeps the output alive."""

    def forward(self, x: Tensor) -> Tensor:
        y = 2 * x
        y.register_hook(lambda gradient: gradient * y.new_ones(()))
        return y


def backward_through(module: nn.Module) -> None:
    x = torch.ones(2, requires_grad=True)
    module(3 * x).sum().backward()
