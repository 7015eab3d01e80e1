"""Labels beside the marks of a plot, placed so that they hide as little as possible."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from aegis_cli.cli.render.plots import literal

_REACHES = (7, 13, 20, 30, 42)  # pixels (at 100 dpi) from the mark to the label's nearest side
_ANGLES = 16
_LEADER = 18  # from this distance on, a thin line connects the label and its mark


class Label(NamedTuple):
    """Text for a mark at (x, y) in the axis's data; `size` in points."""

    x: float
    y: float
    text: str
    color: str
    size: float
    bold: bool


class Box(NamedTuple):
    """The left, lower, right and upper side in pixels."""

    left: float
    low: float
    right: float
    high: float

    def overlap(self, other: Box) -> float:
        """The area of the intersection."""
        width = min(self.right, other.right) - max(self.left, other.left)
        height = min(self.high, other.high) - max(self.low, other.low)
        return max(0.0, width) * max(0.0, height)

    def holds(self, x: float, y: float) -> bool:
        """Whether a point is inside, or at most 3 pixels away."""
        return self.left - 3 < x < self.right + 3 and self.low - 3 < y < self.high + 3


def place(axis: Any, labels: Sequence[Label], taken: Sequence[tuple[float, float]]) -> None:
    """Write each label near its mark, in the given order, at the place with the lowest cost.

    A place costs for every label that it overlaps, for every point of `taken` (in data coordinates)
    that it covers, for leaving the axes, and for its distance.
    """
    from matplotlib.patheffects import withStroke

    # In pixels from here on, because labels have sizes in pixels and log scales are not linear.
    points = [tuple(axis.transData.transform(spot)) for spot in taken]
    frame, written = Box(*axis.bbox.extents), _written(axis)
    for label in labels:
        text = axis.text(
            label.x,
            label.y,
            literal(label.text),
            color=label.color,
            fontsize=label.size,
            fontweight="bold" if label.bold else "normal",
            ha="left",
            va="bottom",
            zorder=8,
        )
        text.set_in_layout(False)  # otherwise the layout would make room and move everything
        text.set_path_effects([withStroke(linewidth=2, foreground="white")])
        extent = text.get_window_extent()
        mark = tuple(axis.transData.transform((label.x, label.y)))
        reach, box = min(
            _places(mark, extent.width, extent.height),
            key=lambda place: _cost(*place, written, points, frame),
        )
        text.set_position(axis.transData.inverted().transform((box.left, box.low)))
        written.append(box)
        if reach >= _LEADER:
            _lead(axis, mark, box, label.color)


def _written(axis: Any) -> list[Box]:
    """The boxes of text that is already on the axes."""
    return [Box(*text.get_window_extent().extents) for text in axis.texts]


def _places(mark: tuple[float, float], width: float, height: float) -> Iterator[tuple[float, Box]]:
    """Boxes of that size around a mark, each with its distance."""
    for reach in _REACHES:
        for k in range(_ANGLES):
            angle = 2 * math.pi * k / _ANGLES
            # The box's centre is on an ellipse that grows with the box.
            x = mark[0] + math.cos(angle) * (reach + width / 2) - width / 2
            y = mark[1] + math.sin(angle) * (reach + height / 2) - height / 2
            yield reach, Box(x, y, x + width, y + height)


def _cost(
    reach: float,
    box: Box,
    written: Sequence[Box],
    points: Sequence[tuple[float, float]],
    frame: Box,
) -> float:
    """The cost of a place, in the unit of its distance in pixels."""
    area = (box.right - box.left) * (box.high - box.low)
    overlaps = [box.overlap(other) / area for other in written]
    covered = sum(box.holds(*point) for point in points)
    outside = 1 - box.overlap(frame) / area
    # Even for a small overlap, a place one step farther away is better.
    hidden = sum(60 * share + 15 for share in overlaps if share > 0)
    return hidden + 10 * covered + 200 * outside + reach


def _lead(axis: Any, mark: tuple[float, float], box: Box, color: str) -> None:
    """A thin line from a mark to the nearest point of its label."""
    from matplotlib.lines import Line2D

    x = min(max(mark[0], box.left), box.right)
    y = min(max(mark[1], box.low), box.high)
    ends = axis.transData.inverted().transform([mark, (x, y)])
    axis.add_artist(Line2D(*ends.T, color=color, linewidth=0.6, alpha=0.7, zorder=1.5))
