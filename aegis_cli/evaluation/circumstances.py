"""What a measurement depends on beside the model and the data, by which kept ones are found."""

from __future__ import annotations

import importlib.metadata

import torch

from aegis_cli.common import devices, version

_LIBRARIES = (
    "torch",
    "transformers",
    "tokenizers",
    "pillow",
    "numpy",
    "mujoco",
    "dm-control",
    "metaworld",
)


def found() -> dict[str, str]:
    """The code, the libraries, and the kind of device that computes."""
    device = devices.pick()
    on = torch.cuda.get_device_name(device) if device.type == "cuda" else device.type
    return {"code": version.code(), "device": on} | {name: _version(name) for name in _LIBRARIES}


def _version(library: str) -> str:
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
