"""Policies as LeRobot and openpi write them: a VLM under a prefix, an action expert beside it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

WEIGHTS = "model.safetensors"
SCALES = "policy_preprocessor_step_5_normalizer_processor.safetensors"
TABLE = "language_model.model.embed_tokens.weight"  # of the PaliGemma of samples.hf, as it is saved


def of_modules(name: str) -> str:
    """As transformers 5 names the modules of what it saves as `language_model.model...`."""
    if name.startswith("language_model.model."):
        return f"model.language_model.{name.removeprefix('language_model.model.')}"
    if name.startswith("language_model.lm_head."):
        return name.removeprefix("language_model.")
    return name if name.startswith(("model.", "lm_head.")) else f"model.{name}"


def with_vision_model(name: str) -> str:
    """As transformers did until 5.5, which openpi and LeRobot have."""
    return name.replace("vision_tower.", "vision_tower.vision_model.")


class Form(NamedTuple):
    """How a program names a policy's tensors.

    Attributes:
        prefix, expert: what the VLM's names and the action expert's have before them.
        name: the VLM's names, as its folder has them -> the policy's.
    """

    prefix: str
    expert: str
    name: Callable[[str], str] = str
    type: str | None = "pi0"


FORMS = {
    "pi0 of LeRobot": Form(
        "model.paligemma_with_expert.paligemma.",
        "model.paligemma_with_expert.gemma_expert.model.",
        lambda name: with_vision_model(of_modules(name)),
    ),
    "pi0 of a later transformers": Form(
        "model.paligemma_with_expert.paligemma.",
        "model.paligemma_with_expert.gemma_expert.model.",
        of_modules,
    ),
    "pi0 of an earlier LeRobot": Form(
        "model.paligemma_with_expert.paligemma.",
        "model.paligemma_with_expert.gemma_expert.model.",
        with_vision_model,
    ),
    "pi0 of openpi": Form(
        "paligemma_with_expert.paligemma.",
        "paligemma_with_expert.gemma_expert.model.",
        lambda name: with_vision_model(of_modules(name)),
        None,
    ),
    "at the root": Form("", "action_expert.", of_modules, "own"),
    "smolvla": Form(
        "model.vlm_with_expert.vlm.", "model.vlm_with_expert.lm_expert.", str, "smolvla"
    ),
}


def moved(vlm: Path, by: float = 0.05, seed: int = 0) -> dict[str, Tensor]:
    """The VLM's tensors after a training; 0 leaves them as they are."""
    drawn = torch.Generator().manual_seed(seed)
    own = load_file(vlm / WEIGHTS)
    return {
        name: tensor + by * torch.randn(tensor.shape, generator=drawn).to(tensor.dtype)
        for name, tensor in sorted(own.items())
    }


def is_layer(name: str, at_least: int = 0) -> bool:
    """Whether a tensor is of a language layer of that number or a higher one."""
    before, _, behind = name.partition(".layers.")
    return before.endswith(("language_model.model", "text_model")) and (
        int(behind.partition(".")[0]) >= at_least
    )


def expert(vlm: Mapping[str, Tensor], form: Form, width: int | None) -> dict[str, Tensor]:
    """An action expert with the names of the VLM's layers.

    Args:
        width: of its layers; None: the VLM's.
    """
    drawn = torch.Generator().manual_seed(1)
    found = {}
    for name, tensor in vlm.items():
        if is_layer(name):
            shape = tensor.shape if width is None else (width,) * tensor.ndim
            behind = "layers." + name.partition(".layers.")[2]
            found[form.expert + behind] = torch.randn(shape, generator=drawn)
    head = form.prefix.partition(".")[0] + "." if form.prefix else ""
    return found | {f"{head}action_in_proj.weight": torch.randn(4, 8, generator=drawn)}


def tensors(vlm: Mapping[str, Tensor], form: Form, width: int | None = 8) -> dict[str, Tensor]:
    """All of a policy's tensors."""
    own = {form.prefix + form.name(name): tensor for name, tensor in vlm.items()}
    return own | expert(vlm, form, width)


def write(folder: Path, found: Mapping[str, Tensor], form: Form, shards: int = 1) -> Path:
    """A policy's folder with what lies beside its weights."""
    (folder / "assets").mkdir(parents=True)
    (folder / "assets" / "norm_stats.json").write_text("{}")
    if form.type is not None:
        (folder / "config.json").write_text(json.dumps({"type": form.type, "chunk_size": 8}))
    (folder / "policy_preprocessor.json").write_text('{"steps": []}')
    save_file({"observation.state.mean": torch.zeros(3)}, folder / SCALES)
    names = sorted(found)
    metadata = {"format": "pt"}
    if shards == 1:
        save_file({n: found[n].contiguous() for n in names}, folder / WEIGHTS, metadata)
        return folder
    places = {
        n: f"model-{i % shards + 1:05}-of-{shards:05}.safetensors" for i, n in enumerate(names)
    }
    for place in sorted(set(places.values())):
        part = {n: found[n].contiguous() for n in names if places[n] == place}
        save_file(part, folder / place, metadata)
    index = {"metadata": {"total_size": 0}, "weight_map": places}
    (folder / f"{WEIGHTS}.index.json").write_text(json.dumps(index))
    return folder
