"""Backbones by name, path or hub id."""

from __future__ import annotations

import hashlib
import importlib.util
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from aegis_cli.common import artifacts, files, hub, kept_digests
from aegis_cli.common.errors import AegisError
from aegis_cli.models import shipped
from aegis_cli.models.backbones import model_folder, shapes
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.backbones.dual import DualEncoder

EMBEDDED, EMBEDDED_EASY = shipped.EMBEDDED, shipped.EMBEDDED_EASY
EMBEDDED_DUAL = shipped.EMBEDDED_DUAL
SHIPPED = shipped.FILES
LOCAL = ("runs/", "models/")  # our folders in recipes and docs, whose names look like hub ids


def locate(name: str) -> Path:
    """The path of the model called `name`: a file of Aegis, or a folder in the hub's layout.

    Args:
        name: one of `SHIPPED`, a model file, a backbone folder, the folder of a run, of one of its
            checkpoints or of a policy in LeRobot's layout, or the id of a model or a policy on the
            hub, which is downloaded if needed; what follows a '#' is ignored.

    Raises:
        AegisError: there is no such model, or its path is not valid UTF-8, which its readers do not
            accept.
    """
    name = divided(name)[0]
    model_folder.refuse_gguf(Path(name))
    model_folder.refuse_part(Path(name))
    # The disk takes precedence over the hub: a folder `models/x` is no id.
    if (here := _on_disk(name)) is not None:
        files.check_utf8(here, files.RENAME)
        return here
    if not hub.is_local(name) and _has_transformers():
        return _of_repository(model_folder.fetch(name))
    raise _no_backbone(name)


def is_here(name: str) -> bool:
    """Whether a model can be loaded without downloading it; `name` is as for `load`."""
    own = divided(name)[0]
    if shapes.of_backbone(name) is not None or _on_disk(own) is not None:
        return True
    return not hub.is_local(own) and _has_transformers() and model_folder.is_cached(own)


def divided(name: str) -> tuple[str, str | None]:
    """A backbone's name without the part after '#', and that part, which names its layers, or None.

    An existing path may itself contain a '#'.
    """
    if "#" not in name or os.path.exists(name):
        return name, None
    own, _, layers = name.rpartition("#")
    return own, layers or None


def _of_repository(folder: Path) -> Path:
    """The model in a downloaded repository: its folder, unless it is a policy's repository."""
    if model_folder.is_policy(folder) or (folder / "expert.safetensors").is_file():
        return _on_disk(str(folder)) or folder
    return folder


def _on_disk(name: str) -> Path | None:
    """The shipped or local model that `name` stands for; None: only the hub may have it."""
    if name in SHIPPED:
        return shipped.locate(name)
    path = Path(name)
    if model_folder.is_policy(path):
        return path / "model.safetensors"
    for folder in (path / "checkpoints" / "last" / "backbone", path, path / "backbone"):
        if model_folder.is_model(folder):
            return folder
        if (folder / "model.safetensors").is_file():
            return folder / "model.safetensors"
    return path if path.is_file() else None


def load(name: str) -> Backbone:
    """Load a backbone in float32, ready to be asked or adapted.

    Args:
        name: as for `locate`; for a Hugging Face model of an unknown family,
            `NAME#path.of.its.layers`; `random:SHAPE` is a model of a real shape with random
            weights.

    Raises:
        AegisError: as for `locate`; or the model does not load, or layers of an embedded one are
            named.
    """
    if (shape := shapes.of_backbone(name)) is not None:
        need_transformers(name)
        from aegis_cli.models.backbones import of_shape

        return of_shape.build(shape)
    own, layers = divided(name)
    path = locate(name)
    if path.is_dir():
        need_transformers(name)
        from aegis_cli.models.backbones import hf

        backbone = hf.load(path, layers)
        before = _before(path)
        backbone.stored = before.get("stored") or backbone.stored
        backbone.hub_id = own if _on_disk(own) is None else before.get("base_model")
        return backbone
    if layers is not None:
        raise AegisError(
            f"'#{layers}' after the embedded VLM '{path}'",
            "layers after a Hugging Face model only",
            "leave it out",
        )
    if model_folder.is_policy(path.parent):
        from aegis_cli.models import lerobot_folder

        return lerobot_folder.load(path.parent)[0].backbone
    if not artifacts.is_artifact(path):
        raise AegisError(
            f"'{path}' is a safetensors file without an 'aegis' header: another program wrote it",
            "a backbone that Aegis wrote, or the folder of a Hugging Face model",
            f"check the path; of a robot policy, {model_folder.take_out(name)}",
        )
    from aegis_cli.models.backbones.embedded import load_file

    return load_file(path)[0]


def _before(path: Path) -> Mapping[str, Any]:
    """What a checkpoint says of its backbone before training; empty for any other folder.

    `stored` is the dtype in which its weights were stored, since a checkpoint holds them in
    float32; `base_model` is its id on the hub. Either may be missing.
    """
    expert = path.parent / "expert.safetensors"
    return artifacts.read_header(expert).meta if expert.is_file() else {}


def load_dual(name: str) -> DualEncoder:
    """Load a dual encoder in float32.

    Args:
        name: 'embedded-dual', a file or folder that `aegis pretrain` wrote, or a CLIP model's
            folder or id on the hub.
    """
    path = locate(name)
    if path.is_dir():
        need_transformers(name)
        from aegis_cli.models.backbones import clip

        return clip.load(path)
    from aegis_cli.models.backbones.embedded_dual import load_file

    return load_file(path)[0]


def model_files(name: str) -> list[Path]:
    """The files that make up the model, none for random weights; `name` is as for `load`."""
    if shapes.of_backbone(name) is not None:
        return []
    path = locate(name)
    if path.is_file():
        return [path]
    return [
        *model_folder.weights(path),
        path / "config.json",
        *(path / part for part in model_folder.processor_files(path)),
    ]


def sha256(name: str) -> str:
    """sha256 of the model's file, or over all files of the model and processor in its folder."""
    path = locate(name)
    if path.is_file():
        return kept_digests.of_files([path], path.parent)[path]
    digest = hashlib.sha256()
    own = [*model_folder.weights(path), path / "config.json"]
    for file, of_file in kept_digests.of_files(own, path).items():
        digest.update(f"{file.name} {of_file}".encode())
    for file_name, content in model_folder.processor_files(path).items():
        digest.update(f"{file_name} {hashlib.sha256(content).hexdigest()}".encode())
    return digest.hexdigest()


def _no_backbone(name: str) -> AegisError:
    model_folder.refuse_adapter(Path(name))
    found = f"no backbone at '{name}': " + (
        "no model in it" if Path(name).exists() else "no such file or folder"
    )
    expected = (
        "'embedded', 'embedded-easy', a run's folder (it holds checkpoints/last) or a "
        "checkpoint's, a backbone's folder or file, or a hub id"
    )
    fix = f"check the path, and give it as {model_folder.GIVE}"
    if hub.is_id(name) and not _has_transformers():
        fix += "; a model on the hub needs: pip install 'aegis-vla[hf]'"
    elif hub.is_id(name) and not name.startswith(LOCAL):
        fix += f"; for a model on the hub: hf download {name} --local-dir MODEL"
    return AegisError(found, expected, fix)


def need_transformers(name: str) -> None:
    """Raise AegisError unless transformers is there to load the model of that name."""
    if not _has_transformers():
        found = f"a Hugging Face model at '{name}', and no transformers to load it"
        raise AegisError(found, "the extra 'hf'", "pip install 'aegis-vla[hf]'")


def _has_transformers() -> bool:
    return importlib.util.find_spec("transformers") is not None
