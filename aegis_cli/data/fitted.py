"""A camera's frames in another size than they were recorded with."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from aegis_cli.common import pictures
from aegis_cli.data.lerobot.on_demand import FramesOnDemand

if TYPE_CHECKING:
    from aegis_cli.data.joined_frames import JoinedFrames


class FittedFrames:
    """Frames [N, H, W, 3] uint8 that are resized when they are read.

    Attributes:
        frames: as they were recorded.
        shape: (N, H, W, 3).
    """

    def __init__(
        self, frames: Tensor | FramesOnDemand | FittedFrames | JoinedFrames, size: tuple[int, int]
    ) -> None:
        """Take the frames of one camera, of any size, and the (height, width) to fit them to."""
        self.frames = frames
        self.shape = (len(frames), *size, 3)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, numbers: Tensor) -> Tensor:
        """Frames [B, H, W, 3] by their numbers [B] int64."""
        _, height, width, _ = self.shape
        found = np.empty((len(numbers), height, width, 3), np.uint8)
        for row, frame in zip(found, self.frames[numbers], strict=True):  # views of `found`
            row[:] = pictures.fit(frame.numpy(), height, width)
        return torch.from_numpy(found)
