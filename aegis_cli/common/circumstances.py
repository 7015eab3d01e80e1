"""What a measurement depends on beside the model and the data, by which kept ones are found."""

from __future__ import annotations

import torch

from aegis_cli.common import devices, machine, version

_ANSWER = ("torch", "torchvision", "transformers", "tokenizers", "pillow", "numpy")
_PLAY = (*_ANSWER, "mujoco", "dm-control", "metaworld", "hf-libero", "robosuite")


def of_answers() -> dict[str, str]:
    """The code, the libraries, and what computes; another processor may round otherwise."""
    return _with(_ANSWER)


def of_episodes(renderer: str) -> dict[str, str]:
    """The same, with the simulators and what draws their pictures."""
    return {"renderer": renderer, **_with(_PLAY)}


def _with(libraries: tuple[str, ...]) -> dict[str, str]:
    device = devices.pick()
    on = torch.cuda.get_device_name(device) if device.type == "cuda" else machine.processor()
    return {"code": version.code(), "device": on, **machine.versions(libraries)}
