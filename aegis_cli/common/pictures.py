"""Decoding image files, and fitting pictures of any size to one size.

Questions, streams and robot frames share these functions.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from PIL.Image import Image

GREY = 128  # about 0 for a backbone that scales pixels to [-1, 1]
FILTER = "bilinear, as wide as the reduction, grey borders"
DECODER = "upright, on white where transparent, 16 bits of grey as 8"
# Accepted formats of a picture's bytes, whatever its name. Pillow also reads formats that are
# programs, such as PostScript, which it passes to an interpreter.
RASTER = ("PNG", "JPEG", "WEBP", "BMP", "GIF", "TIFF", "PPM", "AVIF", "JPEG2000", "TGA")


def decoded(data: bytes) -> np.ndarray:
    """RGB pixels [H, W, 3] uint8 of an image file, upright as a viewer shows them.

    Transparent pixels are composited on white, as current processors of transformers do. Those of
    5.5 show the colour stored below, so we apply the rule ourselves, whichever is installed.

    Raises:
        ValueError: it is not a raster image or truncated, has too many pixels, or is grey with an
            unknown range.
    """
    from PIL import Image, ImageOps, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            # The other warnings are about metadata; unreadable pixels raise an exception.
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=_raster()) as image:
                image.load()
                # With damaged metadata, viewers show the picture as stored.
                with contextlib.suppress(Exception):
                    ImageOps.exif_transpose(image, in_place=True)
                return rgb(image)
    except UnidentifiedImageError as error:  # its message is the address of the bytes
        raise ValueError("not in a known raster format") from error
    except Exception as error:  # damaged data makes Pillow's decoders raise nearly anything
        raise ValueError(str(error) or type(error).__name__) from error


@cache
def _raster() -> list[str]:
    """The raster formats that this build of Pillow reads."""
    from PIL import Image

    Image.init()
    return [name for name in RASTER if name in Image.OPEN]


def rgb(image: Image) -> np.ndarray:
    """Pixels [H, W, 3] uint8 of an image that Pillow has read, with transparency on white.

    Raises:
        ValueError: it is grey with an unknown range.
    """
    from PIL import Image as pillow

    if image.mode.startswith("I;16"):  # Pillow's own conversion makes everything above 255 white
        grey = (np.asarray(image) / 257).round().astype(np.uint8)  # 65535 becomes 255
        return np.repeat(grey[..., None], 3, axis=-1)
    if image.mode in ("I", "F"):
        raise ValueError(f"mode {image.mode}, whose numbers have no defined white")
    if image.has_transparency_data:
        drawn = image.convert("RGBA")
        image = pillow.alpha_composite(pillow.new("RGBA", drawn.size, "white"), drawn)
    return np.array(image.convert("RGB"))


def fit(picture: np.ndarray, height: int, width: int) -> np.ndarray:
    """The whole picture [H, W, 3] uint8, centred in [height, width, 3] with grey around it.

    Its aspect ratio is kept.

    The filter is Pillow's bilinear one, which averages over all pixels that one new pixel covers. A
    picture that already has that size is returned as it is.
    """
    if picture.shape[:2] == (height, width):
        return picture
    from PIL import Image

    scale = min(height / picture.shape[0], width / picture.shape[1])
    rows, columns = [max(1, round(side * scale)) for side in picture.shape[:2]]
    # Pillow takes the width first.
    small = Image.fromarray(picture).resize((columns, rows), Image.Resampling.BILINEAR)
    out = np.full((height, width, 3), GREY, np.uint8)
    top, left = (height - rows) // 2, (width - columns) // 2
    out[top : top + rows, left : left + columns] = np.asarray(small)
    return out
