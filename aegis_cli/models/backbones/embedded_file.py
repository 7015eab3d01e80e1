"""An embedded model as one artifact: its weights, sizes, vocabulary and provenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar

import torch
from torch import Tensor, nn

from aegis_cli.common import artifacts
from aegis_cli.common.state_dicts import (
    check_heads,
    check_state,
    outline,
    reading_meta,
    shape_from,
)
from aegis_cli.models.backbones.tokenizer import Tokenizer


class EmbeddedModel(Protocol):
    """The interface of both embedded models through which their files are written and read.

    Attributes:
        kind: the artifact's kind.
        shape: a dataclass of sizes.
    """

    kind: ClassVar[str]
    shape: Any
    tokenizer: Tokenizer

    def __init__(self, shape: Any, vocabulary: Sequence[str]) -> None: ...

    def state_dict(self) -> dict[str, Tensor]: ...

    def load_state_dict(self, state: dict[str, Tensor], /, *, assign: bool = False) -> Any: ...

    def fingerprint(self) -> str: ...

    def eval(self) -> nn.Module: ...


Model = TypeVar("Model", bound=EmbeddedModel)


def save(
    model: EmbeddedModel,
    path: Path,
    dtype: torch.dtype,
    provenance: Mapping[str, object] | None = None,
) -> None:
    """Write the model as one artifact; `dtype` bfloat16 halves it and rounds the weights."""
    path.parent.mkdir(parents=True, exist_ok=True)
    state = model.state_dict()
    tensors = {name: t.detach().to(dtype).cpu().contiguous() for name, t in state.items()}
    artifacts.save(
        path,
        model.kind,
        tensors,
        fingerprint=model.fingerprint(),
        meta={
            "shape": asdict(model.shape),
            "vocabulary": list(model.tokenizer.vocabulary),
            "provenance": provenance or {},
        },
    )


def load(path: Path, model_type: type[Model], shape_type: type) -> tuple[Model, dict[str, object]]:
    """Load the model in an artifact, in float32 and evaluation mode, and its provenance.

    Raises:
        AegisError: the file is no artifact of that model's kind or is damaged, or its tensors are
            not those of the model that it describes.
    """
    artifact = artifacts.load(path, model_type.kind)
    meta, tensors = artifact.header.meta, artifact.tensors
    with reading_meta(path):
        vocabulary, provenance = list(meta["vocabulary"]), dict(meta["provenance"])
        shape = shape_from(shape_type, meta["shape"], path, len(tensors))
    with outline(path):
        check_heads(shape.width, shape.heads)
        model = model_type(shape, vocabulary)
    # Not exact: a file may be in half precision, while the model is in float32.
    check_state(f"'{path}'", tensors, model.state_dict(), exact=False)
    # A copy, so that training never changes the memory map of the file.
    weights = {name: t.to(torch.float32, copy=True) for name, t in tensors.items()}
    model.load_state_dict(weights, assign=True)
    model.eval()
    return model, provenance
