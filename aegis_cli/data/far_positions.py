"""Positions far from those of the training: a robot may report them in other units."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from aegis_cli.data.batch import Normalizer

# Scales of a normalizer beyond which a position is far. For quantiles a scale is half the distance
# between the 1 % and the 99 % quantile, which is about two standard deviations.
_FAR, _FAR_BY_QUANTILES = 10.0, 5.0
_BEYOND = 2  # times the farthest position of the training, if that was already far


def reach(rows: Tensor, scale: Normalizer, normalization: str) -> list[float] | None:
    """How far from the middle each dimension of rows [N, P] ever was, in its scale.

    Returns:
        P numbers; None if no row was far, as usual. A gripper that hardly ever closes is.
    """
    ends = torch.stack(tuple(rows.aminmax(dim=0)))  # [2, P]
    farthest = scale(ends.to(scale.mean.device)).abs().amax(0)
    return farthest.tolist() if bool((farthest > _far(normalization)).any()) else None


def _far(normalization: str) -> float:
    return _FAR_BY_QUANTILES if normalization == "quantiles" else _FAR


class FarPositions:
    """Notices positions far from those of the training, once for each of them.

    Positions in smaller units, such as radians instead of degrees, are near the mean and are not
    noticed. A position that hardly varied in training has no scale of its own: the normalizer only
    centres it, and it is far if it changes by more than its own size.
    """

    def __init__(
        self,
        scale: Normalizer,
        names: Sequence[str] | None = None,
        normalization: str = "mean_std",
        farthest: Sequence[float] | None = None,
    ) -> None:
        """Know the scales.

        Args:
            scale: of the P positions.
            names: of the positions; None if they are unknown.
            farthest: what `reach` returned for the training.
        """
        self._mean, self._std = (x.cpu().float().numpy() for x in (scale.mean, scale.std))
        self._names, self._normalization = names, normalization
        each = np.where(self._std == 0, 1.0, self._std)  # as the normalizer divides
        known = np.zeros_like(each) if farthest is None else np.asarray(farthest)
        self._limit = each * np.maximum(_far(normalization), _BEYOND * known)
        # The normalizer leaves a dimension that hardly varies unscaled.
        self._still = (self._std == 0) | (self._std == 1)
        self._limit[self._still] = np.maximum(self._limit, np.abs(self._mean))[self._still]
        self._told: set[int] = set()

    def anew(self) -> FarPositions:
        """The same for another robot: nothing is noticed yet."""
        other = copy.copy(self)
        other._told = set()
        return other

    def notice(self, positions: np.ndarray) -> str | None:
        """Describe the far ones among positions [P] or [B, P] that were not described before."""
        off = np.abs(positions - self._mean)
        rows = off.reshape(-1, len(self._mean))
        far = np.flatnonzero((rows > self._limit).any(0)).tolist()
        new = [i for i in far if i not in self._told]
        if not new:
            return None
        self._told.update(new)
        values = positions.reshape(rows.shape)
        said = [self._said(i, float(values[rows[:, i].argmax(), i])) for i in new]
        return (
            f"positions far from those of the training: {', '.join(said)}. Check that the units "
            "(degrees, radians, normalised to -100..100) and the calibration are those of the "
            "training"
        )

    def _said(self, i: int, value: float) -> str:
        name = "" if self._names is None else self._names[i]
        mean, std = float(self._mean[i]), float(self._std[i])
        known = f"training mean {mean:.4g}, standard deviation {std:.4g}"
        if self._still[i]:
            known = f"in training about {mean:.4g}"
        elif self._normalization == "quantiles":
            known = f"98 % of the training's between {mean - std:.4g} and {mean + std:.4g}"
        return f"{repr(name) if name else f'positions[{i}]'} is {value:.4g} ({known})"
