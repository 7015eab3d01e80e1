"""The second backward pass over a kept graph, and the combination of both gradients."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import torch
from torch import Tensor, nn
from torch.autograd.graph import Node

from aegis_cli.common.ranks import rows_here
from aegis_cli.core import projection

Gram = tuple[Tensor, Tensor, Tensor]
Groups = Sequence[Sequence[nn.Parameter]]
Weights = Sequence[float] | Tensor  # one for each group


def second_backward(
    groups: Groups, penalty: Tensor, retain_graph: bool = False
) -> dict[int, Tensor | None]:
    """The anchor gradient of each parameter by its id; None if the penalty does not reach it.

    Args:
        groups: the parameters, each once.
        penalty: scalar, in the graph that the first backward pass has kept.
        retain_graph: whether the other backward pass is still to come.
    """
    flat = [p for group in groups for p in group]
    # `autograd.grad` does not touch `.grad`, which holds the task gradient.
    gradients = torch.autograd.grad(penalty, flat, retain_graph=retain_graph, allow_unused=True)
    return {id(p): gradient for p, gradient in zip(flat, gradients, strict=True)}


def second_backward_of_rows(
    groups: Groups, penalty: Tensor, others: Iterable[nn.Parameter] = ()
) -> dict[int, Tensor | None]:
    """The anchor gradient of each parameter by its id, if a process has only some of its rows.

    FSDP reduces and shards a gradient on its way into `.grad`, so the anchor gradient has to go
    there too. The task gradients are set aside meanwhile, including those of other parameters that
    the penalty reaches: these keep only their task gradient.

    Args:
        others: further parameters that the penalty may depend on. The leaves of its graph are
            found anyway, but the graph does not show the sharded parameters that FSDP writes
            gradients to.
    """
    parameters = [p for group in groups for p in group]
    # By id, because a parameter may also be a leaf of the graph.
    reached = {id(p): p for p in (*parameters, *others, *_leaves(penalty))}
    task = {key: p.grad for key, p in reached.items()}
    # Cleared, because a backward pass accumulates into `.grad`.
    for parameter in reached.values():
        parameter.grad = None
    penalty.backward()
    found = {id(p): p.grad for p in parameters}
    for key, parameter in reached.items():
        parameter.grad = task[key]
    return found


def _nodes(result: Tensor) -> Iterator[Node]:
    """The nodes of the graph that leads to `result`, each once."""
    # A loop, because the graph of a deep model exceeds Python's recursion limit.
    waiting, seen = [result.grad_fn], set()
    while waiting:
        node = waiting.pop()
        if node is None or node in seen:
            continue
        seen.add(node)
        yield node
        waiting += [earlier for earlier, _ in node.next_functions]


def _leaves(result: Tensor) -> Iterator[Tensor]:
    """The tensors whose `.grad` a backward pass from `result` may accumulate into."""
    for node in _nodes(result):
        if (leaf := getattr(node, "variable", None)) is not None:
            yield leaf


def uses_reentrant_checkpointing(result: Tensor) -> bool:
    """Whether part of the graph is recomputed by `torch.utils.checkpoint(use_reentrant=True)`.

    Such a part allows only one backward pass.
    """
    return any(node.name() == "CheckpointFunctionBackward" for node in _nodes(result))


def where_task_moves(
    groups: Groups, anchor: Mapping[int, Tensor | None]
) -> dict[int, Tensor | None]:
    """The anchor gradient, zeroed wherever `.grad` is zero, and None if there is no `.grad`.

    Args:
        anchor: the anchor gradient by the parameters' ids; it is not modified.
    """
    return {id(p): _masked(p.grad, anchor[id(p)]) for group in groups for p in group}


def _masked(task: Tensor | None, anchor: Tensor | None) -> Tensor | None:
    if task is None or anchor is None:
        return None
    return anchor.masked_fill(task == 0, 0)


def combine_gradients(
    groups: Groups,
    anchor: Mapping[int, Tensor | None],
    combine: projection.Combine,
    total: Callable[[Tensor], Tensor] | None = None,
    reads: bool = True,
) -> tuple[Gram, Weights]:
    """Replace each group's `.grad` by its combination with the anchor gradient.

    Args:
        anchor: the anchor gradient by the parameters' ids.
        combine: the method's rule (AEGIS: arXiv 2604.16067).
        total: sums a tensor over the processes, if each has some rows of every parameter; None if
            each has all of them.
        reads: whether the weights may be read, which forces a GPU sync.

    Returns:
        The inner products task-task, task-anchor and anchor-anchor [G], and the weight of each
        group's anchor gradient [G], as numbers if they were read.
    """
    pairs = []
    for group in groups:
        of_group = [p.grad for p in group], [anchor[id(p)] for p in group]
        pairs.append(of_group)
    gram = projection.gram(pairs) if total is None else _gram_of_rows(pairs, total)
    of_task: Weights
    of_anchor: Weights
    of_task, of_anchor = combine(*gram)
    if reads or _moves_idle(pairs):
        # One transfer for all groups: reading each number separately would sync the GPU each time.
        of_task, of_anchor = torch.stack((of_task, of_anchor)).tolist()
    for group, (task, pull), wg, wa in zip(groups, pairs, of_task, of_anchor, strict=True):
        combined = projection.apply(task, pull, wg, wa)
        for parameter, gradient in zip(group, combined, strict=True):
            parameter.grad = gradient
    return gram, of_anchor


def _moves_idle(pairs: Sequence[tuple[projection.Gradients, projection.Gradients]]) -> bool:
    """Whether the projection may move parameters that the task does not.

    Such a parameter gets a gradient only if the weight is not 0; without one the optimizer skips
    it. So the weight has to be read.
    """
    for task, anchor in pairs:
        for g, a in zip(task, anchor, strict=True):
            if g is None and a is not None:
                return True
    return False


def _gram_of_rows(
    pairs: Sequence[tuple[projection.Gradients, projection.Gradients]],
    total: Callable[[Tensor], Tensor],
) -> Gram:
    """The inner products of gradients that are sharded by rows, in one reduction."""
    here = []
    for task, anchor in pairs:
        here.append((_rows_here(task), _rows_here(anchor)))
    tt, ta, aa = total(torch.stack(projection.gram(here)))
    return tt, ta, aa


def _rows_here(gradients: projection.Gradients) -> projection.Gradients:
    return [None if g is None else rows_here(g) for g in gradients]


def recompile_for_two_backward_passes() -> None:
    """If torch.compile was used, recompile so that each graph allows a second backward pass.

    A graph compiled for one backward pass overwrites the buffers that the second needs.
    """
    # Only if both are loaded: without them nothing is compiled, and importing them is slow.
    if not {"torch._functorch.config", "torch._dynamo"} <= sys.modules.keys():
        return
    import torch._dynamo as dynamo
    import torch._functorch.config as config

    if config.donated_buffer:
        config.donated_buffer = False
        dynamo.reset()


def compile_for_two_backward_passes() -> None:
    """Let graphs compiled from now on allow a second backward pass, and recompile older ones."""
    import torch._functorch.config as config

    recompile_for_two_backward_passes()
    config.donated_buffer = False
