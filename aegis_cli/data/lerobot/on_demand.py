"""A camera's frames that stay in their videos until somebody asks for them."""

from __future__ import annotations

import threading
from bisect import bisect_right
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from aegis_cli.common import pictures as fitting
from aegis_cli.data.lerobot import video
from aegis_cli.data.lerobot.frames import VideoPart


class FramesOnDemand:
    """Frames [N, H, W, 3] uint8 that are decoded as they are asked for; nothing is written.

    They are those of `frames.load`, which keeps them on the disk. Several threads may ask.

    Attributes:
        shape: (N, H, W, 3).
    """

    def __init__(self, parts: Sequence[VideoPart], count: int, side: int | None) -> None:
        """Decode the first frame, which tells their size unless `side` does, in pixels.

        Args:
            parts: the frames that may be asked for, rising.
            count: N, how many there are with those that are in no part.
        """
        self._parts = parts
        self._begin_at = [part.first_frame for part in parts]
        self._readers = _Readers()
        first = parts[0].first_frame
        height, width = (side, side) if side is not None else self._decoded(first).shape[:2]
        self.shape = (count, height, width, 3)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, numbers: Tensor) -> Tensor:
        """Frames [B, H, W, 3] by their numbers [B] int64.

        Raises:
            AegisError: a video that is missing or damaged.
        """
        _, height, width, _ = self.shape
        fitted = np.empty((len(numbers), height, width, 3), np.uint8)
        for row, number in zip(fitted, numbers.tolist(), strict=True):
            row[:] = fitting.fit(self._decoded(number), height, width)
        return torch.from_numpy(fitted)

    def _decoded(self, number: int) -> np.ndarray:
        # Of the parts that begin at this frame or before it, the last.
        part = self._parts[bisect_right(self._begin_at, number) - 1]
        time = part.times[number - part.first_frame]
        return self._readers.own.frame(part.path, time, part.tolerance)


class _Readers(threading.local):
    """A reader of each thread's own, since none is for several at once.

    Python calls `__init__` anew in each thread that asks.
    """

    def __init__(self) -> None:
        self.own = video.Reader()
