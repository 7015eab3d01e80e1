"""L2-SP (arXiv 1802.01483): weight decay towards the pre-trained weights instead of zero.

loss + (weight / 2) |theta - theta0|^2, that is g <- g + weight (theta - theta0). The paper's second
term, decay towards zero for weights that are not pre-trained, is the optimizer's own weight decay
(which also acts on the backbone, as under naive).
"""

from __future__ import annotations

import torch

from aegis_cli.methods.base import Method, MethodContext, Parts, train_all


def start(context: MethodContext) -> Parts:
    """Pull every parameter towards its current value."""
    weight = context.options["weight"]
    if weight == 0:
        return Parts()
    learning, reference = context.learning(), context.reference()

    @torch.no_grad()
    def pull() -> None:
        for name, parameter in learning.items():
            if parameter.grad is not None:  # without a gradient it has not moved
                parameter.grad.add_(parameter - reference[name], alpha=weight)

    return Parts(pull=pull)


METHOD = Method("l2sp", "weight decay towards the pre-trained weights", train_all, start=start)
