"""Read and write safetensors files a few rows at a time, without ever loading a whole model."""

from __future__ import annotations

import contextlib
import json
import math
import re
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError, few
from aegis_cli.publishing.vlm_names import Spec

TYPES = {
    "F64": torch.float64,
    "F32": torch.float32,
    "F16": torch.float16,
    "BF16": torch.bfloat16,
}
NAMES = {str(dtype).removeprefix("torch."): name for name, dtype in TYPES.items()}
# Integer types, as in buffers. Any other type is only copied, as bytes.
_WHOLE = {
    "I64": torch.int64,
    "I32": torch.int32,
    "I16": torch.int16,
    "I8": torch.int8,
    "BOOL": torch.bool,
}
_AT_ONCE = 2**26  # bytes of a tensor that are in memory at once
_ONE = "model.safetensors"
_INDEX = f"{_ONE}.index.json"


@dataclass(frozen=True)
class TensorFile:
    """The contents of one file's header.

    Attributes:
        head: the raw header, with its length before it.
        specs: the tensors, in the order of their data in the file.
        offsets: where each of them begins and ends, counted from the end of the header [bytes].
        metadata: the header's metadata; None if there is none.
    """

    path: Path
    head: bytes
    specs: Mapping[str, Spec]
    offsets: Mapping[str, tuple[int, int]]
    metadata: Mapping[str, str] | None


