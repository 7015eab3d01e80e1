"""Inspect a file by its header; torch is loaded only for kinds that have figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from aegis_cli.common import files, headers
from aegis_cli.common.errors import AegisError
from aegis_cli.inspection.report import InspectReport, TensorInfo

_WITH_FIGURES = ("anchor", "ledger")
OF_QUESTIONS = (".jsonl", ".json", ".parquet")  # suffixes of question files


def inspect(path: Path) -> InspectReport:
    """Inspect an artifact.

    Raises:
        AegisError: the file is no artifact, or damaged.
    """
    if path.is_file() and path.suffix != ".safetensors" and not _is_safetensors(path):
        what = f"a {path.suffix} file" if path.suffix else "a file that Aegis does not know"
        fix = "give the artifact itself, or the folder that it lies in; a recipe ends in .yaml"
        if path.suffix in OF_QUESTIONS:
            fix += f"; {asked_by(path)}"
        expected = "a .safetensors file, or the folder of a run, study, dataset or model"
        raise AegisError(f"'{path}' is {what}", expected, fix)
    header = headers.read_header(path)
    figures: dict[str, Any] = {}
    if header.kind in _WITH_FIGURES:
        from aegis_cli.inspection.figures import of_file

        figures = of_file(path, header.kind)
    tensors = tuple(
        TensorInfo(name, spec.shape, spec.dtype, spec.unit) for name, spec in header.tensors.items()
    )
    return InspectReport(header.kind, str(path), _header_facts(header), tensors, **figures)


def asked_by(path: Path) -> str:
    """Advice for question files, which are no artifacts."""
    return f"questions are asked by aegis probe MODEL --vqa '{path}'"


def _is_safetensors(path: Path) -> bool:
    """Whether a file of another suffix begins like safetensors: the header's length, then JSON."""
    with files.reading(path, "check the path"), open(path, "rb") as file:
        return file.read(9)[8:] == b"{"  # the length takes 8 bytes


def _header_facts(header: headers.Header) -> dict[str, Any]:
    known = {
        "schema": header.schema,
        "version": header.version,
        "seed": header.seed,
        "fingerprint": header.fingerprint,
    }
    facts = known | {"inputs": header.inputs or None} | header.meta  # None values are left out
    if header.kind == "ledger" and "step" in header.tensors:
        facts["steps"] = header.tensors["step"].shape[0]
    return {k: v for k, v in facts.items() if v is not None}
