"""Measurements of models that change tensors in place, of failed passes, and of mistakes."""

from __future__ import annotations

import pytest
import torch
from samples.guard import IMAGE, LAYERS, batch, make
from torch import Tensor, nn
from torch.nn import functional as F

from aegis_cli import Guard
from aegis_cli.common.errors import AegisError
from aegis_cli.core.spectrum import Spectrum

IDS = torch.arange(24).view(4, 6) % 20


class Residual(nn.Module):
    """Layers that add in place or not; their first maps read the sum itself or a copy."""

    def __init__(self, in_place: bool, copied: bool) -> None:
        super().__init__()
        self.words = nn.Embedding(20, 8)
        self.layers = nn.ModuleList(
            nn.Sequential(nn.Linear(8, 8), nn.Tanh(), nn.Linear(8, 8)) for _ in range(2)
        )
        self.head = nn.Linear(8, 20)
        self.in_place, self.copied = in_place, copied

    def forward(self, ids: Tensor) -> Tensor:
        x = self.words(ids)
        for layer in self.layers:
            # Autograd needs the input of a trainable map, and would itself raise an error.
            added = layer(x.clone() if self.copied else x)
            if self.in_place:
                x += added
            else:
                x = x + added
        return self.head(F.relu(x))


def curvature(in_place: bool, copied: bool = True, frozen: bool = False) -> dict[str, Spectrum]:
    torch.manual_seed(0)
    model = Residual(in_place, copied).eval()
    if frozen:
        for layer in model.layers:
            layer[0].requires_grad_(False)
    with Guard.measure(model, parts=("curvature",), energy=1.0) as found:
        with found.watch(None):
            scores = model(IDS)
        found.answer(scores)
    return found.anchor().curvature


def test_a_residual_stream_that_is_added_to_in_place_is_measured_like_another() -> None:
    expected = curvature(in_place=False)
    found = curvature(in_place=True)
    assert found.keys() == expected.keys() and any("layers.0" in name for name in found)
    for name, spectrum in expected.items():
        torch.testing.assert_close(found[name].values, spectrum.values)


def test_what_a_map_has_read_may_not_change_before_it_is_counted() -> None:
    """For a frozen map autograd does not need the input, and raises no error."""
    with pytest.raises(AegisError, match="changed in place"):
        curvature(in_place=True, copied=False, frozen=True)


def test_a_pass_that_failed_half_way_is_not_forgotten() -> None:
    model = make()
    pixels, ids, mask = batch(0)
    with Guard.measure(model, layers=LAYERS, parts=("moments", "inputs"), vision="vision") as found:
        for fails in (False, True, False):
            try:
                with found.watch(mask, IMAGE):
                    model(pixels, ids, mask)
                    if fails:
                        raise RuntimeError("out of memory")
            except RuntimeError:
                assert fails
        with pytest.raises(AegisError, match="a watched pass that failed"):
            found.anchor()


def test_a_measurement_that_is_refused_leaves_no_hook() -> None:
    model = make()
    with pytest.raises(AegisError):
        Guard.measure(model, layers=LAYERS, parts=("moments", "inputs"), vision="nope")
    assert not any(module._forward_hooks for module in model.modules())
