"""A camera's frames from several sets of demonstrations, one set after the other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from aegis_cli.data.fitted import FittedFrames
from aegis_cli.data.lerobot.on_demand import FramesOnDemand


class JoinedFrames:
    """Frames [N, H, W, 3] uint8 that stay in their sets until they are read.

    Several threads may read them.

    Attributes:
        parts: each set's own frames [n, H, W, 3], all of one size.
        shape: (N, H, W, 3).
    """

    def __init__(self, parts: Sequence[Tensor | FramesOnDemand | FittedFrames]) -> None:
        """Number all frames consecutively, in the order of the sets."""
        self.parts = tuple(parts)
        self._ends = np.cumsum([len(part) for part in self.parts])
        self.shape = (int(self._ends[-1]), *self.parts[0].shape[1:])

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, numbers: Tensor) -> Tensor:
        """Frames [B, H, W, 3] by their numbers [B] int64."""
        found = torch.empty((len(numbers), *self.shape[1:]), dtype=torch.uint8)
        # "right", since the end of one part is the first number of the next.
        of_part = np.searchsorted(self._ends, numbers.numpy(), side="right")
        for index in np.unique(of_part).tolist():  # each part is read once, for all of its frames
            part, own = self.parts[index], torch.from_numpy(of_part == index)
            begins_at = int(self._ends[index]) - len(part)
            found[own] = part[numbers[own] - begins_at]
        return found
