"""Steps of a user's optimizer, none of which bypasses the guard."""

from __future__ import annotations

import math
import warnings
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.optimizer import (
    Optimizer,
    register_optimizer_step_post_hook,
    register_optimizer_step_pre_hook,
)

from aegis_cli.common.errors import AegisError
from aegis_cli.common.ranks import ALONE, Ranks
from aegis_cli.guard.learning_parameters import LearningParameters
from aegis_cli.guard.pending_watch import PendingWatch
from aegis_cli.methods.base import Parts
from aegis_cli.methods.stepper import Stepper
from aegis_cli.models.buffers import WrittenBuffers

Scaler = torch.amp.GradScaler
Closure = Callable[[], Any]
_AT_WORK: weakref.WeakSet[GuardedStepper] = weakref.WeakSet()  # those that are not removed


class GuardedStepper:
    """Runs the user's optimizer through a `Stepper`, and refuses steps that bypass the guard.

    A method that constrains nothing leaves every step as it is, provided that a guarded backward
    pass came before it.
    """

    def __init__(
        self,
        model: nn.Module,
        parts: Parts,
        may_shard: bool = False,
        averaging: Mapping[str, nn.Module] | None = None,
        why_strong: Callable[[float], str | None] = lambda rate: None,
    ) -> None:
        """Create a stepper that has taken no step yet.

        Args:
            may_shard: as for `Stepper`.
            averaging: modules, by name, that must not update running averages of their inputs
                while the method is active.
            why_strong: why the model may learn little at a learning rate; None if it does learn.
        """
        self._parts, self._averaging = parts, averaging or {}
        self._learning = LearningParameters(model)
        self._stepper, self._may_shard = Stepper(model, parts, may_shard), may_shard
        self._count = 0  # steps since the guard was created or last settled
        self._automatic: Callable[[], Mapping[int, Tensor | None]] | None = None
        self._since = _SincePass()
        self._taken: _TakenStep | None = None
        self._own: _OwnStep | None = None
        # Nesting depth, for an optimizer that calls the step of its base class or of another one.
        self._depth, self._in_closure = 0, False
        self._tells = False  # whether any optimizer has ever reported a step
        self._buffers, self._rates = _BufferWatch(model), _RateWatch(why_strong)
        _AT_WORK.add(self)
        # On every optimizer of the process: that of the loop may be created after the guard.
        before, after = _hooks_of_every_optimizer(self)
        self._hooks: list[Any] = [
            register_optimizer_step_pre_hook(before),
            register_optimizer_step_post_hook(after),
        ]
        if parts.every > 1:  # otherwise no step is pending once it has ended
            self._hooks.append(PendingWatch(model, self._stepper))

    def take_by_itself(self, anchor: Callable[[], Mapping[int, Tensor | None]]) -> None:
        """Constrain the steps that a loop takes by `optimizer.step()`, instead of refusing them.

        Args:
            anchor: returns the anchor gradient by the parameters' ids.
        """
        self._automatic = anchor

    def remove(self) -> None:
        """Let every step pass."""
        _AT_WORK.discard(self)
        for hook in self._hooks:
            hook.remove()

    # --- passes -----------------------------------------------------------------------------------

    def check(self) -> None:
        """Refuse a model whose parameters are not those that the guard was created with.

        Raises:
            AegisError: they were replaced or moved, further ones learn, or another guard is active
                on them.
        """
        self._end_broken_step()
        self._refuse_another_guard()
        self._stepper.known.check()
        self._learning.refuse_further()
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
        """Record a guarded backward pass, after which every optimizer may take one step.

        Raises:
            AegisError: it left no gradient in the model, or another guard is active on it.
        """
        self._end_broken_step()
        self._refuse_another_guard()
        if not self._sums_late:
            self._learning.refuse_unreached()
        self._buffers.look()
        self._since = _SincePass(guarded=True, written=self._learning.versions())
        if not self._in_closure:
            self._depth = 0  # a step that raised an exception did not reset it

    def _refuse_another_guard(self) -> None:
        """Refuse a second guard of the same kind on a parameter: it would undo the first's work.

        But one may project gradients while another constrains the updates computed from them.
        """
        for other in _AT_WORK:
            used = other is not self and other._since.guarded
            if not used or other._parts.constrains != self._parts.constrains:
                continue
            if shared := self._learning.shared_with(other._learning):
                raise AegisError(
                    f"two guards at work on {len(shared)} parameters, first '{shared[0]}'",
                    "one for each parameter: a second one would move what the first has held",
                    "guard.remove() for one that is done; freeze what two guarded models share; or "
                    "measure one anchor on the questions of both",
                )

    def may_have_moved(self, skips: bool) -> bool:
        """Whether a step may have moved the weights since the last guarded backward pass.

        Args:
            skips: whether there was a scaler, which skips steps that overflow.
        """
        if self._since.moved or self._since.written != self._learning.versions():
            return True
        # An optimizer that is not PyTorch's reports nothing, and may bypass the version counter.
        return not (self._tells or skips)

    @property
    def has_stepped(self) -> bool:
        """Whether an optimizer has reported moving weights since the last guarded pass."""
        return self._since.moved

    @property
    def _sums_late(self) -> bool:
        """Whether gradients may arrive only in the last pass of a step.

        Several passes over sharded weights may sum their gradients only in the last of them. A
        method that reads the gradient needs that of each pass.
        """
        return self._may_shard and self._parts.penalty is None

    def gradients_finite(self, owners: Ranks = ALONE) -> bool:
        """Whether the gradients of all trainable parameters are finite, in all processes."""
        return self._learning.gradients_finite(owners)

    # --- steps that the guard takes ---------------------------------------------------------------

    def step(
        self, optimizer: Optimizer, scaler: Scaler | None, anchor: Mapping[int, Tensor | None]
    ) -> None:
        """Take the optimizer's step and constrain its update.

        Args:
            anchor: the anchor gradient by the parameters' ids.

        Raises:
            AegisError: the trainable parameters are not those from when the guard was created, or
                their gradients come from a plain backward pass.
        """
        if not self._parts.constrains or not self._learning.are_in(optimizer):
            _take(optimizer, scaler)
            return
        self._learning.refuse_others()
        self._refuse_another_place()
        self._refuse_unguarded(optimizer)
        self._refuse_second(optimizer)
        self._refuse_unreached()
        self._rates.look(self._learning.groups_of(optimizer))
        self._stepper.begin(self._learning.by_name(anchor))
        # Before the step: the shares come from the gradients that the step uses.
        slowed = SlowedStep(self._parts)
        taken = self._taken = _TakenStep(self._learning.versions())
        try:
            _take(optimizer, scaler)
        finally:
            self._taken = None
            # A scaler skips a step that overflowed, and a trainer's optimizer skips steps while it
            # accumulates gradients. A step that moved nothing must not be constrained. One that
            # raises an exception may have moved some of the weights.
            self._end(slowed, taken.has_moved(optimizer, self._learning))

    def _end(self, slowed: SlowedStep, moved: bool) -> None:
        """Constrain a step, if it has moved the weights."""
        if not moved:
            self._stepper.cancel()
            return
        # First apply the shares, as if the learning rate had been lower; then constrain the result.
        slowed.go_back()
        self._count += 1
        self._stepper.end(self._count)

    @property
    def pending(self) -> int:
        """Steps that are not constrained yet."""
        return self._stepper.pending

    def settle(self) -> None:
        """Constrain the pending steps, however many there are."""
        self._end_broken_step()
        self._stepper.settle()
        # A model saved now may be continued by a new guard, which counts from here.
        self._count = 0

    def drop_pending(self) -> None:
        """Forget the pending steps: the next one is the first since the present weights."""
        self._own = None
        self._stepper.drop_pending()
        self._count = 0

    def is_of_all(self, optimizer: Optimizer) -> bool:
        """Whether an optimizer has all trainable parameters, so that no other shares its step."""
        return self._learning.are_all_in(optimizer)

    # --- every optimizer of the process -----------------------------------------------------------

    def before_step(self, optimizer: Optimizer, closure: Closure | None) -> Closure | None:
        """Raise, before anything moves, if this is a step that bypasses the guard.

        Args:
            closure: runs the backward passes inside the step.

        Returns:
            The function that the optimizer calls instead of its closure.
        """
        if not self._learning.are_in(optimizer):
            return closure
        if self._parts.constrains and self._taken is None and self._automatic is None:
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

        # The backward passes happen inside the step, so its gradients can only be checked between
        # the end of the closure and the first weight that moves.
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
        """The gradients are ready, and the weights are about to move."""
        self._refuse_unguarded(optimizer)
        if self._automatic is None or self._taken is not None or not self._parts.constrains:
            return
        if self._own is not None:  # an optimizer may call its closure several times in one step
            return
        self._learning.refuse_others()
        self._refuse_unreached()
        self._refuse_second(optimizer)
        self._rates.look(self._learning.groups_of(optimizer))
        self._stepper.begin(self._learning.by_name(self._automatic()))
        self._own = _OwnStep(SlowedStep(self._parts), self._learning.versions())

    def after_step(self, optimizer: Optimizer, scaler: Scaler | None = None) -> None:
        """The weights have moved, and will move further if this step is nested in another one.

        Args:
            scaler: the `grad_scaler` argument of the step.
        """
        if not self._learning.are_in(optimizer):
            return
        moved = not overflowed(optimizer, scaler)
        self._tells = True
        # A second step of this optimizer before the next pass would reuse the same gradients.
        self._since.stepped.add(id(optimizer))
        self._since.moved = moved or self._since.moved
        if self._taken is not None:
            self._taken.told = moved or bool(self._taken.told)
        # The update is complete only when the outermost step has ended.
        self._depth = max(0, self._depth - 1)
        if not self._depth:
            self._end_own(moved)

    def _end_own(self, moved: bool) -> None:
        """End the loop's own step, if one is in progress."""
        own, self._own = self._own, None
        if own is not None:
            self._end(own.slowed, moved)

    def _end_broken_step(self) -> None:
        """End a step of the loop that has raised an exception, if there was one.

        While an optimizer is calling its closure, its step is still in progress.
        """
        if self._own is not None and not self._in_closure:
            self._end_own(self._own.written != self._learning.versions())

    # --- refusals ---------------------------------------------------------------------------------

    def _refuse_another_place(self) -> None:
        """Refuse a model whose device or dtype differs from those of its constraints."""
        if self._parts.constrains:
            self._learning.refuse_another_place()

    def _refuse_unreached(self) -> None:
        """Raise AegisError if the passes of a step have left no gradient in the model."""
        if self._sums_late and self._since.guarded:
            self._learning.refuse_unreached()

    def _refuse_second(self, optimizer: Optimizer) -> None:
        """Refuse a second optimizer's step after one pass, to avoid constraining updates twice."""
        if self._since.constrained not in (None, id(optimizer)):
            raise AegisError(
                "two optimizers on guarded parameters, whose updates would be constrained twice",
                "one, which may have groups with settings of their own",
                "torch.optim.AdamW([{'params': ..., 'lr': ...}, ...]); parameters that "
                "the guard does not know may have an optimizer of their own",
            )
        self._since.constrained = id(optimizer)

    def _refuse_unguarded(self, optimizer: Optimizer) -> None:
        """Raise AegisError if gradients of guarded parameters come from a plain backward pass."""
        if self._since.guarded and id(optimizer) not in self._since.stepped:
            return
        # Some libraries take a step with zero gradients to initialise an optimizer's state.
        if not any(gradient.any() for gradient in self._learning.gradients()):
            return
        found = "a step on guarded parameters without a guard.backward since the last one"
        for other in _AT_WORK:
            if other is not self and (shared := other._learning.shared_with(self._learning)):
                raise AegisError(
                    f"{found}, of one of two guards on {len(shared)} parameters, first "
                    f"'{shared[0]}'",
                    "each guard sees every backward pass, and only one can be called in the loop",
                    "guard.automatic() for one of them, or for both and a loop with "
                    "loss.backward() and optimizer.step(); guard.remove() for one that is done",
                )
        raise AegisError(
            found,
            "guard.backward(loss) instead of loss.backward(), before every step",
            "call guard.backward in the loop that trains; where a trainer calls backward "
            "itself, guard.automatic(), or Trainer(callbacks=[guard.callback()]); "
            "guard.remove() when done",
        )


