"""The embedded dual encoder: an image and a text tower, together about a million parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from aegis_cli.common.errors import AegisError
from aegis_cli.core.attention import additive
from aegis_cli.models.backbones import embedded_file
from aegis_cli.models.backbones.dual import DualEncoder, early_layer
from aegis_cli.models.backbones.embedded import Layer
from aegis_cli.models.backbones.tokenizer import Tokenizer

MAX_WORDS = 14  # the most tokens of a text, including the end token
SIDE = 4  # image tokens per side
FIRST_SCALE, MAX_SCALE = 1 / 0.07, 100.0  # factors of the logits, as in CLIP


@dataclass(frozen=True)
class Shape:
    """Sizes of the towers; an image token covers a square of `image_size` / 4 pixels."""

    width: int = 128
    depth: int = 3  # layers of the image tower
    text_depth: int = 2
    heads: int = 4
    mlp_ratio: int = 4
    stem_width: int = 48
    image_size: int = 48


class Stem(nn.Module):
    """The image tower's stem: patches of 4 x 4 pixels, mixed with their neighbours.

    Each of the 16 tokens [B, 16, D] covers 3 x 3 patches and a border.
    """

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.patch = nn.Conv2d(3, shape.stem_width, 4, stride=4)
        self.mix = nn.Conv2d(shape.stem_width, shape.stem_width, 3, padding=1)
        self.token = nn.Conv2d(shape.stem_width, shape.width, 5, stride=3, padding=1)
        self.position = nn.Embedding(SIDE**2, shape.width)
        nn.init.normal_(self.position.weight, std=0.02)

    def forward(self, pixels: Tensor) -> Tensor:
        x = self.patch(pixels)
        x = x + self.mix(F.relu(x))
        tokens = self.token(F.relu(x))  # [B, D, 4, 4], each from 5 x 5 overlapping patches
        return tokens.flatten(2).transpose(1, 2) + self.position.weight


class Tower(nn.Module):
    """Transformer layers over tokens [B, T, D]."""

    def __init__(self, width: int, depth: int, heads: int, mlp_ratio: int) -> None:
        super().__init__()
        layers = [Layer(width, heads, mlp_ratio) for _ in range(depth)]
        self.layers = nn.ModuleList(layers)
        self.norm = nn.LayerNorm(width)
        self.project = nn.Linear(width, width, bias=False)
        # Residual branches start small, so that depth does not inflate the stream.
        for layer in layers:
            for branch in (layer.out, layer.down):
                nn.init.normal_(branch.weight, std=0.02 / (2 * depth) ** 0.5)

    def forward(self, x: Tensor, mask: Tensor | None) -> Tensor:
        return self.norm(self._pass(x, mask, len(self.layers)))

    def early(self, x: Tensor) -> Tensor:
        """Hidden states [B, T, D] after two thirds of the layers (at least one), without a mask."""
        return self._pass(x, None, early_layer(len(self.layers)))

    def _pass(self, x: Tensor, mask: Tensor | None, count: int) -> Tensor:
        x = x.unsqueeze(1)  # [B, 1, T, D]: an image or a text is one block
        for layer in self.layers[:count]:
            x, _ = layer(x, mask, None)
        return x.squeeze(1)

    def feature(self, pooled: Tensor) -> Tensor:
        """The projected rows [B, D], normalized to length 1, in float32."""
        # Under autocast the projection is in half precision; cosines are to be in float32.
        return F.normalize(self.project(pooled).float(), dim=-1)


class EmbeddedDual(DualEncoder):
    """A small dual encoder that ships with the package."""

    kind: ClassVar[str] = "dual-encoder"

    def __init__(self, shape: Shape, vocabulary: Sequence[str]) -> None:
        super().__init__()
        self.shape, self.tokenizer = shape, Tokenizer(vocabulary)
        self.width, self.image_size = shape.width, shape.image_size
        self.stem = Stem(shape)
        self.image = Tower(shape.width, shape.depth, shape.heads, shape.mlp_ratio)
        self.words = nn.Embedding(len(vocabulary), shape.width)
        self.position = nn.Embedding(MAX_WORDS, shape.width)
        self.text = Tower(shape.width, shape.text_depth, shape.heads, shape.mlp_ratio)
        # Learned as a logarithm, as in CLIP, so that it stays positive.
        self.log_scale = nn.Parameter(torch.tensor(math.log(FIRST_SCALE)))
        for table in (self.words, self.position):
            nn.init.normal_(table.weight, std=0.02)

    def pixels(self, images: Tensor) -> Tensor:
        """Images [B, S, S, 3] uint8 -> [B, 3, S, S] float32 in [-1, 1]."""
        return images.to(self.device).permute(0, 3, 1, 2).float() / 127.5 - 1

    def image_features(self, pixels: Tensor) -> Tensor:
        return self.image.feature(self.image(self.stem(pixels), None).mean(1))

    def looks(self, pixels: Tensor) -> Tensor:
        return self.image.early(self.stem(pixels)).mean(1).float()

    def text_features(self, texts: Sequence[str]) -> Tensor:
        return self.id_features(self.ids(texts))

    def ids(self, texts: Sequence[str]) -> Tensor:
        """Texts -> ids [N, T] int64 with the end token, padded on the right.

        Raises:
            AegisError: a word is unknown, or there are too many.
        """
        rows = [[*self.tokenizer.encode(text), self.tokenizer.end] for text in texts]
        length = max(map(len, rows))
        if length > MAX_WORDS:
            longest = max(texts, key=lambda text: len(text.split()))
            raise AegisError(
                f"{length - 1} words in '{longest}'", f"at most {MAX_WORDS - 1}", "use fewer words"
            )
        padded = [[*row, *[self.tokenizer.pad] * (length - len(row))] for row in rows]
        return torch.tensor(padded, device=self.device)

    def id_features(self, ids: Tensor) -> Tensor:
        """Features [N, D] of texts of ids [N, T], taken at the end token, which has read it all."""
        mask = additive(ids != self.tokenizer.pad)[:, None, None, None]  # [N, 1, 1, 1, T]
        tokens = self.words(ids) + self.position.weight[: ids.shape[1]]  # [N, T, D]
        hidden = self.text(tokens, mask)
        end = (ids == self.tokenizer.end).int().argmax(1)  # [N]; every text has exactly one
        return self.text.feature(hidden[torch.arange(len(ids), device=ids.device), end])

    def scale(self) -> Tensor:
        return self.log_scale.exp().clamp(max=MAX_SCALE)

    def sites(self) -> dict[str, nn.Linear]:
        found = {}
        for tower, module in (("image", self.image), ("text", self.text)):
            for i, layer in enumerate(module.layers):
                for name in ("out", "up", "down"):
                    found[f"{tower}.layers.{i}.{name}"] = getattr(layer, name)
        return found

    def in_text(self, site: str) -> bool:
        return site.startswith("text.")

    def save(self, folder: Path) -> None:
        embedded_file.save(self, Path(folder) / "model.safetensors", torch.float32)


def load_file(path: Path) -> tuple[EmbeddedDual, dict[str, object]]:
    """Load the model in an artifact, in float32, and its provenance.

    Raises:
        AegisError: the file is damaged, or its tensors are not those of the model it describes.
    """
    return embedded_file.load(path, EmbeddedDual, Shape)
