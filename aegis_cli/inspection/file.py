"""Inspect a file by its header; torch is loaded only for kinds that have figures."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from aegis_cli.common import files, headers
from aegis_cli.common.errors import AegisError
from aegis_cli.inspection.report import InspectReport, TensorInfo

_WITH_FIGURES = ("anchor", "ledger")
_WORDS = re.compile(r"[a-z]+")  # `action` and `in` of `action_in_proj`
_LAYER = re.compile(r"(?:^|\.)layers\.\d+\.")
OF_QUESTIONS = (".jsonl", ".json", ".parquet")  # suffixes of question files


def inspect(path: Path) -> InspectReport:
    """Inspect an artifact, or another program's safetensors file.

    Raises:
        AegisError: the file is something else, or damaged.
    """
    if path.is_file() and path.suffix != ".safetensors" and not _is_safetensors(path):
        what = f"a {path.suffix} file" if path.suffix else "a file that Aegis does not know"
        fix = "give the artifact itself, or the folder that it lies in; a recipe ends in .yaml"
        if path.suffix in OF_QUESTIONS:
            fix += f"; {asked_by(path)}"
        expected = "a .safetensors file, or the folder of a run, study, dataset or model"
        raise AegisError(f"'{path}' is {what}", expected, fix)
    if not headers.is_artifact(path):
        return _of_another_program(path)
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


def _of_another_program(path: Path) -> InspectReport:
    """The tensors of a file that Aegis has not written, and what their names look like."""
    with headers.opened(path, None) as file:
        slices = {name: file.get_slice(name) for name in sorted(file.keys())}
        tensors = tuple(
            TensorInfo(name, tuple(part.get_shape()), part.get_dtype(), "1")
            for name, part in slices.items()
        )
    types = Counter(tensor.dtype for tensor in tensors)
    facts: dict[str, Any] = {
        "written_by": "another program",
        "parameters": sum(math.prod(tensor.shape) for tensor in tensors),
        "types": {name: types[name] for name in sorted(types)},
    }
    return InspectReport("safetensors", str(path), facts | _likely(path, tensors), tensors)


def _likely(path: Path, tensors: Sequence[TensorInfo]) -> dict[str, str]:
    """What a file is by the names of its tensors, and what can be done with it; may be empty."""
    from aegis_cli.models.backbones import model_folder  # imports torch

    parts = {part for tensor in tensors for part in _WORDS.findall(tensor.name)}
    sees = not parts.isdisjoint(("vision", "visual"))
    if not (sees and any(_LAYER.search(tensor.name) for tensor in tensors)):
        return {}
    if not parts.isdisjoint(("action", "expert")) or model_folder.foreign_policy(path) is not None:
        return {"likely": "a robot policy with a VLM", "vlm": model_folder.take_out(path)}
    likely = {"likely": "a vision-language model"}
    if model_folder.is_model(path.parent):
        return likely | {"folder": f"commands take '{path.parent}', with its configuration"}
    return likely


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
