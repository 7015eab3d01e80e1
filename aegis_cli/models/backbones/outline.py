"""A description of a backbone without its weights, so that one file can hold a policy's tensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from aegis_cli.common.state_dicts import check_heads, reading_meta, shape_from
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.backbones.embedded import EmbeddedVLM, Shape


def describe(backbone: Backbone, folder: Path) -> dict[str, Any]:
    """What `build` needs to make the backbone again, as values that JSON can hold.

    Args:
        folder: written if a model has its own files, as one from the hub has.
    """
    if isinstance(backbone, EmbeddedVLM):
        vocabulary = list(backbone.tokenizer.vocabulary)
        return {"kind": "embedded", "shape": asdict(backbone.shape), "vocabulary": vocabulary}
    backbone.save_description(folder)  # type: ignore[operator]
    return {"kind": "hugging-face"}


def build(described: Mapping[str, Any], folder: Path, path: Path, tensors: int) -> Backbone:
    """The backbone that `describe` described, whose weights are still to be loaded.

    Args:
        folder: the folder that `describe` was given.
        path: the file that the description was read from, for the error.
        tensors: how many tensors the file has; a model has more of them than layers.

    Raises:
        AegisError: it describes no model.
    """
    with reading_meta(path):
        kind = described["kind"]
        if kind == "embedded":
            shape = shape_from(Shape, described["shape"], path, tensors)
            check_heads(shape.width, shape.heads)
            return EmbeddedVLM(shape, list(described["vocabulary"])).eval()
        if kind != "hugging-face":
            raise ValueError(f"a backbone of kind {kind!r}")
    from aegis_cli.models.backbones import hf

    return hf.described(folder)
