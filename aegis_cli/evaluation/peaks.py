"""The peak number of operations per second of a GPU."""

from __future__ import annotations

import re
from dataclasses import dataclass


@dataclass(frozen=True)
class Peak:
    """The peak performance of a device.

    Attributes:
        device: the maker's name of the device.
        tflops: 10^12 operations per second of dense matrix products.
        dtype: the dtype of these products.
    """

    device: str
    tflops: float
    dtype: str


# A part of torch's name for a GPU -> dense products in bfloat16 and in float32 (without TF32, which
# Aegis does not use), from the makers' data sheets. The first match counts.
_PEAKS = {
    "B200": (2250.0, 75.0),
    "GH200": (989.0, 67.0),
    "H200": (989.0, 67.0),
    "H100 PCIe": (756.0, 51.0),
    "H100 NVL": (835.0, 60.0),
    "H100": (989.0, 67.0),
    "A100": (312.0, 19.5),
    "L40S": (362.0, 91.6),
    "L4": (121.0, 30.3),
    "A10": (125.0, 31.2),
    "RTX 4090": (165.2, 82.6),
    "RTX 3090": (71.0, 35.6),
}


def peak_of(device: str, bf16: bool) -> Peak | None:
    """The peak of a GPU of that name; None if it is not known."""
    for name, (half, single) in _PEAKS.items():
        if re.search(rf"\b{name}\b", device):
            return Peak(name, half if bf16 else single, "bfloat16" if bf16 else "float32")
    return None
