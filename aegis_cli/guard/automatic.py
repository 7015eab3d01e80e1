"""The guard in a loop that never calls it, such as a trainer's: hooks do all the work.

A forward pass of the model is watched by hooks on its call. The anchor gradient is taken as it
ends, from the graph that the loop's own backward pass goes through afterwards. When that backward
pass has ended, `.grad` is projected, before anything clips it; the optimizer's hooks see the step.
So the loop may be accelerate's, Lightning's, or a Trainer's.
"""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._pytree import tree_leaves

from aegis_cli.anchors.hooks import LayerHooks
from aegis_cli.common.errors import AegisError
from aegis_cli.common.ranks import Ranks
from aegis_cli.guard.dual_backward import AnchorGradient, DualBackward, diverged
from aegis_cli.guard.stepper import GuardedStepper, Scaler
from aegis_cli.methods.base import Pass
from aegis_cli.methods.ledger_file import LedgerOutsideRuns
from aegis_cli.models import wrappers

# The name of an argument of the model's forward, or a function of all its arguments by name.
Source = str | Callable[[Mapping[str, Any]], Tensor | None] | None


class AutomaticLoop:
    """What the guard does at each event of the loop that `LoopHooks` reports."""

    def __init__(
        self,
        stepper: GuardedStepper,
        dual: DualBackward | None,
        hooks: LayerHooks,
        check: Callable[[Pass], None],
        scaler: Scaler | None,
        ledger: LedgerOutsideRuns,
        owners: Ranks,
    ) -> None:
        """Begin without a pass.

        Args:
            stepper: takes the steps.
            dual: takes the anchor gradients; None for a method that has none.
            hooks: on the layers.
            check: refuses a pass that cannot be compared with the anchor.
            scaler: the loop's own, which scales its losses.
            ledger: of the guard.
            owners: the processes that have some rows of every weight.
        """
        self._stepper, self._dual, self._hooks = stepper, dual, hooks
        self._check, self._scaler, self._ledger = check, scaler, ledger
        self._owners = owners
        self._watched: contextlib.ExitStack | None = None
        self._ahead: AnchorGradient | None = None

    def begin(self, mask: Tensor | None, image: Tensor | None) -> None:
        """A forward pass under gradients begins.

        Raises:
            AegisError: parameters that the guard does not know, or the pass before is still unused.
        """
        if not self._owners.several:
            # Sharded weights may be gathered already, and others then in their place.
            self._stepper.check()
        if self._dual is None:
            return
        if self._ahead is not None:
            raise AegisError(
                "a second forward pass under gradients before the backward pass of the first",
                "one forward pass of the guarded model for each backward pass",
                "use torch.no_grad() around passes that nothing learns from; guard.discard() for a "
                "batch that is skipped, or whose loss.backward() failed; where a step needs "
                "several passes at once, call the guard in the loop: guard.watch around all of "
                "them, and guard.backward",
            )
        self._dual.check_group()
        self._dual.forget_cleared()
        self._watched = contextlib.ExitStack()
        self._watched.enter_context(self._hooks.watch(mask, image, self._note))

    def end(self, failed: bool) -> None:
        """It has ended, or has raised an exception."""
        if self._watched is None:
            return
        watched, self._watched = self._watched, None
        if failed:
            self._hooks.forget()
        else:
            watched.close()

    def _note(self, seen: Pass) -> None:
        assert self._dual is not None
        self._check(seen)
        # Now, and not in the loop's own backward pass: that frees the graph.
        device = seen.hidden[0].device.type
        # The loop may call the model inside an autocast of its own.
        with torch.autocast(device, enabled=False):
            self._ahead = self._dual.ahead(seen, self._scale())

    def _scale(self) -> float:
        """What the loop's scaler multiplies its next loss by."""
        return 1.0 if self._scaler is None else self._scaler.get_scale()

    def discard(self) -> None:
        """Forget the pass of a batch that is skipped."""
        self._ahead = None

    def before_backward(self) -> None:
        """A backward pass has come to the first parameter, and left nothing in it yet."""
        if self._dual is not None:
            self._dual.reopen()

    def left_nothing(self) -> None:
        """The backward pass has ended and left nothing in `.grad`: it belongs to no step."""
        if self._dual is not None:
            self._dual.leave()

    def after_backward(self) -> None:
        """All its gradients lie in `.grad`.

        Raises:
            AegisError: the guard saw no pass that they could be of.
            Diverged: one is not finite, and no scaler skips the step.
        """
        # An enabled scaler skips a step that overflows by itself.
        skips = self._scaler is not None and self._scaler.is_enabled()
        if self._dual is None:
            self._stepper.passed()
            if not skips and not self._stepper.gradients_finite(self._owners):
                raise diverged(len(self._ledger))
            return
        ahead, self._ahead = self._ahead, None
        if ahead is None:
            raise AegisError(
                "a backward pass to guarded parameters without a forward pass that the guard saw",
                "one call of the guarded model under gradients for each backward pass",
                "call the model itself and not its parts, or name the module whose call is a pass: "
                "guard.automatic(around=policy)",
            )
        self._dual.arrived(ahead, self._scale(), skips)


