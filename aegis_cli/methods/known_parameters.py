"""The parameters that a method was started with, and a check that no others learn instead.

A method works on the parameters that it found at its start. If a wrapper has replaced them since,
it would silently protect nothing.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor, nn

from aegis_cli.common.errors import AegisError, few
from aegis_cli.common.ranks import is_sharded
from aegis_cli.methods.backward import Gram
from aegis_cli.models import structure

_SHARDED = "weights that are whole in every process: one process, or DistributedDataParallel"


class KnownParameters:
    """The parameters of a model at the time when a method was started on it."""

    def __init__(self, model: nn.Module, may_shard: bool = False) -> None:
        """Remember the parameters of a model.

        Args:
            may_shard: whether the method supports sharded weights and these are already sharded.

        Raises:
            AegisError: they are sharded, and `may_shard` is false.
        """
        self._model, self._may_shard = model, may_shard
        self._refuse_sharded()
        # The parameters themselves are kept, so that no other object can reuse an id.
        self._known = {id(p): (p, p.shape) for p in model.parameters()}

    def check(self) -> None:
        """Refuse a model with trainable parameters that were not there at the start.

        Raises:
            AegisError: parameters were sharded, replaced, added or resized.
        """
        if self._unchanged():
            return
        self._refuse_sharded()
        learning = structure.learning(self._model)
        unknown = [name for name, p in learning.items() if id(p) not in self._known]
        if unknown:
            raise AegisError(
                f"{few(unknown)}: parameters that were added to the model later",
                "the parameters that it had at the start",
                "add adapters (peft.get_peft_model) and wrap parts before you make the guard, or "
                "start the method",
            )
        resized = [name for name, p in learning.items() if p.shape != self._known[id(p)][1]]
        if resized:
            raise AegisError(
                f"{few(resized)}: parameters with a different shape than at the start, as sharding "
                "leaves them",
                _SHARDED,
                "train without FSDP or ZeRO",
            )

    def _unchanged(self) -> bool:
        """Whether the trainable parameters are the same as at the start, without using names.

        It is called at every step, and naming a thousand modules takes milliseconds.
        """
        sharding = () if self._may_shard else _sharding_modules()
        waiting: list[nn.Module] = [self._model]
        seen: set[int] = set()
        while waiting:
            module = waiting.pop()
            if id(module) in seen:
                continue
            seen.add(id(module))
            if isinstance(module, sharding):  # always False for ()
                return False
            for parameter in module._parameters.values():
                if parameter is None or not parameter.requires_grad:
                    continue
                known = self._known.get(id(parameter))
                if known is None or parameter.shape != known[1]:
                    return False
            waiting += [part for part in module._modules.values() if part is not None]
        return True

    def _refuse_sharded(self) -> None:
        if not self._may_shard:
            refuse_sharded(self._model)


def refuse_sharded(model: nn.Module) -> None:
    """Refuse a model that is split over processes.

    Raises:
        AegisError: a parameter is a DTensor, or a module is under FSDP.
    """
    if found := sharded(model):
        raise AegisError(
            f"{few(found)}: sharded by FSDP",
            _SHARDED,
            "fully_shard before the guard is made, with process_group=; or DistributedDataParallel",
        )


def refuse_partly_sharded(model: nn.Module, count: int) -> None:
    """Refuse a model whose weights are not all sharded by rows over `count` processes.

    Raises:
        AegisError: FSDP1, another layout, or a trainable parameter that is not sharded.
    """
    wrong = []
    for name, parameter in structure.learning(model).items():
        if not is_sharded(parameter):
            wrong.append(name)
            continue
        placements = parameter.placements
        rows = len(placements) == 1 and placements[0].is_shard(0)
        if not rows or parameter.device_mesh.size() != count:
            wrong.append(name)
    if wrong:
        raise AegisError(
            f"{few(wrong)}: not sharded by FSDP2 by rows, over the {count} processes of "
            "process_group=",
            "everything that learns sharded, or nothing",
            "fully_shard(model) after its blocks, on a mesh of one dimension",
        )


def sharded(model: nn.Module) -> list[str]:
    """Names of the parameters and modules of which this process may hold only a part.

    Neither class can occur unless its module was imported, so nothing is imported here.
    """
    tensors = sys.modules.get("torch.distributed.tensor")
    found = []
    if tensors is not None:
        found += [name for name, p in model.named_parameters() if isinstance(p, tensors.DTensor)]
    kinds = _sharding_modules()
    if kinds and not found:
        found += [
            name or "the model" for name, part in model.named_modules() if isinstance(part, kinds)
        ]
    return found


def _sharding_modules() -> tuple[type, ...]:
    """The classes of modules that FSDP shards; empty if FSDP was not imported."""
    fsdp = sys.modules.get("torch.distributed.fsdp")
    return () if fsdp is None else (fsdp.FSDPModule, fsdp.FullyShardedDataParallel)


def check_reached(parameters: Iterable[nn.Parameter]) -> None:
    """Refuse a backward pass that reached none of the parameters.

    Raises:
        AegisError: none of them has a gradient.
    """
    if all(p.grad is None for p in parameters):
        raise AegisError(
            "a backward pass that left no gradient in any parameter of the model",
            "a loss that depends on the model",
            "compute the loss with the same model that the method was started on, and detach "
            "nothing on the way; with several passes over weights that FSDP2 has sharded, let each "
            "sum its gradient: set_requires_gradient_sync(True)",
        )


def check_row(gram: Gram, groups: Sequence[str]) -> None:
    """Refuse a step whose anchor gradient is zero in every group, as it would protect nothing.

    Args:
        gram: inner products of task and anchor gradient [G].
        groups: names of the groups.

    Raises:
        AegisError: the anchor gradient reached no parameter.
    """
    anchor: Tensor = gram[2]
    if not torch.any(anchor):
        raise AegisError(
            f"an anchor gradient of zero in all {len(groups)} groups ({few(groups)})",
            "hidden states through which the anchor reaches the layers' parameters",
            "let the layers learn, and call the same layers that the method was started on",
        )
