"""Compiling a backbone with torch.compile: its whole pass, or each transformer layer by itself.

If layers are compiled, the code between them, which depends on the data, is not compiled: which
rows are padded, where the images' tokens go, what hooks see. Layers of one kind share their
compiled code.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import torch
from torch import Tensor, nn

from aegis_cli.core.attention import KeyValue
from aegis_cli.models.backbones.caches import cache_argument

MULTIPLE = 32  # tokens; lengths are padded to multiples, since each new shape is compiled again
# The most times that a function is compiled for another shape, kind of layer or method. PyTorch's
# own limit of 8 is soon reached in a run of several methods; beyond it nothing is compiled.
_RECOMPILED = 64


class _Kept:
    """Stands in for an attention module's cache, and keeps the keys and values that it is given."""

    key: Tensor
    value: Tensor

    def update(self, key: Tensor, value: Tensor, *_: Any, **__: Any) -> tuple[Tensor, Tensor]:
        self.key, self.value = key, value
        return key, value


def _passed(layer: nn.Module, arguments: tuple[Any, ...], named: dict[str, Any]) -> Any:
    """The layer's output."""
    # Through the class: the layer's own `forward` is the `CompiledForward` that calls this.
    return type(layer).forward(layer, *arguments, **named)


def _passed_with_keys(
    layer: nn.Module, arguments: tuple[Any, ...], named: dict[str, Any]
) -> tuple[Any, Tensor, Tensor]:
    """The layer's output, and the keys and values that it attends to."""
    kept = _Kept()
    output = type(layer).forward(layer, *arguments, **named | {cache_argument(layer): kept})
    return output, kept.key, kept.value


class CompiledForward:
    """Replaces a layer's `forward`."""

    def __init__(self, layer: nn.Module, run: Callable[..., Any], keeps_keys: bool) -> None:
        self._layer, self._run, self._keeps_keys = layer, run, keeps_keys
        self._tell: Callable[[KeyValue], None] | None = None
        self._cache = cache_argument(layer)

    @contextmanager
    def telling(self, tell: Callable[[KeyValue], None]) -> Generator[None]:
        """Call `tell` with the keys and values of each pass inside the block."""
        self._tell = tell
        try:
            yield
        finally:
            self._tell = None

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        if not self._keeps_keys:
            return self._run(self._layer, arguments, named)
        if named.get(self._cache) is not None:
            # An answer is being generated with the model's own cache.
            return _passed(self._layer, arguments, named)
        output, key, value = self._run(self._layer, arguments, named)
        if self._tell is not None:
            self._tell(KeyValue(key, value))
        return output


def compiled(
    function: Callable[..., Any], backend: str, dynamic: bool | None = None
) -> Callable[..., Any]:
    """The function under torch.compile, with graphs that allow two backward passes.

    Args:
        dynamic: as in torch.compile; False compiles each new shape again.
    """
    # `import torch` does not load these, which takes a second: only who compiles waits for it.
    from torch._dynamo import config as dynamo
    from torch._functorch import config as functorch

    dynamo.recompile_limit = max(dynamo.recompile_limit, _RECOMPILED)
    functorch.donated_buffer = False
    return torch.compile(function, dynamic=dynamic, backend=backend)


def uncompiled(holds: bool = True) -> AbstractContextManager[object]:
    """Compile nothing inside the block, if `holds`.

    Left-over frames and episodes make shapes that are hardly used again.
    """
    return torch.compiler.set_stance("force_eager") if holds else nullcontext()


def compile_layers(layers: Iterable[nn.Module], backend: str, keeps_keys: bool) -> None:
    """Compile the forward pass of each layer, for shapes that do not vary.

    Args:
        backend: of torch.compile.
        keeps_keys: whether these are language layers, which pass keys and values to a cache.
    """
    run = compiled(_passed_with_keys if keeps_keys else _passed, backend, dynamic=False)
    for layer in layers:
        layer.forward = CompiledForward(layer, run, keeps_keys)  # type: ignore[method-assign]
