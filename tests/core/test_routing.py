"""Routed experts: what they compute, what they never change, and why a router projects."""

from __future__ import annotations

import pytest
import torch
from samples.subspaces import share_inside
from torch import Tensor, nn

from aegis_cli.core import routing
from aegis_cli.core.identification import basis
from aegis_cli.core.routing import RoutedLinear, activate, traced

WIDTHS = (11, 7)  # inputs, outputs
SEEDS = range(4)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def site(
    seed: int, experts: int = 0, rank: int = 3, dtype: torch.dtype = torch.float64
) -> tuple[RoutedLinear, torch.Generator]:
    """A map, and this many experts with random B."""
    g = generator(seed)
    base = nn.Linear(*WIDTHS).to(dtype)
    with torch.no_grad():
        for p in base.parameters():
            p.copy_(torch.randn(p.shape, generator=g))
    made = RoutedLinear(base)
    for _ in range(experts):
        fill(made, made.add_expert(rank, 0, g), g)
    return made, g


def fill(made: RoutedLinear, number: int, g: torch.Generator) -> None:
    b = made.experts[str(number)].b
    b.data = torch.randn(b.shape, generator=g).to(b.dtype)


def stir(made: RoutedLinear, task: int, g: torch.Generator) -> None:
    """Random logits and scale, as training would leave them."""
    for p in made.routers[str(task)].parameters():
        p.data = torch.randn(p.shape, generator=g).to(p.dtype)


def inputs(g: torch.Generator, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.randn(4, 5, WIDTHS[0], generator=g).to(dtype)


@pytest.mark.parametrize("seed", SEEDS)
def test_without_experts_it_is_the_bare_map(seed: int) -> None:
    made, g = site(seed, experts=3)
    x = inputs(g)
    bare = made.base(x)
    assert torch.equal(made(x), bare)
    made.active = 5  # a task without a router here
    assert torch.equal(made(x), bare)
    made.add_router(0, (0, 2), g)
    made.restrict(0, ())
    made.active = 0
    assert torch.equal(made(x), bare)


@pytest.mark.parametrize("seed", SEEDS)
def test_new_experts_and_their_router_change_nothing_yet(seed: int) -> None:
    made, g = site(seed)
    x = inputs(g)
    numbers = [made.add_expert(3, 0, g) for _ in range(2)]
    made.add_router(0, numbers, g)
    made.active = 0
    assert torch.equal(made(x), made.base(x))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("top", "constant"), [(None, False), (2, False), (2, True)])
def test_it_computes_its_equation(seed: int, top: int | None, constant: bool) -> None:
    made, g = site(seed, experts=4)
    used = (0, 1, 3)
    router = made.add_router(7, used, g, top, constant)
    stir(made, 7, g)
    made.active, x = 7, inputs(g)
    with torch.no_grad():
        expected = made.base(x).clone()
        for place in torch.cartesian_prod(torch.arange(4), torch.arange(5)).tolist():
            row = x[tuple(place)]
            said = [made.experts[str(e)].b @ (made.experts[str(e)].a @ row) for e in used]
            logits = torch.stack(
                [
                    router.read[i] @ (made.experts[str(e)].a @ row) + router.bias[i]
                    if top is None
                    else router.bias[i]
                    if constant
                    else router.read[i] @ x[place[0]].mean(0)
                    for i, e in enumerate(used)
                ]
            )
            if top is not None:
                logits[logits.argsort(descending=True)[top:]] = -torch.inf
            expected[tuple(place)] += router.scale * sum(
                p * f for p, f in zip(logits.softmax(0), said, strict=True)
            )
        torch.testing.assert_close(
            made(x), expected, rtol=1e-5, atol=1e-5
        )  # the softmax is taken in float32


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize(
    ("top", "constant"), [(None, False), (1, False), (2, False), (1, True), (2, True)]
)
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_weights_sum_to_one_over_what_exists(
    count: int, top: int | None, constant: bool, scale: float
) -> None:
    made, g = site(count, experts=6)
    made.add_router(0, range(count), g, top, constant)
    stir(made, 0, g)
    made.active = 0
    with traced({"map": made}) as found:
        made(scale * inputs(g))
    weights = found["map"][0].weights
    assert weights.shape == (4, 5, count) and (weights >= 0).all()
    torch.testing.assert_close(
        weights.sum(-1), torch.ones(4, 5, dtype=torch.float64), rtol=0, atol=1e-6
    )
    if top is not None:
        assert ((weights > 0).sum(-1) <= top).all()
    assert made.trace is None


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("seed", SEEDS)
def test_what_later_tasks_add_changes_no_bit_of_earlier_outputs(
    seed: int, dtype: torch.dtype
) -> None:
    made, g = site(seed, experts=2, dtype=dtype)
    made.add_router(0, (0, 1), g)
    stir(made, 0, g)
    made.active, x = 0, inputs(g, dtype)
    before = made(x)
    for task in (1, 2, 3):
        new = [made.add_expert(3, task, g) for _ in range(2)]
        for number in new:
            fill(made, number, g)
        made.add_router(task, made.numbers, g)
        stir(made, task, g)
        made.restrict(task, made.numbers[:-1])
        assert torch.equal(made(x), before)
        made.active = task
        assert not torch.equal(made(x), before)
        made.active = 0
        assert torch.equal(made(x), before)


