"""The gradients of one optimisation step, from one or two backward passes over one graph.

Several processes may share the step's frames, and each may split its own into several passes
(`train.accumulate`). The task's loss is divided by the size of the whole batch, so the gradients of
all passes add up to those of the batch; a method's own loss weighs all passes equally. What a
method measures over the frames of a pass, such as the transport penalty, it measures over those of
all processes; over several passes it is averaged.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from aegis_cli.common import devices
from aegis_cli.common.ranks import ALONE, Ranks
from aegis_cli.core import projection
from aegis_cli.data.batch import PreparedPass, RobotBatch, Share, WholeBatch
from aegis_cli.methods.backward import (
    Gram,
    Groups,
    combine_gradients,
    second_backward,
    second_backward_of_rows,
    where_task_moves,
)
from aegis_cli.methods.base import Method, Parts, Pass
from aegis_cli.models.backbones.base import Backbone, Batch, Encoding
from aegis_cli.models.policy import Policy
from aegis_cli.training import parallel
from aegis_cli.training.masters import NONE, Masters

Rows = TypeVar("Rows", np.ndarray, Tensor)
NOT_PREPARED = PreparedPass(inputs=None)


@dataclass(frozen=True)
class LedgerRow:
    """The ledger's entries for one step: inner products [G] per group and W2^2 [L] per layer.

    The groups are those with trainable parameters.
    """

    tt: Tensor
    ta: Tensor
    aa: Tensor
    w2: Tensor


@dataclass(frozen=True)
class StepGradients:
    """The results of `compute_gradients`; the combined gradients themselves are in `.grad`.

    Attributes:
        loss: the task's own loss, even if the gradient includes other terms.
        row: None for a method that reads no anchor gradient.
        anchor: the anchor gradient by the backbone's parameter names, as it was combined with the
            task's; empty for such a method.
        taken: the complete anchor gradient, which later steps may reuse.
    """

    loss: Tensor
    row: LedgerRow | None
    anchor: Mapping[str, Tensor]
    taken: Mapping[str, Tensor]


@dataclass(frozen=True)
class _Settings:
    """What the passes of a step have in common."""

    policy: Policy
    method: Method
    parts: Parts
    groups: Groups
    index: int
    flow_samples: int
    precision: str
    ranks: Ranks
    accumulate: int
    reuses: bool


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
    ranks: Ranks = ALONE,
    accumulate: int = 1,
    masters: Masters = NONE,
) -> StepGradients:
    """Run the forward and backward passes, and combine the gradients as the method does.

    AEGIS's sequential dual backward: both gradients come from the same graph. The anchor gradient
    is taken only with respect to the backbone's parameters, so it never reaches the expert.

    Args:
        batch: this process's frames of the step, those of the first pass first.
        reused: the anchor gradient that an earlier step has `taken`, instead of this step's own;
            the ledger's row has the inner products with it, but this step's W2^2.
        ranks: the processes that share the step.
        accumulate: number of passes that the step is split into.
        masters: the weights that a pass sees rounded; their gradients are still float32.
    """
    names = _learning_names(policy.backbone)
    groups = list(policy.backbone.learning_groups().values())
    settings = _Settings(
        policy=policy,
        method=method,
        parts=parts,
        groups=groups,
        index=index,
        flow_samples=flow_samples,
        precision=precision,
        ranks=ranks,
        accumulate=accumulate,
        reuses=reused is not None,
    )
    loss, w2, taken = _all_passes(settings, batch, generator, masters)
    # Both gradients are summed over the whole batch before any inner product is taken: the inner
    # product of two sums is not the sum of the processes' inner products.
    parallel.add_up_gradients(policy, ranks)
    loss = ranks.total(loss)
    if w2 is None:
        found = StepGradients(loss, None, {}, {})
    else:
        if reused is not None:
            taken = {i: reused.get(name) for i, name in names.items()}
        else:
            taken = parallel.added_up(taken, groups, ranks)
        # What later steps may reuse stays unmasked: their task gradients have zeros elsewhere.
        anchor = where_task_moves(groups, taken) if parts.keeps_idle else taken
        gram = _combine_gradients(settings, anchor)
        row = LedgerRow(*gram, w2)
        found = StepGradients(loss, row, _named(names, anchor), _named(names, taken))
    if parts.pull is not None:
        parts.pull()  # after the combination, so that what it adds to `.grad` is not projected
    return found


def _all_passes(
    settings: _Settings, batch: RobotBatch, generator: torch.Generator, masters: Masters
) -> tuple[Tensor, Tensor | None, dict[int, Tensor | None]]:
    """Run this process's forward and backward passes of a step.

    Returns:
        Their contribution to the task's loss; the mean W2^2 of each layer [L], None without a
        penalty; and their contribution to the anchor gradient, by the parameters' ids.
    """
    losses, distances = [], []
    taken: dict[int, Tensor | None] = {}
    noise = generator.get_state()
    device = settings.policy.backbone.device
    each_pass = passes(batch, settings.ranks, settings.accumulate, device)
    for number, (part, whole_batch) in enumerate(each_pass):
        generator.set_state(noise)  # each pass draws the whole step's and uses its frames' part
        prepared = batch.prepared[number] if batch.prepared else NOT_PREPARED
        with masters.rounded():
            loss, w2, anchor = _backward(settings, part, whole_batch, generator, prepared)
        losses.append(loss)
        if w2 is not None:
            distances.append(w2)
        _add(taken, masters.wide(anchor))
    # A pass's loss is its part of the whole batch's mean, but its W2^2 is that of its own frames
    # only.
    loss = torch.stack(losses).sum()
    w2 = torch.stack(distances).mean(0) if distances else None  # [L]
    return loss, w2, taken


def _combine_gradients(settings: _Settings, anchor: Mapping[int, Tensor | None]) -> Gram:
    """Combine the task's and the anchor's gradients by group; return their inner products."""
    combine = settings.parts.combine or projection.naive
    # Only with sharding, each process's inner products are partial sums.
    total = settings.ranks.total if parallel.is_sharded(settings.policy) else None
    reads = not devices.reading_stalls(settings.policy.backbone.device)
    gram, _ = combine_gradients(settings.groups, anchor, combine, total, reads)
    return gram


def own_rows(rows: Rows, ranks: Ranks, accumulate: int = 1) -> Rows:
    """The rows of a step that this process takes, those of its first pass first."""
    places: list[int] = []
    for share in shares(ranks, accumulate):
        within = share.rows(len(rows))
        places += range(within.start, within.stop)
    return rows[places]


def shares(ranks: Ranks, accumulate: int) -> list[Share]:
    """This process's part of each pass."""
    count = accumulate * ranks.count
    return [Share(i, count) for i in range(ranks.rank, count, ranks.count)]


