"""Augmentation of training frames, with the transformations and ranges of LeRobot.

LeRobot (`ImageTransformsConfig`) draws three of six transformations for each picture and applies
them in a fixed order. They are computed here as in torchvision's `transforms.v2.functional`, but
without torchvision: if that is installed, transformers prefers other image processors, and a model
would read other pixels than its anchor did.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from aegis_cli.data.batch import Images

_GREY = (0.2989, 0.587, 0.114)  # of red, green and blue, as Pillow has it
_DEGREES, _SHIFT = 5.0, 0.05  # the largest; the shift is a share of the side

Draw = np.random.Generator


def augmented(
    images: Images,
    frames: Sequence[int],
    names: Sequence[str],
    count: int,
    seed: int,
    step: int,
    repeats: Sequence[int] | None = None,
) -> Images:
    """The images of a batch, each changed by its own random transformations.

    The draws depend only on the seed, the step, the frame, its camera and its repeat: neither
    resuming nor the number of processes changes them.

    Args:
        images: [B, H, W, 3] uint8, or B tuples of one [H, W, 3] per camera.
        frames: their B numbers in the demonstrations.
        names: keys of `TRANSFORMATIONS` to draw from.
        count: how many of them are applied to one image; all if there are fewer.
        step: number of steps before this one.
        repeats: how often each of the B frames has already occurred in this step, as counted by
            `earlier`; None if none occurs twice.
    """

    def changed(image: Tensor, place: int, camera: int) -> Tensor:
        again = 0 if repeats is None else repeats[place]
        # Earlier versions did not distinguish repeats; the draws for a first occurrence stay the
        # same.
        key = [seed, step, frames[place], camera, *([again] if again else [])]
        return _augmented(image, names, count, np.random.default_rng(key))

    if isinstance(images, Tensor):
        return torch.stack([changed(image, place, 0) for place, image in enumerate(images)])
    found = []
    for place, several in enumerate(images):
        # Each camera has its own draw, as in LeRobot.
        found.append(tuple(changed(image, place, n) for n, image in enumerate(several)))
    return found


def earlier(frames: Sequence[int]) -> list[int]:
    """How often each frame occurs earlier in the list: a batch may be larger than the dataset."""
    seen = Counter[int]()
    found = []
    for frame in frames:
        found.append(seen[frame])
        seen[frame] += 1
    return found


def _augmented(image: Tensor, names: Sequence[str], count: int, draw: Draw) -> Tensor:
    """One image [H, W, 3] uint8; it is rounded once, after the last transformation."""
    count = min(count, len(names))
    # Sorted, because they do not commute and LeRobot applies them in a fixed order.
    drawn = sorted(draw.choice(len(names), count, replace=False).tolist())
    changed = image.permute(2, 0, 1).float() / 255
    for number in drawn:
        changed = TRANSFORMATIONS[names[number]](changed, draw)
    return (changed * 255).round().to(torch.uint8).permute(1, 2, 0).contiguous()


# --- the transformations of an image [3, H, W] in [0, 1] ------------------------------------------


def brightness(image: Tensor, factor: float) -> Tensor:
    return (image * factor).clamp(0, 1)


def contrast(image: Tensor, factor: float) -> Tensor:
    """Blend with the image's mean grey."""
    return _blend(image, _grey(image).mean(), factor)


def saturation(image: Tensor, factor: float) -> Tensor:
    """Blend with the grey image."""
    return _blend(image, _grey(image), factor)


def sharpness(image: Tensor, factor: float) -> Tensor:
    """Blend with the smoothed image, whose border pixels stay as they are."""
    if min(image.shape[1:]) <= 2:
        return image
    kernel = torch.ones(3, 3)
    kernel[1, 1] = 5
    kernel = (kernel / kernel.sum()).expand(3, 1, 3, 3)  # one for each channel
    smooth = image.clone()
    smooth[:, 1:-1, 1:-1] = F.conv2d(image[None], kernel, groups=3)[0]
    return _blend(image, smooth, factor)


def hue(image: Tensor, turn: float) -> Tensor:
    """Rotate the hue by a share of the colour circle."""
    red, green, blue = image
    high, low = image.max(0).values, image.min(0).values
    spread = high - low
    divisor = torch.where(spread == 0, 1.0, spread)  # greys have no hue; any value will do
    # The strongest colour determines in which third of the circle the hue lies.
    by_red = (green - blue) / divisor
    by_green = (blue - red) / divisor + 2
    by_blue = (red - green) / divisor + 4
    sextant = torch.where(high == red, by_red, torch.where(high == green, by_green, by_blue))
    return _from_hue((sextant / 6 + turn) % 1, high, spread)


def affine(image: Tensor, degrees: float, right: int, down: int) -> Tensor:
    """Rotate the image about its centre, then shift it by pixels; uncovered areas are black.

    Interpolation is nearest-neighbour.
    """
    _, height, width = image.shape
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    # The source of each new pixel, in pixels from the centre: the inverse of the movement.
    x = torch.arange(width) - (width - 1) / 2 - right
    y = (torch.arange(height) - (height - 1) / 2 - down)[:, None]
    # `grid_sample` expects both from -1 to 1, from one border of the image to the other.
    across, along = (cos * x + sin * y) * 2 / width, (cos * y - sin * x) * 2 / height
    source = torch.stack([across, along], -1)  # [H, W, 2]
    return F.grid_sample(image[None], source[None], "nearest", "zeros", align_corners=False)[0]


def _blend(image: Tensor, other: Tensor, factor: float) -> Tensor:
    return (factor * image + (1 - factor) * other).clamp(0, 1)


def _grey(image: Tensor) -> Tensor:
    """The grey levels [H, W] of an image [3, H, W]."""
    return torch.einsum("chw,c->hw", image, torch.tensor(_GREY))


def _from_hue(turned: Tensor, high: Tensor, spread: Tensor) -> Tensor:
    """Red, green and blue [3, H, W] of hue in [0, 1), value and value times saturation [H, W]."""
    # Smith's formula: a colour falls from `high` by `spread` over a part of the circle.
    offsets = torch.tensor([5.0, 3.0, 1.0])[:, None, None]
    place = (offsets + turned * 6) % 6
    share = torch.minimum(place, 4 - place).clamp(0, 1)
    return (high - spread * share).clamp(0, 1)


# --- what is drawn --------------------------------------------------------------------------------


def _between(
    change: Callable[[Tensor, float], Tensor], low: float, high: float
) -> Callable[[Tensor, Draw], Tensor]:
    return lambda image, draw: change(image, draw.uniform(low, high))


def _moved(image: Tensor, draw: Draw) -> Tensor:
    _, height, width = image.shape
    degrees = draw.uniform(-_DEGREES, _DEGREES)
    right = round(draw.uniform(-_SHIFT * width, _SHIFT * width))
    down = round(draw.uniform(-_SHIFT * height, _SHIFT * height))
    return affine(image, degrees, right, down)


TRANSFORMATIONS: dict[str, Callable[[Tensor, Draw], Tensor]] = {
    "brightness": _between(brightness, 0.8, 1.2),
    "contrast": _between(contrast, 0.8, 1.2),
    "saturation": _between(saturation, 0.5, 1.5),
    "hue": _between(hue, -0.05, 0.05),
    "sharpness": _between(sharpness, 0.5, 1.5),
    "affine": _moved,
}
