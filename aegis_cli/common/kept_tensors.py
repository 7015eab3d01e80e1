"""Cache files with figures and tensors, which are read back bit for bit or not at all.

A file begins with the length of its head (8 bytes) and the head: JSON with the figures and with
each tensor's name, dtype and shape. The tensors follow, one after the other, then a sha256 of
everything before it.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch import Tensor

from aegis_cli.common import files

_DIGEST = hashlib.sha256().digest_size


@dataclass(frozen=True)
class Kept:
    """Saved results.

    Attributes:
        figures: JSON values.
        tensors: on any device; after reading, on the CPU.
    """

    figures: Mapping[str, Any]
    tensors: Mapping[str, Tensor] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Bytes of the tensors."""
        return sum(tensor.nbytes for tensor in self.tensors.values())


class Damaged(Exception):
    """A file whose contents are not what was written."""


def write(path: Path, kept: Kept) -> None:
    """Write such a file, all or nothing.

    Raises:
        AegisError: it cannot be written.
    """
    files.write_atomically(path, lambda file: _write(file, kept))


def read(path: Path) -> Kept | None:
    """What a file holds; None if there is no file that this user may read.

    Raises:
        Damaged: its contents are not what was written.
    """
    try:
        with open(path, "rb") as file:
            return _read(file)
    except OSError:
        return None
    except (ValueError, TypeError, KeyError, AttributeError, RuntimeError) as error:
        raise Damaged(str(error)) from error


def _write(file: BinaryIO, kept: Kept) -> None:
    table = [
        [name, str(tensor.dtype).removeprefix("torch."), list(tensor.shape)]
        for name, tensor in kept.tensors.items()
    ]
    head = json.dumps({"figures": kept.figures, "tensors": table}).encode()
    digest = hashlib.sha256()

    def parts() -> Iterator[memoryview]:
        for part in (len(head).to_bytes(8, "little"), head):
            digest.update(part)
            yield memoryview(part)
        for tensor in kept.tensors.values():
            # Tensors of a GPU are moved to the CPU one at a time.
            values = _bytes(tensor.detach().cpu().contiguous())
            digest.update(values)
            yield values

    files.pour(file, parts())
    file.write(digest.digest())


def _read(file: BinaryIO) -> Kept:
    digest = hashlib.sha256()

    def take(into: memoryview) -> None:
        if file.readinto(into) != len(into):  # type: ignore[attr-defined]
            raise ValueError("it ends too early")
        digest.update(into)

    def taken(size: int) -> bytes:
        found = bytearray(_checked(file, size))
        take(memoryview(found))
        return bytes(found)

    head = files.parse_json(taken(int.from_bytes(taken(8), "little")))
    tensors = {name: _tensor(file, take, *kind) for name, *kind in head["tensors"]}
    if file.read() != digest.digest():
        raise ValueError("its content is not that of its digest")
    return Kept(head["figures"], tensors)


def _tensor(
    file: BinaryIO, take: Callable[[memoryview], None], dtype: str, shape: list[int]
) -> Tensor:
    kind = getattr(torch, dtype)
    count = 1
    for side in shape:
        count *= side
    _checked(file, count * kind.itemsize)
    found = torch.empty(shape, dtype=kind, device="cpu")
    take(_bytes(found))
    return found


def _checked(file: BinaryIO, size: int) -> int:
    """Return `size` if the file has that many bytes left before its digest, else raise.

    Without this check a damaged length could ask for any amount of memory.
    """
    left = os.fstat(file.fileno()).st_size - file.tell() - _DIGEST
    if not 0 <= size <= left:
        raise ValueError("it ends too early")
    return size


def _bytes(tensor: Tensor) -> memoryview:
    """The values of a contiguous tensor on the CPU, in its own memory."""
    return tensor.reshape(-1).view(torch.uint8).numpy().data
