"""Artifacts on disk: safetensors files whose only metadata key, `aegis`, describes them.

Equal inputs give equal bytes, a file is either complete or absent, and nothing wrong loads
silently. The content of each kind is declared in kinds.py; this module knows no model.
"""

from __future__ import annotations

import fnmatch
import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch import Tensor

from aegis_cli.common.devices import single_threaded
from aegis_cli.common.errors import AegisError
from aegis_cli.common.files import (
    canonical,
    load_json,
    pour,
    save_json,
    sha256_file,
    write_atomically,
)
from aegis_cli.common.headers import (
    MIGRATIONS,
    Header,
    TensorSpec,
    is_artifact,
    opened,
    parse_header,
    read_header,
    rewrite,
    schema,
)
from aegis_cli.common.kinds import KINDS, Tensors, is_finite, layout_problems
from aegis_cli.common.version import __version__


@dataclass(frozen=True)
class Artifact:
    """A loaded and validated file."""

    header: Header
    tensors: dict[str, Tensor]


__all__ = [
    "KINDS",
    "BACKBONE",
    "MIGRATIONS",
    "Artifact",
    "Header",
    "Owner",
    "TensorSpec",
    "is_artifact",
    "load",
    "load_json",
    "made_with",
    "read_header",
    "save",
    "save_json",
    "schema",
    "sha256_file",
]

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
BACKBONE = "backbone"  # in the meta of a file: the backbone that it was made with, as it was given
_NO_DIGEST = "0" * 64  # placeholder for a file's digest


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
        seed: the seed that it was made with.
        inputs: sha256 of every file that it was made from, by a name for the file.
        fingerprint: digest of the backbone that it belongs to.
        units: units by tensor name or fnmatch pattern; "1" if none matches.
        meta: JSON whose meaning depends on the kind.

    Raises:
        AegisError: the content does not fit the kind, or the file cannot be written.
    """
    # GPU tensors are moved to the CPU one at a time: a training state may exceed its memory.
    plain = {name: tensor.detach() for name, tensor in tensors.items()}
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
    # Like `asdict`, which would copy thousands of shapes one number at a time.
    fields = vars(header) | {"tensors": {name: vars(spec) for name, spec in table.items()}}
    # Hashing takes as long as writing to a fast disk, so a thread does it during the write.
    with ThreadPoolExecutor(1, "digest") as pool:
        hashed = pool.submit(_digest, fields, plain)
        write_atomically(Path(path), lambda file: _write_safetensors(file, plain, fields, hashed))
    return replace(header, digest=hashed.result())


@dataclass(frozen=True)
class Owner:
    """The backbone that a file has to belong to.

    Attributes:
        fingerprint: digest of its weights.
        name: what it was loaded from, as the user knows it.
        fix: what to do about a file that belongs to another one.
    """

    fingerprint: str
    name: str
    fix: str


def load(path: str | Path, kind: str | None = None, *, owner: Owner | None = None) -> Artifact:
    """Read and validate one artifact; its tensors stay memory-mapped.

    It checks, in this order: the kind, the schema (older ones are migrated), the exact tensors with
    shapes and dtypes, the digest if the file has one, that values are finite and in the kind's
    domain, and whether it belongs to the backbone, if one is given.

    Raises:
        AegisError: the first check that fails.
    """
    with opened(path, kind, "pt") as file:
        metadata = file.metadata()
        header = parse_header(path, metadata, kind)
        tensors = {name: file.get_tensor(name) for name in sorted(file.keys())}
    again = rewrite(header.kind)
    # Only the header has units.
    found, listed = (
        {name: (spec.shape, spec.dtype) for name, spec in table.items()}
        for table in (_table(tensors, {}), header.tensors)
    )
    if found != listed:
        raise AegisError(
            f"the tensors in '{path}' are not those its header lists",
            "the file as Aegis wrote it",
            again,
        )
    # The digest covers the fields as stored in the file; migrated ones of older schemas differ.
    fields = json.loads(metadata["aegis"])
    if header.digest is not None and header.digest != _digest(fields, tensors):
        raise AegisError(
            f"'{path}' is damaged: its content does not match its digest",
            "the file as Aegis wrote it",
            f"bring back a copy of it, or {again}",
        )
    header, tensors = _migrate(header, tensors)
    _validate(path, header, tensors, again)
    if owner is not None and header.fingerprint != owner.fingerprint:
        raise AegisError(
            f"'{path}' ({header.kind}) {_made_with(header, owner)}",
            f"one that was made with '{owner.name}' as it is now",
            owner.fix,
        )
    return Artifact(header, tensors)


def made_with(header: Header) -> str | None:
    """The name of the backbone that a file was made with, as it was given; None if not recorded."""
    said = header.meta.get(BACKBONE)
    return said if isinstance(said, str) else None


def _made_with(header: Header, owner: Owner) -> str:
    """Which backbone a file of another one was made with, in words."""
    there, here = _short(header.fingerprint), _short(owner.fingerprint)
    name = made_with(header)
    if name == owner.name:
        return f"was made with '{name}' when that had other weights (digest {there}, now {here})"
    what = "weights that" if name is None else f"'{name}', whose weights"
    return f"was made with {what} are not those of '{owner.name}' (digest {there}, not {here})"


def _migrate(header: Header, tensors: dict[str, Tensor]) -> tuple[Header, dict[str, Tensor]]:
    """Migrate an older file, schema by schema, to the one that this version writes."""
    meta = header.meta
    # The first migration is from schema 1, so a file with the newest schema needs none.
    for migration in MIGRATIONS.get(header.kind, ())[header.schema - 1 :]:
        tensors, meta = migration(tensors, meta)
    # By the whole names: as patterns for each other, thousands of them would take seconds.
    units = {name: spec.unit for name, spec in header.tensors.items()}
    table = {name: _spec(tensor, units.get(name, "1")) for name, tensor in tensors.items()}
    return replace(header, schema=schema(header.kind), tensors=table, meta=meta), tensors


def _validate(path: str | Path, header: Header, tensors: Tensors, fix: str) -> None:
    """Raise AegisError unless layout, finiteness and domain are right.

    The checks run in this order, because each relies on the one before it.
    """
    checks = (
        (layout_problems(header.kind, tensors), "exactly the tensors of this kind"),
        (_not_finite(tensors), "finite numbers"),
        (_domain_problems(header, tensors), "values that make sense for this kind"),
    )
    for problems, expected in checks:
        if found := "; ".join(problems):
            raise AegisError(f"{header.kind} '{path}': {found}", expected, fix)


def _domain_problems(header: Header, tensors: Tensors) -> Iterator[str]:
    """Problems of the values, and of the metadata in a damaged file without a digest."""
    try:
        yield from KINDS[header.kind].domain(_OnCpu(tensors), header.meta)
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        yield f"metadata of other types ({error})"


def _not_finite(tensors: Tensors) -> Iterator[str]:
    with single_threaded():  # thousands of short sums, each of which would synchronise threads
        wrong = {name: tensor for name, tensor in tensors.items() if not is_finite(tensor)}
    for name, tensor in wrong.items():
        bad = int((~tensor.isfinite()).sum())
        yield f"'{name}' has {bad} NaN or infinite of {tensor.numel()} values"


def _write_safetensors(
    file: BinaryIO, tensors: Tensors, fields: Mapping[str, Any], digest: Future[str]
) -> None:
    """Write the safetensors format (length, JSON header, data) as a stream.

    Not by safetensors.torch.save_file, which writes mode 0600, hides the errno of a full disk,
    refuses tensors that share memory, and whose bytes may change with its version.

    Args:
        fields: fields of the header without the digest, which is filled in when it is known.
    """
    # With the widest dtypes first, every tensor is aligned.
    names = sorted(tensors, key=lambda name: (-tensors[name].element_size(), name))
    table: dict[str, Any] = {}
    end = 0
    for name in names:
        start, end = end, end + tensors[name].nbytes
        dtype, shape = _FORMAT[tensors[name].dtype], list(tensors[name].shape)
        table[name] = {"dtype": dtype, "shape": shape, "data_offsets": [start, end]}
    file.write(_head(table, fields, _NO_DIGEST))
    pour(file, (_bytes(tensors[name]) for name in names))
    file.seek(0)  # write the head again with the digest, once the thread is done
    file.write(_head(table, fields, digest.result()))


def _head(table: Mapping[str, Any], fields: Mapping[str, Any], digest: str) -> bytes:
    """The beginning of a file; its length does not depend on the digest."""
    metadata = {"aegis": canonical({**fields, "digest": digest})}
    raw = canonical({**table, "__metadata__": metadata}).encode()
    raw += b" " * (-len(raw) % 8)  # so that the data begins at a multiple of 8 bytes
    return len(raw).to_bytes(8, "little") + raw


def _digest(fields: Mapping[str, Any], tensors: Tensors) -> str:
    """sha256 over the header's other fields, and over the tensors' bytes by name."""
    said = {name: value for name, value in fields.items() if name != "digest"}
    whole = hashlib.sha256(canonical(said).encode())
    for name in sorted(tensors):
        whole.update(_bytes(tensors[name]))
    return whole.hexdigest()


def _bytes(tensor: Tensor) -> memoryview:
    """A tensor's values as contiguous bytes."""
    return tensor.cpu().reshape(-1).view(torch.uint8).numpy().data


