"""The guard in a loop that never calls it, such as a trainer's: hooks do all the work.

Hooks on the model's call watch each forward pass. When it ends, the anchor gradient is computed
from the graph that the loop's own backward pass goes through later. When that backward pass has
ended, `.grad` is projected, before anything clips it; the optimizer's hooks see the step. So the
loop may be that of accelerate, Lightning, or a Trainer.
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

# The name of an argument of the model's forward, or a function of a mapping of all its arguments.
Source = str | Callable[[Mapping[str, Any]], Tensor | None] | None


class AutomaticLoop:
    """The guard's action at each event of the loop that `LoopHooks` reports."""

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
        """Start in a state without a pass.

        Args:
            stepper: takes the steps.
            dual: computes the anchor gradients; None for a method that has none.
            hooks: hooks on the layers.
            check: refuses a pass that cannot be compared with the anchor.
            scaler: the loop's own, which scales its losses.
            ledger: the guard's ledger.
            owners: the processes that each have some rows of every weight.
        """
        self._stepper, self._dual, self._hooks = stepper, dual, hooks
        self._check, self._scaler, self._ledger = check, scaler, ledger
        self._owners = owners
        self._watched: contextlib.ExitStack | None = None
        self._ahead: AnchorGradient | None = None

    def begin(self, mask: Tensor | None, image: Tensor | None) -> None:
        """A forward pass with gradients begins.

        Raises:
            AegisError: the model has parameters that the guard does not know, or the previous pass
                is still unused.
        """
        if not self._owners.several:
            # Sharded weights may already be gathered, with other parameters in their place.
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
        """The forward pass has ended, or has raised an exception."""
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
        # Now, not after the loop's own backward pass, which frees the graph.
        device = seen.hidden[0].device.type
        # The loop may call the model inside an autocast of its own.
        with torch.autocast(device, enabled=False):
            self._ahead = self._dual.ahead(seen, self._scale())

    def _scale(self) -> float:
        """The factor by which the loop's scaler multiplies its next loss."""
        return 1.0 if self._scaler is None else self._scaler.get_scale()

    def discard(self) -> None:
        """Forget the pass of a batch that is skipped."""
        self._ahead = None

    def before_backward(self) -> None:
        """A backward pass has reached the first parameter, and not yet changed its gradient."""
        if self._dual is not None:
            self._dual.reopen()

    def left_nothing(self) -> None:
        """The backward pass has ended without changing `.grad`, so it belongs to no step."""
        if self._dual is not None:
            self._dual.leave()

    def after_backward(self) -> None:
        """The backward pass has ended, with all its gradients in `.grad`.

        Raises:
            AegisError: the guard saw no forward pass that they could belong to.
            Diverged: one is not finite, and no scaler skips the step.
        """
        # An enabled scaler skips overflowing steps on its own.
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
    """Hooks on one module's call and on the parameters of a model.

    Hooks on a sharded parameter see nothing, because FSDP writes its gradient into `.grad` without
    calling them. In that case a backward pass begins when it reaches the outputs of the call.
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
        """Register the hooks.

        Args:
            learning: the trainable parameters; empty if they are sharded.
            around: the module whose call is a forward pass.
            loop: receives the events.
            reads: whether masks are read from the arguments of a call.
            mask: source of the mask of a pass.
            image: source of the image mask of a pass.
        """
        self._around, self._loop, self._reads = around, loop, reads
        self._mask, self._image = mask, image
        self._parameters = inspect.signature(wrappers.unwrapped(around).forward)
        self._in_pass = self._in_backward = self._accumulated = self._at_output = False
        # Plain functions, because bound methods would be copied along with the module. They are
        # excluded from compilation.
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
        """Remove the hooks."""
        for handle in self._handles:
            handle.remove()

    # --- the call ---------------------------------------------------------------------------------

    def _before(self, module: nn.Module, args: tuple[Any, ...], named: dict[str, Any]) -> None:
        # A pass without gradients is an evaluation. A copy of the module carries the hooks too.
        if module is not self._around or not torch.is_grad_enabled() or self._in_pass:
            return
        # A backward pass that never ended has raised an exception, such as out of memory.
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
            # If the call has raised an exception, there is no output.
            self._loop.end(failed=output is None)
        finally:
            self._in_pass = False
        # A backward pass reaches the outputs of the call before any gradient of the model.
        hook = self._on_gradient if self._sharded else self._on_output
        for part in tree_leaves(output):
            if isinstance(part, Tensor) and part.requires_grad:
                part.register_hook(hook)

    def _given(self, args: tuple[Any, ...], named: dict[str, Any]) -> dict[str, Any]:
        """The arguments of a call by name."""
        given = dict(self._parameters.bind_partial(*args, **named).arguments)
        # Arguments collected in **kwargs have names of their own.
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
        """Record a running backward pass, since it may fail before the first parameter."""
        if not self._at_output:
            self._at_output = True
            at_end(self._on_output_end)

    def _on_output_end(self) -> None:
        self._at_output = False

    def _on_gradient(self, gradient: Tensor) -> None:
        """Prepare for the end of a backward pass, at the first tensor that it reaches."""
        if self._in_pass or self._in_backward:  # the guard's own pass, or a later tensor
            return
        # For sharded parameters, no hook reports whether `.grad` has changed: assume that it has.
        self._in_backward, self._accumulated = True, self._sharded
        self._loop.before_backward()
        at_end(self._on_end)

    def _on_accumulated(self, parameter: Tensor) -> None:
        self._accumulated = True

    def _on_end(self) -> None:
        # DistributedDataParallel has a callback of its own, which may have been queued after ours.
        at_end(self._on_finished)

    def _on_finished(self) -> None:
        self._in_backward = False
        # `torch.autograd.grad` does not change `.grad`, so it belongs to no step.
        if self._accumulated:
            self._loop.after_backward()
        else:
            self._loop.left_nothing()


def at_end(call: Callable[[], None]) -> None:
    """Call a function when the running backward pass has ended, as FSDP2 does."""
    torch.autograd.Variable._execution_engine.queue_callback(call)
