"""Gradient accumulation: `.grad` holds the projection of the sum, after every backward pass.

Over the micro-batches of one optimizer step, the task gradients are summed (as PyTorch sums them)
and the anchor gradients averaged; the sum is what is projected. Projecting each micro-batch by
itself would leave the conflicts between one's gradient and another's anchor gradient. Nobody has to
say which micro-batch is the last: each call takes back the projection of the sum so far, adds its
own share, and projects the new sum.

Several processes may have a copy of the model each (DistributedDataParallel, which averages what
arrives in `.grad`). The anchor gradient does not arrive there, so it is averaged here; without that
each process would project the same task gradient against an anchor gradient of its own, and the
copies would part.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn
from torch import distributed as dist

from aegis_cli.common.errors import AegisError
from aegis_cli.common.ranks import rows_here
from aegis_cli.core import projection
from aegis_cli.methods.backward import Groups


@dataclass
class Accumulation:
    """The sum since `.grad` was last cleared.

    Attributes:
        count: micro-batches in it.
        anchor: mean anchor gradient of each parameter by its id.
        w2: mean W2^2 of each layer [L].
        weights: of the anchor gradient in each group's `.grad`.
        idle: ids of the parameters whose `.grad` is that anchor gradient alone.
        empty: whether that projection was of zeros.
        marks: each parameter's `.grad`, and how often it had been written to, when the last
            projection was done.
    """

    count: int
    anchor: dict[int, Tensor | None]
    w2: Tensor
    weights: list[float]
    marks: dict[int, tuple[Tensor | None, int]]
    idle: set[int] = field(default_factory=set)
    empty: bool = False


def started(anchor: Mapping[int, Tensor | None], w2: Tensor) -> Accumulation:
    """The sum after its first micro-batch, not yet projected."""
    return Accumulation(1, dict(anchor), w2, [], {})


@torch.no_grad()
def grow(total: Accumulation, anchor: Mapping[int, Tensor | None], w2: Tensor) -> None:
    """Add a micro-batch to the means."""
    total.count += 1
    share = 1 / total.count
    for i, a in anchor.items():
        mean = total.anchor[i]
        if mean is not None:
            # Never in place: autograd may give several parameters one and the same tensor.
            total.anchor[i] = mean * (1 - share) if a is None else mean.lerp(a, share)
        elif a is not None:
            total.anchor[i] = a * share
    total.w2 = total.w2 + (w2 - total.w2) * share


def mark(total: Accumulation, groups: Groups, weights: list[float]) -> None:
    """Remember the state of every `.grad`, which now holds the sum projected with these weights."""
    total.weights, total.marks, total.empty = weights, {}, cleared(groups)
    for group in groups:
        for p in group:
            # PyTorch counts in `_version` how often a tensor was written to.
            written = 0 if p.grad is None else p.grad._version
            total.marks[id(p)] = (p.grad, written)


def absent(groups: Groups) -> bool:
    """Whether there is no gradient at all, as `zero_grad` leaves it."""
    return all(p.grad is None for group in groups for p in group)


def cleared(groups: Groups) -> bool:
    """Whether there is no gradient: none, or zeros."""
    gradients = [rows_here(p.grad) for group in groups for p in group if p.grad is not None]
    return not any(gradient.any() for gradient in gradients)


def continues(total: Accumulation | None, groups: Groups) -> bool:
    """Whether `.grad` is what the last projection left, rather than cleared since.

    Raises:
        AegisError: neither: it was scaled, clipped or added to, so that its projection cannot be
            taken back.
    """
    # Zeros that were written past PyTorch's count, as by `p.grad.data.zero_()`, are seen first.
    if total is None or (not total.empty and cleared(groups)):
        return False
    parameters = [p for group in groups for p in group]
    if all(_untouched(p, total.marks.get(id(p))) for p in parameters):
        return True
    if cleared(groups):
        return False
    if _only_cleared(total, parameters):
        refuse_partly_cleared(parameters)
    raise AegisError(
        "gradients that changed since the last guard.backward",
        "what it left, or zero_grad() before the next step's first",
        "call optimizer.zero_grad() after each step; clip, unscale and add other losses' "
        "gradients after a step's last guard.backward, or add the losses: "
        "guard.backward(loss + other)",
    )


def refuse_partly_cleared(parameters: Sequence[nn.Parameter]) -> None:
    """Raise AegisError where some of the gradients are cleared, and others are not."""
    parameters = [p for p in parameters if rows_here(p).numel()]  # else nothing can be told
    kept = sum(not cleared([[p]]) for p in parameters)
    if 0 < kept < len(parameters):
        raise AegisError(
            f"gradients of which {len(parameters) - kept} were cleared since the last "
            f"guard.backward and {kept} were not",
            "all of them cleared, or none",
            "model.zero_grad() clears those that the optimizer does not have, too; or freeze what "
            "it does not have before the guard is made",
        )


def _only_cleared(total: Accumulation, parameters: Sequence[nn.Parameter]) -> bool:
    """Whether every gradient is what the last projection left, or gone."""
    return all(_untouched(p, total.marks.get(id(p))) or cleared([[p]]) for p in parameters)


def _untouched(parameter: nn.Parameter, marked: tuple[Tensor | None, int] | None) -> bool:
    if marked is None:
        return False
    gradient, (known, written) = parameter.grad, marked
    if gradient is None or known is None:
        return gradient is known
    if known._version != written:
        return False
    # DistributedDataParallel with gradient_as_bucket_view puts gradients into buckets that it makes
    # anew before the second forward pass: other tensors of the same values.
    return gradient is known or torch.equal(rows_here(gradient), rows_here(known))


def take_back(total: Accumulation, groups: Groups) -> None:
    """Make `.grad` the plain sum again."""
    _shift(total, groups, -1)


def put_back(total: Accumulation, groups: Groups) -> None:
    """Undo `take_back`, so that `.grad` is the projected sum again."""
    _shift(total, groups, 1)
    mark(total, groups, total.weights)


@torch.no_grad()
def _shift(total: Accumulation, groups: Groups, times: int) -> None:
    """Add the anchor gradient to `.grad` so many times, with each group's weight.

    Where the task left no gradient, there is none without the anchor's: the optimizer leaves such a
    parameter as it is, and would let one of zeros decay.
    """
    for group, weight in zip(groups, total.weights, strict=True):
        for parameter in group:
            a = total.anchor[id(parameter)]
            if weight == 0 or a is None:
                continue
            if id(parameter) in total.idle:
                parameter.grad = None if times < 0 else projection.scaled(a, weight)
            elif parameter.grad is not None:
                projection.add_scaled([parameter.grad], [a], times * weight)


def poison(total: Accumulation, groups: Groups) -> list[nn.Parameter]:
    """Fill `.grad` with infinity, so that a scaler skips the step.

    It skips steps whose gradients are not finite; where only the anchor gradient overflowed,
    nothing else would tell it.

    Returns:
        The parameters whose gradient it is. Where the task left none, there is none: an optimizer
        that leaves such a parameter out would never clear it.
    """
    poisoned = []
    for group in groups:
        for parameter in group:
            if id(parameter) in total.idle:
                parameter.grad = None
            else:
                parameter.grad = torch.full_like(parameter, torch.inf)
                poisoned.append(parameter)
    return poisoned


# --- several processes ---------------------------------------------------------------------------


WORLD = "world"  # all processes, also where they are connected only after the guard was made
Group = dist.ProcessGroup | str | None


def processes() -> int:
    """How many processes torch.distributed has connected by now; 1 where it has none."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def resolved(group: Group) -> dist.ProcessGroup | None:
    """The group that is meant, as far as it is there by now.

    Raises:
        AegisError: another text than "world".
    """
    if not isinstance(group, str):
        return group
    if group != WORLD:
        raise AegisError(
            f"process_group={group!r}",
            f"a group of torch.distributed, or {WORLD!r}",
            f"process_group={WORLD!r}",
        )
    return dist.group.WORLD if processes() > 1 else None


