"""The known Hugging Face model families: where their language layers are, and how they are asked.

All of them structure their language model as Llama does: `layers`, and beside them `rotary_emb` and
`norm`; each layer has one attention module, which passes its keys and values to a cache.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any


def _nothing(model: Any) -> tuple[str, ...]:
    return ()


def _beyond_features(model: Any) -> tuple[str, ...]:
    """The parts of a CLIP tower after the layer whose output the language model reads.

    `vision_feature_layer` counts the embeddings as 0, and -1 is the last layer.
    """
    config, tower = model.config, "model.vision_tower"
    depth, chosen = config.vision_config.num_hidden_layers, config.vision_feature_layer
    layers = [chosen] if isinstance(chosen, int) else chosen
    last = max(layer if layer >= 0 else depth + 1 + layer for layer in layers)
    unread = [f"encoder.layers.{i}" for i in range(last, depth)]
    if hasattr(model.get_submodule(tower), "vision_model"):  # as in transformers 5.5
        tower += ".vision_model"
    return tuple(f"{tower}.{part}" for part in (*unread, "post_layernorm"))


@dataclass(frozen=True)
class Family:
    """Module paths and prompt formats of one family.

    Attributes:
        layers: dotted path of the language model's layers.
        prompt: the format of a question for the processor, after an `<image>` for each of its
            images; None: the processor's own chat template.
        answer: how an answer continues the prompt; with a chat template, after the prompt for the
            model's turn.
        answer_types: values for an answer's tokens in the processor's per-token tensors, by the
            tensor's name; 0 if not named.
        held: names of parameters that no input describes, such as a matrix outside of any torch
            module: they are protected by freezing them.
        connector: dotted name of the module that makes tokens of image features, if transformers
            5.5 inserts these among the words without checking their dtype, which autocast changes;
            else None.
        idle: the model -> dotted names of the parts whose outputs nothing reads.
    """

    layers: str
    prompt: str | None = None
    answer: str = "{}"
    answer_types: Mapping[str, int] = field(default_factory=dict)
    held: tuple[str, ...] = ()
    connector: str | None = None
    idle: Callable[[Any], tuple[str, ...]] = _nothing


FAMILIES: dict[str, Family] = {
    # PaliGemma 2 too. Its tokens of type 0 attend bidirectionally, and those of type 1 causally.
    "paligemma": Family(
        "model.language_model.layers",
        prompt="answer en {}",
        answer_types={"token_type_ids": 1},
    ),
    "smolvlm": Family("model.text_model.layers", answer=" {}", connector="model.connector"),
    "idefics3": Family("model.text_model.layers", answer=" {}"),
    "qwen2_5_vl": Family("model.language_model.layers"),
    "llava_onevision": Family("model.language_model.layers"),
    "qwen2_vl": Family("model.language_model.layers"),
    "qwen3_vl": Family("model.language_model.layers"),
    "llava": Family("model.language_model.layers", idle=_beyond_features),
    "llava_next": Family("model.language_model.layers", idle=_beyond_features),
    "mistral3": Family("model.language_model.layers"),
    "internvl": Family("model.language_model.layers"),
    "gemma3": Family(
        "model.language_model.layers",
        held=("model.multi_modal_projector.mm_input_projection_weight",),
    ),
}

_LINEAR = "most of its layers are linear attention, which keeps no keys and values of its tokens"
_OLD_REPOSITORY = (
    "it is of the model's first repository, whose own code reads the images, and no code of a "
    "model folder is run; transformers' own conversion has a name that ends in -hf"
)
# Families that cannot be used, whatever layers are named after a `#` -> the reason.
REFUSED: dict[str, str] = {
    "internvl_chat": _OLD_REPOSITORY,
    "llava_llama": _OLD_REPOSITORY,
    "llava_mistral": _OLD_REPOSITORY,
    "llava_qwen": _OLD_REPOSITORY,
    "qwen3_5": _LINEAR,
    "qwen3_5_moe": _LINEAR,
    "lfm2_vl": "most of its layers are convolutions, which keep no keys and values of their tokens",
    "mllama": "it reads the image in cross-attention layers, whose keys are the image's alone, and "
    "no token carries the image",
    "phi4_multimodal": "transformers has it as a causal language model with inputs of its own, and "
    "not as a model of images and text",
    "phi4mm": "its repository's own code reads the images, and no code of a model folder is run",
}
