"""The name of the cache argument of transformers' layers and attention modules."""

from __future__ import annotations

import inspect

from torch import nn

CACHE, EARLIER = "cache", "past_key_values"  # since transformers 5.24, and before


def cache_argument(module: nn.Module) -> str:
    """The name of the cache argument in a module's forward: the one it was written with."""
    return CACHE if CACHE in _arguments(module) else EARLIER


def takes_cache(module: nn.Module) -> bool:
    """Whether a module's forward has a cache argument."""
    return not _arguments(module).isdisjoint({CACHE, EARLIER})


def _arguments(module: nn.Module) -> set[str]:
    # The class's forward, since a compiled layer has its own.
    return set(inspect.signature(type(module).forward).parameters)
