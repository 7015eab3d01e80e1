"""The known Hugging Face model families: where their language layers are, and how they are asked.

All of them keep their language model as Llama does: `layers`, and beside them `rotary_emb` and
`norm`; each layer has one attention module, which hands its keys and values to a cache.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Family:
    """One row of module paths and prompt shapes.

    Attributes:
        layers: dotted path of the language model's layers.
        prompt: what a question becomes before the processor sees it, after an `<image>` for each of
            its images; None: the processor's own chat template.
        answer: how an answer continues the prompt; with a chat template, where it leaves off for
            the model to speak.
    """

    layers: str
    prompt: str | None = None
    answer: str = "{}"


FAMILIES: dict[str, Family] = {
    "paligemma": Family("model.language_model.layers", prompt="answer en {}"),  # PaliGemma 2 too
    "smolvlm": Family("model.text_model.layers", answer=" {}"),
    "idefics3": Family("model.text_model.layers", answer=" {}"),
    "qwen2_5_vl": Family("model.language_model.layers"),
    "llava_onevision": Family("model.language_model.layers"),
}
