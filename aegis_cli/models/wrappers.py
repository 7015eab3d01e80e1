"""What others put around a model and its parts: DistributedDataParallel, FSDP, PEFT, torch.compile.

A wrapper holds the wrapped module under a name of its own. Users, anchors and ledgers call a part
by its plain name, the one that it has without wrappers. Wrappers are known by their classes and
never by the names alone, since a model may call a part of its own `module`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Protocol, TypeGuard

import torch
from torch import Tensor, nn

PlainNames = Callable[[str], str]

# The class of each wrapper -> the name under which it holds what it wraps. They are told by their
# dotted names, so that none of their packages has to be installed.
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
# Those that hold weights of their own beside what they wrap.
_ADAPTERS = {"base_layer", "original_module"}


def _held(module: nn.Module) -> str | None:
    """The name under which a wrapper holds what it wraps; None for any other module."""
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
    """A function that takes the name of a part or parameter and gives it without wrappers.

    What does not begin with the name of a module stays as it is.
    """
    table = {"": ""}
    # `named_modules` gives a module before what it holds, whose own name builds on it.
    for name, module in model.named_modules():
        held = _held(module)
        for child, _ in module.named_children():
            plain = table[name] if child == held else _joined(table[name], child)
            table[_joined(name, child)] = plain

    def plain(name: str) -> str:
        # The longest beginning that names a module; what follows it, as `weight`, stays. The empty
        # name is in the table, so that this ends.
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
    # A wrapper has the plain name of what it holds, and comes before it.
    found = [module for known, module in modules.items() if plain(known) == wanted]
    return found[-1] if found else None


# --- adapters -------------------------------------------------------------------------------------


def adapted(model: nn.Module) -> dict[str, nn.Module]:
    """The modules of PEFT that hold adapters, by name."""
    return {name: m for name, m in model.named_modules() if _held(m) in _ADAPTERS}


def adapter_weights(model: nn.Module) -> set[str]:
    """Names of the state that belongs to adapters and not to what they adapt."""
    held = {name: _held(module) for name, module in adapted(model).items()}
    found = set()
    for name in model.state_dict():
        parts = name.split(".")
        # Below a module that adapts, whatever is not in what it adapts is its own.
        for i, part in enumerate(parts):
            outer = ".".join(parts[:i])
            if outer in held and part != held[outer]:
                found.add(name)
    return found


@torch.no_grad()
def adapters_are_idle(model: nn.Module) -> bool:
    """Whether the model does what it would do without its adapters.

    A fresh LoRA is idle, because its second factor is zero. An adapter that cannot say what it adds
    to the weights counts as one that changes something.
    """
    return all(_is_idle(module) for module in adapted(model).values())


class _Adapting(Protocol):
    """A layer that can say what its adapters add to the weights.

    Attributes:
        active_adapters: their names.
        adapter_layer_names: its attributes that hold weights by the adapters' names.
    """

    @property
    def active_adapters(self) -> Sequence[str]: ...

    @property
    def adapter_layer_names(self) -> Sequence[str]: ...

    def get_delta_weight(self, adapter: str, /) -> Tensor: ...


def _is_idle(module: nn.Module) -> bool:
    if _held(module) == "original_module":
        # `map` ends with the copies; of originals there is no end.
        return all(map(_equal_weights, _copies(module), _originals(module)))
    if not _says(module):
        return False
    names = [name for name in module.active_adapters if name in _known_adapters(module)]
    return not any(module.get_delta_weight(name).any() for name in names)


def _says(module: nn.Module) -> TypeGuard[_Adapting]:
    return hasattr(module, "get_delta_weight")


def _known_adapters(layer: _Adapting) -> set[str]:
    """The adapters that a layer has weights of; others may be active elsewhere in the model."""
    parts = [getattr(layer, name) for name in layer.adapter_layer_names]
    return {key for part in parts for key in part}


def _copies(wrapper: nn.Module) -> Iterator[nn.Module]:
    """What learns in the place of a module that is to be saved with the adapters."""
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
