"""The untrained two-layer VLM that most tests use."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from aegis_cli.data.vqa.questions import vocabulary
from aegis_cli.models.backbones.embedded import EmbeddedVLM, Shape
from aegis_cli.models.backbones.tokenizer import SPECIAL


def make_tiny(seed: int = 0, words: Sequence[str] | None = None) -> EmbeddedVLM:
    """Two layers, width 32; draws from its own generator state."""
    known = vocabulary() if words is None else words
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return EmbeddedVLM(
            Shape(width=32, depth=2, heads=2, stem_width=8), (*SPECIAL, *known)
        ).eval()