def check_group(group: Group) -> None:
    """Raise AegisError where several processes run and no group names those that share a model."""
    if resolved(group) is None and processes() > 1:
        raise AegisError(
            f"a guard in one of {processes()} processes without process_group=",
            "those that train one model together",
            f"process_group={WORLD!r}, under DistributedDataParallel or FSDP2",
        )


@torch.no_grad()
def mean_over(tensors: Sequence[Tensor], group: dist.ProcessGroup) -> list[Tensor]:
    """Mean of each tensor over the group's processes.

    The means are new tensors, because autograd may give several parameters one and the same.
    """
    means = [tensor / dist.get_world_size(group) for tensor in tensors]
    # All are begun before the first is waited for, so that they overlap.
    begun = [dist.all_reduce(tensor, group=group, async_op=True) for tensor in means]
    for work in begun:
        work.wait()
    return means


@torch.no_grad()
def mean_gradients(
    gradients: Mapping[int, Tensor | None],
    parameters: Mapping[int, Tensor],
    group: dist.ProcessGroup,
) -> dict[int, Tensor | None]:
    """Mean of each gradient over the group's processes, by the parameters' ids.

    A gradient that a process lacks counts as zero there; one that all lack stays None.
    """
    like = next(iter(parameters.values()))
    here = [gradients[i] is not None for i in parameters]
    # Every process has to join each reduction below, so they agree first on which there are.
    counts = torch.tensor(here, dtype=torch.int32, device=like.device)
    dist.all_reduce(counts, group=group)
    somewhere = [i for i, count in zip(parameters, counts.tolist(), strict=True) if count]
    own = []
    for i in somewhere:
        gradient = gradients[i]
        own.append(torch.zeros_like(parameters[i]) if gradient is None else gradient)
    means = dict(zip(somewhere, mean_over(own, group), strict=True))
    return dict.fromkeys(gradients) | means