@dataclass
class _SincePass:
    """What optimizers have done since the last guarded backward pass.

    Attributes:
        guarded: whether there was such a pass.
        written: how often each weight had been written to at that pass.
        stepped: ids of the optimizers that have taken a step since.
        moved: whether one of them has moved the weights.
        constrained: id of the optimizer whose update was constrained; None if there was none.
    """

    guarded: bool = False
    written: Sequence[int] = ()
    stepped: set[int] = field(default_factory=set)
    moved: bool = False
    constrained: int | None = None


@dataclass
class _TakenStep:
    """A step that the guard takes.

    Attributes:
        written: how often each weight had been written to before it.
        told: whether an optimizer's hook reported moved weights; None if no hook was called.
    """

    written: Sequence[int]
    told: bool | None = None

    def has_moved(self, optimizer: Optimizer, learning: LearningParameters) -> bool:
        """Whether the weights have moved."""
        if self.told is not None:
            return self.told
        # An optimizer that is not PyTorch's may bypass the version counter.
        return not isinstance(optimizer, Optimizer) or self.written != learning.versions()


@dataclass
class _OwnStep:
    """A step that the loop takes by itself.

    Attributes:
        slowed: reduces the update to its shares.
        written: how often each weight had been written to before it.
    """

    slowed: SlowedStep
    written: Sequence[int]


