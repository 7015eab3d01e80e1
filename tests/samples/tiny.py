"""The untrained two-layer VLM that most tests use."""

from __future__ import annotations

import torch

from aegis_cli.data.vqa.questions import vocabulary
from aegis_cli.models.backbones.embedded import EmbeddedVLM, Shape
from aegis_cli.models.backbones.tokenizer import SPECIAL


def make_tiny(seed: int = 0) -> EmbeddedVLM:
    """Two layers, width 32; draws from its own generator state."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return EmbeddedVLM(
            Shape(width=32, depth=2, heads=2, stem_width=8), (*SPECIAL, *vocabulary())
        ).eval()
