"""Warns if a model's weights are taken or replaced while steps are not constrained yet."""

from __future__ import annotations

import warnings
import weakref
from typing import Any

from torch import nn

from aegis_cli.methods.stepper import Stepper


class PendingWatch:
    """Hooks on `state_dict` and `load_state_dict` of a model and of each of its modules.

    The hooks of a module are called as well if a wrapper or a policy around it is saved or loaded.
    Each of the two warns once.
    """

    def __init__(self, model: nn.Module, stepper: Stepper) -> None:
        """Register the hooks.

        Args:
            stepper: that of the guard, which counts the pending steps.
        """
        taken, loaded = _Hook(stepper, _TAKEN), _Hook(stepper, _LOADED)
        self._handles: list[Any] = []
        for module in model.modules():
            self._handles.append(module.register_state_dict_pre_hook(taken))
            self._handles.append(module.register_load_state_dict_post_hook(loaded))

    def remove(self) -> None:
        """Remove the hooks."""
        for handle in self._handles:
            handle.remove()


_TAKEN = (
    "the weights were copied or saved with {} pending, so they contain what the method has not "
    "removed yet: call guard.settle() before model.state_dict()"
)
_LOADED = (
    "weights were loaded with {} pending, so the method would take what was loaded for their "
    "update: call guard.settle() before model.load_state_dict(), or guard.drop_pending() after it; "
    "it does no harm if the earlier weights are loaded back before the next step"
)


class _Hook:
    """Warns at the first call while steps are pending.

    It does not keep the model alive. A copy of the model, such as a moving average, has no guard
    and may be saved and loaded at any time, so a copy of the hook does nothing.
    """

    def __init__(self, stepper: Stepper, text: str) -> None:
        self._stepper, self._text, self._warned = weakref.ref(stepper), text, False

    def __call__(self, *_: object) -> None:
        stepper = self._stepper()
        if self._warned or stepper is None or not stepper.pending:
            return
        self._warned = True
        steps = "1 step" if stepper.pending == 1 else f"{stepper.pending} steps"
        warnings.warn(self._text.format(steps), stacklevel=2)

    def __reduce__(self) -> tuple[type[_CopiedHook], tuple[()]]:
        return _CopiedHook, ()


class _CopiedHook:
    def __call__(self, *_: object) -> None:
        """Do nothing."""
