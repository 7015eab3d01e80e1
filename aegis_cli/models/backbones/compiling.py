"""What torch.compile makes of a backbone: its whole pass, or transformer layers each by itself.

Where layers are compiled, what stands between them depends on the data, and stays as it is: which
rows are padded, where the images' tokens go, what hooks see. Layers of a kind share what was
compiled for one of them.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import torch
from torch import Tensor, nn

from aegis_cli.core.attention import KeyValue
from aegis_cli.models.backbones.caches import cache_argument

MULTIPLE = 32  # tokens; lengths are padded to multiples, since every other shape is compiled anew
# How often a function is compiled for another shape, kind of layer or method. PyTorch's own limit
# of 8 is soon reached in a run of several methods; past it, nothing more is compiled.
_RECOMPILED = 64


class _Kept:
    """Stands where an attention module expects its cache, and keeps what that is given."""

    key: Tensor
    value: Tensor

    def update(self, key: Tensor, value: Tensor, *_: Any, **__: Any) -> tuple[Tensor, Tensor]:
        self.key, self.value = key, value
        return key, value


def _passed(layer: nn.Module, arguments: tuple[Any, ...], named: dict[str, Any]) -> Any:
    """What the layer makes of its arguments."""
    # By its class: the layer's own `forward` is the `CompiledForward` that calls this.
    return type(layer).forward(layer, *arguments, **named)


def _passed_with_keys(
    layer: nn.Module, arguments: tuple[Any, ...], named: dict[str, Any]
) -> tuple[Any, Tensor, Tensor]:
    """What the layer makes of its arguments, and the keys and values that it attends to."""
    kept = _Kept()
    output = type(layer).forward(layer, *arguments, **named | {cache_argument(layer): kept})
    return output, kept.key, kept.value


class CompiledForward:
    """Takes the place of a layer's `forward`."""

    def __init__(self, layer: nn.Module, run: Callable[..., Any], keeps_keys: bool) -> None:
        self._layer, self._run, self._keeps_keys = layer, run, keeps_keys
        self._tell: Callable[[KeyValue], None] | None = None
        self._cache = cache_argument(layer)

    @contextmanager
    def telling(self, tell: Callable[[KeyValue], None]) -> Generator[None]:
        """Tell the keys and values of each pass inside the block."""
        self._tell = tell
        try:
            yield
        finally:
            self._tell = None

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        if not self._keeps_keys:
            return self._run(self._layer, arguments, named)
        if named.get(self._cache) is not None:
            # An answer is being generated, by a cache of the model's own.
            return _passed(self._layer, arguments, named)
        output, key, value = self._run(self._layer, arguments, named)
        if self._tell is not None:
            self._tell(KeyValue(key, value))
        return output


def compiled(
    function: Callable[..., Any], backend: str, dynamic: bool | None = None
) -> Callable[..., Any]:
    """The function under torch.compile, with graphs that bear two backward passes.

    Args:
        dynamic: as torch.compile takes it; False compiles every other shape anew.
    """
    # `import torch` does not load them; it takes a second, which others need not wait.
    from torch._dynamo import config as dynamo
    from torch._functorch import config as functorch

    dynamo.recompile_limit = max(dynamo.recompile_limit, _RECOMPILED)
    functorch.donated_buffer = False
    return torch.compile(function, dynamic=dynamic, backend=backend)


def uncompiled(holds: bool = True) -> AbstractContextManager[object]:
    """Let no pass inside the block compile anything, unless this does not hold.

    Frames and episodes of which some are left over make shapes that are soon of no more use.
    """
    return torch.compiler.set_stance("force_eager") if holds else nullcontext()


def compile_layers(layers: Iterable[nn.Module], backend: str, keeps_keys: bool) -> None:
    """Compile the forward pass of each layer, for shapes that do not vary.

    Args:
        backend: of torch.compile.
        keeps_keys: whether these are language layers, which hand keys and values to a cache.
    """
    run = compiled(_passed_with_keys if keeps_keys else _passed, backend, dynamic=False)
    for layer in layers:
        layer.forward = CompiledForward(layer, run, keeps_keys)  # type: ignore[method-assign]
