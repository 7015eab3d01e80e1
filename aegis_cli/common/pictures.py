"""Pictures out of image files, and pictures of any size brought to one size.

Questions, streams and robot frames share them.
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

GREY = 128  # what a backbone that scales pixels to [-1, 1] reads as nothing
FILTER = "bilinear, as wide as the reduction, grey borders"
DECODER = "upright, on white where transparent, 16 bits of grey as 8"
# What a picture's bytes may be, whatever its name says. Pillow knows others that are programs, such
# as PostScript, which it has another program run.
RASTER = ("PNG", "JPEG", "WEBP", "BMP", "GIF", "TIFF", "PPM", "AVIF", "JPEG2000", "TGA")


def decoded(data: bytes) -> np.ndarray:
    """RGB pixels [H, W, 3] uint8 of an image file, upright as a viewer shows them.

    What is transparent lies on white, as today's processors of transformers have it; those of 5.5
    show what colour there is below, so that the rule is ours, whichever is installed.

    Raises:
        ValueError: no raster image or only a part of one, too many pixels, or grey of no known
            range.
    """
    from PIL import Image, ImageOps, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            # They are about metadata; what makes pixels unreadable is raised.
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=_raster()) as image:
                image.load()
                # With damaged metadata, viewers show the picture as it lies.
                with contextlib.suppress(Exception):
                    ImageOps.exif_transpose(image, in_place=True)
                return rgb(image)
    except UnidentifiedImageError as error:  # whose text is where the bytes lay
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
    """Pixels [H, W, 3] uint8 of an image that Pillow has read; what is transparent lies on white.

    Raises:
        ValueError: grey of no known range.
    """
    from PIL import Image as pillow

    if image.mode.startswith("I;16"):  # where Pillow's own conversion makes all above 255 white
        grey = (np.asarray(image) / 257).round().astype(np.uint8)  # 65535 becomes 255
        return np.repeat(grey[..., None], 3, axis=-1)
    if image.mode in ("I", "F"):
        raise ValueError(f"mode {image.mode}, whose numbers have no defined white")
    if image.has_transparency_data:
        drawn = image.convert("RGBA")
        image = pillow.alpha_composite(pillow.new("RGBA", drawn.size, "white"), drawn)
    return np.array(image.convert("RGB"))


def fit(picture: np.ndarray, height: int, width: int) -> np.ndarray:
    """The whole picture [H, W, 3] uint8 in the middle of [height, width, 3], grey around it.

    The ratio of its sides is kept.

    The filter is Pillow's bilinear one, which averages over as many pixels as one new pixel covers;
    a picture of that size already comes back as it is.
    """
    if picture.shape[:2] == (height, width):
        return picture
    from PIL import Image

    scale = min(height / picture.shape[0], width / picture.shape[1])
    rows, columns = [max(1, round(side * scale)) for side in picture.shape[:2]]
    # Pillow has the width first.
    small = Image.fromarray(picture).resize((columns, rows), Image.Resampling.BILINEAR)
    out = np.full((height, width, 3), GREY, np.uint8)
    top, left = (height - rows) // 2, (width - columns) // 2
    out[top : top + rows, left : left + columns] = np.asarray(small)
    return out
