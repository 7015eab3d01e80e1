"""What torch's graphs need to bear two backward passes."""

from __future__ import annotations

import sys

from torch import Tensor


def keep_compiled() -> None:
    """A graph compiled for one backward pass overwrites what the second needs: from now on none is,
    and older ones go.
    """
    config, dynamo = (
        sys.modules.get(name) for name in ("torch._functorch.config", "torch._dynamo")
    )
    if config is not None and dynamo is not None and config.donated_buffer:
        config.donated_buffer = False
        dynamo.reset()


def has_node(result: Tensor, name: str) -> bool:
    """Whether a function of that name has a part in the result's graph."""
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
