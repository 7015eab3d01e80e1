"""Statistics of features as LeRobot defines them: min, max, mean, std, count and five quantiles.

Quantiles are read off a histogram of 5,000 bins; those of several episodes are merged to an
envelope, the minimum of lower and the maximum of upper quantiles. Means and deviations are computed
in float64 and about the mean, while LeRobot uses E[x^2] - E[x]^2 in the data's own dtype.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

Statistics = dict[str, np.ndarray]

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_BINS = 5000
_LEAST, _MOST, _POWER = 100, 10_000, 0.75  # pictures sampled for an episode's statistics
_LARGE, _SMALL = 300, 150  # sides in pixels; larger pictures are subsampled to about the second


def of_vectors(rows: np.ndarray) -> Statistics:
    """Statistics [D] of each column of rows [T, D]; a column [T] counts as [T, 1]."""
    columns = rows.reshape(len(rows), -1).astype(np.float64)
    figures = [_of_values(column, np.ones(len(column))) for column in columns.T]
    return _stacked(figures) | {"count": np.array([len(rows)])}


def of_images(frames: np.ndarray) -> Statistics:
    """Statistics of each colour channel [3, 1, 1] in [0, 1], from a sample of [T, H, W, 3] uint8.

    `count` is the number of sampled frames.
    """
    sample = _thinned(frames[_sample(len(frames))])
    levels = np.arange(256.0)
    figures = []
    for channel in range(3):
        # 256 levels with their frequencies represent millions of pixels.
        counts = np.bincount(sample[..., channel].ravel(), minlength=256)
        seen = counts > 0
        figures.append(_of_values(levels[seen], counts[seen].astype(np.float64)))
    stacked = {name: x.reshape(3, 1, 1) / 255 for name, x in _stacked(figures).items()}
    return stacked | {"count": np.array([len(sample)])}


def _stacked(figures: Sequence[Mapping[str, float]]) -> Statistics:
    """Each statistic of all columns as one array."""
    return {name: np.array([figure[name] for figure in figures]) for name in figures[0]}


def merge(parts: Sequence[Statistics]) -> Statistics:
    """The statistics of all parts together."""
    count = _sum(part["count"] for part in parts)
    shares = [part["count"] / count for part in parts]
    mean = _sum(share * part["mean"] for share, part in zip(shares, parts, strict=True))
    # Chan, Golub & LeVeque (1979): the variances within the parts, and that of their means.
    variance = _sum(
        s * (p["std"] ** 2 + (p["mean"] - mean) ** 2) for s, p in zip(shares, parts, strict=True)
    )
    least = np.stack([part["min"] for part in parts]).min(0)
    most = np.stack([part["max"] for part in parts]).max(0)
    merged = {"min": least, "max": most, "mean": mean, "std": np.sqrt(variance), "count": count}
    for name, share in QUANTILES.items():
        if not all(name in part for part in parts):
            continue  # version 2.1 has no quantiles
        values = np.stack([part[name] for part in parts])
        merged[name] = values.min(0) if share <= 0.5 else values.max(0)
    return merged


def _sum(figures: Iterable[np.ndarray]) -> np.ndarray:
    """The sum of at least one array."""
    first, *others = figures
    return sum(others, 0 + first)  # `sum` alone would start with the number 0, which is no array


def _of_values(values: np.ndarray, weights: np.ndarray) -> dict[str, float]:
    """Statistics of values [n] that occur `weights` [n] times."""
    total = weights.sum()
    mean = float((values * weights).sum() / total)
    std = float(np.sqrt((((values - mean) ** 2) * weights).sum() / total))
    least, most = float(values.min()), float(values.max())
    figures = {"min": least, "max": most, "mean": mean, "std": std}
    if total < 2:
        return figures | dict.fromkeys(QUANTILES, mean)
    counts, edges = np.histogram(values, _BINS, (least - 1e-10, most + 1e-10), weights=weights)
    below = counts.cumsum()
    for name, share in QUANTILES.items():
        figures[name] = _quantile(below, edges, share * total)
    return figures


def _quantile(below: np.ndarray, edges: np.ndarray, target: float) -> float:
    """The value at which the cumulative count reaches `target`.

    The values of a bin are assumed to be spread evenly over it.
    """
    i = int(np.searchsorted(below, target))
    if i == 0 or i >= len(below):
        return float(edges[0 if i == 0 else -1])
    share = (target - below[i - 1]) / (below[i] - below[i - 1])
    return float(edges[i] + share * (edges[i + 1] - edges[i]))


def _sample(length: int) -> np.ndarray:
    """The numbers of evenly spaced frames to sample."""
    count = max(min(length, _LEAST), min(int(length**_POWER), _MOST))
    return np.round(np.linspace(0, length - 1, count)).astype(int)


def _thinned(frames: np.ndarray) -> np.ndarray:
    """Subsample the pixels of frames [T, H, W, 3]; small frames stay as they are."""
    larger = max(frames.shape[1:3])
    step = 1 if larger < _LARGE else int(larger / _SMALL)
    return frames[:, ::step, ::step]
