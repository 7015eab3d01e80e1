"""Steps of an optimizer that is not ours, and none of them past the guard."""

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
from aegis_cli.methods.base import Parts
from aegis_cli.methods.stepper import Stepper
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
        self._parts, self._averaging = parts, averaging or {}
        self._learning = LearningParameters(model)
        self._stepper, self._may_shard = Stepper(model, parts, may_shard), may_shard
        self._count = 0  # steps since the guard was made, or was settled
        self._automatic: Callable[[], Mapping[int, Tensor | None]] | None = None
        self._since = _SincePass()
        self._taken: _TakenStep | None = None
        self._own: _OwnStep | None = None
        # Steps inside each other: of an optimizer that calls its base class's, or another one's.
        self._depth, self._in_closure = 0, False
        self._tells = False  # whether any optimizer has ever told of a step
        self._buffers = _BufferWatch(model)
        _AT_WORK.add(self)
        # On every optimizer of the process: the loop's own may be made after the guard.
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

    def remove(self) -> None:
        """Let every step pass."""
        _AT_WORK.discard(self)
        for hook in self._hooks:
            hook.remove()

    # --- passes -----------------------------------------------------------------------------------

    def check(self) -> None:
        """Refuse a model whose parameters are not those that the guard was made with.

        Raises:
            AegisError: they were replaced or moved, further ones learn, or another guard is at
                work on them.
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
        """Note a guarded backward pass, which every optimizer may follow with one step.

        Raises:
            AegisError: it left no gradient in the model, or another guard is at work on it.
        """
        self._end_broken_step()
        self._refuse_another_guard()
        if not self._sums_late:
            self._learning.refuse_unreached()
        self._buffers.look()
        self._since = _SincePass(guarded=True, written=self._learning.versions())
        if not self._in_closure:
            self._depth = 0  # a step that raised an exception has left it as it was

    def _refuse_another_guard(self) -> None:
        """Refuse a second guard of the same kind on a parameter: it would undo what one has held.

        One may project gradients, and another one constrain the updates that are made of them.
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
            skips: whether a scaler was there, which skips steps that overflow.
        """
        if self._since.moved or self._since.written != self._learning.versions():
            return True
        # An optimizer that is none of PyTorch's tells nothing, and may write past its count.
        return not (self._tells or skips)

    @property
    def has_stepped(self) -> bool:
        """Whether an optimizer has told that it moved weights since the last guarded pass."""
        return self._since.moved

    @property
    def _sums_late(self) -> bool:
        """Whether gradients may arrive in the last pass of a step alone.

        Several passes over sharded weights may leave their sum to the last of them. A method that
        reads the gradient needs that of each pass.
        """
        return self._may_shard and self._parts.penalty is None

    def gradients_finite(self, owners: Ranks = ALONE) -> bool:
        """Whether every gradient of what learns is finite, in all processes."""
        return self._learning.gradients_finite(owners)

    # --- steps that the guard takes ---------------------------------------------------------------

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
        if not self._parts.constrains or not self._learning.are_in(optimizer):
            _take(optimizer, scaler)
            return
        self._learning.refuse_others()
        self._refuse_another_place()
        self._refuse_unguarded(optimizer)
        self._refuse_second(optimizer)
        self._refuse_unreached()
        self._stepper.begin(self._learning.by_name(anchor))
        # Before the step: the shares are those of the gradients that it is made of.
        slowed = SlowedStep(self._parts)
        taken = self._taken = _TakenStep(self._learning.versions())
        try:
            _take(optimizer, scaler)
        finally:
            self._taken = None
            # A scaler skips a step that overflowed, and a trainer's optimizer skips those between
            # its accumulated ones. A step that moved nothing must not be constrained. One that
            # raises an exception may have moved some of the weights.
            self._end(slowed, taken.has_moved(optimizer, self._learning))

    def _end(self, slowed: SlowedStep, moved: bool) -> None:
        """Constrain a step, if it has moved the weights."""
        if not moved:
            self._stepper.cancel()
            return
        # First the shares, as a lower rate would have moved it; what is constrained is the result.
        slowed.go_back()
        self._count += 1
        self._stepper.end(self._count)

    @property
    def pending(self) -> int:
        """Steps that are not constrained yet."""
        return self._stepper.pending

    def settle(self) -> None:
        """Constrain the steps since the last time, whatever their turn."""
        self._end_broken_step()
        self._stepper.settle()
        # What is saved now may be gone on with by a guard that counts from here.
        self._count = 0

    def is_of_all(self, optimizer: Optimizer) -> bool:
        """Whether an optimizer has all that learns, and no other one's step belongs to its own."""
        return self._learning.are_all_in(optimizer)

    # --- every optimizer of the process -----------------------------------------------------------

    def before_step(self, optimizer: Optimizer, closure: Closure | None) -> Closure | None:
        """Raise before anything moves, if this is a step that goes past the guard.

        Args:
            closure: makes the backward passes itself, inside the step.

        Returns:
            What the optimizer is to call in the place of its closure.
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

        # The backward passes happen inside the step, so that its gradients can only be looked at
        # between the closure's end and the first weight that moves.
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
        if self._automatic is None or self._taken is not None or not self._parts.constrains:
            return
        if self._own is not None:  # an optimizer may call its closure several times in one step
            return
        self._learning.refuse_others()
        self._refuse_unreached()
        self._refuse_second(optimizer)
        self._stepper.begin(self._learning.by_name(self._automatic()))
        self._own = _OwnStep(SlowedStep(self._parts), self._learning.versions())

    def after_step(self, optimizer: Optimizer, scaler: Scaler | None = None) -> None:
        """The weights have moved, and go on to move where this step lies inside another one.

        Args:
            scaler: what the step was given as `grad_scaler`.
        """
        if not self._learning.are_in(optimizer):
            return
        moved = not overflowed(optimizer, scaler)
        self._tells = True
        # A second step of this optimizer before the next pass would be one on used gradients.
        self._since.stepped.add(id(optimizer))
        self._since.moved = moved or self._since.moved
        if self._taken is not None:
            self._taken.told = moved or bool(self._taken.told)
        # Only when the outermost step has ended have the weights moved for good.
        self._depth = max(0, self._depth - 1)
        if not self._depth:
            self._end_own(moved)

    def _end_own(self, moved: bool) -> None:
        """End the step of the loop's own, if one is under way."""
        own, self._own = self._own, None
        if own is not None:
            self._end(own.slowed, moved)

    def _end_broken_step(self) -> None:
        """End a step of the loop's own that has raised an exception, if there was one.

        An optimizer that calls its closure goes on with its step after it.
        """
        if self._own is not None and not self._in_closure:
            self._end_own(self._own.written != self._learning.versions())

    # --- refusals ---------------------------------------------------------------------------------

    def _refuse_another_place(self) -> None:
        """Refuse a model that is elsewhere, or of another type, than what constrains it."""
        if self._parts.constrains:
            self._learning.refuse_another_place()

    def _refuse_unreached(self) -> None:
        """Raise AegisError where the passes of a step have left no gradient in the model."""
        if self._sums_late and self._since.guarded:
            self._learning.refuse_unreached()

    def _refuse_second(self, optimizer: Optimizer) -> None:
        """Refuse a second optimizer's step after one pass, which would constrain twice."""
        if self._since.constrained not in (None, id(optimizer)):
            raise AegisError(
                "two optimizers on guarded parameters, whose updates would be constrained twice",
                "one, which may have groups with settings of their own",
                "torch.optim.AdamW([{'params': ..., 'lr': ...}, ...]); parameters that "
                "the guard does not know may have an optimizer of their own",
            )
        self._since.constrained = id(optimizer)

    def _refuse_unguarded(self, optimizer: Optimizer) -> None:
        """Raise if guarded gradients are those of a plain backward pass."""
        if self._since.guarded and id(optimizer) not in self._since.stepped:
            return
        # Some libraries take a step on zeros, to have an optimizer's state made.
        if any(gradient.any() for gradient in self._learning.gradients()):
            raise AegisError(
                "a step on guarded parameters without a guard.backward since the last one",
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
        stepped: ids of the optimizers that have stepped since.
        moved: whether one of them has moved the weights.
        constrained: id of the one whose update was constrained; None: none's was.
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
        told: whether an optimizer has moved the weights, by its hook; None: no hook has told.
    """

    written: Sequence[int]
    told: bool | None = None

    def has_moved(self, optimizer: Optimizer, learning: LearningParameters) -> bool:
        """Whether the weights have moved."""
        if self.told is not None:
            return self.told
        # One that is no optimizer of PyTorch's may write past its count.
        return not isinstance(optimizer, Optimizer) or self.written != learning.versions()


@dataclass
class _OwnStep:
    """A step that the loop takes by itself.

    Attributes:
        slowed: goes back to the shares of its update.
        written: how often each weight had been written to before it.
    """

    slowed: SlowedStep
    written: Sequence[int]


class _BufferWatch:
    """Warns, at the second pass, of the buffers that it has written to since the first."""

    def __init__(self, model: nn.Module) -> None:
        self._model, self._looked = model, False
        self._first: WrittenBuffers | None = None

    def look(self) -> None:
        """A pass has ended."""
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


class SlowedStep:
    """Shrinks each parameter's update to its share, after the optimizer's step.

    An update is linear in the learning rate, so interpolating between old and new weights has the
    effect of a lower rate.
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
            # before + share (after - before)
            parameter.copy_(torch.lerp(self._before[parameter], parameter, share))


def _read(shares: Mapping[Tensor, float | Tensor]) -> dict[Tensor, float]:
    """The shares as numbers; those of a GPU by one transfer instead of one sync each."""
    unread = {p: share for p, share in shares.items() if isinstance(share, Tensor)}
    numbers = torch.stack([*unread.values()]).tolist() if unread else []
    read = dict(zip(unread, numbers, strict=True))
    found = {}
    for parameter, share in shares.items():
        found[parameter] = read[parameter] if isinstance(share, Tensor) else share
    return found


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
