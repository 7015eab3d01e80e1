"""A model folder in the layout of the hub: config.json, *.safetensors and the processor's files."""

from __future__ import annotations

import json
from collections.abc import Container, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from safetensors import safe_open
from torch import nn

from aegis_cli.common import commands, files, hub
from aegis_cli.common.errors import AegisError, in_short
from aegis_cli.models.backbones.base import FLOAT32
from aegis_cli.models.backbones.families import FAMILIES, REFUSED, Family

_OWN = "aegis.json"  # in a saved folder of an unknown family: the path of its layers
_MODEL_FILES = {"config.json", "generation_config.json", _OWN}
_TEMPLATES = "additional_chat_templates"
# The parts of a processor, and the files that may hold one.
_PARTS = {
    "tokenizer": (
        *("tokenizer.json", "tokenizer.model", "vocab.json", "vocab.txt"),
        *("spiece.model", "sentencepiece.bpe.model", "tekken.json"),
    ),
    "image processor": ("preprocessor_config.json", "processor_config.json"),
}
_PROCESSOR_SUFFIXES = (".json", ".jinja", ".txt", ".model")
_STORED = {"BF16": "bfloat16", "F16": "float16"}  # safetensors' names
GIVE = (
    "--backbone MODEL (anchor, bench), --set backbone=MODEL (train, run; of a stream's "
    "encoder, encoder=MODEL), --baseline MODEL or as it is (probe)"
)


def fetch(name: str) -> Path:
    """The local folder of a model on the hub, downloaded if it is not there.

    Raises:
        AegisError: neither in the cache nor downloadable.
    """
    try:
        return _snapshot(name)
    except (OSError, ValueError) as error:
        raise AegisError(
            f"no folder '{name}', and no model of that name from the Hugging Face hub: "
            f"{in_short(error)}",
            "a local model, or a hub id with a network (and, for a gated model, a token)",
            f"on a machine with a network: hf download {name} --local-dir MODEL; then give MODEL: "
            f"{GIVE}",
        ) from error


def is_cached(name: str) -> bool:
    """Whether a model on the hub has been downloaded, with all its weights."""
    try:
        folder = _snapshot(name, cached=True)
        indices = [files.load_json(path) for path in folder.glob("*.safetensors.index.json")]
    except (OSError, ValueError, AegisError):
        return False
    there = {path.name for path in weights(folder)}
    needed = {file for index in indices for file in index.get("weight_map", {}).values()}
    return is_model(folder) and bool(there) and needed <= there


def _snapshot(name: str, cached: bool = False) -> Path:
    wanted = [f"*{suffix}" for suffix in (*_PROCESSOR_SUFFIXES, ".safetensors")]
    # Mistral's repositories contain their weights twice.
    return hub.snapshot(name, "model", wanted, unwanted=["consolidated*"], cached=cached)


def is_model(folder: Path) -> bool:
    """Whether a folder holds a model in the hub's layout."""
    return (folder / "config.json").is_file()


def is_policy(folder: Path) -> bool:
    """Whether a folder holds a whole policy of ours in LeRobot's layout (models/lerobot_folder.py).

    LeRobot's configuration file has the same name as that of a model on the hub.
    """
    path = folder / "config.json"
    if not path.is_file() or not (folder / "model.safetensors").is_file():
        return False
    return is_own_config(path.read_bytes())


def is_own_config(content: bytes) -> bool:
    """Whether this is LeRobot's configuration of a policy of ours."""
    try:
        config = files.parse_json(content)
    except ValueError:
        return False  # loading it as a model of the hub gives the error
    return isinstance(config, dict) and config.get("type") == "aegis"


def foreign_policy(path: Path) -> str | None:
    """LeRobot's name for the type of another program's policy; None if it is not one.

    Args:
        path: its folder, or a file in it.
    """
    config = (path if path.is_dir() else path.parent) / "config.json"
    if not config.is_file():
        return None
    try:
        said = files.parse_json(config.read_bytes())
    except ValueError:
        return None
    if not isinstance(said, dict) or "model_type" in said or said.get("type") == "aegis":
        return None
    return said["type"] if isinstance(said.get("type"), str) else None


def refuse_foreign_policy(path: Path) -> None:
    """Raise AegisError for a robot policy of LeRobot that is not ours."""
    if (kind := foreign_policy(path)) is not None:
        folder = path if path.is_dir() else path.parent
        raise AegisError(
            f"'{path}', a policy of LeRobot's of the type '{kind}'",
            "a policy that Aegis has trained, or a vision-language model by itself",
            take_out(folder),
        )


def take_out(policy: object) -> str:
    """How to extract the VLM from a policy that another program trained."""
    command = commands.aegis("extract", policy)
    return (
        f"if it was made from a VLM, take that out, as {command} --base VLM --out FOLDER: aegis "
        "probe, merge and train take FOLDER"
    )


def weights(folder: Path) -> list[Path]:
    """A folder's files of weights, of which there may be several."""
    return sorted(folder.glob("*.safetensors"))