# --- pruning --------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("gone", [(1,), (0, 2), (1, 3)])
def test_an_expert_of_weight_zero_changes_nothing_when_it_goes(
    seed: int, gone: tuple[int, ...]
) -> None:
    made, g = site(seed, experts=4)
    router = made.add_router(0, range(4), g)
    stir(made, 0, g)
    router.bias.data[list(gone)] = -1e30  # a weight of exactly zero
    made.active, x = 0, inputs(g)
    before = made(x)
    made.restrict(0, [e for e in range(4) if e not in gone])
    torch.testing.assert_close(made(x), before, rtol=1e-12, atol=1e-12)
    assert set(made.numbers) == set(range(4)) - set(gone)


@pytest.mark.parametrize("seed", SEEDS)
def test_what_pruning_changes_is_bounded_by_what_is_pruned(seed: int) -> None:
    """If experts with mass m and terms p_e f_e are removed, the change is bounded.

    It is at most m / (1 - m) times the remaining terms, plus the removed ones.
    """
    made, g = site(seed, experts=4)
    made.add_router(0, range(4), g)
    stir(made, 0, g)
    made.active, x = 0, inputs(g)
    with torch.no_grad(), traced({"map": made}) as found:
        before = made(x).flatten(0, 1)
        weights, codes = (part.flatten(0, 1) for part in found["map"][0][:2])
        scale = float(made.routers["0"].scale.abs())
        norms = (
            scale
            * torch.stack(
                [(codes[:, e] @ made.experts[str(e)].b.T).norm(dim=-1) for e in range(4)], 1
            )
            * weights
        )
        made.restrict(0, (0, 2))
        moved = (made(x).flatten(0, 1) - before).norm(dim=-1)
    lost = weights[:, [1, 3]].sum(-1)
    bound = lost / (1 - lost) * norms[:, [0, 2]].sum(-1) + norms[:, [1, 3]].sum(-1)
    assert (moved <= bound * (1 + 1e-5) + 1e-6).all() and moved.max() > 1e-3


def test_a_pruned_map_is_the_map_that_never_had_the_expert() -> None:
    """Pruning and continuing equals, bit for bit, continuing without the expert."""
    made, g = site(0, experts=3)
    made.add_router(0, range(3), g)
    stir(made, 0, g)
    rows = [0, 2]
    read, bias, scale = (
        p.detach().clone()
        for p in (made.routers["0"].read, made.routers["0"].bias, made.routers["0"].scale)
    )
    made.restrict(0, rows)
    without, other = site(0, experts=3)
    router = without.add_router(0, rows, other)
    router.read.data, router.bias.data, router.scale.data = read[rows], bias[rows], scale
    made.active = without.active = 0
    x = inputs(g)
    for one in (made, without):
        optimizer = torch.optim.AdamW(
            [p for name, p in one.named_parameters() if "base" not in name], lr=0.01
        )
        for _ in range(3):
            optimizer.zero_grad()
            one(x).square().sum().backward()
            optimizer.step()
    assert torch.equal(made(x), without(x))


