"""The gradients of one optimisation step, from one or two backward passes over one graph."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from aegis_cli.common import devices
from aegis_cli.core import projection
from aegis_cli.data.batch import RobotBatch
from aegis_cli.methods.backward import Gram, bend, second_backward
from aegis_cli.methods.base import Method, Parts, Pass
from aegis_cli.models.policy import Policy


@dataclass(frozen=True)
class LedgerRow:
    """What the ledger keeps of a step: inner products [G] per group and W2^2 [L] per layer."""

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
    row: LedgerRow | None
    anchor: Mapping[str, Tensor]


def compute_gradients(
    policy: Policy,
    method: Method,
    parts: Parts,
    batch: RobotBatch,
    generator: torch.Generator,
    *,
    index: int,
    flow_samples: int,
    precision: str,
) -> Gradients:
    """Forward, backward, and what the method does to the gradient.

    AEGIS's sequential dual backward: both gradients come from the same graph. The anchor gradient
    is taken with respect to the backbone's parameters alone, so it never reaches the expert.
    """
    with devices.autocast(policy.backbone.device, precision), torch.set_grad_enabled(True):
        inputs = policy.backbone.prepare(batch.images, batch.instructions)
        # A backbone that gets no gradient needs no graph, which would only take memory.
        with torch.set_grad_enabled(not method.stop_gradient):
            encoding = policy.backbone.encode(inputs)
        loss = policy.flow_loss(
            batch, encoding, flow_samples, generator, detach=method.stop_gradient
        )
        seen = Pass(index, inputs, encoding.hidden, encoding.mask, encoding.image)
        total = loss if parts.auxiliary is None else loss + parts.auxiliary(seen)
    row, anchor = None, {}
    if parts.penalty is None:
        total.backward()
    else:
        penalty, w2 = parts.penalty(seen)
        total.backward(retain_graph=True)
        gram, anchor = _combine(policy.backbone, penalty, parts.combine or projection.naive)
        row = LedgerRow(*gram, w2)
    if parts.pull is not None:
        parts.pull()
    return Gradients(loss.detach(), row, anchor)


def _combine(
    backbone: nn.Module, penalty: Tensor, combine: projection.Combine
) -> tuple[Gram, dict[str, Tensor]]:
    """Take the anchor gradient, and make each group's gradient its combination with it.

    Returns:
        The inner products tt, ta and aa [G], and the anchor gradient by the parameters' names.
    """
    names = {id(p): name for name, p in backbone.named_parameters() if p.requires_grad}
    groups = [
        [p for p in group if id(p) in names] for group in backbone.parameter_groups().values()
    ]
    taken = second_backward(groups, penalty)
    gram, _ = bend(groups, taken, combine)
    return gram, {names[i]: a for i, a in taken.items() if a is not None}
