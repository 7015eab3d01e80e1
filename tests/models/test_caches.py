"""A module's cache argument has the name with which its forward was written."""

from __future__ import annotations

from typing import Any

import pytest
from torch import nn

from aegis_cli.models.backbones.caches import cache_argument, takes_cache


class Now(nn.Module):
    def forward(self, hidden: Any, cache: Any = None, **_: Any) -> Any:
        return hidden


class Before(nn.Module):
    def forward(self, hidden: Any, past_key_values: Any = None, **_: Any) -> Any:
        return hidden


class Neither(nn.Module):
    def forward(self, hidden: Any, **_: Any) -> Any:
        return hidden


@pytest.mark.parametrize(
    ("kind", "name", "takes"),
    [
        (Now, "cache", True),
        (Before, "past_key_values", True),
        (Neither, "past_key_values", False),
    ],
)
def test_a_module_says_how_it_is_given_its_cache(
    kind: type[nn.Module], name: str, takes: bool
) -> None:
    module = kind()
    module.forward = lambda *_, **__: None  # type: ignore[method-assign]
    assert cache_argument(module) == name and takes_cache(module) is takes