class LoopHooks:
    """Hooks on one module's call and on parameters of a model.

    A sharded parameter's hooks see nothing, since its gradient is put into `.grad` past them. Then
    a backward pass begins where it comes to what the call has given.
    """

    def __init__(
        self,
        learning: Iterable[nn.Parameter],
        around: nn.Module,
        loop: AutomaticLoop,
        reads: bool,
        mask: Source,
        image: Source,
    ) -> None:
        """Put the hooks on.

        Args:
            learning: what learns; nothing where that is sharded.
            around: the module whose call is a forward pass.
            loop: what is told of it.
            reads: whether masks are read from a call's arguments.
            mask: where the mask of a pass is found.
            image: where it is found which tokens are the image's.
        """
        self._around, self._loop, self._reads = around, loop, reads
        self._mask, self._image = mask, image
        self._parameters = inspect.signature(wrappers.unwrapped(around).forward)
        self._in_pass = self._in_backward = self._accumulated = self._at_output = False
        # Functions are no part of a copy of the module, as bound methods would be. Compiled code
        # leaves them alone.
        before = torch.compiler.disable(lambda *given: self._before(*given))
        after = torch.compiler.disable(lambda *given: self._after(*given))
        self._handles: list[Any] = [
            around.register_forward_pre_hook(before, with_kwargs=True),
            around.register_forward_hook(after, always_call=True),
        ]
        hooked = {id(p): p for p in learning}
        self._sharded = not hooked
        for parameter in hooked.values():
            self._handles.append(parameter.register_hook(self._on_gradient))
            on_sum = parameter.register_post_accumulate_grad_hook(self._on_accumulated)
            self._handles.append(on_sum)

    def remove(self) -> None:
        """Take the hooks off."""
        for handle in self._handles:
            handle.remove()

    # --- the call ---------------------------------------------------------------------------------

    def _before(self, module: nn.Module, args: tuple[Any, ...], named: dict[str, Any]) -> None:
        # A pass without gradients is an evaluation. A copy of the module has the hooks too.
        if module is not self._around or not torch.is_grad_enabled() or self._in_pass:
            return
        # A backward pass that never ended has raised an exception, such as for want of memory.
        if self._in_backward or self._at_output:
            self._loop.discard()
        self._in_backward = self._at_output = False
        mask = image = None
        if self._reads:
            given = self._given(args, named)
            mask, image = self._read(self._mask, given), self._read(self._image, given)
        self._loop.begin(mask, image)
        self._in_pass = True

    def _after(self, module: nn.Module, args: tuple[Any, ...], output: Any) -> None:
        if module is not self._around or not self._in_pass:
            return
        try:
            # Where the call has raised an exception, there is no output.
            self._loop.end(failed=output is None)
        finally:
            self._in_pass = False
        # A backward pass comes to the call's outputs before any of the model's gradients.
        hook = self._on_gradient if self._sharded else self._on_output
        for part in tree_leaves(output):
            if isinstance(part, Tensor) and part.requires_grad:
                part.register_hook(hook)

    def _given(self, args: tuple[Any, ...], named: dict[str, Any]) -> dict[str, Any]:
        """The arguments of a call by name."""
        given = dict(self._parameters.bind_partial(*args, **named).arguments)
        # What the signature calls **kwargs was given by names of its own.
        for name, kind in self._parameters.parameters.items():
            if kind.kind is inspect.Parameter.VAR_KEYWORD:
                given |= given.pop(name, {})
        return given

    def _read(self, source: Source, given: Mapping[str, Any]) -> Tensor | None:
        if source is None:
            return None
        if callable(source):
            return source(given)
        found = given.get(source)
        if not isinstance(found, Tensor):
            raise AegisError(
                f"a call of {type(self._around).__name__} without a tensor '{source}'",
                f"one of its arguments: {', '.join(given) or '(none)'}",
                "guard.automatic(mask=...): the argument's name, a function of all arguments, or "
                "None where every token counts",
            )
        return found

    # --- the backward pass ------------------------------------------------------------------------

    def _on_output(self, gradient: Tensor) -> None:
        """Note, until it has ended, a backward pass that may fail before the first parameter."""
        if not self._at_output:
            self._at_output = True
            at_end(self._on_output_end)

    def _on_output_end(self) -> None:
        self._at_output = False

    def _on_gradient(self, gradient: Tensor) -> None:
        """Prepare for the end of a backward pass, at the first tensor that it comes to."""
        if self._in_pass or self._in_backward:  # the guard's own pass, or a later tensor
            return
        # Of sharded parameters nobody tells whether anything is left in `.grad`: it is taken to be.
        self._in_backward, self._accumulated = True, self._sharded
        self._loop.before_backward()
        at_end(self._on_end)

    def _on_accumulated(self, parameter: Tensor) -> None:
        self._accumulated = True

    def _on_end(self) -> None:
        # DistributedDataParallel has its own work at the end, which it may have asked for later.
        at_end(self._on_finished)

    def _on_finished(self) -> None:
        self._in_backward = False
        # `torch.autograd.grad` leaves nothing in `.grad`: it is no step's.
        if self._accumulated:
            self._loop.after_backward()
        else:
            self._loop.left_nothing()


def at_end(call: Callable[[], None]) -> None:
    """Call a function when the running backward pass has ended, as FSDP2 does."""
    torch.autograd.Variable._execution_engine.queue_callback(call)
