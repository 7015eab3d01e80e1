"""Artifacts on disk: safetensors files whose one metadata key, `aegis`, says what they are.

Equal inputs give equal bytes, a file is either complete or absent, and nothing wrong loads quietly.
What a kind must contain is declared in kinds.py; this module knows no model.
"""

from __future__ import annotations

import contextlib
import fnmatch
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from aegis_cli.common.errors import AegisError
from aegis_cli.common.files import (
    canonical,
    load_json,
    reading,
    save_json,
    sha256_file,
    write_atomically,
)
from aegis_cli.common.kinds import KINDS, Tensors, layout_problems, quoted
from aegis_cli.common.version import __version__


@dataclass(frozen=True)
class TensorSpec:
    """What a header says about one tensor."""

    shape: tuple[int, ...]
    dtype: str
    unit: str


@dataclass(frozen=True)
class Header:
    """The `aegis` metadata of a file: what it is, what made it and what it holds.

    `digest` is the sha256 of all else that the file says, and of its tensors' bytes; None in a file
    of before there was one.
    """

    kind: str
    schema: int
    version: str
    fingerprint: str | None
    inputs: dict[str, str]
    seed: int | None
    tensors: dict[str, TensorSpec]
    meta: dict[str, Any]
    digest: str | None = None


@dataclass(frozen=True)
class Artifact:
    """A loaded and validated file."""

    header: Header
    tensors: dict[str, Tensor]


__all__ = [
    "KINDS",
    "MIGRATIONS",
    "Artifact",
    "Header",
    "TensorSpec",
    "is_artifact",
    "load",
    "load_json",
    "read_header",
    "save",
    "save_json",
    "schema",
    "sha256_file",
]

# Kind -> the functions that lift schema 1 to 2, 2 to 3, ... Append only: an entry never changes.
Migration = Callable[[dict[str, Tensor], dict[str, Any]], tuple[dict[str, Tensor], dict[str, Any]]]
MIGRATIONS: dict[str, tuple[Migration, ...]] = {}

_UPGRADE = "upgrade aegis: git pull && pip install -e ."
_FORMAT = {
    torch.float64: "F64",
    torch.float32: "F32",
    torch.float16: "F16",
    torch.bfloat16: "BF16",
    torch.bool: "BOOL",
    torch.int64: "I64",
    torch.int32: "I32",
    torch.int16: "I16",
    torch.int8: "I8",
    torch.uint8: "U8",
}


def schema(kind: str) -> int:
    """The number of the schema that this version writes."""
    return 1 + len(MIGRATIONS.get(kind, ()))


def save(
    path: str | Path,
    kind: str,
    tensors: Tensors,
    *,
    seed: int | None = None,
    inputs: Mapping[str, str] | None = None,
    fingerprint: str | None = None,
    units: Mapping[str, str] | None = None,
    meta: Mapping[str, Any] | None = None,
) -> Header:
    """Validate and write one artifact: all of it, or nothing.

    Args:
        path: the file to write; its folder must exist.
        kind: one of KINDS.
        tensors: what to store; on any device, in any layout.
        seed: the seed that made it.
        inputs: sha256 of every file that it was made from, by a name for the file.
        fingerprint: digest of the backbone that it belongs to.
        units: units by tensor name or fnmatch pattern; "1" where none matches.
        meta: JSON that only this kind understands.

    Raises:
        AegisError: the content is not what the kind demands, or the file cannot be written.
    """
    plain = {name: tensor.detach().cpu() for name, tensor in tensors.items()}
    table = _table(plain, units or {})
    try:
        pure = json.loads(canonical(dict(meta or {})))
    except ValueError as error:
        raise AegisError(
            f"metadata for '{path}': {error}", "finite numbers", _check_inputs(kind)
        ) from error
    header = Header(
        kind, schema(kind), __version__, fingerprint, dict(inputs or {}), seed, table, pure
    )
    _validate(path, header, plain, _check_inputs(kind))
    header = replace(header, digest=_digest(asdict(header), plain))
    text = canonical(asdict(header))
    write_atomically(Path(path), lambda file: _write_safetensors(file, plain, text))
    return header


