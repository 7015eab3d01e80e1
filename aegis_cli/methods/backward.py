"""The second backward pass over a kept graph, and what a method makes of both gradients."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from aegis_cli.core import projection

Gram = tuple[Tensor, Tensor, Tensor]
Groups = Sequence[Sequence[nn.Parameter]]


def second_backward(groups: Groups, penalty: Tensor) -> dict[int, Tensor | None]:
    """The anchor gradient of each parameter by its id; None where the penalty does not reach it.

    Args:
        groups: the parameters, each once.
        penalty: scalar, in the graph that the first backward pass has kept.
    """
    flat = [p for group in groups for p in group]
    # `grad` leaves `.grad` alone, where the task gradient lies.
    gradients = torch.autograd.grad(penalty, flat, allow_unused=True)
    return {id(p): gradient for p, gradient in zip(flat, gradients, strict=True)}


def bend(
    groups: Groups, anchor: Mapping[int, Tensor | None], combine: projection.Combine
) -> tuple[Gram, list[float]]:
    """Replace each group's `.grad` by its combination with the anchor gradient.

    Args:
        anchor: the anchor gradient by the parameters' ids.
        combine: the method's rule (AEGIS: arXiv 2604.16067).

    Returns:
        The inner products task-task, task-anchor and anchor-anchor [G], and the weight of each
        group's anchor gradient.
    """
    pairs = []
    for group in groups:
        pairs.append(([p.grad for p in group], [anchor[id(p)] for p in group]))
    gram = projection.gram(pairs)
    # One transfer for all groups: on a GPU each number read by itself would wait for the device.
    of_task, of_anchor = (weights.tolist() for weights in combine(*gram))
    for group, (task, pull), wg, wa in zip(groups, pairs, of_task, of_anchor, strict=True):
        combined = projection.apply(task, pull, wg, wa)
        for parameter, gradient in zip(group, combined, strict=True):
            parameter.grad = gradient
    return gram, of_anchor


def keep_compiled() -> None:
    """Compile graphs that bear two backward passes from now on, and drop those compiled before.

    A graph compiled for one backward pass overwrites the buffers that the second needs.
    """
    # They are looked up, not imported: without them nothing is compiled, and they load slowly.
    config, dynamo = (
        sys.modules.get(name) for name in ("torch._functorch.config", "torch._dynamo")
    )
    if config is not None and dynamo is not None and config.donated_buffer:
        config.donated_buffer = False
        dynamo.reset()


def has_node(result: Tensor, name: str) -> bool:
    """Whether a function of that name, such as `AddBackward0`, has a part in the result's graph."""
    seen, waiting = set(), [result.grad_fn]
    while waiting:
        node = waiting.pop()
        if node is None or node in seen:
            continue
        if node.name() == name:
            return True
        seen.add(node)
        waiting += [before for before, _ in node.next_functions]
    return False
