"""Parameters that are used while their own module's forward is not running, which no hook on a module sees."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from aegis_cli.guard import structure

# the function, the parameter, the names of the modules that own it, and what else the function was given
Report = Callable[[Callable[..., Any], nn.Parameter, Sequence[str], tuple[Any, ...]], None]


class Uses:
    """Knows whose forward is running, by hooks on every module with parameters of its own."""

    def __init__(self, model: nn.Module) -> None:
        self._owners = structure.owners(model)
        self._open, self._inside = False, list[str]()
        self._handles = [
            handle
            for name, module in structure.owning(model).items()
            for handle in (
                module.register_forward_pre_hook(partial(self._begin, name)),
                module.register_forward_hook(self._end),
            )
        ]

    def remove(self) -> None:
        """Take the hooks off."""
        for handle in self._handles:
            handle.remove()

    @contextlib.contextmanager
    def watch(self, report: Report) -> Iterator[None]:
        """Report each parameter inside the block that is given to a function which makes a tensor of it."""

        def used(function: Callable[..., Any], parameter: nn.Parameter, arguments: tuple[Any, ...]) -> None:
            names = self._owners.get(id(parameter), ())
            if names and not (self._inside and self._inside[-1] in names):
                report(function, parameter, names, arguments)

        self._open, self._inside = True, []
        try:
            with _Functions(used):
                yield
        finally:
            self._open = False

    def _begin(self, name: str, *_: Any) -> None:
        if self._open:
            self._inside.append(name)

    def _end(self, *_: Any) -> None:
        if self._open:
            self._inside.pop()


def said(function: Callable[..., Any]) -> str:
    """What the file of an anchor says of a parameter's use by this function."""
    return f"{getattr(function, '__name__', function)} reads its parameters outside its forward"


class _Functions(TorchFunctionMode):
    def __init__(self, report: Callable[[Callable[..., Any], nn.Parameter, tuple[Any, ...]], None]) -> None:
        super().__init__()
        self._report = report

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        if isinstance(result, (Tensor, list, tuple)):  # shapes and dtypes are nobody's business
            for given in (*args, *(kwargs or {}).values()):
                for x in given if isinstance(given, (list, tuple)) else (given,):
                    if isinstance(x, nn.Parameter):
                        self._report(func, x, args)
        return result
