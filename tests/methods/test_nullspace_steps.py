"""The null-space method under real optimizers: outputs on VQA inputs never change."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping

import pytest
import torch
from samples.nullspace import (
    CASES,
    SITE,
    Case,
    Inputs,
    Toy,
    fixed,
    measure,
    protection_of,
)
from torch import nn

from aegis_cli.core.anchor import Anchor
from aegis_cli.core.nullspace import allowed
from aegis_cli.core.spectrum import Spectrum
from aegis_cli.methods import METHODS
from aegis_cli.methods.base import Method, MethodContext, Parts, Update

pytestmark = pytest.mark.usefixtures("fixed_draws")

STEPS = 20


OPTIMIZERS: dict[str, tuple[Callable[[list[nn.Parameter]], torch.optim.Optimizer], float]] = {
    "momentum": (
        lambda ps: torch.optim.SGD(ps, lr=1e-4, momentum=0.9, nesterov=True),
        float("inf"),
    ),
    "decay": (lambda ps: torch.optim.AdamW(ps, lr=0.02, weight_decay=2.0), float("inf")),
    "clipping": (lambda ps: torch.optim.AdamW(ps, lr=0.02, weight_decay=0.1), 0.05),
}


def start(
    method: Method, toy: Toy, inputs: Mapping[str, Spectrum], energy: float, soft: float = 0.0
) -> Parts:
    options = {"energy": energy, "soft": soft, "every": 1, "protect": ("maps",), "keeps": "weights"}
    return method.start(
        MethodContext(
            toy, {SITE: list(toy.parameters())}, {SITE: "maps"}, options, Anchor(inputs=inputs)
        )
    )


def train(toy: nn.Module, parts: Parts, optimizer: str, data: Inputs, steps: int = STEPS) -> None:
    """Fit the outputs on `data` to distant targets, under the method's constraint."""
    learning = dict(toy.named_parameters())
    make, clip = OPTIMIZERS[optimizer]
    stepper, target = make(list(learning.values())), 3 * fixed(*toy(*data).shape)
    for _ in range(steps):
        stepper.zero_grad()
        (toy(*data) - target.to(next(toy.parameters()).dtype)).square().sum().backward()
        nn.utils.clip_grad_norm_(learning.values(), clip)
        before = {name: p.detach().clone() for name, p in learning.items()}
        stepper.step()
        if parts.constrain is not None:
            parts.constrain(Update(before, {}))


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_protected_inputs_keep_their_outputs_and_others_do_not(case: Case, optimizer: str) -> None:
    toy = case.model()
    parts = start(METHODS["nullspace"], toy, measure(toy.map, case.vqa()), energy=1.0)
    protected, other = case.vqa(), case.any()
    said, other_said = toy(*protected).detach(), toy(*other).detach()
    train(toy, parts, optimizer, case.any())
    assert (toy(*protected) - said).abs().max() < 1e-10
    assert (toy(*other) - other_said).abs().max() > 1e-2
    free = (
        case.model()
    )  # without protection these steps would have changed the outputs of protected inputs
    train(free, Parts(), optimizer, case.any())
    assert (free(*protected) - said).abs().max() > 1e-2


def test_projecting_the_gradient_alone_would_not_do(case: Case) -> None:
    """Adam and weight decay bring the removed part back, so the applied update is projected."""
    toy = case.model()
    protection = protection_of(case, case.vqa(), energy=1.0)
    stepper = torch.optim.AdamW(toy.parameters(), lr=0.02, weight_decay=2.0)
    protected = case.vqa()
    said, data = toy(*protected).detach(), case.any()
    for _ in range(STEPS):
        stepper.zero_grad()
        toy(*data).square().sum().backward()
        gradient = (
            toy.map.weight.grad,
            None if getattr(toy.map, "bias", None) is None else toy.map.bias.grad,
        )
        for parameter, kept in zip(toy.parameters(), allowed(protection, gradient)):
            parameter.grad = kept
        stepper.step()
    assert (toy(*protected) - said).abs().max() > 1e-2


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_no_protection_is_naive_bit_for_bit(case: Case, optimizer: str) -> None:
    free, toy, data = case.model(), case.model(), case.any()
    train(free, start(METHODS["naive"], free, {}, 0.0), optimizer, data)
    train(
        toy,
        start(METHODS["nullspace"], toy, measure(toy.map, case.vqa()), energy=0.0),
        optimizer,
        data,
    )
    assert not torch.equal(toy.map.weight, case.model().map.weight)
    assert all(torch.equal(x, y) for x, y in zip(free.parameters(), toy.parameters(), strict=True))


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 1e-5)])
def test_full_rank_inputs_at_share_one_freeze_the_map(
    case: Case, dtype: torch.dtype, tolerance: float
) -> None:
    toy = case.model()
    parts = start(METHODS["nullspace"], toy.to(dtype), measure(toy.map, case.any()), energy=1.0)
    origin = copy.deepcopy(toy)
    train(
        toy, parts, "decay", tuple(x.to(dtype) if x.is_floating_point() else x for x in case.any())
    )
    for now, before in zip(toy.parameters(), origin.parameters(), strict=True):
        torch.testing.assert_close(now, before, rtol=0, atol=tolerance)


class Two(nn.Module):
    """A map of a protected kind beside one of another kind; both read the same inputs."""

    def __init__(self, toy: Toy) -> None:
        super().__init__()
        self.held, self.free = copy.deepcopy(toy), copy.deepcopy(toy)

    def forward(self, *data: torch.Tensor) -> torch.Tensor:
        return torch.stack([self.held(*data), self.free(*data)])


@pytest.mark.parametrize("other", ["norms", "embeddings", "stem"])
def test_only_the_kinds_asked_for_are_protected(other: str) -> None:
    case = CASES["linear"]
    toy = case.model()
    two = Two(toy)
    kinds = {f"held.{SITE}": "maps", f"free.{SITE}": other}
    (spectrum,) = measure(toy.map, case.vqa()).values()
    options = {"energy": 1.0, "soft": 0.0, "every": 1, "protect": ("maps",), "keeps": "weights"}
    parts = METHODS["nullspace"].start(
        MethodContext(
            two,
            {"both": list(two.parameters())},
            kinds,
            options,
            Anchor(inputs=dict.fromkeys(kinds, spectrum)),
        )
    )
    protected = case.vqa()
    said = two(*protected).detach()
    train(two, parts, "momentum", case.any())
    held, free = (two(*protected) - said).abs().amax(dim=tuple(range(1, said.dim())))
    assert held < 1e-10 < 1e-3 < free
