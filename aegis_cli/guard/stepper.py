"""Steps of an optimizer that is not ours, and none of them past the guard."""

from __future__ import annotations

import math
import warnings
import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.optimizer import (
    Optimizer,
    register_optimizer_step_post_hook,
    register_optimizer_step_pre_hook,
)

from aegis_cli.common.errors import AegisError
from aegis_cli.common.ranks import ALONE, Ranks, rows_here
from aegis_cli.methods.base import Parts
from aegis_cli.methods.known_parameters import check_reached
from aegis_cli.methods.stepper import Stepper
from aegis_cli.models import structure
from aegis_cli.models.buffers import WrittenBuffers

Scaler = torch.amp.GradScaler
Closure = Callable[[], Any]
_AT_WORK: weakref.WeakSet[GuardedStepper] = weakref.WeakSet()  # those that were not removed


class GuardedStepper:
    """Takes the user's optimizer through a `Stepper`, and refuses steps that go past the guard.

    A method that constrains nothing leaves every step as it is, if a guarded backward pass came
    before it.
    """

    def __init__(
        self,
        model: nn.Module,
        parts: Parts,
        may_shard: bool = False,
        averaging: Mapping[str, nn.Module] | None = None,
    ) -> None:
        """Begin without a step.

        Args:
            may_shard: as of `Stepper`.
            averaging: modules that may not average what they read while the method works, by name.
        """
        self._model, self._parts = model, parts
        self._averaging = averaging or {}
        self._learning = structure.learning(model)
        self._devices = [p.device for p in self._learning.values()]
        self._types = [p.dtype for p in self._learning.values()]
        self._stepper, self._may_shard = Stepper(model, parts, may_shard), may_shard
        self._stepping, self._count = False, 0
        self._counted: int | None = None  # the optimizer whose step was counted since the last pass
        self._automatic: Callable[[], Mapping[int, Tensor | None]] | None = None
        # Of a step of the loop's own, and how often each weight had been written to before it.
        self._slowed: SlowedStep | None = None
        self._begun_at: list[int] = []
        # Steps inside each other: of an optimizer that calls its base class's, or another one's.
        self._depth, self._in_closure = 0, False
        # Whether an optimizer has moved the weights in `step`; None: no hook has told of any.
        self._moved: bool | None = None
        # Ids of the optimizers that have stepped since the last guarded backward pass; None before
        # the first pass.
        self._stepped: set[int] | None = None
        # Whether an optimizer has moved the weights since then; whether any has ever told of a
        # step; and how often each weight had been written to.
        self._took, self._tells = False, False
        self._written: list[int] = []
        # The buffers as the first pass left them; None before it, and once the second was seen.
        self._buffers: WrittenBuffers | None = None
        self._looked = False
        _AT_WORK.add(self)
        before, after = _hooks_of_every_optimizer(self)
        self._hooks = [
            register_optimizer_step_pre_hook(before),
            register_optimizer_step_post_hook(after),
        ]

    def take_by_itself(self, anchor: Callable[[], Mapping[int, Tensor | None]]) -> None:
        """Constrain the steps that a loop takes by `optimizer.step()`, instead of refusing them.

        Args:
            anchor: gives the anchor gradient by the parameters' ids.
        """
        self._automatic = anchor

    def check(self) -> None:
        """Refuse a model whose parameters are not those that the guard was made with.

        Raises:
            AegisError: they were replaced or moved, or further ones learn.
        """
        self._end_broken_step()
        self._stepper.known.check()
        if structure.learning(self._model).keys() - self._learning.keys():
            self._refuse_other_parameters()
        self._refuse_another_place()
        if at_work := [name for name, module in self._averaging.items() if module.training]:
            raise AegisError(
                f"'{at_work[0]}' first of {len(at_work)} modules in training mode, whose running "
                "statistics every pass changes and no method holds",
                "batch normalisations in evaluation mode",
                "module.eval() for each of them after model.train(); or name what is protected: "
                "protect=(...)",
            )

    def passed(self) -> None:
        """Note a guarded backward pass, which every optimizer may follow with one step.

        Raises:
            AegisError: it left no gradient in the model, or another guard is at work on it.
        """
        self._end_broken_step()
        self._refuse_another_guard()
        if not self._sums_late:
            check_reached(self._learning.values())
        if not self._looked:
            self._look_at_buffers()
        self._stepped, self._counted = set(), None
        self._took, self._written = False, self._versions()
        if not self._in_closure:
            self._depth = 0  # a step that raised an exception has left it as it was

    def _look_at_buffers(self) -> None:
        """Warn, at the second pass, of what it has written to since the first."""
        before, self._buffers = self._buffers, None
        if before is None:
            self._buffers = WrittenBuffers(self._model)
            return
        self._looked = True
        if not (written := before.modules()):
            return
        more = f" and of {len(written) - 1} more modules" if written[1:] else ""
        warnings.warn(
            f"passes in training mode change buffers of '{written[0]}'{more}, as BatchNorm "
            "averages what it reads: answers change with them, and no method holds them; call "
            "module.eval() for each of these modules after model.train()",
            stacklevel=2,
        )

    def _refuse_another_guard(self) -> None:
        """Refuse a second guard of the same kind on a parameter: it would undo what one has held.

        One may project gradients, and another one constrain the updates that are made of them.
        """
        mine = {id(p) for p in self._learning.values()}
        for other in _AT_WORK:
            used = other is not self and other._stepped is not None
            if not used or other._parts.constrains != self._parts.constrains:
                continue
            shared = [name for name, p in other._learning.items() if id(p) in mine]
            if shared:
                raise AegisError(
                    f"two guards at work on {len(shared)} parameters, first '{shared[0]}'",
                    "one for each parameter: a second one moves again what the first has held",
                    "guard.remove() for one that is done; freeze what two guarded models share; or "
                    "measure one anchor on the questions of both",
                )

    def may_have_moved(self, skips: bool) -> bool:
        """Whether a step may have moved the weights since the last guarded backward pass.

        Args:
            skips: whether a scaler was there, which skips steps that overflow.
        """
        if self._took or self._written != self._versions():
            return True
        # An optimizer that is none of PyTorch's tells nothing, and may write past its count.
        return not (self._tells or skips)

    @property
    def _sums_late(self) -> bool:
        """Whether gradients may arrive in the last pass of a step alone.

        Several passes over sharded weights may leave their sum to the last of them. A method that
        reads the gradient needs that of each pass.
        """
        return self._may_shard and self._parts.penalty is None

    def _refuse_unreached(self) -> None:
        """Raise AegisError where the passes of a step have left no gradient in the model."""
        if self._sums_late and self._stepped is not None:
            check_reached(self._learning.values())

    def gradients_finite(self, owners: Ranks = ALONE) -> bool:
        """Whether every gradient of what learns is finite, in all processes."""
        largest = nn.utils.get_total_norm(self.gradients(), norm_type=math.inf)
        return not owners.any(not largest.isfinite())[0]

    def gradients(self) -> list[Tensor]:
        """The gradients of what learns, as far as they are there, and of sharded ones the rows."""
        return [rows_here(p.grad) for p in self._learning.values() if p.grad is not None]

    def remove(self) -> None:
        """Let every step pass."""
        _AT_WORK.discard(self)
        for hook in self._hooks:
            hook.remove()

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
        if not self._parts.constrains or not self._guards(optimizer):
            _take(optimizer, scaler)
            return
        self._refuse_other_parameters()
        self._refuse_another_place()
        self._refuse_unguarded(optimizer)
        self._refuse_second(optimizer)
        self._refuse_unreached()
        self._stepper.begin(self._by_name(anchor))
        slowed = SlowedStep(self._parts)
        versions = self._versions()
        self._stepping, self._moved = True, None
        try:
            _take(optimizer, scaler)
        finally:
            self._stepping = False
            # A scaler leaves a step out that overflowed, and a trainer's optimizer those in
            # between. What is drawn back in such a step would be so without an update that asked
            # for it. One that raises an exception may have moved some of the weights.
            if self._has_moved(optimizer, versions):
                self._count += 1
                slowed.go_back()
                self._stepper.end(self._count)
            else:
                self._stepper.take_none()

    def _has_moved(self, optimizer: Optimizer, versions: Sequence[int]) -> bool:
        """Whether the weights have moved in `step`.

        Args:
            versions: of the weights before it.
        """
        if self._moved is not None:
            return self._moved
        # One that is no optimizer of PyTorch's may write past its count.
        return not isinstance(optimizer, Optimizer) or versions != self._versions()

    def _versions(self) -> list[int]:
        """How often each parameter was written to, as PyTorch counts it."""
        return [p._version for p in self._learning.values()]

    def _refuse_another_place(self) -> None:
        """Refuse a model that is elsewhere, or of another type, than what constrains it."""
        devices = [p.device for p in self._learning.values()]
        if self._parts.constrains and devices != self._devices:
            moved = zip(self._devices, devices, strict=True)
            then, now = next((then, now) for then, now in moved if then != now)
            raise AegisError(
                f"a model that was on {then} when the guard was made, and is on {now}",
                "one and the same",
                f"model.to('{now}') before Guard(...), also where a trainer would do it",
            )
        types = [p.dtype for p in self._learning.values()]
        if self._parts.constrains and types != self._types:
            place = next(
                i
                for i, (now, then) in enumerate(zip(types, self._types, strict=True))
                if now != then
            )
            raise AegisError(
                f"'{list(self._learning)[place]}', which was in {self._types[place]} when the "
                f"guard was made, and is in {types[place]}",
                "one and the same: rounding to half precision is as large as an update",
                "leave the model as it was, with torch.autocast for fast products; of Lightning, "
                "precision='bf16-mixed'",
            )

    def _refuse_second(self, optimizer: Optimizer) -> None:
        """Refuse a second optimizer's step after one pass, which would constrain twice."""
        if self._counted not in (None, id(optimizer)):
            raise AegisError(
                "two optimizers on guarded parameters, whose updates would be constrained twice",
                "one, which may have groups with settings of their own",
                "torch.optim.AdamW([{'params': ..., 'lr': ...}, ...]); an optimizer of parameters "
                "that the guard does not know may be there besides",
            )
        self._counted = id(optimizer)

    def _refuse_other_parameters(self) -> None:
        if structure.learning(self._model).keys() != self._learning.keys():
            raise AegisError(
                "other trainable parameters than when the guard was made",
                "the same",
                "freeze and unfreeze before Guard(...)",
            )

    def _by_name(self, anchor: Mapping[int, Tensor | None]) -> dict[str, Tensor]:
        named = {name: anchor.get(id(p)) for name, p in self._learning.items()}
        return {name: a for name, a in named.items() if a is not None}

    @property
    def pending(self) -> int:
        """Steps that are not constrained yet."""
        return self._stepper.pending

    def settle(self) -> None:
        """Constrain the steps since the last time, whatever their turn."""
        self._end_broken_step()
        self._stepper.settle()

    def _end_broken_step(self) -> None:
        """End a step of the loop's own that has raised an exception, if there was one.

        An optimizer that calls its closure goes on with its step after it.
        """
        if self._slowed is not None and not self._in_closure:
            self._end(self._begun_at != self._versions())

    # --- every optimizer of the process -----------------------------------------------------------

    def before_step(self, optimizer: Optimizer, closure: Closure | None) -> Closure | None:
        """Raise before anything moves, if this is a step that goes past the guard.

        Args:
            closure: makes the backward passes itself, inside the step.

        Returns:
            What the optimizer is to call in the place of its closure.
        """
        if not self._guards(optimizer):
            return closure
        if self._parts.constrains and not self._stepping and self._automatic is None:
            raise AegisError(
                "optimizer.step() on guarded parameters",
                "guard.step(optimizer), which constrains the update",
                "call guard.step(optimizer), with a GradScaler guard.step(optimizer, scaler), or "
                "guard.automatic() before the loop; guard.remove() when done",
            )
        if closure is None:
            self._begin(optimizer)
            self._depth += 1
            return None
        self._depth += 1

        def guarded() -> Any:
            self._in_closure = True
            try:
                lost = closure()
            finally:
                self._in_closure = False
            self._begin(optimizer)
            return lost

        return guarded

    def _begin(self, optimizer: Optimizer) -> None:
        """The gradients are there, and the weights are about to move."""
        self._refuse_unguarded(optimizer)
        by_itself = self._automatic is not None and not self._stepping
        # An optimizer may call its closure several times in one step.
        if by_itself and self._parts.constrains and self._slowed is None:
            assert self._automatic is not None
            self._refuse_other_parameters()
            self._refuse_unreached()
            self._refuse_second(optimizer)
            self._stepper.begin(self._by_name(self._automatic()))
            self._slowed, self._begun_at = SlowedStep(self._parts), self._versions()

    def after_step(self, optimizer: Optimizer, scaler: Scaler | None = None) -> None:
        """The weights have moved, and go on to move where this step lies inside another one.

        Args:
            scaler: what the step was given as `grad_scaler`.
        """
        if not self._guards(optimizer):
            return
        moved = not overflowed(optimizer, scaler)
        self._moved = moved or bool(self._moved)
        self._took, self._tells = moved or self._took, True
        if self._stepped is not None:
            self._stepped.add(id(optimizer))
        self._depth = max(0, self._depth - 1)
        if self._slowed is not None and not self._depth:
            self._end(moved)

    def _end(self, moved: bool) -> None:
        """Constrain a step of the loop's own, if it has moved the weights."""
        assert self._slowed is not None
        slowed, self._slowed = self._slowed, None
        if not moved:
            self._stepper.take_none()
            return
        slowed.go_back()
        self._count += 1
        self._stepper.end(self._count)

    def _guards(self, optimizer: Optimizer) -> bool:
        mine = {id(p) for p in self._learning.values()}
        return any(id(p) in mine for group in optimizer.param_groups for p in group["params"])

    def is_of_all(self, optimizer: Optimizer) -> bool:
        """Whether an optimizer has all that learns, and no other one's step belongs to its own.

        One that is none of PyTorch's does not tell.
        """
        if not isinstance(optimizer, Optimizer):
            return False
        mine = {id(p) for p in self._learning.values()}
        return mine <= {id(p) for group in optimizer.param_groups for p in group["params"]}

    def _refuse_unguarded(self, optimizer: Optimizer) -> None:
        """Raise if guarded gradients are those of a plain backward pass."""
        if self._stepped is not None and id(optimizer) not in self._stepped:
            return
        # Some libraries take a step on zeros, to have an optimizer's state made.
        if any(gradient.any() for gradient in self.gradients()):
            raise AegisError(
                "a step on guarded parameters without a guard.backward since the last one",
                "guard.backward(loss) instead of loss.backward(), before every step",
                "call guard.backward in the loop that trains; where a trainer calls backward "
                "itself, guard.automatic(), or Trainer(callbacks=[guard.callback()]); "
                "guard.remove() when done",
            )