class Tensors:
    """The tensors of a model or a policy, from all of its files."""

    def __init__(self, parts: Sequence[TensorFile], opened: Mapping[Path, BufferedReader]) -> None:
        self.parts = parts
        self.specs = {name: spec for part in parts for name, spec in part.specs.items()}
        self._parts = {name: part for part in parts for name in part.specs}
        self._files = opened

    def rows(self, name: str, first: int, last: int) -> Tensor:
        """Rows of a tensor; a scalar is returned whole.

        If PyTorch's type is not known here, each row is returned as its bytes. If rows do not begin
        at whole bytes, all bytes are returned as one row.

        They are read and not memory-mapped, since mapped pages of a large model fill memory too.

        Raises:
            AegisError: the file has become shorter since it was opened, or only some rows are asked
                for that do not begin at whole bytes.
        """
        part, spec = self._parts[name], self.specs[name]
        start, end = part.offsets[name]
        rows = spec.shape[0] if spec.shape else 1
        packed = bool(spec.shape) and _row_bits(spec) % 8 != 0
        if packed and last - first < rows:
            raise AegisError(
                f"'{name}' in '{part.path}' has rows of {_row_bits(spec)} bits",
                "rows of whole bytes, or a table with as many rows as the other model's",
                "store the tensor in a type of 8 bits or more",
            )
        count, a_row = (1, end - start) if packed else (last - first, (end - start) // max(1, rows))
        file = self._files[part.path]
        file.seek(len(part.head) + start + (0 if packed else first * a_row))
        values = torch.empty(count * a_row, dtype=torch.uint8)
        if values.numel() and file.readinto(values.numpy().data) != values.numel():
            raise AegisError(f"'{part.path}' has become shorter", "a complete file", _AGAIN)
        dtype = {**TYPES, **_WHOLE}.get(spec.dtype)
        if dtype is None:
            return values.view(count, a_row) if spec.shape else values
        shape = (last - first, *spec.shape[1:]) if spec.shape else ()
        return values.view(dtype).reshape(shape)


def paths(folder: Path) -> list[Path]:
    """The files of weights in a folder: those of its index, else the model's, else all.

    LeRobot stores the scales of a policy's pre- and post-processing in separate files, and
    Mistral's repositories contain their weights twice.

    Raises:
        AegisError: a file that the index names is missing or outside of the folder, or there are
            several indices, none of which is the model's.
    """
    found = sorted(folder.glob("*.safetensors.index.json"))
    # A variant, such as `model.fp16.safetensors.index.json`, may come first in the order of names.
    if folder / _INDEX in found:
        found = [folder / _INDEX]
    if found and not (folder / _ONE).is_file():
        if len(found) > 1:
            raise AegisError(
                f"{len(found)} indices in '{folder}', none of them named {_INDEX}: "
                f"{few([path.name for path in found])}",
                "the index of one set of weights",
                f"rename the one to read to {_INDEX}, or move the others elsewhere",
            )
        index = files.load_json(found[0])
        listed = index.get("weight_map") if isinstance(index, dict) else None
        if not isinstance(listed, dict) or not listed:
            raise AegisError(
                f"'{found[0]}' without a weight_map", "the index of files of weights", _AGAIN
            )
        names = sorted(set(map(str, listed.values())))
        # The file of each name is also written, in the new folder.
        if outside := [name for name in names if _leaves(name)]:
            raise AegisError(
                f"'{found[0]}' names a file outside of its folder: '{outside[0]}'",
                "files of weights in the folder of their index",
                f"move them there, and correct the index; if you do not know why it does, {_AGAIN}",
            )
        parts = [folder / name for name in names]
        if absent := [part for part in parts if not part.is_file()]:
            raise AegisError(
                f"no file '{absent[0]}', which '{found[0].name}' names: {len(absent)} of "
                f"{len(parts)} are missing",
                "all files of the weights",
                _AGAIN,
            )
        return parts
    if (folder / _ONE).is_file():
        return [folder / _ONE]
    return sorted(folder.glob("*.safetensors"))


def _leaves(name: str) -> bool:
    """Whether a relative name may lead out of the folder that it is looked up in."""
    path = PurePosixPath(name)
    return path.is_absolute() or ".." in path.parts


_AGAIN = "download it again"


@contextlib.contextmanager
def opened(parts: Sequence[Path]) -> Generator[Tensors]:
    """The tensors of these files, which stay open inside the block.

    Raises:
        AegisError: a file that is missing, damaged or not in safetensors, or two files with a
            tensor of the same name.
    """
    with contextlib.ExitStack() as stack:
        read, found = [], {}
        for path in parts:
            files.check_utf8(path, files.RENAME)
            try:
                with files.reading(path, "check the path"):
                    with safe_open(path, framework="np"):  # it validates the header
                        pass
                    found[path] = stack.enter_context(open(path, "rb"))
                    read.append(_header(path, found[path]))
            except SafetensorError as error:
                files.refuse_pointer(path)
                raise AegisError(
                    f"'{path}' is truncated or not a safetensors file ({error})",
                    "a complete safetensors file",
                    _AGAIN,
                ) from error
        names = [name for part in read for name in part.specs]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise AegisError(
                f"'{twice}' in more than one file of '{parts[0].parent}'",
                "each tensor in one file",
                "leave the files of one model alone in the folder",
            )
        yield Tensors(read, found)


def _header(path: Path, file: BufferedReader) -> TensorFile:
    """A file's header, which safetensors has already validated."""
    length = file.read(8)
    raw = file.read(int.from_bytes(length, "little"))
    table: dict[str, Any] = json.loads(raw)
    metadata = table.pop("__metadata__", None)
    order = sorted(table, key=lambda name: (table[name]["data_offsets"], name))
    specs = {name: Spec(tuple(table[name]["shape"]), table[name]["dtype"]) for name in order}
    offsets = {name: tuple(table[name]["data_offsets"]) for name in order}
    return TensorFile(path, length + raw, specs, offsets, metadata)


def retyped(part: TensorFile, types: Mapping[str, str]) -> TensorFile:
    """A file's header with other dtypes for some of the tensors."""
    if all(types.get(name, spec.dtype) == spec.dtype for name, spec in part.specs.items()):
        return part
    specs = {n: Spec(spec.shape, types.get(n, spec.dtype)) for n, spec in part.specs.items()}
    # With the widest types first, every tensor is aligned. Types of one byte or less come last.
    names = sorted(specs, key=lambda n: (-_bits(specs[n].dtype), n))
    table: dict[str, Any] = {} if part.metadata is None else {"__metadata__": dict(part.metadata)}
    offsets, end = {}, 0
    for name in names:
        shape, dtype = specs[name]
        start, end = end, end + nbytes(specs[name])
        offsets[name] = start, end
        table[name] = {"dtype": dtype, "shape": list(shape), "data_offsets": [start, end]}
    raw = json.dumps(table, separators=(",", ":")).encode()
    raw += b" " * (-len(raw) % 8)
    head = len(raw).to_bytes(8, "little") + raw
    in_order = {name: specs[name] for name in names}
    return TensorFile(part.path, head, in_order, offsets, part.metadata)


_BITS = re.compile(r"(?:BOOL|[A-Z]+(\d+))(?:_|$)")  # F32, U8, F8_E4M3, F4, F6_E2M3


def _bits(dtype: str) -> int:
    """Bits of one number: of types such as F4, several numbers share a byte."""
    found = _BITS.match(dtype)
    return 8 if found is None or found[1] is None else int(found[1])


def nbytes(spec: Spec) -> int:
    """Bytes that a tensor takes in a file."""
    return math.prod(spec.shape) * _bits(spec.dtype) // 8


def _row_bits(spec: Spec) -> int:
    return math.prod(spec.shape[1:]) * _bits(spec.dtype)


def blocks(spec: Spec) -> Iterator[tuple[int, int]]:
    """The first row and the row after the last one of each block of a tensor, in turn.

    A tensor whose rows do not begin at whole bytes is one block.
    """
    if not spec.shape:
        yield 0, 1
        return
    rows = spec.shape[0]
    if _row_bits(spec) % 8:
        yield 0, rows
        return
    a_row = max(1, _row_bits(spec) // 8)
    at_once = max(1, _AT_ONCE // a_row)
    for first in range(0, rows, at_once):
        yield first, min(rows, first + at_once)


def write(path: Path, part: TensorFile, rows: Callable[[str, int, int], Tensor]) -> None:
    """Write a new file with this header.

    Args:
        rows: returns rows of a tensor, in the header's dtype; called for the tensors in order, each
            from its first row to its last.
    """

    def parts() -> Iterator[memoryview]:
        for name, spec in part.specs.items():
            for first, last in blocks(spec):
                yield rows(name, first, last).reshape(-1).view(torch.uint8).numpy().data

    with open(path, "xb") as file:
        file.write(part.head)
        files.pour(file, parts())


def equal(tensors: Tensors, one: str, other: str) -> bool:
    """Whether two tensors have the same shape and values.

    If their floating-point types differ, the values are compared in the narrower one.
    """
    spec, second = tensors.specs[one], tensors.specs[other]
    if spec != second and not (spec.shape == second.shape and spec.is_float and second.is_float):
        return False
    narrow = TYPES.get(min(spec.dtype, second.dtype, key=_bits))

    def rows(name: str, part: tuple[int, int]) -> Tensor:
        found = tensors.rows(name, *part)
        return found if narrow is None else found.to(narrow)

    return all(torch.equal(rows(one, part), rows(other, part)) for part in blocks(spec))
