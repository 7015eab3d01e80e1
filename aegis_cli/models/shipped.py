"""The models that come with the package, by name."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

EMBEDDED, EMBEDDED_EASY, EMBEDDED_DUAL = "embedded", "embedded-easy", "embedded-dual"
FILES = {
    EMBEDDED: "embedded.safetensors",
    EMBEDDED_EASY: "embedded-easy.safetensors",
    EMBEDDED_DUAL: "dual.safetensors",
}


def locate(name: str) -> Path:
    """The file of one of `FILES`."""
    return Path(str(resources.files("aegis_cli") / "weights" / FILES[name]))