class SlowedStep:
    """An optimizer's step, from which each parameter goes back to its share.

    An update is linear in the learning rate, so that an interpolation of the weights does what
    another learning rate would have done.
    """

    @torch.no_grad()
    def __init__(self, parts: Parts) -> None:
        """Keep the weights before the step, by the gradients that it is made of."""
        shares = {} if parts.shares is None else _read(parts.shares())
        # A gradient that overflowed has no finite share, and a scaler skips its step.
        self._shares = {p: s for p, s in shares.items() if s != 1 and math.isfinite(s)}
        self._before = {p: p.detach().clone() for p in self._shares}

    @torch.no_grad()
    def go_back(self) -> None:
        """Leave of what has moved each parameter's share."""
        for parameter, share in self._shares.items():
            parameter.copy_(torch.lerp(self._before[parameter], parameter, share))


def _read(shares: Mapping[Tensor, float | Tensor]) -> dict[Tensor, float]:
    """The shares as numbers: those of a GPU by one transfer, where each by itself would wait."""
    unread = {p: share for p, share in shares.items() if isinstance(share, Tensor)}
    numbers = torch.stack([*unread.values()]).tolist() if unread else []
    read = dict(zip(unread, numbers, strict=True))
    return {p: read[p] if isinstance(share, Tensor) else share for p, share in shares.items()}