def passes(
    batch: RobotBatch, ranks: Ranks, accumulate: int, device: torch.device
) -> Iterator[tuple[RobotBatch, WholeBatch]]:
    """This process's frames of each pass, and the batch that they are a share of."""
    if batch.of_step is not None:
        # Counted when the batch was prepared: asking the other processes would wait for the GPU in
        # each step.
        frames, shown = batch.of_step
    else:
        frames, shown = len(batch), int((~batch.is_pad).sum())
        if ranks.several:
            frames, shown = ranks.total(torch.tensor([frames, shown], device=device)).tolist()
    # `rows` are indices into the whole step. In this batch the process's shares are contiguous, so
    # only their lengths count.
    begin = 0
    for share in shares(ranks, accumulate):
        rows = share.rows(frames)
        end = begin + rows.stop - rows.start
        yield batch.rows(slice(begin, end)), WholeBatch(frames, shown, share)
        begin = end


def with_prepared(
    batch: RobotBatch,
    size: tuple[int, int],
    backbone: Backbone,
    ranks: Ranks,
    accumulate: int,
    fraction: float = 1.0,
    by_method: Callable[[RobotBatch], Any] | None = None,
) -> RobotBatch:
    """The batch with the backbone's inputs for each pass, which are still to be sent to its device.

    Args:
        batch: this process's frames.
        size: of the whole batch, as in `RobotBatch.of_step`.
        fraction: share of each pass's frames that is passed a second time.
        by_method: the method's own `prepare`.
    """
    batch = replace(batch, of_step=size)
    prepared = []
    for part, _ in passes(batch, ranks, accumulate, backbone.device):
        inputs = backbone.process(part.images, part.instructions)
        anchor_inputs = None
        if fraction < 1:
            shown = first_frames(part, fraction)
            anchor_inputs = backbone.process(shown.images, shown.instructions)
        made = None if by_method is None else by_method(part)
        prepared.append(PreparedPass(inputs, anchor_inputs, made))
    return replace(batch, prepared=prepared)


def first_frames(batch: RobotBatch, fraction: float) -> RobotBatch:
    """The first frames of a batch, a share of it and at least one."""
    return batch.rows(slice(math.ceil(fraction * len(batch))))