def load(path: str | Path, kind: str | None = None, *, fingerprint: str | None = None) -> Artifact:
    """Read and validate one artifact; its tensors stay memory-mapped.

    It checks, in this order: the kind, the schema (older ones are migrated), the exact tensors with
    shapes and dtypes, the digest if the file has one, that numbers are finite, the kind's domain,
    and the backbone's fingerprint if one is given.

    Raises:
        AegisError: the first check that fails.
    """
    with _opened(path, kind) as file:
        metadata = file.metadata()
        header = _parse_header(path, metadata, kind)
        tensors = {name: file.get_tensor(name) for name in sorted(file.keys())}
    again = _rewrite(header.kind)
    found = {name: replace(spec, unit="") for name, spec in _table(tensors, {}).items()}
    if found != {name: replace(spec, unit="") for name, spec in header.tensors.items()}:
        raise AegisError(
            f"the tensors in '{path}' are not those its header lists",
            "the file as Aegis wrote it",
            again,
        )
    if header.digest is not None and header.digest != _digest(
        json.loads(metadata["aegis"]), tensors
    ):
        raise AegisError(
            f"'{path}' is damaged: its content is not that of its digest",
            "the file as Aegis wrote it",
            f"bring back a copy of it, or {again}",
        )
    header, tensors = _migrate(header, tensors)
    _validate(path, header, tensors, again)
    if fingerprint is not None and header.fingerprint != fingerprint:
        raise AegisError(
            f"{header.kind} '{path}' belongs to backbone {_short(header.fingerprint)}",
            f"one that belongs to backbone {_short(fingerprint)}",
            f"run '{KINDS[header.kind].command}' again with this backbone, or use the backbone "
            "the file was made with",
        )
    return Artifact(header, tensors)


def read_header(path: str | Path) -> Header:
    """What a file is, from its header's bytes alone."""
    with _opened(path, None) as file:
        return _parse_header(path, file.metadata(), None)


def is_artifact(path: str | Path) -> bool:
    """Whether a safetensors file is one of Aegis's, rather than another program's.

    Raises:
        AegisError: it cannot be read.
    """
    with _opened(path, None) as file:
        return "aegis" in (file.metadata() or {})


@contextlib.contextmanager
def _opened(path: str | Path, kind: str | None) -> Iterator[safe_open]:
    """The open file, or an AegisError that says why it is no artifact."""
    fix = _rewrite(kind)
    try:
        with reading(path, fix), safe_open(path, framework="pt") as file:
            yield file
    except SafetensorError as error:
        problem = f"'{path}' is truncated or not a safetensors file ({error})"
        raise AegisError(problem, "a complete safetensors file", fix) from error


def _parse_header(
    path: str | Path, metadata: Mapping[str, str] | None, expected: str | None
) -> Header:
    """The header in a file's metadata, if the file is one of Aegis's.

    It has to be of the `expected` kind, and not of a later version.
    """
    if "aegis" not in (metadata or {}):
        raise AegisError(
            f"'{path}' is a safetensors file without an 'aegis' header: another program wrote it",
            f"a file of kind {repr(expected) if expected else 'known to Aegis'}",
            _rewrite(expected),
        )
    try:
        fields = json.loads(metadata["aegis"])
        kind, number = str(fields["kind"]), int(fields["schema"])
        _check_kind(path, kind, expected)
        _check_schema(path, kind, number)
        specs = fields["tensors"].items()
        tensors = {
            name: TensorSpec(**{**spec, "shape": tuple(spec["shape"])}) for name, spec in specs
        }
        header = Header(**{**fields, "tensors": tensors})
        _check_types(header)
        return header
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise AegisError(
            f"the header of '{path}' is damaged: {error}",
            "the header as Aegis wrote it",
            _rewrite(expected),
        ) from error


def _check_types(header: Header) -> None:
    """Raise TypeError or ValueError unless the fields are of the types that they are declared as.

    A damaged file is found here, and not where a field is used.
    """
    if type(header.schema) is not int or header.schema < 1:
        raise ValueError(f"schema {header.schema!r}")
    texts = {"fingerprint": header.fingerprint, "digest": header.digest, "version": header.version}
    for name, value in texts.items():
        if not isinstance(value, str | None):
            raise TypeError(f"{name} {value!r}")
    if not isinstance(header.seed, int | None):
        raise TypeError(f"seed {header.seed!r}")
    if not isinstance(header.meta, dict):
        raise TypeError("meta is no mapping")
    if not all(isinstance(digest, str) for digest in header.inputs.values()):
        raise TypeError("an input whose digest is no text")
    for name, spec in header.tensors.items():
        sizes = all(type(size) is int for size in spec.shape)
        if not sizes or not isinstance(spec.unit, str) or not isinstance(spec.dtype, str):
            raise TypeError(f"'{name}' is {spec}")