def stored_type(folder: Path) -> str:
    """Name of the dtype of all weights in the files; float32 if they differ."""
    found = set()
    for path in weights(folder):
        # Only headers are read: `get_slice` does not load a tensor.
        with safe_open(path, framework="np") as opened:
            for name in sorted(opened.keys()):
                found.add(opened.get_slice(name).get_dtype())
    # Counters among the weights are whole numbers.
    kinds = {kind for kind in found if not kind.startswith(("I", "U", "BOOL"))}
    return _STORED.get(kinds.pop(), FLOAT32) if len(kinds) == 1 else FLOAT32


def processor_files(folder: Path) -> dict[str, bytes]:
    """Contents, by path, of files that are neither the model's weights nor its configuration."""
    inside = [*folder.iterdir(), *(folder / _TEMPLATES).glob("*")]
    found = {}
    for path in sorted(inside):
        # An index lists the weights' shards, but the weights are saved as one file.
        of_model = path.name in _MODEL_FILES or path.name.endswith(".index.json")
        if path.suffix in _PROCESSOR_SUFFIXES and path.is_file() and not of_model:
            found[str(path.relative_to(folder))] = path.read_bytes()
    return found


def check_processor(folder: Path) -> None:
    """Raise AegisError unless a folder has a file for each part of a processor.

    Without files, transformers would create an empty tokenizer.
    """
    own = {path.name for path in folder.iterdir()}
    for part, names in _PARTS.items():
        if not own.intersection(names):
            raise AegisError(
                f"no {part} in '{folder}'",
                f"the processor's files beside the model's, such as {names[0]}",
                "copy them from the repository of the model that this one was made from",
            )


def processor_class(folder: Path) -> str | None:
    """The name of the processor's class in the folder's files."""
    for name in ("processor_config.json", "preprocessor_config.json", "tokenizer_config.json"):
        path = folder / name
        if not path.is_file():
            continue
        said = files.load_json(path)
        if isinstance(said, dict) and (found := said.get("processor_class")):
            return str(found)
    return None


def family(folder: Path, kind: str, layers: str | None) -> Family:
    """The row of the table for a model of type `kind`, with `layers` in place of its own, if given.

    Raises:
        AegisError: an unknown type without layers.
    """
    if layers is None and (folder / _OWN).is_file():
        said = files.load_json(folder / _OWN)
        layers = said.get("layers") if isinstance(said, dict) else None
    known = FAMILIES.get(kind)
    if layers is not None:
        return Family(layers) if known is None else replace(known, layers=layers)
    if known is None:
        raise AegisError(
            f"'{folder}' is a model of the family '{kind}'",
            f"one of {', '.join(FAMILIES)}, or the path of its language layers",
            f"name it after a #, e.g. --backbone '{folder}#model.language_model.layers'",
        )
    return known


def remember_layers(folder: Path, layers: str) -> None:
    """Record the layers' path, so that it need not be given again when the folder is loaded."""
    (folder / _OWN).write_text(json.dumps({"layers": layers}), encoding="utf-8")


def check_complete(folder: Path, report: Mapping[str, Any]) -> None:
    """Raise AegisError if loading left parameters without a value, or weights without a place."""
    problems = []
    for part in ("missing", "unexpected", "mismatched"):
        keys = sorted(map(str, report.get(f"{part}_keys", ())))
        if keys:
            problems.append(f"{len(keys)} {part} ({', '.join(keys[:3])})")
    if problems:
        raise AegisError(
            f"weights in '{folder}' that are not those of its config.json: {'; '.join(problems)}",
            "exactly the model's weights",
            "download or export the model again",
        )


def check_path(model: nn.Module, layers: str) -> nn.ModuleList:
    """The list of a language model's layers that `layers` names.

    Raises:
        AegisError: it names none, or no rotary embedding stands beside it.
    """
    modules = dict(model.named_modules())
    lists = {name: module for name, module in modules.items() if isinstance(module, nn.ModuleList)}
    # The `rotary_emb` beside it tells a language model's list from other lists of blocks.
    rotated = []
    for name in lists:
        parent = name.rpartition(".")[0]
        beside = f"{parent}.rotary_emb" if parent else "rotary_emb"
        if beside in modules:
            rotated.append(name)
    if layers not in rotated:
        why = "is no list of the model's layers"
        if layers in lists:
            why = "has no rotary_emb beside it, as language models have"
        raise AegisError(
            f"'{layers}' {why}",
            f"one of {', '.join(rotated or lists)}",
            "name the language model's layers",
        )
    return lists[layers]


