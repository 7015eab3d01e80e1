"""A batch of robot frames, and the normalizers of a policy's inputs and outputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

# The images of B rows, [B, H, W, 3] uint8. A backbone without an `image_size` also takes B images
# [H, W, 3] of any sizes. One that `reads_several` images per row, a robot's cameras, also takes B
# sequences of them.
Images = Tensor | Sequence[Tensor] | Sequence[Sequence[Tensor]]
# Images, a question about each, and the reference answers.
Asked = tuple[Images, Sequence[str], Sequence[str]]

# A dimension that varies less than this share of its own magnitude is left unscaled: dividing by a
# tiny deviation would turn sensor noise into the largest input. The second value is an absolute
# bound for means near zero; units may be large: slow motions in metres per frame deviate by 1e-5.
_NEAR_CONSTANT, _LEAST = 1e-4, 1e-6


def least_spread(middle: Tensor) -> Tensor:
    """The deviations [D] above which dimensions with these means [D] count as varying."""
    return (_NEAR_CONSTANT * middle.abs()).clamp(min=_LEAST)


class Normalizer(nn.Module):
    """(x - mean) / std over the last dimension [..., D]; near-constant dimensions are only centred.

    A dimension that never varied has the scale 0. It is centred too, and `invert` always gives its
    mean: an action that was never demonstrated must not be predicted as noise.

    A quantile normalizer has the midpoint of the 1 % and the 99 % quantile as `mean`, and half
    their distance as `std`. So the two become -1 and 1: 2 (x - q01) / (q99 - q01) - 1, which is
    LeRobot's QUANTILES.
    """

    def __init__(self, mean: Tensor, std: Tensor) -> None:
        super().__init__()
        self.mean: Tensor
        self.std: Tensor
        self.register_buffer("mean", mean)
        self.register_buffer("std", std)

    @classmethod
    def fit(cls, rows: Tensor) -> Normalizer:
        """Normalize by mean and standard deviation of rows [N, D]."""
        middle = _by_dimension(rows, torch.mean)
        return cls.scaled(middle, deviations(rows), _by_dimension(rows, _never_varies))

    @classmethod
    def fit_quantiles(cls, rows: Tensor) -> Normalizer:
        """Map the 1 % and 99 % quantiles of rows [N, D], interpolated linearly, to -1 and 1."""
        low, high = _by_dimension(rows, _outer_quantiles).unbind(1)
        still = _by_dimension(rows, _never_varies)
        return cls.scaled((low + high) / 2, (high - low) / 2, still)

    @classmethod
    def scaled(cls, middle: Tensor, scale: Tensor, still: Tensor | None = None) -> Normalizer:
        """Map `middle` [D] to 0 and `middle + scale` [D] to 1.

        Args:
            still: [D] bool, the dimensions that are known never to vary.
        """
        varies = scale > least_spread(middle)
        std = torch.where(varies, scale, 1.0)
        if still is not None:
            std = torch.where(still, 0.0, std)
        return cls(middle.float(), std.float())

    def forward(self, x: Tensor) -> Tensor:
        """Normalised values of raw x [..., D]."""
        scale = torch.where(self.std == 0, 1.0, self.std)  # a fixed dimension is only centred
        return (x - self.mean) / scale

    def invert(self, x: Tensor) -> Tensor:
        """The raw values behind normalised x [..., D]."""
        return x * self.std + self.mean


def deviations(rows: Tensor) -> Tensor:
    """Standard deviations [D] float64 of rows [N, D]; 0 for a dimension that never varies."""
    return _by_dimension(rows, _deviation)


def _by_dimension(rows: Tensor, measure: Callable[[Tensor], Tensor]) -> Tensor:
    """Apply a function of a column [N] float64 to each column of rows [N, D], and stack.

    One column at a time: float64 copies of millions of rows would take gigabytes.
    """
    found = [measure(column.double()) for column in rows.unbind(1)]
    if not found:  # rows without dimensions, whose result has none either
        one = measure(torch.zeros(1, dtype=torch.float64, device=rows.device))
        return one.new_empty(0, *one.shape)
    return torch.stack(found)


def _deviation(column: Tensor) -> Tensor:
    """The standard deviation [] of a column [N]; 0 if it never varies.

    Two passes in float64: E[x^2] - E[x]^2 would cancel if the mean is large.
    """
    spread = (column - column.mean()).square_().mean().sqrt()
    return torch.where(_never_varies(column), 0.0, spread)


def _outer_quantiles(column: Tensor) -> Tensor:
    """The 1 % and the 99 % quantile [2] of a column [N], interpolated linearly."""
    # NumPy's, since `torch.quantile` refuses more than 2**24 numbers.
    return torch.from_numpy(np.quantile(column.numpy(), (0.01, 0.99)))


def _never_varies(column: Tensor) -> Tensor:
    """Whether a column [N] is constant except for sensor noise.

    Quantiles do not show it: for a gripper that closes in one frame of two hundred they are equal.
    """
    low, high = column.aminmax()
    return high - low <= least_spread(column.mean())


@dataclass(frozen=True)
class PreparedPass:
    """What was prepared on the CPU, ahead of a step, for one of its passes.

    Attributes:
        inputs: the backbone's inputs made from the pass's frames.
        anchor_inputs: the same for the first of them, if the anchor gradient is taken on these
            only; else None.
        by_method: the result of the method's own `prepare` for the frames, if it has one.
    """

    inputs: Any
    anchor_inputs: Any = None
    by_method: Any = None

    def to(self, device: torch.device) -> PreparedPass:
        """The same with the backbone's inputs on that device."""
        anchor_inputs = None if self.anchor_inputs is None else self.anchor_inputs.to(device)
        return PreparedPass(self.inputs.to(device), anchor_inputs, self.by_method)


