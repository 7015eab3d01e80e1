"""Images that are decoded when they are looked at."""

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
        key: what identifies it; all questions about an image have the same.
        where: for errors: the file and line that name it.
        source: its file, or what reads its bytes.
    """

    key: str
    where: str
    source: Path | Callable[[], bytes]


@dataclass(frozen=True)
class Pictures:
    """Images of files by number, like the array of a rendered set; each look decodes what is new.

    Attributes:
        size: side in pixels that every image is brought to; None leaves them as they are.
    """

    pictures: Sequence[Picture]
    size: int | None = None
    _last: dict[int, np.ndarray] = field(default_factory=dict, repr=False, compare=False)

    def __len__(self) -> int:
        return len(self.pictures)

    def __getitem__(self, rows: np.ndarray | slice) -> np.ndarray | list[np.ndarray]:
        """Images of some rows, uint8: [B, size, size, 3], or a list of [H, W, 3] as they are.

        Raises:
            AegisError: an image that cannot be decoded.
        """
        numbers = np.arange(len(self))[rows].tolist()
        # Only the last look's images are kept: questions about one image lie side by side.
        # A copy, because another thread may look at the same time.
        held = dict(self._last)
        fresh = {}
        for row in dict.fromkeys(numbers):
            fresh[row] = held[row] if row in held else decode(self.pictures[row], self.size)
        self._last.clear()
        self._last.update(fresh)
        images = [fresh[row] for row in numbers]
        return images if self.size is None else np.stack(images)

    def sized(self, size: int | None) -> Pictures:
        """The same images, each brought to another size."""
        return replace(self, size=size, _last={})


def decode(picture: Picture, size: int | None) -> np.ndarray:
    """RGB pixels [H, W, 3] uint8, upright as a viewer shows them.

    With a size the image is scaled to fit a square of that side (bilinear, over all the pixels it
    shrinks) and padded with grey: nothing is cut off or distorted. An image of that very size stays
    as it is.

    Raises:
        AegisError: what is there is no image, or only a part of one.
    """
    source = picture.source
    try:
        pixels = decoded(source.read_bytes() if isinstance(source, Path) else source())
    except AegisError:  # the reader knows better what is wrong
        raise
    except Exception as error:  # a damaged data set makes pyarrow raise nearly anything
        raise AegisError(
            f"{picture.where}: {_name(picture)} cannot be read as an image "
            f"({error or type(error).__name__})",
            "a whole image file of a common format",
            "replace the image, or leave it out with --skip-bad",
        ) from error
    return pixels if size is None else fit(pixels, size, size)


def tensors(images: np.ndarray | Sequence[np.ndarray]) -> Tensor | list[Tensor]:
    """Images as a backbone takes them: [B, H, W, 3] uint8, or a list of [H, W, 3] as they are."""
    if isinstance(images, np.ndarray):
        return torch.from_numpy(images)
    return [torch.from_numpy(image) for image in images]


def _name(picture: Picture) -> str:
    return f"'{picture.source}'" if isinstance(picture.source, Path) else "its image"
