"""One step's gradients: two backward passes over one graph, against plain autograd."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from samples.training import (
    adapt,
    double_policy,
    gradients,
    make_moments,
    make_policy,
    of_all_tokens,
    options_of,
    robot_batch,
    same_bits,
    snapshot_gradients,
)
from torch import Tensor, nn

from aegis_cli.common import devices
from aegis_cli.core import projection
from aegis_cli.core.moments import Moments, batch_moments
from aegis_cli.core.transport import WEIGHTINGS, layer_weights, transport_penalty
from aegis_cli.methods import METHODS
from aegis_cli.methods.base import Method, MethodContext, Parts, train_all
from aegis_cli.models.policy import Policy

NAIVE, AEGIS = METHODS["naive"], METHODS["aegis"]
PRECISIONS = {"float32": (make_policy, 2e-5), "float64": (double_policy, 1e-12)}
Named = dict[str, Tensor | None]


def plain_penalty(policy: Policy, anchor: list[Moments], weighting: str) -> Tensor:
    """The mean over layers of W2^2 between the batch's valid tokens and the anchor, written out."""
    batch = robot_batch()
    encoding = policy.encode(batch.images, batch.instructions)
    costs = []
    for hidden, moments in zip(encoding.hidden, anchor, strict=True):
        rows = torch.cat([row[mask] for row, mask in zip(hidden, encoding.mask, strict=True)])
        mean, std = rows.mean(0), rows.std(0, correction=0)
        cost = (mean - moments.mean).square().sum() + (std - moments.var.sqrt()).square().sum()
        costs.append(cost / moments.var.sum() if weighting == "variance" else cost)
    return torch.stack(costs).mean()


def independent(
    policy: Policy, anchor: list[Moments], weighting: str = "none"
) -> tuple[Named, Named]:
    """Task and anchor gradients from two passes with a graph each; leaves no `.grad` behind."""
    batch = robot_batch()
    policy.zero_grad()
    encoding = policy.encode(batch.images, batch.instructions)
    policy.flow_loss(batch, encoding, 2, torch.Generator().manual_seed(0)).backward()
    task = snapshot_gradients(policy)
    policy.zero_grad()
    plain_penalty(policy, anchor, weighting).backward()
    pull = snapshot_gradients(policy)
    policy.zero_grad()
    return task, pull


def groups(policy: Policy) -> dict[str, list[str]]:
    """Parameter names, as the policy has them, of each group."""
    name_of = {id(p): name for name, p in policy.named_parameters()}
    return {
        group: [name_of[id(p)] for p in members]
        for group, members in policy.backbone.parameter_groups().items()
    }


def flat(named: Named, names: list[str], like: Policy) -> Tensor:
    """Some gradients as one float64 vector; a missing one is zero."""
    sizes = {name: p.numel() for name, p in like.named_parameters()}
    return torch.cat(
        [torch.zeros(sizes[n]) if named[n] is None else named[n].flatten() for n in names]
    ).double()


# --- the dual backward ----------------------------------------------------------------------------


@pytest.mark.parametrize("weighting", WEIGHTINGS)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_dual_backward_equals_two_independent_ones(precision: str, weighting: str) -> None:
    make, tolerance = PRECISIONS[precision]
    policy, anchor = make(), make_moments()
    task, pull = independent(policy, anchor, weighting)
    row = gradients(adapt(AEGIS, policy, of_all_tokens(anchor), weighting=weighting), AEGIS).row
    got = snapshot_gradients(policy)
    signs = set()
    for i, names in enumerate(groups(policy).values()):
        g, a = flat(task, names, policy), flat(pull, names, policy)
        d = g @ a
        signs.add(math.copysign(1, d) if d else 0)
        expected = g - d / (a @ a) * a if d < 0 else g
        scale = g.norm() + a.norm() + 1e-30
        assert (flat(got, names, policy) - expected).norm() <= tolerance * scale
        for found, value in ((row.tt[i], g @ g), (row.ta[i], d), (row.aa[i], a @ a)):
            assert abs(found - value) <= tolerance * (g @ g + a @ a)
    assert signs == {
        -1,
        0,
        1,
    }  # conflict, agreement, and the final norm, which no gradient reaches


def test_w2_in_the_row_is_each_layers_unweighted_cost() -> None:
    policy, anchor = make_policy(), make_moments()
    row = gradients(adapt(AEGIS, policy, of_all_tokens(anchor), weighting="variance"), AEGIS).row
    assert row.w2.shape == (2,)
    torch.testing.assert_close(
        row.w2.mean(), plain_penalty(policy, anchor, "none").detach(), check_dtype=False
    )


def test_the_loss_is_the_task_loss_alone() -> None:
    naive, aegis = (gradients(adapt(method, make_policy()), method) for method in (NAIVE, AEGIS))
    assert same_bits(naive.loss, aegis.loss)
    assert naive.row is None and aegis.row is not None


def test_the_anchor_gradient_never_reaches_the_expert() -> None:
    naive, aegis = adapt(NAIVE, make_policy()), adapt(AEGIS, make_policy())
    gradients(naive, NAIVE)
    gradients(aegis, AEGIS)
    task, combined = snapshot_gradients(naive, "expert."), snapshot_gradients(aegis, "expert.")
    assert task and all(gradient is not None for gradient in task.values())
    assert all(same_bits(task[name], combined[name]) for name in task)


