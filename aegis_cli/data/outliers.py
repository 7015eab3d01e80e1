"""Outliers that alone determine the scale of a joint, such as a sensor's glitches."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from aegis_cli.data.batch import deviations

_FEWEST = 100  # rows; among fewer, each may be the only one of its kind
_SHARE = 1000  # one in this many rows is left out at either end
_SQUEEZED = 3  # times the deviation of the others


class Outlier(NamedTuple):
    """A dimension, and its row farthest from the median.

    Attributes:
        std: standard deviation of all values; `others` is that of the values that are not left out.
    """

    dimension: int
    row: int
    value: float
    std: float
    others: float


def outliers(rows: Tensor) -> Iterator[Outlier]:
    """Dimensions of rows [N, D] whose deviation is due to at most one value in 500.

    A joint that otherwise never moves does not count: a gripper may close as rarely.
    """
    if len(rows) < _FEWEST:
        return
    cut = max(1, len(rows) // _SHARE)
    for dimension, std in enumerate(deviations(rows).tolist()):
        column = rows[:, dimension].double().numpy()
        inner = np.partition(column, (cut, len(column) - cut - 1))[cut : len(column) - cut]
        others = float(deviations(torch.from_numpy(inner)[:, None]))
        if 0 < others * _SQUEEZED < std:
            row = int(np.abs(column - np.median(inner)).argmax())
            yield Outlier(dimension, row, float(column[row]), std, others)