@dataclass(frozen=True)
class RobotBatch:
    """Demonstration frames with the actions that follow.

    Attributes:
        images: [B, H, W, 3] uint8; with several cameras, B tuples of [H, W, 3].
        instructions: B texts.
        proprio: [B, P] float32, raw units.
        actions: [B, H, A] float32, raw units.
        is_pad: [B, H] bool; True where the chunk runs past its episode's end.
        of_step: number of frames in the step that these are a share of, and of valid (unpadded)
            actions in its chunks; None if not counted.
        prepared: one per pass of the step, in order; empty if nothing was prepared ahead.
    """

    images: Images
    instructions: Sequence[str]
    proprio: Tensor
    actions: Tensor
    is_pad: Tensor
    of_step: tuple[int, int] | None = None
    prepared: Sequence[PreparedPass] = ()

    def __len__(self) -> int:
        return len(self.instructions)

    def with_prepared_on(self, device: torch.device) -> RobotBatch:
        """The batch with its prepared inputs on that device."""
        return replace(self, prepared=[each.to(device) for each in self.prepared])

    def rows(self, chosen: slice) -> RobotBatch:
        """The frames of these rows, without `of_step` and `prepared`."""
        return RobotBatch(
            self.images[chosen],
            self.instructions[chosen],
            self.proprio[chosen],
            self.actions[chosen],
            self.is_pad[chosen],
        )


@dataclass(frozen=True)
class Share:
    """One of `count` equal, consecutive parts of a step's rows.

    Several processes share a step, and gradient accumulation divides it further: part i of a step
    that n processes take in k passes belongs to pass i // n and to process i % n.
    """

    index: int = 0
    count: int = 1

    def rows(self, size: int) -> slice:
        """Its slice of `size` rows; shares differ by at most one row."""
        return slice(size * self.index // self.count, size * (self.index + 1) // self.count)


@dataclass(frozen=True)
class WholeBatch:
    """The batch that a smaller one is a share of, which determines its noise and its mean.

    Attributes:
        frames: how many it has.
        shown: number of valid (unpadded) actions in all its chunks.
        share: the part that the smaller batch is.
    """

    frames: int
    shown: int
    share: Share = Share()
