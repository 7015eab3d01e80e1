"""One optimisation step: a forward pass, one or two backward passes over its graph, one update."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from aegis_cli.core import projection
from aegis_cli.core.moments import Moments, batch_moments
from aegis_cli.core.transport import transport_penalty
from aegis_cli.methods.base import Method
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
    """Gradients now lie in `.grad`; `row` is None for a method that reads no anchor gradient."""

    loss: Tensor
    row: Row | None


def compute_gradients(
    policy: Policy,
    method: Method,
    batch: RobotBatch,
    generator: torch.Generator,
    *,
    flow_samples: int,
    precision: str,
    anchor: Sequence[Moments] | None = None,
    weighting: str = "none",
) -> Gradients:
    """Forward, backward, and (for a method that combines) the anchor's backward and the projection.

    AEGIS's sequential dual backward: both gradients come from the same graph. The anchor gradient is taken
    with respect to the backbone's parameters alone, so it never reaches the expert.
    """
    with devices.autocast(policy.backbone.device, precision), torch.set_grad_enabled(True):
        with torch.set_grad_enabled(not method.stop_gradient):
            encoding = policy.encode(batch.images, batch.instructions)
        loss = policy.flow_loss(batch, encoding, flow_samples, generator, detach=method.stop_gradient)
    if method.combine is None:
        loss.backward()
        return Gradients(loss.detach(), None)
    if anchor is None:
        raise ValueError(f"method '{method.name}' needs an anchor")
    moments = [batch_moments(hidden, encoding.mask) for hidden in encoding.hidden]
    penalty, w2 = transport_penalty(moments, anchor, weighting)
    loss.backward(retain_graph=True)
    tt, ta, aa = _combine(policy.backbone.parameter_groups(), penalty, method.combine)
    return Gradients(loss.detach(), Row(tt, ta, aa, w2))


def _combine(
    groups: dict[str, list[nn.Parameter]], penalty: Tensor, combine: projection.Combine
) -> tuple[Tensor, Tensor, Tensor]:
    """Second backward; then each group's gradient becomes its combination. Returns tt, ta, aa [G]."""
    learning = {name: [p for p in parameters if p.requires_grad] for name, parameters in groups.items()}
    flat = [p for parameters in learning.values() for p in parameters]
    taken = iter(torch.autograd.grad(penalty, flat, allow_unused=True))
    pairs = [([p.grad for p in group], [next(taken) for _ in group]) for group in learning.values()]
    tt, ta, aa = projection.gram(pairs)
    for group, (task, anchor), wg, wa in zip(learning.values(), pairs, *_weights(combine, tt, ta, aa), strict=True):
        for parameter, gradient in zip(group, projection.apply(task, anchor, wg, wa), strict=True):
            parameter.grad = gradient
    return tt, ta, aa


def _weights(combine: projection.Combine, tt: Tensor, ta: Tensor, aa: Tensor) -> tuple[list[float], list[float]]:
    task, anchor = combine(tt, ta, aa)
    return task.tolist(), anchor.tolist()