def test_a_single_expert_needs_no_logits_and_parameters_are_counted() -> None:
    made, g = site(0, experts=3, rank=2)
    expert = 2 * sum(WIDTHS)
    made.add_router(0, (1,), g)
    assert made.count() == 3 * expert + 1
    made.add_router(1, (0, 1, 2), g)
    assert made.count() == 3 * expert + 1 + (3 * (2 + 1) + 1)
    made.add_router(2, (0, 2), g, top=2)
    assert made.count() == 3 * expert + 1 + 10 + 2 * WIDTHS[0] + 1
    del made.routers["2"]
    made.restrict(1, (1,))  # no router has the others any more
    assert made.numbers == (1,) and made.count() == expert + 2
    assert [made.add_expert(2, 3, g) for _ in range(3)] == [
        3,
        4,
        5,
    ]  # a number is never reused


@pytest.mark.parametrize(("top", "constant"), [(None, False), (2, False), (2, True)])
def test_structure_and_tensors_rebuild_it(top: int | None, constant: bool) -> None:
    made, g = site(1, experts=4)
    for task, used in ((0, (0, 1)), (3, (1, 2, 3)), (11, (2,))):
        made.add_router(task, used, g, top, constant)
        stir(made, task, g)
    made.experts["2"].frozen = True
    again, _ = site(1)
    again.rebuild(made.structure())
    assert again.structure() == made.structure()
    kept = routing.named_parameters({"map": made})
    found = routing.named_parameters({"map": again})
    assert list(found) == list(kept) and not any(p.requires_grad for p in found.values())
    for name, p in found.items():
        p.data.copy_(kept[name])
    x = inputs(g)
    for task in (None, 0, 3, 11):
        made.active = again.active = task
        assert torch.equal(again(x), made(x))


# --- why routing is a projection ------------------------------------------------------------------


@pytest.mark.parametrize("weight", [0.0, 0.01, 0.5])
def test_the_gradient_of_an_expert_is_scaled_by_its_weight(weight: float) -> None:
    """dL/dB_e = s sum_n p_e g (A_e x)^T, and nothing at p_e = 0."""
    made, g = site(0, experts=2)
    router = made.add_router(0, (0, 1), g)
    router.read.data.zero_()
    logit = torch.tensor(weight, dtype=torch.float64).logit() if weight else torch.tensor(-1e30)
    router.bias.data = torch.stack([torch.zeros((), dtype=torch.float64), logit.double()])
    router.scale.data.fill_(1.7)
    made.active, x = 0, inputs(g)
    y = made(x)
    y.retain_grad()
    (y * torch.randn(y.shape, generator=g)).sum().backward()
    outer = torch.einsum("bto,btr->or", y.grad, x @ made.experts["1"].a.T)
    torch.testing.assert_close(made.experts["1"].b.grad, 1.7 * weight * outer, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_router_over_frozen_experts_moves_inside_their_span_only(seed: int) -> None:
    """Whatever the loss, a router's step moves outputs along the columns of the experts' B."""
    made, g = site(seed, experts=2, rank=2)
    router = made.add_router(0, (0, 1), g)
    stir(made, 0, g)
    made.active, x = 0, inputs(g)
    columns = basis([e.b for e in made.of((0, 1))])
    assert columns.shape == (WIDTHS[1], 4)
    before = made(x)
    (before * torch.randn(before.shape, generator=g)).sum().backward()
    with torch.no_grad():
        for p in router.parameters():
            p -= 0.1 * p.grad
        moved = (made(x) - before).flatten(0, 1).T
    assert moved.norm() > 1e-3 and share_inside(moved, columns) == pytest.approx(1, abs=1e-6)


# --- in a tree of modules -------------------------------------------------------------------------


def test_route_replaces_maps_where_they_are_and_changes_nothing() -> None:
    torch.manual_seed(0)
    model = nn.Sequential(
        nn.Linear(4, 6), nn.ModuleDict({"inner": nn.Linear(6, 6)})["inner"], nn.Linear(6, 2)
    )
    tree = nn.ModuleDict({"part": model})
    x = torch.randn(3, 4)
    before = model(x)
    names = {"part.0": model[0], "part.2": model[2]}
    routed = routing.route(tree, names)
    assert (
        tree.get_submodule("part.2") is routed["part.2"]
        and routed["part.2"].base is names["part.2"]
    )
    assert torch.equal(model(x), before)
    assert not any(p.requires_grad for p in model[0].parameters()) and model[1].weight.requires_grad
    activate(routed, 4)
    assert [m.active for m in routed.values()] == [4, 4]
    assert routing.named_parameters(routed) == {}