def overflowed(optimizer: Optimizer, scaler: Scaler | None = None) -> bool:
    """Whether a scaler has told this optimizer to leave out the step that it is in.

    A scaler calls the step of a fused optimizer in any case. It gives it `found_inf` for that time,
    and the kernel leaves the weights as they are, although PyTorch counts them as written to.

    Args:
        scaler: what the step was given as `grad_scaler`: by the older contract, the optimizer asks
            it by itself.
    """
    found = getattr(optimizer, "found_inf", None)
    if found is not None:
        return bool(found)
    return scaler is not None and any(map(bool, scaler._found_inf_per_device(optimizer).values()))


def _take(optimizer: Optimizer, scaler: Scaler | None) -> None:
    """The step as the loop's owner would take it."""
    if scaler is None:
        optimizer.step()
    else:
        scaler.step(optimizer)


def _hooks_of_every_optimizer(
    stepper: GuardedStepper,
) -> tuple[Callable[..., Any], Callable[..., None]]:
    """Checks before and after any step in the process, which do not keep the model alive."""
    known = weakref.ref(stepper)

    def before(
        optimizer: Optimizer, given: tuple[Any, ...], named: dict[str, Any]
    ) -> tuple[tuple[Any, ...], dict[str, Any]] | None:
        alive = known()
        if alive is None:
            return None
        at_place = len(given) > 1  # the first is the optimizer itself
        closure = given[1] if at_place else named.get("closure")
        guarded = alive.before_step(optimizer, closure)
        if guarded is closure:
            return None
        if at_place:
            return (given[0], guarded, *given[2:]), named
        return given, named | {"closure": guarded}

    def after(optimizer: Optimizer, given: tuple[Any, ...], named: dict[str, Any]) -> None:
        if (alive := known()) is not None:
            alive.after_step(optimizer, named.get("grad_scaler"))

    return before, after
