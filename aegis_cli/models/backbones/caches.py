"""The argument by which transformers' layers and attention modules are given their cache."""

from __future__ import annotations

import inspect

from torch import nn

CACHE, EARLIER = "cache", "past_key_values"  # since transformers 5.24, and before


def cache_argument(module: nn.Module) -> str:
    """The name that a module's forward has for its cache, which is the one it was written with."""
    return CACHE if CACHE in _arguments(module) else EARLIER


def takes_cache(module: nn.Module) -> bool:
    """Whether a module's forward names a cache among its arguments."""
    return not _arguments(module).isdisjoint({CACHE, EARLIER})


def _arguments(module: nn.Module) -> set[str]:
    # The class's forward counts: a compiled layer has another of its own.
    return set(inspect.signature(type(module).forward).parameters)
