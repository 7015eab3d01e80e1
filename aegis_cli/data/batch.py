"""A batch of robot frames, and the scales of what goes into a policy and comes out of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

# Of B rows: [B, H, W, 3] uint8; to a backbone without an `image_size` also B images [H, W, 3] of
# any sizes, and to one that `reads_several` images of a row (a robot's cameras) also B sequences of
# them.
Images = Tensor | Sequence[Tensor] | Sequence[Sequence[Tensor]]

# A dimension that varies less than this share of its own magnitude (or of 1) is left unscaled:
# dividing by a deviation of almost nothing would turn sensor noise into the largest input.
NEAR_CONSTANT = 1e-4


class Normalizer(nn.Module):
    """(x - mean) / std over the last dimension; near-constant dimensions are only centred.

    By quantiles, `mean` is the middle between the 1 % and the 99 % quantile and `std` half their
    distance, which then are -1 and 1: 2 (x - q01) / (q99 - q01) - 1, LeRobot's QUANTILES.
    """

    def __init__(self, mean: Tensor, std: Tensor) -> None:
        super().__init__()
        self.mean: Tensor
        self.std: Tensor
        self.register_buffer("mean", mean)
        self.register_buffer("std", std)

    @classmethod
    def fit(cls, rows: Tensor) -> Normalizer:
        """Statistics of rows [N, D], two-pass in float64."""
        x = rows.double()
        mean = x.mean(0)
        return cls._scaled(mean, (x - mean).square().mean(0).sqrt())

    @classmethod
    def fit_quantiles(cls, rows: Tensor) -> Normalizer:
        """The 1 % and 99 % quantiles of rows [N, D], by linear interpolation, become -1 and 1."""
        low, high = torch.from_numpy(np.quantile(rows.double().numpy(), (0.01, 0.99), axis=0))
        return cls._scaled((low + high) / 2, (high - low) / 2)

    @classmethod
    def _scaled(cls, middle: Tensor, scale: Tensor) -> Normalizer:
        varies = scale > NEAR_CONSTANT * middle.abs().clamp(min=1)
        return cls(middle.float(), torch.where(varies, scale, 1.0).float())

    def forward(self, x: Tensor) -> Tensor:
        return (x - self.mean) / self.std

    def invert(self, x: Tensor) -> Tensor:
        return x * self.std + self.mean


@dataclass(frozen=True)
class RobotBatch:
    """Demonstration frames with what to do next.

    Attributes:
        images: [B, H, W, 3] uint8; of several cameras B tuples of [H, W, 3].
        instructions: B texts.
        proprio: [B, P] float32, raw units.
        actions: [B, H, A] float32, raw units.
        is_pad: [B, H] bool; True where the chunk runs past its episode's end.
    """

    images: Images
    instructions: Sequence[str]
    proprio: Tensor
    actions: Tensor
    is_pad: Tensor
