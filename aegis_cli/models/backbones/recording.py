"""Record what passes through a language model's layers, by hooks that last for one pass.

A hook on each layer sees its output. A hook on each attention module passes it a cache that only
returns what it is given: keys and values after the rotary embedding, in the model's own number of
heads. A compiled layer reports them itself. What gradient checkpointing recomputes comes later,
when the hooks are gone.
"""

from __future__ import annotations

import contextlib
from collections.abc import Generator
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor, nn

from aegis_cli.core.attention import KeyValue
from aegis_cli.models.backbones.caches import cache_argument
from aegis_cli.models.backbones.compiling import CompiledForward


@dataclass
class Seen:
    """The record of one pass, by layer, and the positions of its tokens.

    Hidden states are [B, T, D], keys and values [B, kv_heads, T, head_dim].
    """

    hidden: dict[int, Tensor] = field(default_factory=dict)
    keys_values: dict[int, KeyValue] = field(default_factory=dict)
    positions: Tensor | None = None

    def axes(self) -> int | None:
        """The number of positions per token; None: one, without a dimension for it.

        Qwen2.5-VL counts time, height and width separately: [3, B, T].
        """
        assert self.positions is not None
        return len(self.positions) if self.positions.ndim == 3 else None

    def next_position(self, mask: Tensor) -> Tensor:
        """One more than the largest position [B] among each row's valid tokens.

        The mask is [B, T]; of a position with several axes the largest counts.
        """
        assert self.positions is not None
        positions = self.positions if self.axes() is None else self.positions.amax(0)
        # [1, T] for all rows, or [B, T]. Padding is set below any position, so it is never the
        # maximum.
        return positions.expand_as(mask).masked_fill(~mask, -1).amax(-1) + 1


class _PassThrough:
    """Stands in for an attention module's cache."""

    def __init__(self, seen: Seen, layer: int) -> None:
        self._seen, self._layer = seen, layer

    def update(self, key: Tensor, value: Tensor, *_: Any, **__: Any) -> KeyValue:
        self._seen.keys_values[self._layer] = KeyValue(key, value)
        return KeyValue(key, value)


def attention(layer: nn.Module) -> nn.Module:
    """The layer's one attention module.

    Raises:
        LookupError: there is none, or there are several.
    """
    found = [child for child in layer.children() if type(child).__name__.endswith("Attention")]
    if len(found) != 1:
        raise LookupError(f"{len(found)} attention modules in a {type(layer).__name__}")
    return found[0]


def sliding_window(layer: nn.Module) -> int | None:
    """How many tokens the layer's attention sees; None: all earlier ones."""
    found = getattr(attention(layer), "sliding_window", None)
    return found if isinstance(found, int) else None


@contextlib.contextmanager
def recording(layers: nn.ModuleList, rotary: nn.Module) -> Generator[Seen]:
    """Record what passes through `layers`, and the positions given to their rotary embedding."""
    seen = Seen()

    def leaves(number: int) -> Any:
        def hook(_: nn.Module, __: Any, output: Any) -> None:
            seen.hidden[number] = output[0] if isinstance(output, tuple) else output

        return hook

    def hands(number: int) -> Any:
        def hook(
            module: nn.Module, arguments: tuple[Any, ...], named: dict[str, Any]
        ) -> tuple[tuple[Any, ...], dict[str, Any]]:
            # Replaces the layer's own cache, which is None: no answer is generated here.
            return arguments, named | {cache_argument(module): _PassThrough(seen, number)}

        return hook

    def tells(number: int) -> Any:
        return lambda keys_values: seen.keys_values.__setitem__(number, keys_values)

    def asks(_: nn.Module, arguments: tuple[Any, ...], named: dict[str, Any]) -> None:
        # rotary_emb(x, position_ids)
        seen.positions = named["position_ids"] if "position_ids" in named else arguments[1]

    with contextlib.ExitStack() as stack:
        stack.callback(rotary.register_forward_pre_hook(asks, with_kwargs=True).remove)
        for number, layer in enumerate(layers):
            stack.callback(layer.register_forward_hook(leaves(number)).remove)
            if isinstance(layer.forward, CompiledForward):
                stack.enter_context(layer.forward.telling(tells(number)))
                continue
            stack.callback(
                attention(layer).register_forward_pre_hook(hands(number), with_kwargs=True).remove
            )
        yield seen


@contextlib.contextmanager
def unrotated(layers: nn.ModuleList) -> Generator[dict[int, Tensor]]:
    """The keys that each attention would have without its rotary embedding, by layer."""
    seen = Seen()
    plain: dict[int, Tensor] = {}

    def again(number: int) -> Any:
        def hook(module: nn.Module, arguments: tuple[Any, ...], named: dict[str, Any]) -> None:
            cos, sin = named["position_embeddings"]
            # A rotation by 0: cosines of 1 and sines of 0.
            still = {"position_embeddings": (cos.new_ones(cos.shape), sin.new_zeros(sin.shape))}
            # Calling the module itself would run its hooks again, including this one.
            cache = {cache_argument(module): _PassThrough(seen, number)}
            module.forward(*arguments, **named | still | cache)
            plain[number] = seen.keys_values[number].key

        return hook

    with contextlib.ExitStack() as stack:
        for number, layer in enumerate(layers):
            stack.callback(
                attention(layer).register_forward_pre_hook(again(number), with_kwargs=True).remove
            )
        yield plain