class _BufferWatch:
    """Warns at the second pass about buffers that were written to since the first."""

    def __init__(self, model: nn.Module) -> None:
        self._model, self._looked = model, False
        self._first: WrittenBuffers | None = None

    def look(self) -> None:
        """Check the buffers at the end of a pass."""
        if self._looked:
            return
        if self._first is None:
            self._first = WrittenBuffers(self._model)
            return
        written = self._first.modules()
        self._looked, self._first = True, None
        if not written:
            return
        more = f" and of {len(written) - 1} more modules" if written[1:] else ""
        warnings.warn(
            f"passes in training mode change buffers of '{written[0]}'{more}, as BatchNorm "
            "averages what it reads: answers change with them, and no method protects them; call "
            "module.eval() for each of these modules after model.train()",
            stacklevel=2,
        )


HELD = 100  # steps without a rise after which a learning rate is taken for the highest


class _RateWatch:
    """Warns at the peak of the learning rate if a method is too strong for it."""

    def __init__(self, why_strong: Callable[[float], str | None]) -> None:
        self._why_strong, self._highest, self._looked = why_strong, 0.0, False
        self._held = 0  # steps since the rate last rose

    def look(self, groups: Sequence[Mapping[str, Any]]) -> None:
        """Check the rates of a step's groups."""
        if self._looked:
            return
        rate = max((float(group.get("lr", 0)) for group in groups), default=0.0)
        if rate > self._highest or rate == 0:
            self._highest, self._held = max(rate, self._highest), 0
            return
        # A warm-up begins far below the peak, and some schedules rise only every few steps. So wait
        # until the rate falls, or has stayed for long.
        self._held += 1
        if rate == self._highest and self._held < HELD:
            return
        self._looked = True
        if why := self._why_strong(self._highest):
            warnings.warn(why, stacklevel=2)


