"""The second backward pass over a kept graph, and what a method makes of both gradients."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from aegis_cli.core import projection

Gram = tuple[Tensor, Tensor, Tensor]


Groups = Sequence[Sequence[nn.Parameter]]


def second_backward(groups: Groups, penalty: Tensor) -> dict[int, Tensor | None]:
    """The anchor gradient of each parameter by its id, from the graph that the first backward has
    kept.
    """
    flat = [p for group in groups for p in group]
    return dict(
        zip(map(id, flat), torch.autograd.grad(penalty, flat, allow_unused=True), strict=True)
    )


def bend(
    groups: Groups, anchor: Mapping[int, Tensor | None], combine: projection.Combine
) -> tuple[Gram, list[float]]:
    """Each group's `.grad` becomes its combination with the anchor gradient, given by the
    parameters' ids.

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
