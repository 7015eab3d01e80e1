"""The options of AEGIS: tokens compared, groups projected, where the conflict is removed."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import pytest
import torch
from samples.training import (
    adapt,
    double_policy,
    gradients,
    make_moments,
    make_policy,
    options_of,
    robot_batch,
    same_bits,
    snapshot,
    snapshot_gradients,
)
from torch import Tensor, nn

from aegis_cli.core import projection
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.moments import Moments
from aegis_cli.core.numerics import ratio
from aegis_cli.methods import METHODS, aegis
from aegis_cli.methods.base import MethodContext, Parts, Pass, Update
from aegis_cli.models.policy import Policy
from aegis_cli.recipes import IDLE, PROJECTED, SCOPES, WEIGHTINGS
from aegis_cli.training import step

AEGIS, NAIVE = METHODS["aegis"], METHODS["naive"]
DEPTH, WIDTH, BATCH, IMAGE, TEXT = 3, 5, 4, 6, 7
Named = Mapping[str, Tensor | None]


# --- the penalty, on hidden states made up --------------------------------------------------------


def make_anchor() -> Anchor:
    """Image and text tokens that differ in number, mean and size, and layers that grow."""
    layers = {
        "image": make_moments(DEPTH, WIDTH, seed=1),
        "text": make_moments(DEPTH, WIDTH, seed=2),
    }
    counts = {"image": 300, "text": 70}
    grown = {
        name: [Moments(counts[name], 3**i * m.mean, 9**i * m.var) for i, m in enumerate(ms)]
        for name, ms in layers.items()
    }
    return Anchor(grown["image"], grown["text"])


def make_pass(seed: int = 0) -> Pass:
    """Text of different lengths; values at padding are huge, so using them would show."""
    generator = torch.Generator().manual_seed(seed)
    mask = torch.ones(BATCH, IMAGE + TEXT, dtype=torch.bool)
    for row, length in enumerate((TEXT, 2, 4, 1)):
        mask[row, IMAGE + length :] = False
    hidden = [
        torch.randn(BATCH, IMAGE + TEXT, WIDTH, generator=generator, dtype=torch.float64)
        for _ in range(DEPTH)
    ]
    hidden = [h.masked_fill(~mask[..., None], 1e6).requires_grad_() for h in hidden]
    return Pass(0, None, hidden, mask, torch.arange(IMAGE + TEXT) < IMAGE)


def start(**options: Any) -> Parts:
    module = nn.Linear(1, 1).double()
    return AEGIS.start(
        MethodContext(
            module,
            {"layers.0": list(module.parameters())},
            {},
            options_of(AEGIS, **options),
            make_anchor(),
        )
    )


def penalty(seen: Pass, **options: Any) -> tuple[Tensor, Tensor, list[Tensor]]:
    """The penalty, W2^2 of each layer, and the penalty's gradient in the hidden states."""
    measure = start(**options).penalty
    assert measure is not None
    cost, w2 = measure(seen)
    return cost.detach(), w2, list(torch.autograd.grad(cost, list(seen.hidden)))


def distance(rows: Tensor, mean: Tensor, var: Tensor) -> Tensor:
    return (rows.mean(0) - mean).square().sum() + (
        rows.std(0, correction=0) - var.sqrt()
    ).square().sum()


def union(a: Moments, b: Moments) -> tuple[Tensor, Tensor]:
    """Mean and variance of both token sets, from E[x] and E[x^2]."""
    share = b.count / (a.count + b.count)
    mean = (1 - share) * a.mean + share * b.mean
    square = (1 - share) * (a.var + a.mean.square()) + share * (b.var + b.mean.square())
    return mean, square - mean.square()


def expected(seen: Pass, scope: str) -> tuple[list[Tensor], list[Tensor]]:
    """W2^2 of each layer over the tokens in scope, and the trace of each layer's anchor."""
    anchor = make_anchor()
    inside = {"all": seen.mask, "image": seen.mask & seen.image, "text": seen.mask & ~seen.image}[
        scope
    ]
    targets = {
        "all": [union(i, t) for i, t in zip(anchor.image, anchor.text, strict=True)],
        "image": [(m.mean, m.var) for m in anchor.image],
        "text": [(m.mean, m.var) for m in anchor.text],
    }[scope]
    costs = [distance(h[inside], *target) for h, target in zip(seen.hidden, targets, strict=True)]
    return costs, [var.sum() for _, var in targets]


