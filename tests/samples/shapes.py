"""Shapes of the real families, small enough to train."""

from __future__ import annotations

from aegis_cli.models.backbones.shapes import SHAPES, Shape

_TOWER = {
    "hidden_size": 16,
    "intermediate_size": 32,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "image_size": 32,
    "patch_size": 8,
}
_TEXT = {
    "vocab_size": 300,
    "hidden_size": 32,
    "intermediate_size": 64,
    "num_hidden_layers": 2,
    "num_attention_heads": 4,
    "num_key_value_heads": 2,
    "head_dim": 8,
}


def small(name: str) -> Shape:
    """The shape of that name with every size reduced."""
    true = SHAPES[name]
    more, vision = dict(true.more), {**true.vision, **_TOWER}
    if true.family == "paligemma":
        more |= {"hidden_size": 32, "projection_dim": 32, "vocab_size": 300}
        vision["projection_dim"] = 32
    else:
        more["scale_factor"] = 2
    tokens = 16 if true.family == "paligemma" else 4
    return Shape(
        true.family, {**true.text, **_TEXT}, vision, more, true.image_token, tokens, parameters=1
    )
