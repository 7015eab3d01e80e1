"""A program whose default device is a GPU is guarded like any other."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from samples.guard import IMAGE, LAYERS, batch, make, vector
from samples.ranks import METHODS
from torch import Tensor

from aegis_cli import Guard

BATCHES = [batch(seed) for seed in range(3)]


@pytest.mark.parametrize("method", METHODS)
def test_a_guard_makes_nothing_on_the_default_device(method: str, tmp_path: Path) -> None:
    """On the device "meta" numbers have no values, so anything the guard makes there is useless."""
    on_cpu = measured_and_trained(method, tmp_path, "cpu")
    assert torch.equal(measured_and_trained(method, tmp_path, "meta"), on_cpu)


def begun(optimizer: torch.optim.Optimizer) -> torch.optim.Optimizer:
    """The optimizer after a step without gradients.

    The first step makes its state, and some versions of PyTorch make Adam's state on the default
    device, which is not what this test checks.
    """
    for group in optimizer.param_groups:
        for weight in group["params"]:
            weight.grad = torch.zeros_like(weight)
    optimizer.step()
    optimizer.zero_grad()
    return optimizer


def measured_and_trained(method: str, folder: Path, default: str) -> Tensor:
    """The weights after three steps, with an anchor measured by the same program."""
    model, path = make(), folder / f"{default}.safetensors"
    optimizer = begun(torch.optim.AdamW(model.parameters(), lr=1e-2))
    parts = ("curvature",) if method == "kfac" else ("moments", "inputs")
    with torch.device(default):
        with Guard.measure(model, layers=LAYERS, parts=parts, vision="vision") as found:
            for pixels, ids, mask in BATCHES:
                with found.watch(mask, IMAGE):
                    scores = model(pixels, ids, mask)
                if method == "kfac":
                    found.answer(scores[:, -3])
        found.save(path)
        guard = Guard(model, path, method=method, **METHODS[method])
        for pixels, ids, mask in BATCHES:
            with guard.watch(mask, IMAGE):
                loss = (model(pixels, ids, mask) - 1).square().mean()
            guard.backward(loss)
            guard.step(optimizer)
            optimizer.zero_grad()
        guard.ledger.save(folder / f"{default}-ledger.safetensors")
        guard.remove()
    return vector(model)
