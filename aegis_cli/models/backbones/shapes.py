"""The real shapes of some Hugging Face VLMs, which `aegis bench` builds with random weights.

They are taken from the models' own `config.json`. `of_shape.py` builds the models.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from aegis_cli.common.errors import AegisError

PREFIX = "random:"  # prefix of a backbone's name that is a shape with random weights


@dataclass(frozen=True)
class Shape:
    """One model's sizes, with the keys of its configuration.

    Attributes:
        family: `model_type` in transformers, and the row of `families.FAMILIES`.
        text, vision: the sizes of its two towers.
        more: further keys of the configuration.
        image_token: the configuration's key for the image token.
        tokens: tokens of an image of `vision["image_size"]` pixels.
        parameters: number of parameters, in millions.
    """

    family: str
    text: Mapping[str, Any]
    vision: Mapping[str, Any]
    more: Mapping[str, Any]
    image_token: str
    tokens: int
    parameters: int


# SmolVLM merges 4 x 4 neighbouring patches into one token: (512 / 16 / 4)^2 = 64 per image.
_SMOL = {"scale_factor": 4, "tie_word_embeddings": False}
_SMOL_TEXT = {
    "model_type": "llama",
    "vocab_size": 49280,
    "max_position_embeddings": 8192,
    "head_dim": 64,
    "initializer_range": 0.04,
}
_SIGLIP_BASE = {
    "hidden_size": 768,
    "intermediate_size": 3072,
    "num_hidden_layers": 12,
    "num_attention_heads": 12,
    "image_size": 512,
    "patch_size": 16,
}

SHAPES: dict[str, Shape] = {
    "smolvlm2-256m": Shape(
        "smolvlm",
        {
            **_SMOL_TEXT,
            "hidden_size": 576,
            "intermediate_size": 1536,
            "num_hidden_layers": 30,
            "num_attention_heads": 9,
            "num_key_value_heads": 3,
        },
        _SIGLIP_BASE,
        _SMOL,
        "image_token_id",
        tokens=64,
        parameters=256,
    ),
    "smolvlm2-500m": Shape(
        "smolvlm",
        {
            **_SMOL_TEXT,
            "hidden_size": 960,
            "intermediate_size": 2560,
            "num_hidden_layers": 32,
            "num_attention_heads": 15,
            "num_key_value_heads": 5,
        },
        _SIGLIP_BASE,
        _SMOL,
        "image_token_id",
        tokens=64,
        parameters=507,
    ),
    "paligemma2-3b": Shape(
        "paligemma",
        {
            "model_type": "gemma2",
            "vocab_size": 257216,
            "hidden_size": 2304,
            "intermediate_size": 9216,
            "num_hidden_layers": 26,
            "num_attention_heads": 8,
            "num_key_value_heads": 4,
            "head_dim": 256,
            "query_pre_attn_scalar": 256,
            "sliding_window": 4096,
            "max_position_embeddings": 8192,
        },
        {
            "model_type": "siglip_vision_model",
            "hidden_size": 1152,
            "intermediate_size": 4304,
            "num_hidden_layers": 27,
            "num_attention_heads": 16,
            "image_size": 224,
            "patch_size": 14,
            "projection_dim": 2304,
            "vision_use_head": False,
        },
        {"hidden_size": 2304, "projection_dim": 2304, "vocab_size": 257216},
        "image_token_index",
        tokens=256,
        parameters=3032,
    ),
}

# No model has this shape. It has all their parts, to check that this transformers is supported.
SMALL = Shape(
    "smolvlm",
    {
        **_SMOL_TEXT,
        "vocab_size": 64,
        "hidden_size": 32,
        "head_dim": 16,
        "intermediate_size": 64,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
        "num_key_value_heads": 1,
    },
    {
        **_SIGLIP_BASE,
        "hidden_size": 32,
        "intermediate_size": 64,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
        "image_size": 32,
        "patch_size": 8,
    },
    {**_SMOL, "scale_factor": 2},
    "image_token_id",
    tokens=4,
    parameters=0,
)


def get(name: str) -> Shape:
    """The shape of that name.

    Raises:
        AegisError: there is none.
    """
    if name not in SHAPES:
        raise AegisError(
            f"the shape '{name}'", f"one of {', '.join(SHAPES)}", "choose with --shape"
        )
    return SHAPES[name]


def of_backbone(name: str) -> str | None:
    """The shape that a backbone's name asks for; None if it names an actual model."""
    return name.removeprefix(PREFIX) if name.startswith(PREFIX) else None
