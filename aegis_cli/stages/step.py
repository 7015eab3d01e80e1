"""The gradients of one optimisation step: a forward pass, and one or two backward passes over its graph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from aegis_cli.core import projection
from aegis_cli.methods.base import Method, Parts, Pass
from aegis_cli.policy import Policy, RobotBatch
from aegis_cli.stages import device as devices


@dataclass(frozen=True)
class Row:
    """What the ledger keeps of a step: inner products [G] of each group and W2^2 [L] of each layer."""

    tt: Tensor
    ta: Tensor
    aa: Tensor
    w2: Tensor


@dataclass(frozen=True)
class Gradients:
    """Gradients now lie in `.grad`.

    Attributes:
        loss: the task's own, whatever else the gradient is of.
        row: None for a method that reads no anchor gradient.
        anchor: the anchor gradient by the backbone's parameter names; empty for such a method.
    """

    loss: Tensor
    row: Row | None
    anchor: Mapping[str, Tensor]


def compute_gradients(
    policy: Policy, method: Method, parts: Parts, batch: RobotBatch, generator: torch.Generator, *,
    index: int, flow_samples: int, precision: str,
) -> Gradients:  # fmt: skip
    """Forward, backward, and what the method does to the gradient.

    AEGIS's sequential dual backward: both gradients come from the same graph. The anchor gradient is taken
    with respect to the backbone's parameters alone, so it never reaches the expert.
    """
    with devices.autocast(policy.backbone.device, precision), torch.set_grad_enabled(True):
        inputs = policy.backbone.prepare(batch.images, batch.instructions)
        with torch.set_grad_enabled(not method.stop_gradient):
            encoding = policy.backbone.encode(inputs)
        loss = policy.flow_loss(batch, encoding, flow_samples, generator, detach=method.stop_gradient)
        seen = Pass(index, inputs, encoding.hidden, encoding.mask, encoding.image)
        total = loss if parts.auxiliary is None else loss + parts.auxiliary(seen)
    row, anchor = None, {}
    if parts.penalty is None:
        total.backward()
    else:
        penalty, w2 = parts.penalty(seen)
        total.backward(retain_graph=True)
        gram, anchor = _combine(policy.backbone, penalty, parts.combine or projection.naive)
        row = Row(*gram, w2)
    if parts.pull is not None:
        parts.pull()
    return Gradients(loss.detach(), row, anchor)


Gram = tuple[Tensor, Tensor, Tensor]
Groups = Sequence[Sequence[nn.Parameter]]


def _combine(backbone: nn.Module, penalty: Tensor, combine: projection.Combine) -> tuple[Gram, dict[str, Tensor]]:
    """Second backward; then each group's gradient becomes its combination. Returns tt, ta, aa [G] and the anchor's."""
    names = {id(p): name for name, p in backbone.named_parameters() if p.requires_grad}
    groups = [[p for p in group if id(p) in names] for group in backbone.parameter_groups().values()]
    taken = second_backward(groups, penalty)
    gram, _ = bend(groups, taken, combine)
    return gram, {names[i]: a for i, a in taken.items() if a is not None}


def second_backward(groups: Groups, penalty: Tensor) -> dict[int, Tensor | None]:
    """The anchor gradient of each parameter by its id, from the graph that the first backward has kept."""
    flat = [p for group in groups for p in group]
    return dict(zip(map(id, flat), torch.autograd.grad(penalty, flat, allow_unused=True), strict=True))


def bend(groups: Groups, anchor: Mapping[int, Tensor | None], combine: projection.Combine) -> tuple[Gram, list[float]]:
    """Each group's `.grad` becomes its combination with the anchor gradient, given by the parameters' ids.

    Returns:
        tt, ta, aa [G], and the weight of each group's anchor gradient.
    """
    pairs = [([p.grad for p in group], [anchor[id(p)] for p in group]) for group in groups]
    gram = projection.gram(pairs)
    of_task, of_anchor = (weights.tolist() for weights in combine(*gram))
    for group, (task, pull), wg, wa in zip(groups, pairs, of_task, of_anchor, strict=True):
        for parameter, gradient in zip(group, projection.apply(task, pull, wg, wa), strict=True):
            parameter.grad = gradient
    return gram, of_anchor
