"""The optimizer's step under a method that constrains the applied update, and no step
without it.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.optimizer import Optimizer, register_optimizer_step_pre_hook

from aegis_cli.common.errors import AegisError
from aegis_cli.methods.base import Parts, Update
from aegis_cli.models import structure

Scaler = torch.amp.GradScaler


def apply(optimizer: Optimizer, scaler: Scaler | None) -> None:
    """The step as the loop's owner would make it."""
    if scaler is None:
        optimizer.step()
    else:
        scaler.step(optimizer)


class Stepper:
    """Constrains the steps, each or some of them together, and refuses those that go past it; or
    has nothing to constrain.
    """

    def __init__(self, model: nn.Module, parts: Parts) -> None:
        self._model, self._parts = model, parts
        self._learning = structure.learning(model)
        self._device = next(iter(self._learning.values())).device.type
        self._stepping, self._steps = False, 0
        self._opened: Update | None = (
            None  # since the last constraint; its anchor gradient is the last step's
        )
        self._hook = register_optimizer_step_pre_hook(_refuser(self)) if parts.constrains else None

    def gradients(self) -> list[Tensor]:
        """Of what learns, as far as they are there."""
        return [p.grad for p in self._learning.values() if p.grad is not None]

    def remove(self) -> None:
        """Let every step pass."""
        if self._hook is not None:
            self._hook.remove()

    def step(
        self, optimizer: Optimizer, scaler: Scaler | None, anchor: Mapping[int, Tensor | None]
    ) -> None:
        """The optimizer's step, its update constrained; `anchor` is the anchor gradient by the
        parameters' ids.

        Raises:
            AegisError: other parameters learn than when the guard was made.
        """
        if not self._parts.constrains:
            apply(optimizer, scaler)
            return
        if structure.learning(self._model).keys() != self._learning.keys():
            raise AegisError(
                "other trainable parameters than when the guard was made",
                "the same",
                "freeze and unfreeze before Guard(...)",
            )
        self._open(anchor)
        self._stepping = True
        try:
            self._move(optimizer, scaler)
        finally:
            self._stepping = False
        self._steps += 1
        if self._steps % self._parts.every == 0:
            self.settle()

    def settle(self) -> None:
        """Constrain the steps since the last time, whatever their turn."""
        opened, self._opened = self._opened, None
        if opened is not None and self._parts.constrain is not None:
            with torch.autocast(self._device, enabled=False):  # a loop may step inside of its own
                self._parts.constrain(opened)

    def _open(self, anchor: Mapping[int, Tensor | None]) -> None:
        """Note what the coming step is constrained by, beside those since the last constraint."""
        opened = self._opened or Update(self._copies() if self._parts.copies else {}, {}, 0)
        named = {name: anchor.get(id(p)) for name, p in self._learning.items()}
        self._opened = Update(
            opened.before, {name: a for name, a in named.items() if a is not None}, opened.steps + 1
        )

    @torch.no_grad()
    def _move(self, optimizer: Optimizer, scaler: Scaler | None) -> None:
        """The step, of which each parameter keeps its share: updates are linear in the learning
        rate.
        """
        shares = {} if self._parts.shares is None else self._parts.shares()
        # of a gradient that overflowed no share can be told, and a scaler skips its step
        slowed = {p: share for p, share in shares.items() if share != 1 and math.isfinite(share)}
        before = {p: p.detach().clone() for p in slowed}
        with torch.enable_grad():
            apply(optimizer, scaler)
        for parameter, share in slowed.items():
            parameter.copy_(torch.lerp(before[parameter], parameter, share))

    def refuse(self, optimizer: Optimizer) -> None:
        """Raise before anything moves, if this is a step that would not be constrained."""
        mine = {id(p) for p in self._learning.values()}
        if not self._stepping and any(
            id(p) in mine for group in optimizer.param_groups for p in group["params"]
        ):
            raise AegisError(
                "optimizer.step() on guarded parameters",
                "guard.step(optimizer), which constrains the update",
                (
                    "call guard.step(optimizer), with a GradScaler guard.step(optimizer, scaler); "
                    "guard.remove() when done"
                ),
            )

    def _copies(self) -> dict[str, Tensor]:
        """The parameters' values by all their names, each once."""
        copies = {id(p): p.detach().clone() for p in self._model.parameters() if p.requires_grad}
        return {name: copies[id(p)] for name, p in self._learning.items()}


def _refuser(stepper: Stepper) -> Callable[[Optimizer, Any, Any], None]:
    """A check of every optimizer in the process that does not keep the model alive."""
    known = weakref.ref(stepper)

    def hook(optimizer: Optimizer, _: Any, __: Any) -> None:
        if (alive := known()) is not None:
            alive.refuse(optimizer)

    return hook