def _backward(
    settings: _Settings,
    batch: RobotBatch,
    whole_batch: WholeBatch,
    generator: torch.Generator,
    prepared: PreparedPass,
) -> tuple[Tensor, Tensor | None, dict[int, Tensor | None]]:
    """Run one forward and backward pass over some frames.

    Args:
        prepared: the inputs prepared from them ahead of the step, if any.

    Returns:
        Its contribution to the task's loss, W2^2 of each layer [L], and its contribution to the
        anchor gradient, by the parameters' ids.
    """
    policy, method, parts = settings.policy, settings.method, settings.parts
    device = policy.backbone.device

    def encode_part() -> Pass:
        shown = first_frames(batch, parts.fraction)
        with devices.autocast(device, settings.precision), torch.enable_grad():
            inputs = prepared.anchor_inputs
            return _encode(settings, shown, whole_batch, inputs, prepared.by_method)[1]

    with devices.autocast(device, settings.precision), torch.set_grad_enabled(True):
        # A backbone that gets no gradient needs no graph, which would only waste memory.
        with torch.set_grad_enabled(not method.stop_gradient):
            inputs = prepared.inputs
            encoding, seen = _encode(settings, batch, whole_batch, inputs, prepared.by_method)
        if method.stop_gradient:
            # Before torch 2.11, autocast reuses weights that it rounded without a graph in later
            # passes with one, such as a method's own, which then give the weights no gradient.
            torch.clear_autocast_cache()
        loss = policy.flow_loss(
            batch, encoding, settings.flow_samples, generator, method.stop_gradient, whole_batch
        )
        objective = loss  # what the gradient is taken of; the reported loss stays the task's own
        if parts.auxiliary is not None:
            # The task's loss is already divided by the whole batch's size; this one is a mean over
            # a pass.
            objective = loss + parts.auxiliary(seen) / settings.accumulate
    # Backward passes run outside autocast, as PyTorch asks: each operation's backward runs in the
    # dtype of its forward.
    if parts.penalty is None:
        objective.backward()
        return loss.detach(), None, {}
    w2, taken = _dual_backward(settings, objective, seen, encode_part)
    return loss.detach(), w2.detach(), taken


def _encode(
    settings: _Settings,
    frames: RobotBatch,
    whole_batch: WholeBatch,
    inputs: Batch | None,
    by_method: Any,
) -> tuple[Encoding, Pass]:
    """Encode frames with the backbone; return the encoding and what a method sees of the pass.

    Args:
        inputs: the backbone's inputs prepared ahead of the step; None: they were not prepared.
        by_method: what the method has prepared from them.
    """
    backbone, ranks = settings.policy.backbone, settings.ranks
    if inputs is None:  # on a CPU nothing is prepared ahead
        inputs = backbone.prepare(frames.images, frames.instructions)
    encoding = backbone.encode(inputs)
    seen = Pass(
        step=settings.index,
        inputs=inputs,
        hidden=encoding.hidden,
        mask=encoding.mask,
        image=encoding.image,
        frames=frames,
        share=whole_batch.share,
        total=ranks.total if ranks.several else None,
        prepared=by_method,
    )
    return encoding, seen


def _dual_backward(
    settings: _Settings, objective: Tensor, seen: Pass, encode_part: Callable[[], Pass]
) -> tuple[Tensor, dict[int, Tensor | None]]:
    """Run the backward passes of the loss and of the penalty.

    Args:
        objective: the loss that the task's gradient is taken of.
        encode_part: passes the share of the frames that the anchor gradient is taken on.
    """
    penalty_of, parts = settings.parts.penalty, settings.parts
    assert penalty_of is not None
    if settings.reuses:
        # The ledger still gets this step's own W2^2, which needs no backward pass.
        with torch.no_grad():
            _, w2 = penalty_of(seen)
        objective.backward()
        return w2, {}
    if parts.fraction < 1:
        objective.backward()  # frees the whole graph before the small one is built
        penalty, w2 = penalty_of(encode_part())
    else:
        penalty, w2 = penalty_of(seen)
        objective.backward(retain_graph=True)  # g goes into `.grad`; the penalty needs the graph
    sharded = parallel.is_sharded(settings.policy)
    again = second_backward_of_rows if sharded else second_backward
    # a is returned and does not touch `.grad`. Divided, so that the sum over passes is their mean.
    return w2, again(settings.groups, penalty / settings.accumulate)


def _add(total: dict[int, Tensor | None], more: Mapping[int, Tensor | None]) -> None:
    """Add a pass's anchor gradient to those of earlier passes."""
    for i, gradient in more.items():
        known = total.get(i)
        if known is None:
            total[i] = gradient
        elif gradient is not None:
            # Never in place: autograd may give several parameters the same tensor.
            total[i] = known + gradient


def _learning_names(backbone: Backbone) -> dict[int, str]:
    """Names of the trainable parameters, by id."""
    return {id(p): name for name, p in backbone.named_parameters() if p.requires_grad}


def _named(names: Mapping[int, str], gradients: Mapping[int, Tensor | None]) -> dict[str, Tensor]:
    """The gradients that are not None, by the parameters' names instead of their ids."""
    return {names[i]: a for i, a in gradients.items() if a is not None}
