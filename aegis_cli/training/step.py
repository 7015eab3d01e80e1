"""The gradients of one optimisation step, from one or two backward passes over one graph.

Several processes may share the step's frames, and each may take its own in several passes
(`train.accumulate`). The task's loss is divided by what the whole batch has, so that all passes'
gradients add up to those of the batch; a method's own loss counts each pass alike. What a method
measures over the frames of a pass, the transport penalty for one, it measures over those of all
processes; over several passes it is averaged.
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
    """What the ledger keeps of a step: inner products [G] per group and W2^2 [L] per layer.

    The groups are those of which something learns.
    """

    tt: Tensor
    ta: Tensor
    aa: Tensor
    w2: Tensor


@dataclass(frozen=True)
class StepGradients:
    """What `compute_gradients` found; the combined gradients themselves are left in `.grad`.

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
    """Forward, backward, and what the method does to the gradient.

    AEGIS's sequential dual backward: both gradients come from the same graph. The anchor gradient
    is taken with respect to the backbone's parameters alone, so it never reaches the expert.

    Args:
        batch: this process's frames of the step, those of the first pass first.
        reused: the anchor gradient that an earlier step has `taken`, in place of this step's own;
            the ledger's row has the inner products with it, and this step's W2^2.
        ranks: the processes that share the step.
        accumulate: passes in which it is taken.
        masters: the weights that a pass sees rounded; their gradients are float32 all the same.
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
    # Both gradients become the whole batch's before any inner product is taken: that of two sums
    # is not the sum of the processes' inner products.
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
        parts.pull()  # after the combination: nothing projects what it adds to `.grad`
    return found


def _all_passes(
    settings: _Settings, batch: RobotBatch, generator: torch.Generator, masters: Masters
) -> tuple[Tensor, Tensor | None, dict[int, Tensor | None]]:
    """This process's passes of a step, forward and back.

    Returns:
        What they contribute to the task's loss; the mean W2^2 of each layer [L], None without a
        penalty; and what they contribute to the anchor gradient, by the parameters' ids.
    """
    losses, distances = [], []
    taken: dict[int, Tensor | None] = {}
    noise = generator.get_state()
    device = settings.policy.backbone.device
    each_pass = passes(batch, settings.ranks, settings.accumulate, device)
    for number, (part, whole_batch) in enumerate(each_pass):
        generator.set_state(noise)  # each pass draws the step's, and takes its own frames' of it
        prepared = batch.prepared[number] if batch.prepared else NOT_PREPARED
        with masters.rounded():
            loss, w2, anchor = _backward(settings, part, whole_batch, generator, prepared)
        losses.append(loss)
        if w2 is not None:
            distances.append(w2)
        _add(taken, masters.wide(anchor))
    # A pass's loss is its part of the whole batch's mean, but its W2^2 is that of its own frames.
    loss = torch.stack(losses).sum()
    w2 = torch.stack(distances).mean(0) if distances else None  # [L]
    return loss, w2, taken


def _combine_gradients(settings: _Settings, anchor: Mapping[int, Tensor | None]) -> Gram:
    """Bend the task's gradient by the anchor's, group by group; their inner products before."""
    combine = settings.parts.combine or projection.naive
    # Only where each process has some rows are its inner products a share of the whole ones.
    total = settings.ranks.total if parallel.is_sharded(settings.policy) else None
    reads = not devices.reading_stalls(settings.policy.backbone.device)
    gram, _ = combine_gradients(settings.groups, anchor, combine, total, reads)
    return gram


def own_rows(rows: Rows, ranks: Ranks, accumulate: int = 1) -> Rows:
    """Which of a step's rows this process takes, those of its first pass first."""
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
        # Counted when the batch was prepared: to ask the others would wait for a GPU in each step.
        frames, shown = batch.of_step
    else:
        frames, shown = len(batch), int((~batch.is_pad).sum())
        if ranks.several:
            frames, shown = ranks.total(torch.tensor([frames, shown], device=device)).tolist()
    # `rows` are places in the whole step. Here this process's shares follow each other without a
    # gap, so that of those places only the number counts.
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
    """The batch with what the backbone makes of each pass's frames, still to be sent to it.

    Args:
        batch: this process's frames.
        size: of the whole batch, as `RobotBatch.of_step` has it.
        fraction: of each pass's frames, which pass once more.
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
    """One pass over some frames, and back.

    Args:
        prepared: what was made of them ahead of the step, if anything was.

    Returns:
        What it contributes to the task's loss, W2^2 of each layer [L], and what it contributes to
        the anchor gradient, by the parameters' ids.
    """
    policy, method, parts = settings.policy, settings.method, settings.parts
    device = policy.backbone.device

    def encode_part() -> Pass:
        shown = first_frames(batch, parts.fraction)
        with devices.autocast(device, settings.precision), torch.enable_grad():
            inputs = prepared.anchor_inputs
            return _encode(settings, shown, whole_batch, inputs, prepared.by_method)[1]

    with devices.autocast(device, settings.precision), torch.set_grad_enabled(True):
        # A backbone that gets no gradient needs no graph, which would only take memory.
        with torch.set_grad_enabled(not method.stop_gradient):
            inputs = prepared.inputs
            encoding, seen = _encode(settings, batch, whole_batch, inputs, prepared.by_method)
        if method.stop_gradient:
            # Before torch 2.11 autocast keeps weights that it has rounded without a graph for later
            # passes with one, such as a method's own, and these then give the weights no gradient.
            torch.clear_autocast_cache()
        loss = policy.flow_loss(
            batch, encoding, settings.flow_samples, generator, method.stop_gradient, whole_batch
        )
        objective = loss  # what the task's gradient is of; the report's loss stays the task's own
        if parts.auxiliary is not None:
            # The task's loss has the whole batch's divisor already; this one is a pass's own mean.
            objective = loss + parts.auxiliary(seen) / settings.accumulate
    # Backward passes run outside autocast, as PyTorch asks: each operation goes back in the type
    # in which it went forward.
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
    """The backbone's pass over frames, and what a method sees of it.

    Args:
        inputs: what the backbone has made of the frames ahead of the step; None: nothing.
        by_method: what the method has made of them.
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
    """Go back from the loss and from the penalty.

    Args:
        objective: what the task's gradient is of.
        encode_part: passes the share of the frames that the anchor gradient is taken on.
    """
    penalty_of, parts = settings.parts.penalty, settings.parts
    assert penalty_of is not None
    if settings.reuses:
        # The ledger has this step's own W2^2 all the same; it costs no backward pass.
        with torch.no_grad():
            _, w2 = penalty_of(seen)
        objective.backward()
        return w2, {}
    if parts.fraction < 1:
        objective.backward()  # lets go of the whole graph before the small one is made
        penalty, w2 = penalty_of(encode_part())
    else:
        penalty, w2 = penalty_of(seen)
        objective.backward(retain_graph=True)  # g goes into `.grad`; the penalty needs the graph
    sharded = parallel.is_sharded(settings.policy)
    again = second_backward_of_rows if sharded else second_backward
    # a is returned and leaves `.grad` alone. Divided, so that the passes' sum is their mean.
    return w2, again(settings.groups, penalty / settings.accumulate)


def _add(total: dict[int, Tensor | None], more: Mapping[int, Tensor | None]) -> None:
    """Add a pass's anchor gradient to those before."""
    for i, gradient in more.items():
        known = total.get(i)
        if known is None:
            total[i] = gradient
        elif gradient is not None:
            # Never in place: autograd may give several parameters one and the same tensor.
            total[i] = known + gradient


def _learning_names(backbone: Backbone) -> dict[int, str]:
    """Names of the parameters that learn, by their ids."""
    return {id(p): name for name, p in backbone.named_parameters() if p.requires_grad}


def _named(names: Mapping[int, str], gradients: Mapping[int, Tensor | None]) -> dict[str, Tensor]:
    """The gradients that there are, by the parameters' names instead of their ids."""
    return {names[i]: a for i, a in gradients.items() if a is not None}