def check_files(folder: Path, kinds: Container[str]) -> None:
    """Raise AegisError unless the folder has a model of one of these `kinds`, in safetensors."""
    refuse_adapter(folder)
    refuse_foreign_policy(folder)
    path, again = folder / "config.json", "download or export the model again"
    expected = "the configuration of a Hugging Face model"
    try:
        config = files.parse_json(path.read_bytes())
    except FileNotFoundError as error:
        raise AegisError(
            f"no config.json in '{folder}'", expected, "give a model of transformers' own layout"
        ) from error
    except ValueError as error:
        raise AegisError(f"'{path}' is not JSON: {error}", expected, again) from error
    if not isinstance(config, dict) or not isinstance(config.get("model_type"), str):
        raise AegisError(f"'{path}' names no model_type", expected, again)
    kind = config["model_type"]
    if kind in REFUSED:
        raise _unsuitable(f"'{folder}', a '{kind}' model", REFUSED[kind])
    if config["model_type"] not in kinds:
        raise AegisError(
            f"'{folder}' is a model of the family '{config['model_type']}', which this "
            "transformers does not have",
            "a family that it has",
            "pip install --upgrade transformers, if it is a new one",
        )
    _refuse_quantised(folder, config)
    if not weights(folder):
        others = [p.name for p in sorted(folder.iterdir()) if p.suffix in (".bin", ".pt", ".pth")]
        raise AegisError(
            f"no *.safetensors in '{folder}'" + (f", but {', '.join(others)}" if others else ""),
            "weights as safetensors",
            "save it anew with transformers: model.save_pretrained(FOLDER)" if others else again,
        )


def _refuse_quantised(folder: Path, config: dict[str, Any]) -> None:
    """Raise AegisError for quantised weights, which no gradient reaches."""
    parts = [config, *(part for part in config.values() if isinstance(part, dict))]
    for part in parts:
        if isinstance(said := part.get("quantization_config"), dict):
            by = str(said.get("quant_method", "a method that it does not name"))
            raise AegisError(
                f"quantised weights in '{folder}' (by {by}, says its config.json)",
                "weights of float32, bfloat16 or float16, which can learn",
                "take the model that it was made from, or save it anew with transformers: "
                "model.dequantize().save_pretrained(FOLDER), with the processor's files",
            )


def refuse_adapter(folder: Path) -> None:
    """Raise AegisError for an adapter, which transformers would add to the model that it loads."""
    if (folder / "adapter_config.json").is_file():
        raise AegisError(
            f"an adapter of PEFT in '{folder}' (adapter_config.json)",
            "a model without one",
            "merge the adapter into its model, and save that elsewhere: "
            "peft_model.merge_and_unload().save_pretrained(FOLDER), with the processor's files",
        )


def refuse_part(path: Path) -> None:
    """Raise AegisError for a file of weights given instead of its model's folder."""
    folder = path.parent
    if path.suffix == ".safetensors" and is_model(folder) and not is_policy(folder):
        refuse_foreign_policy(path)
        raise AegisError(
            f"'{path}', the weights of a Hugging Face model",
            "the model's folder, which has its configuration and its processor too",
            f"give '{folder}'",
        )


def refuse_gguf(path: Path) -> None:
    """Raise AegisError for a model in llama.cpp's format: a file, or a folder with nothing else."""
    found = [path] if path.suffix == ".gguf" else sorted(path.glob("*.gguf"))
    if found and not weights(path):
        raise AegisError(
            f"a model in llama.cpp's form, GGUF: '{found[0]}'",
            "the folder of a Hugging Face model: config.json, *.safetensors and the processor",
            "take the model that it was made from",
        )


def check_attention(layers: nn.ModuleList) -> None:
    """Raise AegisError unless each layer has one attention module, over the tokens themselves."""
    for number, layer in enumerate(layers):
        kinds = [type(child).__name__ for child in layer.children()]
        found = [kind for kind in kinds if kind.endswith("Attention")]
        if len(found) != 1 or "Cross" in found[0]:
            has = " and ".join(found) or "none"
            raise _unsuitable(
                f"layer {number}, a {type(layer).__name__}",
                f"its attention modules over the text's own tokens are {has}, and the action "
                "expert reads the keys and values of one in every layer",
            )


def _unsuitable(found: str, why: str) -> AegisError:
    return AegisError(
        f"{found}: {why}",
        "a vision-language model that attends to all tokens in each of its language layers",
        f"use a model of another family: {', '.join(FAMILIES)}",
    )


def headless(model: nn.Module) -> AegisError:
    """The error for a model that does not answer with words."""
    return AegisError(
        f"a {type(model).__name__} without a head that scores words",
        "a vision-language model that answers with words",
        f"use a model of another family: {', '.join(FAMILIES)}",
    )


def foreign_rotation(layer: int) -> AegisError:
    """The error for a family whose keys are rotated differently from the expert's."""
    found = f"layer {layer} rotates its keys in a way of its own, or not at all"
    expected = (
        "one rotary embedding for all layers, the second half of the channels like the "
        "first (GPT-NeoX's)"
    )
    return AegisError(found, expected, f"use a model of another family: {', '.join(FAMILIES)}")


def misfit(problem: str) -> AegisError:
    """The error for a model and a processor that do not work together."""
    return AegisError(
        f"a model and a processor that do not fit together: {problem}",
        "the processor that the model was trained with",
        "copy the processor's files of the same repository beside the model",
    )
