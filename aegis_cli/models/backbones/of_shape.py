"""A Hugging Face VLM of a real shape with random weights, made from its configuration alone.

It is used to measure time and memory without downloading a model. Its processor is a stand-in: it
scales images and hashes words, and knows no language.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
import transformers
from PIL import Image

from aegis_cli.common import devices
from aegis_cli.models.backbones.families import FAMILIES
from aegis_cli.models.backbones.from_hub import quiet
from aegis_cli.models.backbones.hf import HFBackbone
from aegis_cli.models.backbones.shapes import Shape, get

_PAD, _IMAGE, _END, _FIRST_WORD = range(4)  # tokens
_MARKER = "<image>"


def build(name: str, seed: int = 0) -> HFBackbone:
    """The model of that shape in float32, on the chosen device.

    Like those of the hub's models, its weights are representable in bfloat16. On one device equal
    seeds give equal weights. On a GPU they are drawn there, since a CPU takes long for billions.

    Raises:
        AegisError: there is no such shape.
    """
    return make(get(name), seed)


def make(shape: Shape, seed: int = 0) -> HFBackbone:
    """As `build`, for any shape."""
    device = devices.pick()
    with torch.random.fork_rng([device] if device.type == "cuda" else []), quiet(), device:
        torch.manual_seed(seed)
        model = assemble(shape)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(parameter.to(torch.bfloat16))
    processor = StandInProcessor(shape)
    return HFBackbone(model, processor, FAMILIES[shape.family], files={}).eval()  # type: ignore


def assemble(shape: Shape) -> transformers.PreTrainedModel:
    """The model alone, with the initial weights of transformers."""
    tokens = {"pad_token_id": _PAD, "bos_token_id": _END, "eos_token_id": _END}
    config = transformers.AutoConfig.for_model(
        shape.family,
        text_config={**shape.text, **tokens},
        vision_config=dict(shape.vision),
        **{shape.image_token: _IMAGE},
        **shape.more,
    )
    kind = transformers.AutoModelForImageTextToText
    model = kind.from_config(config, dtype=torch.float32)
    model.generation_config.eos_token_id = _END
    return model


class StandInProcessor:
    """Stands in for a model's own processor: pixels of the real size, and one token per word."""

    chat_template = _MARKER

    def __init__(self, shape: Shape) -> None:
        self._shape = shape
        self.tokenizer = _Words(shape.text["vocab_size"], shape.tokens)

    def __call__(
        self,
        images: Sequence[Sequence[Image.Image]],
        text: Sequence[str],
        padding_side: str,
        **_: Any,
    ) -> dict[str, torch.Tensor]:
        """Each row's images [B, n, 3, H, W] (PaliGemma: [B n, 3, H, W]) and tokens [B, S]."""
        rows_of_pixels = [torch.stack([self._pixels(image) for image in own]) for own in images]
        pixels = torch.stack(rows_of_pixels)  # [B, n, 3, H, W]
        rows = [self.tokenizer.ids(said) for said in text]
        longest = max(map(len, rows))
        ids = torch.full((len(rows), longest), _PAD)
        for row, own in zip(ids, rows, strict=True):
            place = slice(None, len(own)) if padding_side == "right" else slice(-len(own), None)
            row[place] = torch.tensor(own)
        made = {"input_ids": ids, "attention_mask": (ids != _PAD).long()}
        if self._shape.family == "paligemma":
            return {
                **made,
                "pixel_values": pixels.flatten(0, 1),
                "token_type_ids": torch.zeros_like(ids),
            }
        return {**made, "pixel_values": pixels}

    def _pixels(self, image: Image.Image) -> torch.Tensor:
        """[3, H, W] from -1 to 1."""
        side = self._shape.vision["image_size"]
        scaled = np.asarray(image.convert("RGB").resize((side, side)), dtype=np.float32)
        return torch.from_numpy(scaled).permute(2, 0, 1) / 127.5 - 1


class _Words:
    """A tokenizer that numbers words by their checksum."""

    bos_token = None
    pad_token_id = _PAD

    def __init__(self, size: int, image_tokens: int) -> None:
        self._size, self._image_tokens = size, image_tokens

    def ids(self, text: str) -> list[int]:
        """The tokens of a text, including those of its images."""
        found: list[int] = []
        for word in text.replace(_MARKER, f" {_MARKER} ").split():
            if word == _MARKER:
                found += [_IMAGE] * self._image_tokens
            else:
                number = zlib.crc32(word.encode()) % (self._size - _FIRST_WORD)
                found.append(_FIRST_WORD + number)
        return found

    def __call__(self, text: str | Sequence[str], **_: Any) -> dict[str, Any]:
        if isinstance(text, str):
            return {"input_ids": self.ids(text)}
        return {"input_ids": [self.ids(each) for each in text]}

    def apply_chat_template(self, said: Sequence[Mapping[str, Any]], **_: Any) -> str:
        """The conversation's only turn: a marker for each image, and the text."""
        content = said[0]["content"]
        return " ".join(_MARKER if c["type"] == "image" else c["text"] for c in content)

    def convert_ids_to_tokens(self, token: int) -> str:
        return _MARKER if token == _IMAGE else str(token)

    def batch_decode(self, ids: Sequence[Sequence[int]], **_: Any) -> list[str]:
        return [" ".join(map(str, row)) for row in ids]
