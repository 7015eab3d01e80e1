"""The gradients of one optimisation step, from one or two backward passes over one graph."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from aegis_cli.common import devices
from aegis_cli.core import projection
from aegis_cli.data.batch import RobotBatch
from aegis_cli.methods.backward import bend, second_backward, where_task_moves
from aegis_cli.methods.base import Method, Parts, Pass
from aegis_cli.models.backbones.base import Backbone, Encoding
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
        anchor: the anchor gradient by the backbone's parameter names, as the task's was combined
            with it; empty for such a method.
        taken: the anchor gradient whole, as later steps may reuse it.
    """

    loss: Tensor
    row: LedgerRow | None
    anchor: Mapping[str, Tensor]
    taken: Mapping[str, Tensor]


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
    reused: Mapping[str, Tensor] | None = None,
) -> Gradients:
    """Forward, backward, and what the method does to the gradient.

    AEGIS's sequential dual backward: both gradients come from the same graph. The anchor gradient
    is taken with respect to the backbone's parameters alone, so it never reaches the expert.

    Args:
        reused: the anchor gradient that an earlier step has `taken`, in place of this step's own;
            the ledger's row has the inner products with it, and this step's W2^2.
    """

    def encode(frames: int) -> tuple[Encoding, Pass]:
        """The backbone's pass over the first frames of the batch."""
        part = batch.rows(slice(frames))
        inputs = policy.backbone.prepare(part.images, part.instructions)
        encoding = policy.backbone.encode(inputs)
        return encoding, Pass(index, inputs, encoding.hidden, encoding.mask, encoding.image, part)

    def encode_part() -> Pass:
        frames = math.ceil(parts.fraction * len(batch.instructions))
        with devices.autocast(policy.backbone.device, precision), torch.enable_grad():
            return encode(frames)[1]

    with devices.autocast(policy.backbone.device, precision), torch.set_grad_enabled(True):
        # A backbone that gets no gradient needs no graph, which would only take memory.
        with torch.set_grad_enabled(not method.stop_gradient):
            encoding, seen = encode(len(batch.instructions))
        loss = policy.flow_loss(
            batch, encoding, flow_samples, generator, detach=method.stop_gradient
        )
        total = loss if parts.auxiliary is None else loss + parts.auxiliary(seen)
    if parts.penalty is None:
        total.backward()
        found = Gradients(loss.detach(), None, {}, {})
    else:
        found = _dual_backward(policy.backbone, parts, loss, total, seen, encode_part, reused)
    if parts.pull is not None:
        parts.pull()
    return found


def _dual_backward(
    backbone: Backbone,
    parts: Parts,
    loss: Tensor,
    total: Tensor,
    seen: Pass,
    encode_part: Callable[[], Pass],
    reused: Mapping[str, Tensor] | None,
) -> Gradients:
    """Take both gradients, and make each group's its combination with the anchor gradient.

    Args:
        loss: the task's own, `total` what is gone back from.
        encode_part: passes the share of the batch that the anchor gradient is taken on.
    """
    assert parts.penalty is not None
    names = {id(p): name for name, p in backbone.named_parameters() if p.requires_grad}
    groups = [
        [p for p in group if id(p) in names] for group in backbone.parameter_groups().values()
    ]
    if reused is not None:
        with torch.no_grad():
            _, w2 = parts.penalty(seen)
        total.backward()
        taken = {i: reused.get(name) for i, name in names.items()}
    elif parts.fraction < 1:
        total.backward()  # lets go of the whole graph before the small one is made
        penalty, w2 = parts.penalty(encode_part())
        taken = second_backward(groups, penalty)
    else:
        penalty, w2 = parts.penalty(seen)
        total.backward(retain_graph=True)
        taken = second_backward(groups, penalty)
    anchor = where_task_moves(groups, taken) if parts.keeps_idle else taken
    gram, _ = bend(groups, anchor, parts.combine or projection.naive)
    row = LedgerRow(*gram, w2.detach())
    return Gradients(loss.detach(), row, _named(names, anchor), _named(names, taken))


def _named(names: Mapping[int, str], gradients: Mapping[int, Tensor | None]) -> dict[str, Tensor]:
    """The gradients that there are, by the parameters' names instead of their ids."""
    return {names[i]: a for i, a in gradients.items() if a is not None}