class SlowedStep:
    """Shrinks each parameter's update to its share, after the optimizer's step.

    An update is linear in the learning rate, so interpolating between old and new weights has the
    effect of a lower rate.
    """

    @torch.no_grad()
    def __init__(self, parts: Parts) -> None:
        """Compute the shares from the gradients, and copy the weights before the step."""
        shares = {} if parts.shares is None else _read(parts.shares())
        # An overflowed gradient has no finite share, but a scaler skips its step anyway.
        self._shares = {p: s for p, s in shares.items() if s != 1 and math.isfinite(s)}
        self._before = {p: p.detach().clone() for p in self._shares}

    @torch.no_grad()
    def go_back(self) -> None:
        """Reduce each parameter's update to its share."""
        for parameter, share in self._shares.items():
            # before + share (after - before)
            parameter.copy_(torch.lerp(self._before[parameter], parameter, share))


def _read(shares: Mapping[Tensor, float | Tensor]) -> dict[Tensor, float]:
    """The shares as numbers; those on a GPU in one transfer instead of one sync each."""
    unread = {p: share for p, share in shares.items() if isinstance(share, Tensor)}
    numbers = torch.stack([*unread.values()]).tolist() if unread else []
    read = dict(zip(unread, numbers, strict=True))
    found = {}
    for parameter, share in shares.items():
        found[parameter] = read[parameter] if isinstance(share, Tensor) else share
    return found


def overflowed(optimizer: Optimizer, scaler: Scaler | None = None) -> bool:
    """Whether a scaler has told this optimizer to skip its current step.

    A scaler calls the step of a fused optimizer in any case. For the time of the call it sets
    `found_inf` on it, and the kernel leaves the weights as they are, although PyTorch counts them
    as written to.

    Args:
        scaler: the `grad_scaler` argument of the step: by the older convention, the optimizer
            queries the scaler itself.
    """
    found = getattr(optimizer, "found_inf", None)
    if found is not None:
        return bool(found)
    return scaler is not None and any(map(bool, scaler._found_inf_per_device(optimizer).values()))


def _take(optimizer: Optimizer, scaler: Scaler | None) -> None:
    """Take the step as the user's loop would take it."""
    if scaler is None:
        optimizer.step()
    else:
        scaler.step(optimizer)


def _hooks_of_every_optimizer(
    stepper: GuardedStepper,
) -> tuple[Callable[..., Any], Callable[..., None]]:
    """Hooks before and after any step in the process that do not keep the model alive."""
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
