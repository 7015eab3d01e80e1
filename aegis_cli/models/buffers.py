"""Detect buffers that a model's own passes change, such as the running averages of BatchNorm.

No method constrains these: they are not parameters and have no gradient.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from aegis_cli.models.wrappers import plain_names


class WrittenBuffers:
    """A snapshot of a model's buffers, to find out which of them change later."""

    def __init__(self, model: nn.Module) -> None:
        """Copy the buffers."""
        self._model = model
        self._then = {name: [_Then.of(b) for b in own] for name, own in _kept(model)}

    def modules(self) -> list[str]:
        """Plain names of the modules whose buffers have changed since."""
        found, plain = [], plain_names(self._model)
        for name, own in _kept(self._model):
            then = self._then.get(name, [])
            if len(own) != len(then) or _changed(own, then):
                found.append(plain(name))
        return found


@dataclass(frozen=True)
class _Then:
    """A buffer with its version (PyTorch's count of writes) and its values at the snapshot."""

    buffer: Tensor
    version: int
    values: Tensor

    @classmethod
    def of(cls, buffer: Tensor) -> _Then:
        return cls(buffer, buffer._version, buffer.detach().clone())


def _changed(own: Sequence[Tensor], then: Sequence[_Then]) -> bool:
    """Whether any buffer of a module has changed since the snapshot.

    Buffers whose version is unchanged are not read, since reading would wait for the GPU; of
    BatchNorm's only the number of batches counts as written to. DistributedDataParallel writes
    equal values before each pass.
    """
    pairs = list(zip(own, then, strict=True))
    if all(now is before.buffer and now._version == before.version for now, before in pairs):
        return False
    return not all(torch.equal(now, before.values.to(now.device)) for now, before in pairs)


def _kept(model: nn.Module) -> Iterator[tuple[str, list[Tensor]]]:
    """The persistent buffers of each module, by the module's name.

    The others may be rebuilt, as position tables are for longer texts.
    """
    for name, module in model.named_modules():
        own = []
        for leaf, buffer in module._buffers.items():
            lasts = buffer is not None and leaf not in module._non_persistent_buffers_set
            # A tensor made in inference mode has no version, and PyTorch refuses to write to it in
            # training.
            if lasts and not buffer.is_inference():
                own.append(buffer)
        if own:
            yield name, own
