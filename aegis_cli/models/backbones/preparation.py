"""The settings by which a processor makes a model's inputs of images and texts.

An anchor, and the answers of a baseline, belong to these settings as much as to the weights: with
another `image_mean` the same weights see other images. Artifacts record the settings themselves
rather than one digest of the processor's files, since these are formatted differently by each
program that saves them, and since an error can then name the setting that differs.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

META = "prepares"  # the key in the meta of an artifact

# Names of classes and files, which say nothing about the values that the processor computes.
_NAMES = ("auto_map", "chat_template", "name_or_path", "return_tensors", "transformers_version")
_LONGEST = 60  # characters of a setting; longer ones, such as grids, are recorded as their digest
# Its tokens depend on how a tokenizer splits words, numbers, signs and foreign letters.
_SAMPLE = "Where is the RED block? It's 3.14 cm left of\n two cups: über, 東京!"


def of(processor: Any) -> dict[str, str]:
    """A processor's settings by name; one that is not called elsewhere meanwhile.

    The stand-in of a model that was made from a shape alone has none.
    """
    if not hasattr(processor, "image_processor"):
        return {}
    images, tokenizer = processor.image_processor, processor.tokenizer
    found = {name: value for name, value in images.to_dict().items() if _counts(name, value)}
    for name, value in vars(processor).items():
        if _counts(name, value):
            found[f"processor.{name}"] = value
    settings = {name: _text(value) for name, value in found.items()}
    settings["chat template"] = _digest(processor.chat_template)
    settings["vocabulary"] = _digest(sorted(tokenizer.get_vocab().items()))
    settings["tokens of a text"] = _digest(tokenizer(_SAMPLE)["input_ids"])
    return settings


def differing(found: Mapping[str, str], expected: Mapping[str, str]) -> str | None:
    """Names the settings that two models do not share, as an error says them; None: there are none.

    Only settings that both have are compared: a release of transformers may add one, and
    artifacts of before have none.
    """
    told = [
        f"{name} {found[name]} instead of {expected[name]}"
        for name in sorted(found.keys() & expected.keys())
        if found[name] != expected[name]
    ]
    return ", ".join(told) or None


def _counts(name: str, value: Any) -> bool:
    """Whether this is a setting with a value, of images or of prompts."""
    # `image_processor_type`, `processor_class`, `_processor_class`.
    named = name.startswith(("_", "video")) or name.endswith(("_type", "_class")) or name in _NAMES
    return not named and value is not None and _is_plain(value)


def _is_plain(value: Any) -> bool:
    if isinstance(value, Mapping):
        return all(_is_plain(one) for one in value.values())
    if isinstance(value, list | tuple):
        return all(_is_plain(one) for one in value)
    return value is None or isinstance(value, bool | int | float | str)


def _text(value: Any) -> str:
    """A setting as text, the same for a list and a tuple, and with or without empty entries."""
    text = json.dumps(_without_nothing(value), sort_keys=True)
    return text if len(text) <= _LONGEST else _digest(value)


def _without_nothing(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_nothing(own) for key, own in value.items() if own is not None}
    return [_without_nothing(own) for own in value] if isinstance(value, list | tuple) else value


def _digest(value: Any) -> str:
    text = json.dumps(_without_nothing(value), sort_keys=True)
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:12]