@pytest.mark.parametrize("weighting", WEIGHTINGS)
@pytest.mark.parametrize("scope", [s for s in SCOPES if s != "each"])
def test_the_penalty_is_the_distance_of_the_tokens_in_scope(scope: str, weighting: str) -> None:
    seen = make_pass()
    cost, w2, gradient = penalty(seen, scope=scope, weighting=weighting)
    layers, traces = expected(seen, scope)
    wanted = torch.stack(
        [c / t if weighting == "variance" else c for c, t in zip(layers, traces, strict=True)]
    ).mean()
    torch.testing.assert_close(cost, wanted.detach())
    torch.testing.assert_close(w2, torch.stack(layers).detach())  # never weighted
    for got, own in zip(gradient, torch.autograd.grad(wanted, list(seen.hidden)), strict=True):
        torch.testing.assert_close(got, own)


def test_scopes_and_weightings_differ() -> None:
    """Otherwise the comparisons of these tests would show nothing."""
    seen = make_pass()
    costs = [penalty(seen, scope=s, weighting=w)[0].item() for s in SCOPES for w in WEIGHTINGS]
    assert len({round(cost, 9) for cost in costs}) == len(SCOPES) * len(WEIGHTINGS) == 8


@pytest.mark.parametrize("scope", ["image", "text"])
def test_tokens_out_of_scope_change_nothing(scope: str) -> None:
    seen = make_pass()
    out = seen.image if scope == "text" else ~seen.image
    noise = make_pass(seed=9).hidden
    changed = [
        torch.where(out[:, None], n, h).detach().requires_grad_()
        for h, n in zip(seen.hidden, noise, strict=True)
    ]
    before, after = (
        penalty(seen, scope=scope),
        penalty(dataclasses.replace(seen, hidden=changed), scope=scope),
    )
    assert torch.equal(before[0], after[0]) and torch.equal(before[1], after[1])
    for was, now in zip(before[2], after[2], strict=True):
        assert torch.equal(was, now)
        assert now[:, ~out].any() and not now[:, out].any()


@pytest.mark.parametrize("scope", SCOPES)
def test_padding_is_never_compared(scope: str) -> None:
    seen = make_pass()
    changed = [
        h.masked_fill(~seen.mask[..., None], torch.nan).detach().requires_grad_()
        for h in seen.hidden
    ]
    before, after = (
        penalty(seen, scope=scope),
        penalty(dataclasses.replace(seen, hidden=changed), scope=scope),
    )
    assert torch.equal(before[0], after[0])
    assert all(
        torch.equal(x, y) and not y[~seen.mask].any()
        for x, y in zip(before[2], after[2], strict=True)
    )


@pytest.mark.parametrize("weighting", WEIGHTINGS)
def test_each_is_the_mean_of_image_and_text(weighting: str) -> None:
    seen = make_pass()
    each, image, text = (
        penalty(seen, scope=scope, weighting=weighting) for scope in ("each", "image", "text")
    )
    torch.testing.assert_close(each[0], (image[0] + text[0]) / 2)
    torch.testing.assert_close(each[1], (image[1] + text[1]) / 2)
    for both, i, t in zip(each[2], image[2], text[2], strict=True):
        torch.testing.assert_close(both, (i + t) / 2)


# --- which groups, and the restoring term ---------------------------------------------------------


def task_and_anchor() -> tuple[Named, Named]:
    """Task and anchor gradients of the backbone, neither changed by the other."""
    policy = adapt(AEGIS, double_policy(), projects="update")
    anchor = gradients(policy, AEGIS).anchor
    return snapshot_gradients(policy, "backbone."), {
        f"backbone.{name}": a for name, a in anchor.items()
    }


def bent(**options: Any) -> Named:
    policy = adapt(AEGIS, double_policy(), **options)
    gradients(policy, AEGIS)
    return snapshot_gradients(policy, "backbone.")


