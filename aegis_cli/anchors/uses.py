"""Parameters that are used while their own module's forward is not running, which no hook on a
module sees.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from aegis_cli.models import structure

# the function, the parameter, the names of the modules that own it, and what else the function was
# given
Report = Callable[[Callable[..., Any], nn.Parameter, Sequence[str], tuple[Any, ...]], None]


@contextlib.contextmanager
def watch_uses(model: nn.Module, report: Report) -> Iterator[None]:
    """Report each parameter inside the block that is given to a function which makes a tensor of
    it.

    Whose forward is running is known by hooks on every module with parameters of its own.
    """
    owners, inside = structure.owners(model), list[str]()

    def used(
        function: Callable[..., Any], parameter: nn.Parameter, arguments: tuple[Any, ...]
    ) -> None:
        names = owners.get(id(parameter), ())
        if names and not (inside and inside[-1] in names):
            report(function, parameter, names, arguments)

    with contextlib.ExitStack() as hooks:
        for name, module in structure.owning(model).items():
            hooks.callback(module.register_forward_pre_hook(partial(_begin, inside, name)).remove)
            hooks.callback(module.register_forward_hook(partial(_end, inside)).remove)
        hooks.enter_context(_Functions(used))
        yield


def _begin(inside: list[str], name: str, *_: Any) -> None:
    inside.append(name)


def _end(inside: list[str], *_: Any) -> None:
    inside.pop()


def said(function: Callable[..., Any]) -> str:
    """What the file of an anchor says of a parameter's use by this function."""
    return f"{getattr(function, '__name__', function)} reads its parameters outside its forward"


class _Functions(TorchFunctionMode):
    def __init__(
        self, report: Callable[[Callable[..., Any], nn.Parameter, tuple[Any, ...]], None]
    ) -> None:
        super().__init__()
        self._report = report

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        if isinstance(result, (Tensor, list, tuple)):  # shapes and dtypes are nobody's business
            for given in (*args, *(kwargs or {}).values()):
                for x in given if isinstance(given, (list, tuple)) else (given,):
                    if isinstance(x, nn.Parameter):
                        self._report(func, x, args)
        return result
