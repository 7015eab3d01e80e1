"""Steps of an optimizer that is not ours, and none of them past the guard."""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.optimizer import Optimizer, register_optimizer_step_pre_hook

from aegis_cli.common.errors import AegisError
from aegis_cli.common.ranks import rows_here
from aegis_cli.methods.base import Parts
from aegis_cli.methods.known_parameters import check_reached
from aegis_cli.methods.stepper import Stepper
from aegis_cli.models import structure

Scaler = torch.amp.GradScaler


class GuardedStepper:
    """Takes the user's optimizer through a `Stepper`, and refuses steps that go past the guard.

    A method that constrains nothing leaves every step as it is, if a guarded backward pass came
    before it.
    """

    def __init__(self, model: nn.Module, parts: Parts, may_shard: bool = False) -> None:
        self._model, self._parts = model, parts
        self._learning = structure.learning(model)
        self._stepper = Stepper(model, parts, may_shard)
        self._stepping, self._count = False, 0
        # Ids of the optimizers that have stepped since the last guarded backward pass; None before
        # the first pass.
        self._stepped: set[int] | None = None
        self._hook = register_optimizer_step_pre_hook(_refuser(self))

    def check(self) -> None:
        """Refuse a model whose parameters are not those that the guard was made with."""
        self._stepper.known.check()

    def passed(self) -> None:
        """Note a guarded backward pass, which every optimizer may follow with one step.

        Raises:
            AegisError: it left no gradient in the model.
        """
        check_reached(self._learning.values())
        self._stepped = set()

    def gradients(self) -> list[Tensor]:
        """The gradients of what learns, as far as they are there, and of sharded ones the rows."""
        return [rows_here(p.grad) for p in self._learning.values() if p.grad is not None]

    def remove(self) -> None:
        """Let every step pass."""
        self._hook.remove()

    def step(
        self, optimizer: Optimizer, scaler: Scaler | None, anchor: Mapping[int, Tensor | None]
    ) -> None:
        """Take the optimizer's step, its update constrained.

        Args:
            anchor: the anchor gradient by the parameters' ids.

        Raises:
            AegisError: other parameters learn than when the guard was made, or their gradients are
                those of a plain backward pass.
        """
        if not self._parts.constrains:
            _take(optimizer, scaler)
            return
        if structure.learning(self._model).keys() != self._learning.keys():
            raise AegisError(
                "other trainable parameters than when the guard was made",
                "the same",
                "freeze and unfreeze before Guard(...)",
            )
        self._refuse_unguarded(optimizer)
        named = {name: anchor.get(id(p)) for name, p in self._learning.items()}
        self._stepping = True
        try:
            self._stepper.step(
                self._count + 1,
                partial(self._move, optimizer, scaler),
                {name: a for name, a in named.items() if a is not None},
            )
        finally:
            self._stepping = False
        self._count += 1

    def settle(self) -> None:
        """Constrain the steps since the last time, whatever their turn."""
        self._stepper.settle()

    def _move(self, optimizer: Optimizer, scaler: Scaler | None) -> None:
        take_slowed(self._parts, partial(_take, optimizer, scaler))

    def refuse(self, optimizer: Optimizer, closure: bool) -> None:
        """Raise before anything moves, if this is a step that goes past the guard.

        Args:
            closure: the optimizer calls the backward passes itself, inside its step.
        """
        mine = {id(p) for p in self._learning.values()}
        guarded = [p for g in optimizer.param_groups for p in g["params"] if id(p) in mine]
        if not guarded:
            return
        if self._parts.constrains and not self._stepping:
            raise AegisError(
                "optimizer.step() on guarded parameters",
                "guard.step(optimizer), which constrains the update",
                "call guard.step(optimizer), with a GradScaler guard.step(optimizer, scaler); "
                "guard.remove() when done",
            )
        if not closure:
            self._refuse_unguarded(optimizer)
        if self._stepped is not None:
            self._stepped.add(id(optimizer))

    def _refuse_unguarded(self, optimizer: Optimizer) -> None:
        """Raise if guarded gradients are those of a plain backward pass."""
        if self._stepped is not None and id(optimizer) not in self._stepped:
            return
        # Some libraries take a step on zeros, to have an optimizer's state made.
        if any(gradient.any() for gradient in self.gradients()):
            raise AegisError(
                "a step on guarded parameters without a guard.backward since the last one",
                "guard.backward(loss) instead of loss.backward(), before every step",
                "call guard.backward in the loop that trains (a trainer that calls backward "
                "itself goes past the guard); guard.remove() when done",
            )


@torch.no_grad()
def take_slowed(parts: Parts, take: Callable[[], None]) -> None:
    """Take an optimizer's step, then go back to each parameter's share of it.

    An update is linear in the learning rate, so that an interpolation of the weights does what
    another learning rate would have done.
    """
    shares = {} if parts.shares is None else parts.shares()
    # A gradient that overflowed has no finite share, and a scaler skips its step.
    slowed = {p: share for p, share in shares.items() if share != 1 and math.isfinite(share)}
    before = {p: p.detach().clone() for p in slowed}
    with torch.enable_grad():
        take()
    for parameter, share in slowed.items():
        parameter.copy_(torch.lerp(before[parameter], parameter, share))


def _take(optimizer: Optimizer, scaler: Scaler | None) -> None:
    """The step as the loop's owner would take it."""
    if scaler is None:
        optimizer.step()
    else:
        scaler.step(optimizer)


def _refuser(stepper: GuardedStepper) -> Callable[[Optimizer, Any, Any], None]:
    """A check of every optimizer in the process that does not keep the model alive."""
    known = weakref.ref(stepper)

    def hook(optimizer: Optimizer, given: tuple[Any, ...], named: dict[str, Any]) -> None:
        if (alive := known()) is not None:
            closure = given[1] if len(given) > 1 else named.get("closure")  # the first is itself
            alive.refuse(optimizer, closure is not None)

    return hook