def difference(x: Tensor | None, y: Tensor | None) -> Tensor:
    """x - y; a missing one counts as zero."""
    zero = torch.zeros_like(x if x is not None else y)  # type: ignore[arg-type]
    return (zero if x is None else x) - (zero if y is None else y)


def test_language_leaves_the_other_groups_as_naive_has_them() -> None:
    naive, policies = (
        adapt(NAIVE, make_policy()),
        {g: adapt(AEGIS, make_policy(), groups=g) for g in ("language", "all")},
    )
    gradients(naive, NAIVE)
    task = snapshot_gradients(naive)
    for policy in policies.values():
        gradients(policy, AEGIS)
    found = {groups: snapshot_gradients(policy) for groups, policy in policies.items()}
    outside = {name for name in task if not name.startswith("backbone.layers.")}
    assert {
        "backbone.words.weight",
        "backbone.stem.halve.0.weight",
        "backbone.final_norm.bias",
    } <= outside
    assert all(same_bits(task[name], found["language"][name]) for name in outside)
    assert not all(same_bits(task[name], found["all"][name]) for name in outside)
    inside = task.keys() - outside
    assert all(same_bits(found["all"][name], found["language"][name]) for name in inside)
    assert not all(same_bits(task[name], found["language"][name]) for name in inside)


@pytest.mark.parametrize("projects", PROJECTED)
@pytest.mark.parametrize("groups", ["all", "language"])
def test_restoration_adds_its_share_of_the_anchor_gradient(groups: str, projects: str) -> None:
    _, anchor = task_and_anchor()
    without, restored = (
        bent(groups=groups, projects=projects, restoration=weight) for weight in (0.0, 0.7)
    )
    for name in without:
        a = anchor.get(name)
        if a is None or (groups == "language" and not name.startswith("backbone.layers.")):
            assert same_bits(restored[name], without[name])
        else:
            torch.testing.assert_close(
                difference(restored[name], without[name]), 0.7 * a, rtol=1e-9, atol=1e-13
            )


# --- what the task does not move ------------------------------------------------------------------


def idle_entries(task: Named) -> dict[str, Tensor]:
    """Where each task gradient is zero; a missing gradient is zero everywhere."""
    shapes = {f"backbone.{n}": p for n, p in make_policy().backbone.named_parameters()}
    return {
        name: torch.ones_like(shapes[name], dtype=torch.bool) if g is None else g == 0
        for name, g in task.items()
    }


@pytest.mark.parametrize("restoration", [0.0, 0.7])
def test_kept_bends_nothing_that_the_task_does_not_move(restoration: float) -> None:
    task, _ = task_and_anchor()
    moved, kept = (bent(idle=idle, restoration=restoration) for idle in IDLE)
    idle = idle_entries(task)
    assert any(mask.all() for mask in idle.values())  # tensors that no task gradient reaches
    assert any(mask.any() and not mask.all() for mask in idle.values())  # and parts of others
    assert any(g is not None and g[idle[name]].any() for name, g in moved.items())
    for name, g in kept.items():
        assert (g is None) == (task[name] is None), name
        assert g is None or not g[idle[name]].any(), name
    active = {name for name, mask in idle.items() if not mask.all()}
    assert any(not same_bits(kept[name], task[name]) for name in active)


def test_kept_is_orthogonal_to_the_anchor_gradient_of_what_moves() -> None:
    policy = adapt(AEGIS, double_policy(), idle="kept")
    found = gradients(policy, AEGIS)
    assert found.row is not None and (found.row.ta < 0).any()
    named = {n: p.grad for n, p in policy.backbone.named_parameters()}
    for i, names in enumerate(named_groups(policy).values()):
        parts = [(named[n] * found.anchor[n]).sum() for n in names if n in found.anchor]
        along_anchor = sum(parts, torch.zeros((), dtype=torch.float64))
        scale = (found.row.tt[i] * found.row.aa[i]).sqrt()
        if found.row.ta[i] < 0:
            assert along_anchor.abs() < 1e-12 * scale
    assert found.taken.keys() > found.anchor.keys()  # what later steps may reuse is complete


