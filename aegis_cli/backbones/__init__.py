"""Backbones by name or path."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from aegis_cli.backbones.base import Backbone
from aegis_cli.errors import AegisError

EMBEDDED = "embedded"


def locate(name: str) -> Path:
    """The model file that `name` stands for: 'embedded', a model file, a backbone folder or a run folder."""
    if name == EMBEDDED:
        return Path(str(resources.files("aegis_cli") / "data" / "embedded.safetensors"))
    path = Path(name)
    for candidate in (path / "checkpoints" / "last" / "backbone" / "model.safetensors", path / "model.safetensors", path):
        if candidate.is_file():
            return candidate
    raise AegisError(
        f"no backbone at '{name}'", "'embedded', a run folder, or a folder or file with a model",
        "check the path; a run folder holds checkpoints/last",
    )


def load(name: str) -> Backbone:
    """Load a backbone in float32, ready to be asked or adapted."""
    from aegis_cli.backbones.embedded import load_file

    return load_file(locate(name))[0]
