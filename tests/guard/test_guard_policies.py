"""A guard over the VLM in a policy whose loop calls the parts of the layers itself, as pi0 does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from samples.guard import IMAGE, LAYERS, WIDTH, Block, Vlm, anchors_by_method, batch, make, vector
from torch import Tensor, nn
from torch.nn import functional as F

from aegis_cli import Guard
from aegis_cli.common.errors import AegisError
from aegis_cli.models import structure

METHODS: dict[str, dict[str, Any]] = {
    "aegis": {"layers": LAYERS},
    "nullspace": {"vision": "vision", "energy": 0.9},
    "kfac": {"protect": ("maps",)},
}
EXTRA = 2  # tokens of the action expert


class Policy(nn.Module):
    """A VLM and an action expert, whose tokens attend to one another in every layer.

    Neither a layer of the VLM nor the VLM itself is called. `note` receives the VLM's hidden states
    after each layer.
    """

    def __init__(self, vlm: Vlm) -> None:
        super().__init__()
        self.vlm = vlm
        with torch.random.fork_rng():
            torch.manual_seed(7)
            self.expert = nn.ModuleList(Block() for _ in vlm.text.layers).double()
            self.start = nn.Parameter(torch.randn(EXTRA, WIDTH, dtype=torch.float64))
        self.note: Callable[[Any, Tensor], None] = lambda layer, hidden: None
        self.by_number = True

    def forward(self, pixels: Tensor, ids: Tensor, mask: Tensor) -> Tensor:
        x = torch.cat([self.vlm.vision(pixels).mT, self.vlm.text.words(ids)], 1)
        actions = self.start.expand(len(x), -1, -1)
        for i, (layer, own) in enumerate(zip(self.vlm.text.layers, self.expert, strict=True)):
            x, actions = together(layer, own, x, actions, ~mask)
            self.note(i if self.by_number else layer, x)
        return torch.cat([self.vlm.text.norm(x).mean(1), actions.mean(1)], 1)


def together(
    layer: Block, own: Block, x: Tensor, actions: Tensor, hidden: Tensor
) -> tuple[Tensor, Tensor]:
    """One layer of both; actions attend to the VLM's tokens, which attend only to each other."""
    q, k, v = layer.qkv(layer.norm1(x)).chunk(3, -1)
    r, s, w = own.qkv(own.norm1(actions)).chunk(3, -1)
    x = x + layer.out((q @ k.mT / 4).masked_fill(hidden[:, None], -1e4).softmax(-1) @ v)
    scores = torch.cat([(r @ k.mT / 4).masked_fill(hidden[:, None], -1e4), r @ s.mT / 4], -1)
    actions = actions + own.out(scores.softmax(-1) @ torch.cat([v, w], 1))
    parts = []
    for block, tokens in ((layer, x), (own, actions)):
        parts.append(tokens + block.down(F.gelu(block.up(block.norm2(tokens)))))
    return parts[0], parts[1]