@pytest.mark.parametrize("projects", PROJECTED)
@pytest.mark.parametrize("optimizer", [torch.optim.AdamW, torch.optim.SGD])
def test_a_parameter_without_a_task_gradient_stays_bit_for_bit_when_kept(
    projects: str, optimizer: type[torch.optim.Optimizer]
) -> None:
    unreached = {
        name.removeprefix("backbone.") for name, g in task_and_anchor()[0].items() if g is None
    }
    assert unreached
    changed = {}
    for idle in IDLE:
        policy = adapt(AEGIS, double_policy(), projects=projects, idle=idle)
        first = snapshot(policy.backbone.named_parameters())
        steps = optimizer(policy.parameters(), lr=1e-3, weight_decay=0.1)
        for _ in range(3):
            found, before, _ = stepped(policy, steps)
            if policy.parts.constrain is not None:
                policy.parts.constrain(Update(before, found.anchor))
        after = snapshot(policy.backbone.named_parameters())
        changed[idle] = {name for name in unreached if not same_bits(after[name], first[name])}
    assert not changed["kept"] and changed["moved"]


# --- the anchor gradient of a part of the batch ---------------------------------------------------


def test_a_fraction_of_the_batch_has_the_anchor_gradient_of_its_frames_alone() -> None:
    whole, part = (adapt(AEGIS, double_policy(), fraction=f) for f in (1.0, 0.5))
    batch = robot_batch()
    frames = 3  # half of five, rounded up
    alone = batch.rows(slice(frames))
    own, found = gradients(whole, AEGIS, batch=alone), gradients(part, AEGIS, batch=batch)
    assert own.anchor.keys() == found.anchor.keys()
    for name, a in found.anchor.items():
        torch.testing.assert_close(a, own.anchor[name], rtol=1e-9, atol=1e-13)
    assert own.row is not None and found.row is not None
    torch.testing.assert_close(found.row.w2, own.row.w2)
    full = gradients(adapt(AEGIS, double_policy()), AEGIS, batch=batch)
    assert full.row is not None and torch.equal(full.row.tt, found.row.tt)
    assert not torch.allclose(full.row.aa, found.row.aa)


@pytest.mark.parametrize("projects", PROJECTED)
def test_the_weights_of_the_two_gradients(projects: str) -> None:
    tt, ta, aa = (
        torch.tensor(x, dtype=torch.float64)
        for x in ([1.0, 2.0, 1.0], [-1.0, 1.0, -1.0], [4.0, 4.0, 0.0])
    )
    for weight in (0.0, 0.3):
        combine = start(projects=projects, restoration=weight).combine
        assert combine is not None
        task, anchor = combine(tt[:1], ta[:1], aa[:1])  # for one group, as in the setting
        assert task.tolist() == [1.0] and anchor.tolist() == [
            (0.0 if projects == "update" else 0.25) + weight
        ]


# --- the applied update ---------------------------------------------------------------------------


def named_groups(policy: Policy) -> dict[str, list[str]]:
    name_of = {id(p): name for name, p in policy.backbone.named_parameters()}
    return {
        group: [name_of[id(p)] for p in members]
        for group, members in policy.backbone.parameter_groups().items()
    }


def stepped(
    policy: Policy, optimizer: torch.optim.Optimizer
) -> tuple[step.StepGradients, dict[str, Tensor], dict[str, Tensor]]:
    """One unconstrained step: its gradients, and the parameters before and after it."""
    found = gradients(policy, AEGIS)
    before = snapshot(policy.backbone.named_parameters())
    optimizer.step()
    return found, before, snapshot(policy.backbone.named_parameters())


def along(names: list[str], now: Named, before: Named, anchor: Named) -> tuple[Tensor, Tensor]:
    """<D, a> and the cosine between the two."""
    dd, da, aa = projection.inner(
        [difference(now[n], before[n]) for n in names], [anchor.get(n) for n in names]
    )
    return da, ratio(da, (dd * aa).sqrt())


