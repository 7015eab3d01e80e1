"""A camera's frames that stay in their videos until they are read."""

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
    """Frames [N, H, W, 3] uint8 that are decoded when they are read; nothing is written.

    They equal those of `frames.load`, which caches them on disk. Several threads may read them.

    Attributes:
        shape: (N, H, W, 3).
    """

    def __init__(self, parts: Sequence[VideoPart], count: int, side: int | None) -> None:
        """Determine the frames' size: `side` in pixels, or that of the decoded first frame.

        Args:
            parts: the frames that may be read, in ascending order.
            count: N, including frames that are in no part.
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
            AegisError: a video is missing or damaged.
        """
        _, height, width, _ = self.shape
        fitted = np.empty((len(numbers), height, width, 3), np.uint8)
        for row, number in zip(fitted, numbers.tolist(), strict=True):
            row[:] = fitting.fit(self._decoded(number), height, width)
        return torch.from_numpy(fitted)

    def _decoded(self, number: int) -> np.ndarray:
        # The last part that starts at or before this frame.
        part = self._parts[bisect_right(self._begin_at, number) - 1]
        time = part.times[number - part.first_frame]
        return self._readers.own.frame(part.path, time, part.tolerance)


class _Readers(threading.local):
    """One reader per thread, since a reader is not thread-safe.

    Python calls `__init__` again in each thread.
    """

    def __init__(self) -> None:
        self.own = video.Reader()