class _OnCpu(Mapping[str, Tensor]):
    """Tensors by name, each moved to the CPU on access."""

    def __init__(self, tensors: Tensors) -> None:
        self._tensors = tensors

    def __getitem__(self, name: str) -> Tensor:
        return self._tensors[name].cpu()

    def __iter__(self) -> Iterator[str]:
        return iter(self._tensors)

    def __len__(self) -> int:
        return len(self._tensors)


def _table(tensors: Tensors, units: Mapping[str, str]) -> dict[str, TensorSpec]:
    known = [(_matcher(pattern), unit) for pattern, unit in units.items()]

    def unit_of(name: str) -> str:
        return next((unit for matches, unit in known if matches(name)), "1")

    return {name: _spec(tensor, unit_of(name)) for name, tensor in tensors.items()}


def _spec(tensor: Tensor, unit: str) -> TensorSpec:
    return TensorSpec(tuple(tensor.shape), str(tensor.dtype).removeprefix("torch."), unit)


@cache
def _matcher(pattern: str) -> Callable[[str], object]:
    """A function that tells whether a name matches; cached, because every save needs it."""
    return re.compile(fnmatch.translate(pattern)).match


def _short(fingerprint: str | None) -> str:
    return "unknown" if fingerprint is None else fingerprint[:12]


def _check_inputs(kind: str) -> str:
    return f"check what you gave to '{KINDS[kind].command}'; nothing was written"
