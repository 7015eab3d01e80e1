"""Two small models for the guard: one of our own, one of PaliGemma 2's architecture."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from aegis_cli import Guard

WIDTH, WORDS, PATCHES, TEXT = 16, 23, 3, 5
IMAGE = torch.arange(PATCHES + TEXT) < PATCHES


class Layer(nn.Module):
    """One attention head and a feed-forward part."""

    def __init__(self) -> None:
        super().__init__()
        self.norm, self.qkv, self.out = (
            nn.LayerNorm(WIDTH),
            nn.Linear(WIDTH, 3 * WIDTH),
            nn.Linear(WIDTH, WIDTH),
        )
        self.up, self.down = nn.Linear(WIDTH, 2 * WIDTH), nn.Linear(2 * WIDTH, WIDTH)

    def forward(self, x: Tensor, hidden: Tensor) -> Tensor:
        q, k, v = self.qkv(self.norm(x)).chunk(3, -1)
        scores = (q @ k.mT / WIDTH**0.5).masked_fill(hidden[:, None], -1e4)
        x = x + self.out(scores.softmax(-1) @ v)
        return x + self.down(F.gelu(self.up(x)))


class SmallVlm(nn.Module):
    """Pixels [B, 3, 6, 2] become 3 tokens; with the words [B, 5] they pass `text.layers`."""

    def __init__(self) -> None:
        super().__init__()
        self.vision = nn.Sequential(nn.Conv2d(3, WIDTH, 2, stride=2), nn.Flatten(2))
        self.text = nn.Module()
        self.text.words = nn.Embedding(WORDS, WIDTH)
        self.text.layers = nn.ModuleList(Layer() for _ in range(2))

    def forward(self, images: Tensor, ids: Tensor, mask: Tensor) -> Tensor:
        x = torch.cat([self.vision(images).mT, self.text.words(ids)], 1)
        for layer in self.text.layers:
            x = layer(x, ~mask)
        return x


def small_batches(seed: int) -> list[tuple[Tensor, ...]]:
    """Images, ids, mask and target of two batches; the second row ends in padding."""
    generator = torch.Generator().manual_seed(seed)
    mask = torch.ones(4, PATCHES + TEXT, dtype=torch.bool)
    mask[1, -2:] = False
    return [
        (
            torch.randn(4, 3, 2 * PATCHES, 2, generator=generator),
            torch.randint(WORDS, (4, TEXT), generator=generator),
            mask,
            torch.randn(4, PATCHES + TEXT, WIDTH, generator=generator),
        )
        for _ in range(2)
    ]


def small_vlm(anchor: Path) -> SmallVlm:
    """A model with fixed weights; its anchor is written to `anchor`."""
    torch.manual_seed(0)
    model = SmallVlm().eval()
    with Guard.measure(model, layers="text.layers") as measured:
        for images, ids, mask, _ in small_batches(1):
            with measured.watch(mask, IMAGE):
                model(images, ids, mask)
    measured.save(anchor)
    return model


def save_small_paligemma(folder: Path) -> None:
    """PaliGemma 2's architecture with random weights, as a user would have it on disk."""
    from transformers import PaliGemmaConfig, PaliGemmaForConditionalGeneration

    common = {
        "hidden_size": 16,
        "intermediate_size": 32,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
    }
    vision = {
        "model_type": "siglip_vision_model",
        "image_size": 8,
        "patch_size": 4,
        "vision_use_head": False,
    }
    text = {
        "model_type": "gemma2",
        "num_key_value_heads": 1,
        "head_dim": 8,
        "vocab_size": WORDS,
        "pad_token_id": 0,
    }
    config = PaliGemmaConfig(
        vision_config=common | vision | {"projection_dim": 16},
        text_config=common | text,
        image_token_index=WORDS - 1,
        projection_dim=16,
        vocab_size=WORDS,
        pad_token_id=0,
    )
    torch.manual_seed(0)
    PaliGemmaForConditionalGeneration(config).save_pretrained(folder)


def paligemma_batches(seed: int) -> list[dict[str, Tensor]]:
    """Two batches of three texts about an image of four tokens, as a processor would make them."""
    generator = torch.Generator().manual_seed(seed)
    made = []
    for _ in range(2):
        image = torch.full((3, 4), WORDS - 1)
        words = torch.randint(3, WORDS - 1, (3, TEXT), generator=generator)
        words[0, -2:] = 0
        ids = torch.cat([image, words], 1)
        made.append(
            {
                "input_ids": ids,
                "attention_mask": (ids != 0).long(),
                "token_type_ids": torch.zeros_like(ids),
                "pixel_values": torch.randn(3, 3, 8, 8, generator=generator),
                "labels": ids.masked_fill((ids == 0) | (ids == WORDS - 1), -100),
            }
        )
    return made


def measured_paligemma(folder: Path) -> nn.Module:
    """The model of `save_small_paligemma` in a folder of its own, with its anchor beside it."""
    from transformers import AutoModelForImageTextToText

    saved = folder / "path" / "to" / "paligemma2"
    model = AutoModelForImageTextToText.from_pretrained(saved).eval()
    with Guard.measure(model, layers="model.language_model.layers") as measured:
        for batch in paligemma_batches(3):
            image = batch["input_ids"] == WORDS - 1
            with measured.watch(batch["attention_mask"], image=image):
                model(**batch)
    measured.save(folder / "anchor.safetensors")
    return model
