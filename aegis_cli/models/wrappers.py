"""Wrappers around a model and its parts: DistributedDataParallel, FSDP, PEFT, torch.compile.

A wrapper holds the wrapped module under an additional name. Users, anchors and ledgers refer to a
part by its plain name, the one that it has without wrappers. Wrappers are recognized by class,
never by the name alone, since a model may call one of its own parts `module`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Protocol, TypeGuard

import torch
from torch import Tensor, nn

PlainNames = Callable[[str], str]

# The class of each wrapper -> the name under which it holds the wrapped module. Classes are given
# by dotted names, so that their packages need not be installed.
_HOLDS = {
    "torch._dynamo.eval_frame.OptimizedModule": "_orig_mod",
    "torch.nn.parallel.distributed.DistributedDataParallel": "module",
    "torch.nn.parallel.data_parallel.DataParallel": "module",
    "torch.distributed.fsdp.fully_sharded_data_parallel.FullyShardedDataParallel": (
        "_fsdp_wrapped_module"
    ),
    "torch.distributed.algorithms._checkpoint.checkpoint_wrapper.CheckpointWrapper": (
        "_checkpoint_wrapped_module"
    ),
    "peft.peft_model.PeftModel": "base_model",
    "peft.tuners.tuners_utils.BaseTuner": "model",
    "peft.tuners.tuners_utils.BaseTunerLayer": "base_layer",
    "peft.utils.other.AuxiliaryTrainingWrapper": "original_module",
}
# Those with their own weights beside the wrapped module.
_ADAPTERS = {"base_layer", "original_module"}


def _held(module: nn.Module) -> str | None:
    """The name under which a wrapper holds the wrapped module; None for any other module."""
    for kind in type(module).__mro__:
        name = _HOLDS.get(f"{kind.__module__}.{kind.__qualname__}")
        if name is not None and isinstance(getattr(module, name, None), nn.Module):
            return name
    return None


def unwrapped(module: nn.Module) -> nn.Module:
    """The module without the wrappers directly around it."""
    while (held := _held(module)) is not None:
        module = module.get_submodule(held)
    return module


def plain_names(model: nn.Module) -> PlainNames:
    """A function that removes wrappers from the name of a part or parameter.

    A name that does not begin with the name of a module is returned unchanged.
    """
    table = {"": ""}
    # `named_modules` yields a module before its children, whose names build on its own.
    for name, module in model.named_modules():
        held = _held(module)
        for child, _ in module.named_children():
            plain = table[name] if child == held else _joined(table[name], child)
            table[_joined(name, child)] = plain

    def plain(name: str) -> str:
        # The longest prefix that names a module; the rest, such as `weight`, is kept. The loop
        # ends, since the empty name is in the table.
        known, rest = name, ""
        while known not in table:
            known, _, last = known.rpartition(".")
            rest = _joined(last, rest)
        return _joined(table[known], rest)

    return plain


def innermost(model: nn.Module, name: str) -> nn.Module | None:
    """The part of this name, plain or not, without the wrappers around it; None if there is none.

    Args:
        name: "" for the model itself.
    """
    plain = plain_names(model)
    modules = dict(model.named_modules())
    wanted = plain(name) if name in modules else name
    # A wrapper has the same plain name as the module it holds, and comes before it.
    found = [module for known, module in modules.items() if plain(known) == wanted]
    return found[-1] if found else None


# --- adapters -------------------------------------------------------------------------------------


def adapted(model: nn.Module) -> dict[str, nn.Module]:
    """The PEFT modules that hold adapters, by name."""
    return {name: m for name, m in model.named_modules() if _held(m) in _ADAPTERS}


def adapter_weights(model: nn.Module) -> set[str]:
    """Names of the state entries that belong to adapters, not to the modules they adapt."""
    held = {name: _held(module) for name, module in adapted(model).items()}
    found = set()
    for name in model.state_dict():
        parts = name.split(".")
        # Below an adapting module, everything outside the adapted module is the adapter's.
        for i, part in enumerate(parts):
            outer = ".".join(parts[:i])
            if outer in held and part != held[outer]:
                found.add(name)
    return found


@torch.no_grad()
def adapters_are_idle(model: nn.Module) -> bool:
    """Whether the model behaves as it would without its adapters.

    A fresh LoRA is idle, because its second factor is zero. An adapter that cannot report what it
    adds to the weights counts as one that changes something.
    """
    return all(_is_idle(module) for module in adapted(model).values())


class _Adapting(Protocol):
    """A layer that can report what its adapters add to the weights.

    Attributes:
        active_adapters: their names.
        adapter_layer_names: the names of its attributes that hold weights by adapter name.
    """

    @property
    def active_adapters(self) -> Sequence[str]: ...

    @property
    def adapter_layer_names(self) -> Sequence[str]: ...

    def get_delta_weight(self, adapter: str, /) -> Tensor: ...


def _is_idle(module: nn.Module) -> bool:
    if _held(module) == "original_module":
        # `map` ends with the copies; the iterator of originals is endless.
        return all(map(_equal_weights, _copies(module), _originals(module)))
    if not _says(module):
        return False
    names = [name for name in module.active_adapters if name in _known_adapters(module)]
    return not any(module.get_delta_weight(name).any() for name in names)


def _says(module: nn.Module) -> TypeGuard[_Adapting]:
    return hasattr(module, "get_delta_weight")


def _known_adapters(layer: _Adapting) -> set[str]:
    """The adapters that this layer has weights for; others may be active elsewhere in the model."""
    parts = [getattr(layer, name) for name in layer.adapter_layer_names]
    return {key for part in parts for key in part}


def _copies(wrapper: nn.Module) -> Iterator[nn.Module]:
    """The trainable copies of a module that is saved with the adapters."""
    for name, part in wrapper.named_children():
        if name != "original_module":
            yield from part.children()


def _originals(wrapper: nn.Module) -> Iterator[nn.Module]:
    while True:
        yield wrapper.get_submodule("original_module")


def _equal_weights(one: nn.Module, other: nn.Module) -> bool:
    mine, others = one.state_dict(), other.state_dict()
    return mine.keys() == others.keys() and all(_equal(mine[k], others[k]) for k in mine)


def _equal(one: Tensor, other: Tensor) -> bool:
    return torch.equal(one.detach().float(), other.detach().float())


def _joined(*names: str) -> str:
    return ".".join(name for name in names if name)