@pytest.fixture(scope="module")
def anchors(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The anchor that each method reads, measured on the VLM alone."""
    return anchors_by_method(tmp_path_factory.mktemp("anchors"))


def loss_of(policy: nn.Module, seed: int) -> Tensor:
    return (policy(*batch(seed)) - 1).square().mean()


def train(policy: Policy, guard: Guard | None, by_itself: bool = False) -> Tensor:
    optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-2)
    for seed in range(3):
        if guard is None or by_itself:
            loss_of(policy, seed).backward()
            optimizer.step()
        else:
            with guard.watch(batch(seed)[2]):
                loss = loss_of(policy, seed)
            guard.backward(loss)
            guard.step(optimizer)
        optimizer.zero_grad()
    return vector(policy)


def guarded(method: str, anchors: dict[str, Path]) -> tuple[Policy, Guard]:
    policy = Policy(make())
    guard = Guard(policy, anchors[method], method=method, part="vlm", **METHODS[method])
    policy.note = guard.note
    return policy, guard


@pytest.mark.parametrize("by_number", [True, False])
def test_noted_hidden_states_are_those_of_the_layers(
    by_number: bool, anchors: dict[str, Path]
) -> None:
    """The VLM's tokens do not attend to actions, so they equal those of the VLM's own pass."""
    policy, guard = guarded("aegis", anchors)
    policy.by_number = by_number
    pixels, ids, mask = batch(0)
    with guard.watch(mask):
        policy(pixels, ids, mask)
    noted = guard._seen
    guard.discard()
    with guard.watch(mask):
        policy.vlm(pixels, ids, mask)
    assert noted is not None and guard._seen is not None
    for one, other in zip(noted.hidden, guard._seen.hidden, strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("method", METHODS)
def test_a_part_of_a_policy_is_guarded_and_the_rest_is_not(
    method: str, anchors: dict[str, Path]
) -> None:
    policy, guard = guarded(method, anchors)
    after, naive = train(policy, guard), train(Policy(make()), None)
    assert not torch.allclose(after, naive)
    if method == "aegis":
        rows = guard.ledger.tensors()
        assert guard.ledger.groups[:2] == ("layers.0", "layers.1")
        assert (rows["ta"] < 0).any() and len(guard.ledger) == 3
        assert not [name for name in guard.ledger.groups if "expert" in name]


@pytest.mark.parametrize("method", METHODS)
def test_the_part_by_its_name_is_the_part_itself(method: str, anchors: dict[str, Path]) -> None:
    found = []
    for by_name in (True, False):
        policy = Policy(make())
        given: dict[str, Any] = {"part": "vlm"} if by_name else {}
        model = policy if by_name else policy.vlm
        guard = Guard(model, anchors[method], method=method, **given, **METHODS[method])
        policy.note = guard.note
        found.append(train(policy, guard))
    assert torch.equal(*found)


@pytest.mark.parametrize("method", METHODS)
def test_an_automatic_guard_around_the_policy(method: str, anchors: dict[str, Path]) -> None:
    policy, guard = guarded(method, anchors)
    expected = train(policy, guard)
    other, its = guarded(method, anchors)
    its.automatic(around=other, mask="mask")
    assert torch.equal(train(other, its, by_itself=True), expected)
    with torch.no_grad():
        loss_of(other, 0)  # an evaluation notes nothing


def test_an_anchor_is_measured_of_a_part(anchors: dict[str, Path], tmp_path: Path) -> None:
    """It is that of the part alone, whether its layers are called or noted."""
    found = []
    for noted in (True, False):
        policy = Policy(make()).eval()
        with Guard.measure(policy, LAYERS, part="vlm") as measured:
            policy.note = measured.note
            pixels, ids, mask = batch(100)
            with measured.watch(mask, IMAGE):
                (policy if noted else policy.vlm)(pixels, ids, mask)
        path = tmp_path / f"{noted}.safetensors"
        measured.save(path)
        found.append(measured.anchor().text[0].mean)
        Guard(make(), path, LAYERS)
    torch.testing.assert_close(*found)


def test_layers_that_nobody_notes(anchors: dict[str, Path]) -> None:
    policy, guard = guarded("aegis", anchors)
    policy.note = lambda layer, hidden: None
    with pytest.raises(AegisError, match="was not called") as caught, guard.watch(batch(0)[2]):
        loss_of(policy, 0)
    assert "note(layer, hidden)" in caught.value.fix


@pytest.mark.parametrize(
    ("layer", "says"),
    [(2, "layer 2"), (-1, "layer -1"), (nn.Linear(2, 2), "a Linear")],
)
def test_what_is_none_of_the_layers(layer: Any, says: str, anchors: dict[str, Path]) -> None:
    _, guard = guarded("aegis", anchors)
    guard.note(layer, torch.zeros(1, 2, WIDTH))  # outside a watched pass nothing is checked
    with pytest.raises(AegisError, match=says), guard.watch(None):
        guard.note(layer, torch.zeros(1, 2, WIDTH))


def test_a_layer_that_is_called_and_noted(anchors: dict[str, Path]) -> None:
    model = make()
    guard = Guard(model, anchors["aegis"], LAYERS)
    for first in (True, False):
        with pytest.raises(AegisError, match="called too"), guard.watch(batch(0)[2]):
            if first:
                guard.note(0, torch.zeros(1, 2, WIDTH))
            model(*batch(0))
            guard.note(0, torch.zeros(1, 2, WIDTH))


def test_a_part_that_the_policy_does_not_have(anchors: dict[str, Path]) -> None:
    with pytest.raises(AegisError, match="no part 'vml' in Policy") as caught:
        Guard(Policy(make()), anchors["aegis"], LAYERS, part="vml")
    assert "vlm, expert" in caught.value.expected
    assert structure.part_of(Policy(make()), None).__class__ is Policy


@pytest.mark.parametrize("layers", [None, LAYERS, f"vlm.{LAYERS}"])
def test_the_part_that_the_anchor_was_measured_on_is_named_where_it_is_left_out(
    layers: str | None, anchors: dict[str, Path]
) -> None:
    with pytest.raises(AegisError) as caught:
        Guard(Policy(make()), anchors["aegis"], layers)
    assert str(anchors["aegis"]) in caught.value.expected and 'part="vlm"' in caught.value.fix
    with pytest.raises(AegisError) as caught:
        Guard(Policy(make()), anchors["nullspace"], method="nullspace", vision="vlm.vision")
    assert 'part="vlm"' in caught.value.fix


def test_no_part_is_named_that_was_not_measured(anchors: dict[str, Path]) -> None:
    with pytest.raises(AegisError) as caught:
        Guard(Policy(make(seed=5)), anchors["aegis"])
    assert "part=" not in caught.value.fix and f"vlm.{LAYERS}" in caught.value.fix
