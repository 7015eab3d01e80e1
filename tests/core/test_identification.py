"""What routers tell about a task: flow, pruning, projections, and planted regressions."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import pytest
import torch
from samples.subspaces import share_inside
from torch import Tensor, nn

from aegis_cli.continual.learners import igsp
from aegis_cli.core.identification import (
    Flow,
    basis,
    charge,
    flow,
    needed,
    squared_norm,
    total_variation,
    where_read,
    without_span,
)
from aegis_cli.core.routing import Expert, RoutedLinear, Traced, traced

SEEDS = range(4)


def expert(seed: int, rank: int = 3, inputs: int = 6, outputs: int = 5) -> Expert:
    g = torch.Generator().manual_seed(seed)
    made = Expert(nn.Linear(inputs, outputs).double(), rank, 0)
    made.a.data, made.b.data = (
        torch.randn(p.shape, generator=g).double() for p in (made.a, made.b)
    )
    return made


@pytest.mark.parametrize("seed", SEEDS)
def test_flow_is_mean_weight_and_share_of_what_is_said(seed: int) -> None:
    g = torch.Generator().manual_seed(seed)
    experts = [expert(10 * seed + i) for i in range(3)]
    passes = [
        Traced(
            torch.rand(2, n, 3, generator=g).softmax(-1).double(),
            torch.randn(2, n, 3, 3, generator=g).double(),
            torch.empty(0),
        )
        for n in (4, 9)
    ]
    found = flow(passes, experts)
    weights, codes = (torch.cat([p[k].flatten(0, 1) for p in passes]) for k in (0, 1))
    said = torch.stack(
        [weights[:, i] * (codes[:, i] @ e.b.T).norm(dim=-1) for i, e in enumerate(experts)]
    ).mean(1)
    torch.testing.assert_close(found.mass, weights.mean(0))
    torch.testing.assert_close(found.load, (said / said.sum()).detach())


def test_the_load_of_experts_that_say_nothing_is_zero() -> None:
    made = expert(0)
    made.b.data.zero_()
    found = flow([Traced(torch.ones(2, 1), torch.ones(2, 1, 3), torch.empty(0))], [made])
    assert found.mass.tolist() == [1.0] and found.load.tolist() == [0.0]


def test_where_no_loss_reads_a_map_nothing_flows_and_nothing_is_needed() -> None:
    made = expert(0)
    passed = Traced(torch.ones(2, 1), torch.ones(2, 1, 3), torch.ones(2, 5, requires_grad=True))
    passes = where_read({"map": [passed]}, torch.ones((), requires_grad=True) * 2)
    found = flow(passes["map"], [made])
    assert found.mass.tolist() == found.load.tolist() == [0.0]
    assert needed(found, kappa=0.5, load=0.1) == ()


@pytest.mark.parametrize("seed", SEEDS)
def test_the_norm_needs_no_large_matrix(seed: int) -> None:
    made = expert(seed)
    torch.testing.assert_close(squared_norm(made), (made.b @ made.a).square().sum())


def test_total_variation() -> None:
    a, b = torch.tensor([0.5, 0.5, 0.0]), torch.tensor([0.0, 0.5, 0.5])
    assert total_variation(a, a) == 0 and total_variation(a, b) == total_variation(
        b, a
    ) == pytest.approx(0.5)
    assert total_variation(torch.tensor([1.0, 0.0]), torch.tensor([0.0, 1.0])) == 1


@pytest.mark.parametrize(
    ("mass", "load", "kept"),
    [
        ([0.6, 0.3, 0.1], [0.6, 0.35, 0.05], (0, 1)),  # little weight, little load
        (
            [0.6, 0.3, 0.1],
            [0.4, 0.2, 0.4],
            (0, 1, 2),
        ),  # little weight, but it carries the fit: the trap
        ([0.5, 0.3, 0.2], [0.5, 0.5, 0.0], (0, 1, 2)),  # no load yet, but weight
        ([0.9, 0.05, 0.05], [0.9, 0.05, 0.05], (0,)),  # old ones may go too
        ([0.1, 0.1, 0.8], [0.0, 0.0, 1.0], (2,)),  # only the new one serves
    ],
)
def test_an_expert_goes_only_if_weight_and_load_are_both_small(
    mass: list[float], load: list[float], kept: tuple[int, ...]
) -> None:
    assert needed(Flow(torch.tensor(mass), torch.tensor(load)), kappa=0.5, load=0.1) == kept


# --- projections ----------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("seed", SEEDS)
def test_projections_split_a_matrix(seed: int, scale: float) -> None:
    g = torch.Generator().manual_seed(seed)
    old = [scale * torch.randn(9, r, generator=g) for r in (2, 3)]
    old.append(old[0] @ torch.randn(2, 2, generator=g))  # adds nothing new
    columns = basis(old)
    assert columns.shape == (9, 5)
    torch.testing.assert_close(columns.T @ columns, torch.eye(5).double())
    gradient = torch.randn(9, 4, generator=g)
    outside = without_span(gradient, columns)
    assert outside.dtype == gradient.dtype and (columns.T @ outside.double()).abs().max() < 1e-6
    torch.testing.assert_close(without_span(outside, columns), outside)
    inside = share_inside(gradient, columns)
    assert 0 < inside < 1 and share_inside(outside, columns) < 1e-10
    assert outside.square().sum() / gradient.square().sum() == pytest.approx(1 - inside, rel=1e-4)
    assert share_inside(old[0] / scale, columns) == pytest.approx(1, abs=1e-6)
    assert share_inside(torch.zeros(9, 4), columns) == 0


# --- planted subspaces ----------------------------------------------------------------------------

HISTORY, RANK, INPUTS, OUTPUTS = 2, 2, 24, 16


class Outcome(NamedTuple):
    """The result of phase 1 of a regression.

    It has the loss, the routing flow, the new expert's norm, and how many new experts stay; and the
    share inside the span of history's columns, of what was learned and of what a gradient step of
    the task would add.
    """

    loss: float
    flow: Flow
    norm: float
    kept: int
    inside: float
    gradient_inside: float


@cache
def identify(
    seed: int,
    inside: float,
    reuse: float,
    norm: float,
    steps: int = 250,
    start: float | None = None,
) -> Outcome:
    """One map with two old experts and a new one learns a change.

    The share `inside` of the change is a mix of the old experts'.

    Routing starts as igsp's does, with the mass `start` on history, or uniform.
    """
    g = torch.Generator().manual_seed(seed)
    site = RoutedLinear(nn.Linear(INPUTS, OUTPUTS, bias=False))
    site.base.weight.data = torch.randn(OUTPUTS, INPUTS, generator=g) / INPUTS**0.5
    old = [site.add_expert(RANK, 0, g) for _ in range(HISTORY)]
    for made in site.of(old):
        made.b.data = torch.randn(OUTPUTS, RANK, generator=g)
    target = _unit(
        inside**0.5
        * _unit(
            sum(w * (e.b @ e.a).detach() for w, e in zip((0.6, 0.4), site.of(old), strict=True))
        )
        + (1 - inside) ** 0.5 * _unit(_low_rank(g))
    )
    new = site.add_expert(RANK, 1, g)
    site.requires_grad_(False)
    router = site.add_router(1, (*old, new), g)
    if start is not None:
        igsp.start(router, HISTORY, 1, start)
    made = site.experts[str(new)].requires_grad_(True)
    site.active = 1
    optimizer = torch.optim.AdamW(
        [
            {"params": list(made.parameters()), "lr": 0.01},
            {"params": list(router.parameters()), "lr": 0.05},
        ],
        weight_decay=0.0,
    )
    for _ in range(steps):
        x = torch.randn(64, INPUTS, generator=g)
        with traced({"map": site}) as passes:
            error = (site(x) - site.base(x) - x @ target.T).square().mean()
        charge(passes["map"][0], (HISTORY,), reuse)
        loss = error + norm * squared_norm(made)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    x = torch.randn(512, INPUTS, generator=g)
    with traced({"map": site}) as passes:
        y = site(x)
    found = flow(passes["map"], site.of(router.experts))
    kept = needed(found, kappa=0.5, load=0.1)
    columns = basis([e.b for e in site.of(old)])
    learning = [p for p in site.parameters() if p.requires_grad]
    gradients = torch.autograd.grad((y - site.base(x) - x @ target.T).square().mean(), learning)
    norm_found = squared_norm(made).item() ** 0.5
    with torch.no_grad():
        for parameter, gradient in zip(learning, gradients, strict=True):
            parameter -= 1e-3 * gradient
        shares = (share_inside(change.T, columns) for change in (y - site.base(x), site(x) - y))
    return Outcome(error.item(), found, norm_found, sum(i >= HISTORY for i in kept), *shares)


def _unit(change: Tensor) -> Tensor:
    """Scaled so that it moves outputs by 1 (root mean square) on normal inputs."""
    return change * OUTPUTS**0.5 / change.norm()


def _low_rank(g: torch.Generator) -> Tensor:
    return torch.randn(OUTPUTS, RANK, generator=g) @ torch.randn(RANK, INPUTS, generator=g)


@pytest.mark.parametrize(("inside", "kept"), [(1.0, 0), (0.5, 1), (0.0, 1)])
@pytest.mark.parametrize(("seed", "start"), [(0, None), (1, None), (2, 0.2), (3, 0.2)])
def test_a_target_inside_history_keeps_no_new_expert_and_one_outside_keeps_one(
    seed: int, inside: float, kept: int, start: float | None
) -> None:
    found = identify(seed, inside, reuse=0.1, norm=0.01, start=start)
    assert found.kept == kept and found.loss < 0.02


@pytest.mark.parametrize("seed", range(2))
def test_mass_alone_would_throw_away_what_carries_the_fit(seed: int) -> None:
    """The trap: without norm control a new expert grows while its weight falls under the limit."""
    trap, held = (identify(seed, 0.5, reuse=0.5, norm=norm, steps=350) for norm in (0.0, 0.003))
    uniform = 1 / (HISTORY + 1)
    assert trap.flow.mass[HISTORY] < 0.5 * uniform and trap.flow.load[HISTORY] > 0.25
    assert trap.norm > 5 * held.norm and held.flow.mass[HISTORY] > 2 * trap.flow.mass[HISTORY]
    assert trap.kept == 1  # its load keeps it


@pytest.mark.parametrize("seed", SEEDS)
def test_the_regulariser_projects_the_gradient_on_history(seed: int) -> None:
    """||P_H g||^2 / ||g||^2 of a target half inside rises with `reuse`.

    So does the share of what has been learned there.
    """
    off_, on, more = (
        identify(seed, 0.5, reuse=r, norm=0.01 * (r > 0), steps=20) for r in (0.0, 0.1, 0.2)
    )
    assert (
        off_.gradient_inside < on.gradient_inside - 0.01
        and on.gradient_inside < more.gradient_inside
    )
    assert off_.inside < on.inside < more.inside
    assert off_.flow.mass[HISTORY] > on.flow.mass[HISTORY] > more.flow.mass[HISTORY]


# --- positions that no loss reads -----------------------------------------------------------------


def sequence_map(seed: int) -> tuple[RoutedLinear, list[int], torch.Generator]:
    """A map with two old experts and a new one, all with outputs, in the order of their numbers.

    Task 1 is active.
    """
    g = torch.Generator().manual_seed(seed)
    site = RoutedLinear(nn.Linear(INPUTS, OUTPUTS, bias=False).double())
    site.base.weight.data = torch.randn(OUTPUTS, INPUTS, generator=g).double() / INPUTS**0.5
    numbers = [site.add_expert(RANK, owner, g) for owner in (0, 0, 1)]
    for made in site.of(numbers):
        made.b.data = torch.randn(OUTPUTS, RANK, generator=g).double()
    site.requires_grad_(False)
    igsp.start(site.add_router(1, numbers, g).requires_grad_(True), HISTORY, 1, 0.2)
    site.experts[str(numbers[-1])].requires_grad_(True)
    site.active = 1
    return site, numbers, g


@pytest.mark.parametrize("seed", SEEDS)
def test_a_charge_is_the_gradient_of_the_mass_where_the_loss_reads(seed: int) -> None:
    """With one map after it and two before, the charge equals the gradient of such a loss term."""
    site, numbers, g = sequence_map(seed)
    before, behind = (nn.Linear(n, m).double() for n, m in ((INPUTS, INPUTS), (OUTPUTS, 1)))
    x, read_mask = (
        torch.randn(3, 7, INPUTS, generator=g).double(),
        torch.rand(3, 7, generator=g) < 0.4,
    )
    learning = [*before.parameters(), *(p for p in site.parameters() if p.requires_grad)]
    gradients = []
    for charged in (True, False):
        with traced({"map": site}) as passes:
            loss = (behind(site(before(x)))[..., 0] * read_mask).square().sum()
        if charged:
            charge(passes["map"][0], (1, 2), 0.7)
        else:
            loss = loss + 0.7 * passes["map"][0].weights[read_mask][:, 1:].sum(-1).mean()
        gradients.append(torch.autograd.grad(loss, learning))
    for found, expected in zip(*gradients, strict=True):
        torch.testing.assert_close(found, expected)
    assert site.routers["1"].bias.requires_grad and gradients[0][-1].abs().sum() > 0


@pytest.mark.parametrize("seed", [0, 2])
def test_positions_that_no_loss_reads_decide_nothing(seed: int) -> None:
    """One position of fifty is read, and its target lies outside history.

    So the new expert stays alone.
    """
    site, numbers, g = sequence_map(seed)
    made = site.experts[str(numbers[-1])]
    made.b.data.zero_()
    target, mark = _unit(_low_rank(g)).double(), 2 * torch.randn(INPUTS, generator=g).double()
    learning = [
        {"params": list(made.parameters()), "lr": 0.01},
        {"params": list(site.routers["1"].parameters()), "lr": 0.05},
    ]
    optimizer = torch.optim.AdamW(learning, weight_decay=0.0)
    for step in range(151):
        x = torch.randn(16, 50, INPUTS, generator=g).double()
        x[:, 0] += mark
        with traced({"map": site}) as passes:
            error = (site(x) - site.base(x) - x @ target.T)[:, 0].square().mean()
        if step == 150:
            break
        charge(passes["map"][0], (HISTORY,), 0.1)
        optimizer.zero_grad()
        (error + 0.01 * squared_norm(made)).backward()
        optimizer.step()
    of_all, of_read = (
        flow(p["map"], site.of(numbers)) for p in (passes, where_read(passes, error))
    )
    assert needed(of_read, kappa=0.5, load=0.1) == (HISTORY,) != needed(of_all, kappa=0.5, load=0.1)
    assert of_all.mass[HISTORY] > 0.8  # if all positions counted, the others would remove it
