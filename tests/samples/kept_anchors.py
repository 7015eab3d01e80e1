"""An anchor that is interrupted on a device besides the CPU; a process finds this by its module."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

from aegis_cli.anchors import kept_work, measure
from aegis_cli.common import devices, kept_tensors
from aegis_cli.recipes import Anchor
from samples import second_device


def go_on_there(model: Path, folder: Path, settings: Anchor, memory: int, step: int) -> int:
    """Interrupt an anchor at each of some places on the stand-in, and let it go on to its bytes.

    Args:
        memory: bytes of a group of maps' sums.
        step: from one place to the next, in times at which something is kept.

    Returns:
        At how many places.
    """
    os.environ |= {devices.VARIABLE: "cpu", "AEGIS_CACHE": str(folder / "cache")}
    torch.set_num_threads(1)
    plain, out = kept_tensors.write, folder / "anchor.safetensors"
    written, last, places = 0, step, 0

    def write(path: Path, kept: kept_tensors.Kept) -> None:
        nonlocal written
        plain(path, kept)
        written += 1
        if written == last:
            raise KeyboardInterrupt

    with second_device.in_reach(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(measure._PartMeasurement, "_memory", memory)
        patch.setattr(kept_work, "_EVERY_S", 0.0)
        patch.setattr(kept_work, "_TIMES", 0)
        measure.run(str(model), settings, out, keep=False)
        whole = out.read_bytes()
        patch.setattr(kept_tensors, "write", write)
        while True:
            written = 0
            try:
                measure.run(str(model), settings, out)
            except KeyboardInterrupt:
                last = -1
                measure.run(str(model), settings, out)
                assert out.read_bytes() == whole
                places += 1
                last = (places + 1) * step
            else:
                return places
