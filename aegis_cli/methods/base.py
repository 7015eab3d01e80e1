"""A method as parts that combine freely: what is trained, whose gradient reaches it, how it is exported."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from torch import nn

from aegis_cli.core.projection import Combine


@dataclass(frozen=True)
class Method:
    """One way to fine-tune a backbone under an action expert.

    Attributes:
        name: as users write it.
        summary: one line for tables and help.
        adapt: makes the backbone's trainable part trainable, given its language layers' linear maps
            and the method's options; called once, before the optimizer is made.
        combine: per parameter group, inner products of task and anchor gradient -> their weights;
            None: the anchor gradient is never read, so no second backward is paid for.
        stop_gradient: the expert's gradient ends at the backbone's keys and values.
        export: turns an adapted copy of the backbone into a plain one.
    """

    name: str
    summary: str
    adapt: Callable[[nn.Module, Mapping[str, nn.Linear], Mapping[str, float]], None]
    combine: Combine | None = None
    stop_gradient: bool = False
    export: Callable[[nn.Module], None] = lambda backbone: None


def train_all(backbone: nn.Module, _: Mapping[str, nn.Linear], __: Mapping[str, float]) -> None:
    """Every parameter learns."""
    backbone.requires_grad_(True)


def freeze(backbone: nn.Module, _: Mapping[str, nn.Linear], __: Mapping[str, float]) -> None:
    """Nothing in the backbone learns."""
    backbone.requires_grad_(False)
