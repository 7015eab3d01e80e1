"""Elastic weight consolidation (Kirkpatrick et al. 2017, arXiv 1612.00796).

Parameters that matter most to VQA move least. The loss is

    loss + (weight / 2) sum_i F_i (theta_i - theta0_i)^2,
    that is g_i <- g_i + weight F_i (theta_i - theta0_i),

where F is the diagonal of the Fisher information on VQA. As our choice, F is divided by its mean
over all trainable parameters, so that the weight depends neither on the scale of the loss nor on
the number of parameters.

`step: proximal` takes the penalty's proximal step after the optimizer's step instead,

    theta_i - theta0_i <- (theta_i - theta0_i) / (1 + weight F_i),

which Adam does not rescale and which is stable for any weight. `kfac` does the same with a
Kronecker product instead of a diagonal.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from aegis_cli.common.errors import AegisError
from aegis_cli.common.ranks import rows_here
from aegis_cli.core.curvature import bounded, taken
from aegis_cli.methods.base import Method, MethodContext, Parts, Update, train_all


def start(context: MethodContext) -> Parts:
    """Pull every parameter towards its current value, entry by entry.

    Raises:
        AegisError: the anchor lacks the Fisher information of a trainable parameter.
    """
    weight = context.options["weight"]
    if weight == 0:
        return Parts()
    assert context.anchor is not None
    learning, reference = context.learning(), context.reference()
    importance = relative_fisher(context.anchor.fisher, learning)
    if context.owners.several:
        # Cloned, because a slice would keep the other processes' rows in memory.
        for name, parameter in learning.items():
            rows = context.owners.rows(len(parameter))
            importance[name] = importance[name][rows].clone()
    held = []
    for name, parameter in learning.items():
        held.append(_Held(parameter, reference[name], importance[name]))
    if context.options["step"] == "gradient":
        return Parts(pull=_pull(held, weight))
    # The reference is the start, not the previous step, so no weights are copied per step.
    return Parts(constrain=_constrain(held, weight), compares=False)


@dataclass(frozen=True)
class _Held:
    """A parameter that is pulled back to its pre-trained value.

    Attributes:
        origin: its pre-trained value.
        importance: F for the rows that this process has.
    """

    parameter: nn.Parameter
    origin: Tensor
    importance: Tensor

    def moved(self) -> Tensor:
        """Displacement of the rows here from their pre-trained values."""
        return rows_here(self.parameter) - rows_here(self.origin)


def _pull(held: Sequence[_Held], weight: float) -> Callable[[], None]:
    """The penalty's gradient, added to the task's."""

    @torch.no_grad()
    def pull() -> None:
        for one in held:
            gradient = one.parameter.grad
            if gradient is not None:  # without a gradient it has not moved
                rows_here(gradient).addcmul_(one.importance, one.moved(), value=weight)

    return pull


def _constrain(held: Sequence[_Held], weight: float) -> Callable[[Update], None]:
    """The proximal step."""

    @torch.no_grad()
    def constrain(update: Update) -> None:
        # If nothing has moved, `steps` is 0, so nothing is pulled back.
        strength = bounded(weight * update.steps)
        for one in held:
            share = taken(strength * one.importance)
            rows_here(one.parameter).sub_(one.moved() * share)

    return constrain


def relative_fisher(
    fisher: Mapping[str, Tensor], learning: Mapping[str, nn.Parameter]
) -> dict[str, Tensor]:
    """Fisher information of each trainable parameter, scaled to mean 1 over all entries of all.

    It has the parameter's shape and dtype.

    Raises:
        AegisError: a parameter was not measured, or the mean is 0 or NaN.
    """
    missing = next((name for name in learning if name not in fisher), None)
    if missing is not None:
        raise AegisError(
            f"no Fisher information of '{missing}' in the anchor",
            "the Fisher information of every parameter that learns",
            "measure the anchor again with 'fisher' among its parts",
        )
    # In float64: millions of small squares are added up.
    total = sum(fisher[name].sum(dtype=torch.float64) for name in learning)
    count = sum(parameter.numel() for parameter in learning.values())
    mean = total / count
    if not mean > 0:  # a NaN is refused too
        raise AegisError(
            f"a mean Fisher information of {float(mean):g}",
            "one above 0",
            "measure the anchor on more Fisher samples",
        )
    found = {}
    for name, parameter in learning.items():
        found[name] = (fisher[name] / mean).to(parameter.dtype)
    return found


METHOD = Method(
    "ewc",
    "weight decay towards the pre-trained weights, by their Fisher information",
    train_all,
    start=start,
    needs=frozenset({"fisher"}),
)
