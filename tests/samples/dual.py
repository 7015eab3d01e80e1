"""A small untrained dual encoder, and inputs for it."""

from __future__ import annotations

import torch
from torch import Tensor

from aegis_cli.models.backbones.embedded_dual import EmbeddedDual, Shape
from aegis_cli.models.backbones.tokenizer import SPECIAL

TEXTS = ["a red cube", "a blue ball of no size", "cube", "a", "red ball"]


def make_dual(seed: int = 0) -> EmbeddedDual:
    """Width 32; draws from its own generator state."""
    words = sorted({word for text in TEXTS for word in text.split()})
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return EmbeddedDual(
            Shape(width=32, depth=2, text_depth=2, heads=2, stem_width=8), (*SPECIAL, *words)
        ).eval()


def random_images(count: int, seed: int = 0, size: int = 48) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (count, size, size, 3), generator=generator, dtype=torch.uint8)
