"""Our transformations of frames beside torchvision's, which LeRobot comes with."""

from __future__ import annotations

import torch
from torch import Tensor
from torchvision.transforms import InterpolationMode
from torchvision.transforms.v2 import functional as theirs

from aegis_cli.data import augment as ours

CLOSE = 1e-5  # of values in [0, 1]
SIZES = ((17, 23), (96, 96), (64, 48))


def differences(images: int = 50, seed: int = 0) -> dict[str, float]:
    """The largest difference of each transformation, over random images of several sizes."""
    draw = torch.Generator().manual_seed(seed)
    worst: dict[str, float] = {}
    for height, width in SIZES:
        for _ in range(images):
            image = torch.rand((3, height, width), generator=draw)
            for name, (own, other) in _both(image, draw).items():
                found = float((own - other).abs().max())
                worst[name] = max(worst.get(name, 0.0), found)
    return worst


def _both(image: Tensor, draw: torch.Generator) -> dict[str, tuple[Tensor, Tensor]]:
    """Each transformation as we compute it, and as torchvision does."""
    factor = 0.5 + _uniform(draw)
    turn = 0.1 * _uniform(draw) - 0.05
    degrees = 10 * _uniform(draw) - 5
    right, down = (int(torch.randint(-4, 5, (), generator=draw)) for _ in range(2))
    moved = theirs.affine(
        image, degrees, [right, down], 1.0, [0.0, 0.0], interpolation=InterpolationMode.NEAREST
    )
    return {
        "brightness": (ours.brightness(image, factor), theirs.adjust_brightness(image, factor)),
        "contrast": (ours.contrast(image, factor), theirs.adjust_contrast(image, factor)),
        "saturation": (ours.saturation(image, factor), theirs.adjust_saturation(image, factor)),
        "hue": (ours.hue(image, turn), theirs.adjust_hue(image, turn)),
        "sharpness": (ours.sharpness(image, factor), theirs.adjust_sharpness(image, factor)),
        "affine": (ours.affine(image, degrees, right, down), moved),
    }


def _uniform(draw: torch.Generator) -> float:
    return float(torch.rand((), generator=draw))