def _check_kind(path: str | Path, kind: str, expected: str | None) -> None:
    if expected is not None and kind != expected:
        raise AegisError(
            f"'{path}' is of kind '{kind}'",
            f"a file of kind '{expected}'",
            f"give the file that '{KINDS[expected].command}' wrote",
        )
    if kind not in KINDS:
        raise AegisError(
            f"'{path}' is of unknown kind '{kind}'", f"one of {quoted(KINDS)}", _UPGRADE
        )


def _check_schema(path: str | Path, kind: str, number: int) -> None:
    if number > schema(kind):
        raise AegisError(
            f"{kind} '{path}' has schema {number}, written by a newer Aegis",
            f"schema {schema(kind)} or older",
            _UPGRADE,
        )


def _migrate(header: Header, tensors: dict[str, Tensor]) -> tuple[Header, dict[str, Tensor]]:
    """Lift an older file, schema by schema, to the one that this version writes."""
    meta = header.meta
    for migration in MIGRATIONS.get(header.kind, ())[header.schema - 1 :]:
        tensors, meta = migration(tensors, meta)
    units = {name: spec.unit for name, spec in header.tensors.items()}
    table = _table(tensors, units)
    return replace(header, schema=schema(header.kind), tensors=table, meta=meta), tensors


def _validate(path: str | Path, header: Header, tensors: Tensors, fix: str) -> None:
    """Raise AegisError unless layout, finiteness and domain are right.

    The checks run in this order, because each needs what the one before it found right.
    """
    checks = (
        (layout_problems(header.kind, tensors), "exactly the tensors of this kind"),
        (_not_finite(tensors), "finite numbers"),
        (KINDS[header.kind].domain(tensors, header.meta), "values that make sense for this kind"),
    )
    for problems, expected in checks:
        if found := "; ".join(problems):
            raise AegisError(f"{header.kind} '{path}': {found}", expected, fix)


def _not_finite(tensors: Tensors) -> Iterator[str]:
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and (bad := int((~tensor.isfinite()).sum())):
            yield f"'{name}' has {bad} NaN or infinite of {tensor.numel()} values"


def _write_safetensors(file: BinaryIO, tensors: Tensors, text: str) -> None:
    """The safetensors format (length, JSON header, data), streamed.

    Not safetensors.torch.save_file: that one writes mode 0600, hides the errno of a full disk,
    refuses tensors that share memory, and its bytes may change with its version.
    """
    # With the widest types first, every tensor is aligned.
    names = sorted(tensors, key=lambda name: (-tensors[name].element_size(), name))
    table: dict[str, Any] = {"__metadata__": {"aegis": text}}
    end = 0
    for name in names:
        start, end = end, end + tensors[name].nbytes
        dtype, shape = _FORMAT[tensors[name].dtype], list(tensors[name].shape)
        table[name] = {"dtype": dtype, "shape": shape, "data_offsets": [start, end]}
    raw = canonical(table).encode()
    raw += b" " * (-len(raw) % 8)
    file.write(len(raw).to_bytes(8, "little") + raw)
    for name in names:
        file.write(_bytes(tensors[name]))


def _digest(fields: Mapping[str, Any], tensors: Tensors) -> str:
    """sha256 over the header's other fields, and over the tensors' bytes by name."""
    said = {name: value for name, value in fields.items() if name != "digest"}
    whole = hashlib.sha256(canonical(said).encode())
    for name in sorted(tensors):
        whole.update(_bytes(tensors[name]))
    return whole.hexdigest()


def _bytes(tensor: Tensor) -> np.ndarray:
    """A tensor's values as they lie in memory [bytes], one after the other."""
    return tensor.reshape(-1).view(torch.uint8).numpy()


def _table(tensors: Tensors, units: Mapping[str, str]) -> dict[str, TensorSpec]:
    def spec(name: str, tensor: Tensor) -> TensorSpec:
        unit = next((u for pattern, u in units.items() if fnmatch.fnmatchcase(name, pattern)), "1")
        return TensorSpec(tuple(tensor.shape), str(tensor.dtype).removeprefix("torch."), unit)

    return {name: spec(name, tensor) for name, tensor in tensors.items()}


def _short(fingerprint: str | None) -> str:
    return "unknown (no fingerprint)" if fingerprint is None else f"'{fingerprint[:12]}'"


def _rewrite(kind: str | None) -> str:
    known = [KINDS[kind]] if kind in KINDS else KINDS.values()
    commands = sorted({each.command for each in known})
    return f"run {' or '.join(repr(c) for c in commands)} to write it"


def _check_inputs(kind: str) -> str:
    return f"check what you gave to '{KINDS[kind].command}'; nothing was written"
