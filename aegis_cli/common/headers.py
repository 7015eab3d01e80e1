"""The header of an artifact: what the file is, how it was made and what it holds.

Nothing here loads torch, so that `aegis inspect` responds at once.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from aegis_cli.common.errors import AegisError
from aegis_cli.common.files import (
    RENAME,
    canonical,
    check_utf8,
    parse_json,
    reading,
    refuse_pointer,
)
from aegis_cli.common.kinds import KINDS, quoted

if TYPE_CHECKING:
    from safetensors import safe_open
    from torch import Tensor


@dataclass(frozen=True)
class TensorSpec:
    """A header's entry for one tensor."""

    shape: tuple[int, ...]
    dtype: str
    unit: str


@dataclass(frozen=True)
class Header:
    """The `aegis` metadata of a file: what it is, how it was made and what it holds.

    `digest` is the sha256 of the other fields and of the tensors' bytes; None in a file written
    before digests were introduced.
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


# Kind -> the functions that migrate schema 1 to 2, 2 to 3, ... Append-only: entries never change.
Migration = Callable[
    ["dict[str, Tensor]", dict[str, Any]], "tuple[dict[str, Tensor], dict[str, Any]]"
]
MIGRATIONS: dict[str, tuple[Migration, ...]] = {}

_CUT = "smaller than the required mapping size"
_UPGRADE = "upgrade aegis: git pull && pip install -e ."


def schema(kind: str) -> int:
    """The number of the schema that this version writes."""
    return 1 + len(MIGRATIONS.get(kind, ()))


def read_header(path: str | Path, kind: str | None = None) -> Header:
    """The header of a file, without reading its tensors; it must be of `kind`, if that is given."""
    with opened(path, kind) as file:
        return parse_header(path, file.metadata(), kind)


def is_artifact(path: str | Path) -> bool:
    """Whether a safetensors file was written by Aegis rather than another program.

    Raises:
        AegisError: it cannot be read.
    """
    with opened(path, None) as file:
        return "aegis" in (file.metadata() or {})


@contextlib.contextmanager
def opened(
    path: str | Path, kind: str | None, framework: Literal["np", "pt"] = "np"
) -> Generator[safe_open]:
    """The open file.

    Args:
        kind: the kind that it should be, for the error's advice.
        framework: framework that the tensors are read for.

    Raises:
        AegisError: it is missing, truncated or not a safetensors file, or its path is not text and
            its tensors are read for torch.
    """
    from safetensors import SafetensorError, safe_open  # not needed for --help

    fix = rewrite(kind)
    try:
        with reading(path, fix), safe_open(path, framework=framework) as file:
            yield file
    except (SafetensorError, RuntimeError) as error:
        # torch maps the file after reading its header, and raises if it was truncated meanwhile.
        if not isinstance(error, SafetensorError) and _CUT not in str(error):
            raise
        check_utf8(path, RENAME)
        refuse_pointer(path)
        problem = f"'{path}' is truncated or not a safetensors file ({error})"
        raise AegisError(problem, "a complete safetensors file", fix) from error


def parse_header(
    path: str | Path, metadata: Mapping[str, str] | None, expected: str | None
) -> Header:
    """The header in a file's metadata.

    Raises:
        AegisError: the file was not written by Aegis, is not of the `expected` kind, is of a later
            version, or is damaged.
    """
    if metadata is None or "aegis" not in metadata:
        raise AegisError(
            f"'{path}' is a safetensors file without an 'aegis' header: another program wrote it",
            f"a file of kind {repr(expected) if expected else 'known to Aegis'}",
            rewrite(expected),
        )
    try:
        fields: dict[str, Any] = parse_json(metadata["aegis"])
        canonical(fields)  # a number that is not finite is a ValueError
        kind, number = str(fields["kind"]), int(fields["schema"])
        _check_kind(path, kind, expected)
        _check_schema(path, kind, number)  # before the fields: a newer Aegis may have others
        tensors = {name: _spec(said) for name, said in fields["tensors"].items()}
        whole: dict[str, Any] = {**fields, "tensors": tensors}
        header = Header(**whole)
        _check_types(header)
        return header
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise AegisError(
            f"the header of '{path}' is damaged: {error}",
            "the header as Aegis wrote it",
            rewrite(expected),
        ) from error


def _spec(said: Mapping[str, Any]) -> TensorSpec:
    fields: dict[str, Any] = {**said, "shape": tuple(said["shape"])}
    return TensorSpec(**fields)


def _check_types(header: Header) -> None:
    """Raise TypeError or ValueError unless the fields have their declared types.

    A damaged file is detected here, not where a field is used.
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
        sizes = all(type(size) is int for size in spec.shape)  # not `isinstance`: True is an int
        if not sizes or not isinstance(spec.unit, str) or not isinstance(spec.dtype, str):
            raise TypeError(f"'{name}' is {spec}")


def _check_kind(path: str | Path, kind: str, expected: str | None) -> None:
    if expected is not None and kind != expected:
        option = KINDS[kind].option if kind in KINDS else None
        raise AegisError(
            f"'{path}' is of kind '{kind}'",
            f"a file of kind '{expected}'",
            f"give the file that '{KINDS[expected].command}' wrote"
            + (f"; this one belongs to {option}" if option else ""),
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


def rewrite(kind: str | None) -> str:
    """The advice for an unusable file of that kind, or of any kind."""
    known = [KINDS[kind]] if kind in KINDS else KINDS.values()
    commands = sorted({each.command for each in known})
    return f"run {' or '.join(repr(c) for c in commands)} to write it"
