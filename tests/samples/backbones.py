"""An untrained VLM that gives varied answers, and questions for it."""

from __future__ import annotations

import torch
from torch import Tensor

from aegis_cli.models.backbones.base import Backbone, Encoding
from aegis_cli.models.backbones.embedded import EmbeddedVLM
from samples.tiny import make_tiny

TEXTS = [
    "how many balls are there",
    "is there a red ball",
    "what color is the cube",
    "count the objects",
]
LONGEST = "which color does the ball have"


def outspoken_tiny() -> EmbeddedVLM:
    """The untrained VLM with stronger layers, so that its answers differ and contain no padding."""
    model = make_tiny()
    with torch.no_grad():
        for weight in (
            model.words.weight,
            model.text_position.weight,
            *(w.weight for x in model.layers for w in (x.out, x.down)),
        ):
            weight *= 30
        model.words.weight[model.tokenizer.pad] = 0
    return model


def images(count: int, seed: int = 0) -> Tensor:
    return torch.randint(
        256, (count, 64, 64, 3), generator=torch.Generator().manual_seed(seed), dtype=torch.uint8
    )


@torch.no_grad()
def encode(backbone: Backbone, frames: Tensor, texts: list[str]) -> Encoding:
    return backbone.encode(backbone.prepare(frames, texts))


def close(x: Tensor, y: Tensor) -> None:
    torch.testing.assert_close(x, y, rtol=1e-4, atol=1e-5)