# --- the projection -------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 2, 3])
@pytest.mark.parametrize("precision", ["float32", "bf16"])
def test_no_group_raises_the_cost_and_those_without_conflict_are_naive(
    precision: str, seed: int
) -> None:
    """<g, a> >= 0 up to rounding, with `a` from a graph of its own.

    If <g, a> was >= 0 before, the gradient is naive's bit for bit.
    """
    anchor = make_moments(seed=seed)
    naive, aegis = adapt(NAIVE, make_policy()), adapt(AEGIS, make_policy(), of_all_tokens(anchor))
    gradients(naive, NAIVE, precision=precision)
    row = gradients(aegis, AEGIS, precision=precision).row
    before, after = snapshot_gradients(naive), snapshot_gradients(aegis)
    pull = anchor_gradients(aegis, anchor, precision)
    for i, names in enumerate(groups(aegis).values()):
        g, a = flat(after, names, aegis), flat(pull, names, aegis)
        assert g @ a >= -1e-5 * g.norm() * a.norm()
        if row.ta[i] >= 0:
            assert all(same_bits(before[name], after[name]) for name in names)
        else:
            assert not torch.equal(flat(before, names, aegis), g)
    assert (row.ta < 0).any() and (row.ta > 0).any()  # both branches were taken


def anchor_gradients(policy: Policy, anchor: list[Moments], precision: str) -> Named:
    """Anchor gradients from a graph of their own, through the same operations.

    In bfloat16 any other order would round differently.
    """
    batch = robot_batch()
    policy.zero_grad()
    with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
        encoding = policy.encode(batch.images, batch.instructions)
    moments = [batch_moments(hidden, encoding.mask) for hidden in encoding.hidden]
    transport_penalty(moments, anchor, layer_weights(anchor, "none"))[0].backward()
    return snapshot_gradients(policy)


def test_energy_identity_of_the_row() -> None:
    """|g|^2 - |g'|^2 = relu(-ta)^2 / aa: a share of relu(-cos)^2, group by group."""
    naive, aegis = (
        adapt(NAIVE, double_policy()),
        adapt(AEGIS, double_policy(), of_all_tokens(make_moments())),
    )
    gradients(naive, NAIVE)
    row = gradients(aegis, AEGIS).row
    before, after = snapshot_gradients(naive), snapshot_gradients(aegis)
    shed = projection.energy_shed(row.tt, row.ta, row.aa)
    for i, names in enumerate(groups(aegis).values()):
        energy, kept = (flat(g, names, aegis).square().sum() for g in (before, after))
        cosine = row.ta[i] / (row.tt[i] * row.aa[i]).sqrt() if row.aa[i] > 0 else torch.zeros(())
        assert abs(energy - row.tt[i]) <= 1e-9 * energy
        assert abs((energy - kept) - shed[i] * energy) <= 1e-9 * energy
        assert abs(shed[i] - torch.relu(-cosine).square()) <= 1e-9
    assert (shed > 1e-8).any()


def test_an_anchor_that_is_met_exactly_changes_nothing() -> None:
    policy, other = make_policy(), adapt(NAIVE, make_policy())
    batch = robot_batch()
    with torch.no_grad():
        encoding = policy.encode(batch.images, batch.instructions)
    here = [batch_moments(hidden, encoding.mask) for hidden in encoding.hidden]
    row = gradients(
        adapt(AEGIS, policy, of_all_tokens([Moments(1, *pair) for pair in here])), AEGIS
    ).row
    gradients(other, NAIVE)
    assert (row.w2 == 0).all() and (row.aa == 0).all()
    task, combined = snapshot_gradients(other), snapshot_gradients(policy)
    assert all(same_bits(task[name], combined[name]) for name in task)


def test_a_frozen_part_is_left_alone() -> None:
    """The projection covers trainable parameters: a frozen layer has no row and no gradient."""

    def all_but_a_layer(backbone: nn.Module, *_: Any) -> None:
        backbone.requires_grad_(True)
        backbone.layers[0].requires_grad_(False)

    method = replace(AEGIS, adapt=all_but_a_layer)
    policy = adapt(method, make_policy())
    row = gradients(policy, method).row
    learning, every = policy.backbone.learning_groups(), policy.backbone.parameter_groups()
    assert [name for name in every if name not in learning] == ["layers.0"]
    assert len(row.tt) == len(row.ta) == len(row.aa) == len(learning)
    assert all(p.grad is None for p in policy.backbone.layers[0].parameters())
    assert row.aa[list(learning).index("layers.1")] > 0 and len(row.w2) == 2


def test_any_combination_is_a_line() -> None:
    """The penalty method: the gradient of loss + 0.1 * penalty, from existing parts."""
    policy, anchor = double_policy(), make_moments()
    task, pull = independent(policy, anchor)

    def weigh(tt: Tensor, ta: Tensor, aa: Tensor) -> tuple[Tensor, Tensor]:
        return torch.ones_like(tt), torch.full_like(tt, 0.1)

    def started(context: MethodContext) -> Parts:
        return replace(AEGIS.start(replace(context, options=options_of(AEGIS))), combine=weigh)

    method = Method("penalty", "", train_all, start=started)
    gradients(adapt(method, policy, of_all_tokens(anchor)), method)
    got = snapshot_gradients(policy)
    for names in groups(policy).values():
        expected = flat(task, names, policy) + 0.1 * flat(pull, names, policy)
        torch.testing.assert_close(flat(got, names, policy), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("listed", [{}, {"amx_bf16": False}, {"amx_bf16": True}, None])
def test_auto_is_bf16_where_a_processor_lists_amx(
    listed: dict[str, bool] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """ARM processors list no such feature, and an older torch has no list at all: float32."""
    if listed is None:
        monkeypatch.delattr(torch.cpu, "get_capabilities", raising=False)
    else:
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: listed, raising=False)
    with devices.autocast(torch.device("cpu"), "auto"):
        product = torch.ones(2, 2) @ torch.ones(2, 2)
    assert product.dtype == (torch.bfloat16 if listed and listed["amx_bf16"] else torch.float32)
