"""scikit-learn's digits: 1,797 real handwritten digits of 8 x 8 pixels, from UCI's data."""

from __future__ import annotations

from functools import cache

import numpy as np

from aegis_cli.common.errors import AegisError
from aegis_cli.data.streams.names import SIZE

_LEVELS = 16  # the largest pixel value in the data


@cache
def digits() -> tuple[np.ndarray, np.ndarray]:
    """Pictures [1797, S, S, 3] uint8, light on dark, and their digits [1797] int64.

    Raises:
        AegisError: scikit-learn is not installed.
    """
    try:
        from sklearn.datasets import load_digits
        from sklearn.utils import Bunch
    except ImportError:
        found = "no scikit-learn, which brings the stream's real digits"
        raise AegisError(found, "scikit-learn >= 1.4", "pip install 'aegis-vla[streams]'") from None
    found = load_digits()
    assert isinstance(found, Bunch)
    pictures = np.stack([_enlarged(small) for small in found.images])
    return pictures, found.target.astype(np.int64)


def _enlarged(small: np.ndarray) -> np.ndarray:
    """[8, 8] of 0 to 16 -> [S, S, 3] uint8, bilinear."""
    from PIL import Image

    grey = Image.fromarray(np.rint(small * 255 / _LEVELS).astype(np.uint8))
    large = np.asarray(grey.resize((SIZE, SIZE), Image.Resampling.BILINEAR))
    return np.repeat(large[..., None], 3, axis=-1)
