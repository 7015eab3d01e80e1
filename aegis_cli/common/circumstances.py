"""What a measurement depends on besides model and data; saved measurements are found by it."""

from __future__ import annotations

import torch

from aegis_cli.common import devices, machine, version

_ANSWER = ("torch", "torchvision", "transformers", "tokenizers", "pillow", "numpy")
_PLAY = (*_ANSWER, "mujoco", "dm-control", "metaworld", "hf-libero", "robosuite")


def of_answers() -> dict[str, str]:
    """The code, the libraries and the device; another processor may round differently."""
    return _with(_ANSWER)


def of_episodes(renderer: str) -> dict[str, str]:
    """The same, with the simulators and their renderer."""
    return {"renderer": renderer, **_with(_PLAY)}


def _with(libraries: tuple[str, ...]) -> dict[str, str]:
    device = devices.pick()
    on = torch.cuda.get_device_name(device) if device.type == "cuda" else machine.processor()
    return {"code": version.code(), "device": on, **machine.versions(libraries)}
