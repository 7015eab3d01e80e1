"""Gradient accumulation: `.grad` holds the projection of the sum, after every backward pass.

Over the micro-batches of one optimizer step, the task gradients are summed (as PyTorch does) and
the anchor gradients averaged; then the sum is projected. Projecting each micro-batch separately
would leave conflicts between the gradient of one and the anchor gradient of another. The caller
does not have to say which micro-batch is the last: each call undoes the projection of the sum so
far, adds its own share, and projects the new sum.

Several processes may each have a copy of the model (DistributedDataParallel, which averages the
gradients that arrive in `.grad`). The anchor gradient does not arrive there, so it is averaged
here; otherwise each process would project the same task gradient against its own anchor gradient,
and the copies would diverge.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from aegis_cli.common.errors import AegisError
from aegis_cli.common.ranks import rows_here
from aegis_cli.core import projection
from aegis_cli.methods.backward import Groups, Weights


@dataclass
class Accumulation:
    """The sum since `.grad` was last cleared.

    Attributes:
        count: number of micro-batches in the sum.
        anchor: mean anchor gradient of each parameter by its id.
        w2: mean W2^2 of each layer [L].
        weights: weight of the anchor gradient in each group's `.grad`.
        idle: ids of the parameters whose `.grad` is the anchor gradient alone.
        empty: whether the last projection was of zeros.
        marks: each parameter's `.grad`, and how often it had been written to, at the last
            projection.
    """

    count: int
    anchor: dict[int, Tensor | None]
    w2: Tensor
    weights: Weights
    marks: dict[int, tuple[Tensor | None, int]]
    idle: set[int] = field(default_factory=set)
    empty: bool = False


def started(anchor: Mapping[int, Tensor | None], w2: Tensor) -> Accumulation:
    """The sum after the first micro-batch, not yet projected."""
    return Accumulation(1, dict(anchor), w2, [], {})


@torch.no_grad()
def grow(total: Accumulation, anchor: Mapping[int, Tensor | None], w2: Tensor) -> None:
    """Add a micro-batch to the means."""
    total.count += 1
    share = 1 / total.count
    # A running mean, m_n = m_(n-1) + (a - m_(n-1)) / n; a gradient that is None counts as zeros.
    for i, a in anchor.items():
        mean = total.anchor[i]
        if mean is not None:
            # Never in place: autograd may return the same tensor for several parameters.
            total.anchor[i] = mean * (1 - share) if a is None else mean.lerp(a, share)
        elif a is not None:
            total.anchor[i] = a * share
    total.w2 = total.w2 + (w2 - total.w2) * share


def mark(total: Accumulation, groups: Groups, weights: Weights) -> None:
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
    """Whether `.grad` is unchanged since the last projection, rather than cleared.

    Raises:
        AegisError: neither: it was scaled, clipped or added to, so the projection cannot be undone.
    """
    # First detect zeros that PyTorch's version counter missed, as with `p.grad.data.zero_()`.
    if total is None or (not total.empty and cleared(groups)):
        return False
    parameters = [p for group in groups for p in group]
    if all(_untouched(p, total.marks.get(id(p))) for p in parameters):
        return True
    if cleared(groups):  # the last projection was of zeros, which were overwritten with zeros
        return False
    if _only_cleared(total, parameters):
        refuse_partly_cleared(parameters)
    raise AegisError(
        "gradients that changed since the last guard.backward",
        "the gradients that it left, or zero_grad() before the next step's first",
        "call optimizer.zero_grad() after each step; clip, unscale and add other losses' "
        "gradients after a step's last guard.backward, or add the losses: "
        "guard.backward(loss + other)",
    )


def refuse_partly_cleared(parameters: Sequence[nn.Parameter]) -> None:
    """Raise AegisError if some of the gradients are cleared and others are not."""
    # A process may have no rows of a small sharded parameter, which then says nothing.
    parameters = [p for p in parameters if rows_here(p).numel()]
    kept = sum(not cleared([[p]]) for p in parameters)
    if 0 < kept < len(parameters):
        raise AegisError(
            f"gradients of which {len(parameters) - kept} were cleared since the last "
            f"guard.backward and {kept} were not",
            "all of them cleared, or none",
            "call model.zero_grad(), which also clears what the optimizer does not have; or "
            "freeze that before the guard is made",
        )


def _only_cleared(total: Accumulation, parameters: Sequence[nn.Parameter]) -> bool:
    """Whether every gradient is either unchanged since the last projection or cleared."""
    return all(_untouched(p, total.marks.get(id(p))) or cleared([[p]]) for p in parameters)


def _untouched(parameter: nn.Parameter, marked: tuple[Tensor | None, int] | None) -> bool:
    if marked is None:
        return False
    gradient, (known, written) = parameter.grad, marked
    if gradient is None or known is None:
        return gradient is known
    if known._version != written:
        return False
    # DistributedDataParallel with gradient_as_bucket_view puts gradients into buckets, which it
    # recreates before the second forward pass: different tensors with the same values.
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
    """Add the anchor gradient to `.grad`, multiplied by `times` and each group's weight.

    A parameter without a task gradient has None without the anchor gradient, not zeros: the
    optimizer skips a parameter without a gradient, but would apply weight decay to one with zeros.
    """
    for group, weight in zip(groups, total.weights, strict=True):
        for parameter in group:
            a = total.anchor[id(parameter)]
            if weight == 0 or a is None:
                continue
            if id(parameter) in total.idle:
                # The anchor gradient is all there is; without it there is none.
                parameter.grad = None if times < 0 else projection.scaled(a, weight)
            elif parameter.grad is not None:
                projection.add_scaled([parameter.grad], [a], times * weight)


def poison(total: Accumulation, groups: Groups) -> list[nn.Parameter]:
    """Fill `.grad` with infinity, so that a scaler skips the step.

    A scaler skips steps with non-finite gradients; if only the anchor gradient overflowed, it would
    not notice otherwise.

    Returns:
        The parameters whose gradients were filled. Those without a task gradient get none: an
        optimizer that does not have such a parameter would never clear it.
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