@pytest.mark.parametrize("projects", ["update", "both"])
@pytest.mark.parametrize("decay", [0.0, 3.0])
def test_no_applied_update_raises_the_transport_cost(projects: str, decay: float) -> None:
    policy = adapt(AEGIS, double_policy(), projects=projects)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-3, weight_decay=decay)
    conflicts = set()
    for _ in range(4):
        found, before, free = stepped(policy, optimizer)
        policy.parts.constrain(Update(before, found.anchor))
        after = snapshot(policy.backbone.named_parameters())
        for group, names in named_groups(policy).items():
            conflict = bool(along(names, free, before, found.anchor)[0] > 0)
            conflicts.add(conflict)
            if conflict:
                assert along(names, after, before, found.anchor)[1].abs() < 1e-9, group
                removed = {n: difference(free[n], after[n]) for n in names}
                zero = {n: torch.zeros_like(t) for n, t in removed.items()}
                assert (
                    along(names, removed, zero, found.anchor)[1] > 1 - 1e-9
                )  # along the anchor gradient only
            else:
                assert all(same_bits(after[n], free[n]) for n in names), group
    assert conflicts == {True, False}


def test_an_orthogonal_gradient_alone_gives_an_update_that_conflicts() -> None:
    """Why the update can also be projected: Adam's scaling and momentum rotate the gradient."""
    policy = adapt(AEGIS, double_policy(), projects="gradient")
    optimizer, cosines = torch.optim.AdamW(policy.parameters(), lr=1e-3, weight_decay=0.0), []
    for _ in range(2):
        found, before, after = stepped(policy, optimizer)
        cosines += [
            along(names, after, before, found.anchor)[1].item()
            for names in named_groups(policy).values()
        ]
    assert max(cosines) > 0.01


def test_projecting_the_update_leaves_the_gradient_to_the_task() -> None:
    policy, naive = adapt(AEGIS, make_policy(), projects="update"), adapt(NAIVE, make_policy())
    row = gradients(policy, AEGIS).row
    gradients(naive, NAIVE)
    assert row is not None and (row.ta < 0).any()
    task, got = snapshot_gradients(naive), snapshot_gradients(policy)
    assert all(same_bits(task[name], got[name]) for name in task)


def test_what_is_projected_decides_which_parts_work() -> None:
    assert start(projects="gradient").constrain is None
    assert all(
        start(projects=projects).constrain is not None
        for projects in PROJECTED
        if projects != "gradient"
    )


def test_language_projects_the_updates_of_the_layers_alone() -> None:
    policy = adapt(AEGIS, double_policy(), projects="update", groups="language")
    found, before, free = stepped(policy, torch.optim.AdamW(policy.parameters(), lr=1e-3))
    conflicts = {
        group
        for group, names in named_groups(policy).items()
        if along(names, free, before, found.anchor)[0] > 0
    }
    policy.parts.constrain(Update(before, found.anchor))
    moved = {n for n, p in policy.backbone.named_parameters() if not same_bits(p.detach(), free[n])}
    changed = {group for group, names in named_groups(policy).items() if moved & set(names)}
    assert changed == {group for group in conflicts if group.startswith("layers.")} < conflicts


@pytest.mark.parametrize("scale", [1e-20, 1.0, 1e20])
def test_the_size_of_the_anchor_gradient_does_not_matter(scale: float) -> None:
    generator = torch.Generator().manual_seed(0)
    values = [torch.randn(4, 3, generator=generator, dtype=torch.float64) for _ in range(3)]
    parameter = nn.Parameter(values[0] + values[1])
    a = values[2] * (1 if (values[1] * values[2]).sum() > 0 else -1)
    aegis.project_update([parameter], ["w"], Update({"w": values[0]}, {"w": scale * a}))
    moved = parameter.detach() - values[0]
    assert (moved * a).sum().abs() < 1e-12
    torch.testing.assert_close(moved, values[1] - (values[1] * a).sum() / a.square().sum() * a)


def test_a_group_without_an_anchor_gradient_is_left_alone() -> None:
    before, parameter = torch.zeros(3), nn.Parameter(torch.tensor([1.0, -2.0, 3.0]))
    for anchor in ({}, {"w": torch.zeros(3)}):
        aegis.project_update([parameter], ["w"], Update({"w": before}, anchor))
        assert parameter.tolist() == [1.0, -2.0, 3.0]
