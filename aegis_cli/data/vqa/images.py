"""Images that are decoded when they are accessed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from aegis_cli.common.errors import AegisError
from aegis_cli.common.pictures import decoded, fit


@dataclass(frozen=True, slots=True)
class Picture:
    """One image of a set.

    Attributes:
        key: identifies the image; the same for all questions about it.
        where: the file and line that name it, for errors.
        at: the path of its file, or a function that reads its bytes.
    """

    key: str
    where: str
    at: str | Path | Callable[[], bytes]

    @property
    def source(self) -> Path | Callable[[], bytes]:
        """Its file, or a function that reads its bytes."""
        return Path(self.at) if isinstance(self.at, str) else self.at


@dataclass(frozen=True)
class Pictures:
    """Images of files by number, like the array of a rendered set; decoded on access.

    Attributes:
        size: side in pixels that every image is fitted to; None: they keep their size.
    """

    pictures: Sequence[Picture]
    size: int | None = None
    _last: dict[int, np.ndarray] = field(default_factory=dict, repr=False, compare=False)

    def __len__(self) -> int:
        return len(self.pictures)

    def __getitem__(self, rows: np.ndarray | slice) -> np.ndarray | list[np.ndarray]:
        """Images of some rows, uint8: [B, size, size, 3], or a list of unscaled [H, W, 3].

        Raises:
            AegisError: an image cannot be decoded.
        """
        numbers = np.arange(len(self))[rows].tolist()
        # Only the images of the last access are kept: questions about one image are adjacent. A
        # copy, because another thread may access them at the same time.
        held = dict(self._last)
        fresh = {}
        for row in dict.fromkeys(numbers):
            fresh[row] = held[row] if row in held else decode(self.pictures[row], self.size)
        self._last.clear()
        self._last.update(fresh)
        images = [fresh[row] for row in numbers]
        return images if self.size is None else np.stack(images)

    def sized(self, size: int | None) -> Pictures:
        """The same images, fitted to another size."""
        return replace(self, size=size, _last={})


def decode(picture: Picture, size: int | None) -> np.ndarray:
    """RGB pixels [H, W, 3] uint8, upright as a viewer shows them.

    With a size the image is scaled to fit a square of that side (bilinear, with antialiasing) and
    padded with grey: nothing is cropped or distorted. An image of exactly that size stays as it is.

    Raises:
        AegisError: this is no image, or an incomplete one.
    """
    source = picture.source
    try:
        pixels = decoded(source.read_bytes() if isinstance(source, Path) else source())
    except AegisError:  # the reader's own error is more precise
        raise
    except Exception as error:  # for a damaged data set, pyarrow may raise almost anything
        raise AegisError(
            f"{picture.where}: {_name(picture)} cannot be read as an image "
            f"({error or type(error).__name__})",
            "a whole image file of a common format",
            "replace the image, or leave it out with --skip-bad",
        ) from error
    return pixels if size is None else fit(pixels, size, size)


def tensors(images: np.ndarray | Sequence[np.ndarray]) -> Tensor | list[Tensor]:
    """Images for a backbone: [B, H, W, 3] uint8, or a list of [H, W, 3] in their own sizes."""
    if isinstance(images, np.ndarray):
        return torch.from_numpy(images)
    return [torch.from_numpy(image) for image in images]


def _name(picture: Picture) -> str:
    return f"'{picture.source}'" if isinstance(picture.source, Path) else "its image"
