"""Charts as inline SVG: pure functions of their data, without a plotting library.

Colours come from the page's style sheet, so charts adapt to light and dark mode.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from aegis_cli.cli.page.html import Markup, element

WIDTH, HEIGHT = 460, 260  # of a chart, in its own units
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 14, 14, 40
_TURNED, _DIGIT = 30, 7.5  # width of a rotated label at the left, and of a digit of a tick
_NAME_LETTER = 7.4  # assumed width of a letter of a mark's name, since the font is unknown
_ALL = 100  # percent
COLORS = 8  # classes c0 to c7 of the style sheet
Point = tuple[float, float]


# --- scales ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scale:
    """Maps values to positions from `start` to `end`, linearly or by their logarithm.

    `whole` values, such as steps and layers, have no ticks between them.
    """

    low: float
    high: float
    start: float
    end: float
    log: bool = False
    whole: bool = False

    def __call__(self, value: float) -> float:
        low, high = self.low, self.high
        at = min(max(value, low), high)  # values outside are drawn at the edge
        if self.log:
            low, high, at = math.log(low), math.log(high), math.log(at)
        share = (at - low) / (high - low)
        # `start` may be larger than `end`, as for a vertical axis: y grows downwards in SVG.
        return self.start + (self.end - self.start) * share

    def ticks(self) -> list[float]:
        """Round values between the ends: powers of ten, or about five equal steps."""
        if self.log and self.high > 10 * self.low:
            first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
            # Over one or two decades, powers of ten alone would give only one or two ticks.
            steps = (1, 2, 5) if last - first <= 2 else (1,)
            found = [s * 10.0**power for power in range(first, last + 1) for s in steps]
        else:
            step = round_step((self.high - self.low) / 5)
            if self.whole:
                step = max(step, 1)
            # With some tolerance, so that an end that is a multiple of the step keeps its tick.
            first = math.ceil(self.low / step - 1e-9)
            count = math.floor(self.high / step + 1e-9) - first + 1
            found = [round((first + k) * step, 12) for k in range(count)]  # 0.3, not 0.30000000004
        return [value for value in found if self.low * (1 - 1e-9) <= value <= self.high] or found


def round_step(least: float) -> float:
    """The smallest of 1, 2, 5, 10, ... times a power of ten that is not below `least`."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(size * power for size in (1, 2, 5, 10) if size * power >= least * (1 - 1e-9))


def from_first_to_last(values: Sequence[float], start: float, end: float) -> Scale:
    """A scale without margins; a single value is in its middle."""
    low, high = min(values), max(values)
    if low == high:
        low, high = low - 1, high + 1
    return Scale(low, high, start, end, whole=all(float(value).is_integer() for value in values))


def spanning(values: Sequence[float], start: float, end: float, log: bool = False) -> Scale:
    """A scale of all values with small margins, also around a single value."""
    low, high = min(values), max(values)
    if log:
        return Scale(low / 1.15, high * 1.15, start, end, log=True)
    if low == high:
        low, high = low - max(abs(low), 1) * 0.1, high + max(abs(high), 1) * 0.1
    room = 0.05 * (high - low)
    # If no value is negative, the lower margin does not extend below 0.
    below = 0.0 if low >= 0 and low - room < 0 else low - room
    return Scale(below, high + room, start, end)


def label(value: float) -> str:
    """A tick's number, short."""
    if value and (abs(value) >= 1e5 or abs(value) < 1e-3):
        digits, power = f"{value:.2e}".split("e")
        return f"{float(digits):g}e{int(power)}"
    return f"{value:g}"


# --- pieces ---------------------------------------------------------------------------------------


def svg(*children: Markup, width: float = WIDTH, height: float = HEIGHT, name: str) -> Markup:
    """A chart that fills the available width; screen readers read `name`."""
    return element(
        "svg",
        *children,
        viewBox=f"0 0 {width:g} {height:g}",
        role="img",
        aria_label=name,
        class_="chart",
    )


def text(x: float, y: float, said: str, anchor: str = "middle", **attributes: str) -> Markup:
    place = {"x": f"{x:.1f}", "y": f"{y:.1f}", "text_anchor": anchor}
    return element("text", said, **place, **attributes)


def line(x1: float, y1: float, x2: float, y2: float, class_: str) -> Markup:
    ends = {"x1": f"{x1:.1f}", "y1": f"{y1:.1f}", "x2": f"{x2:.1f}", "y2": f"{y2:.1f}"}
    return element("line", **ends, class_=class_)


def rectangle(
    x: float, y: float, width: float, height: float, *inside: Markup, **look: str
) -> Markup:
    place = {"x": x, "y": y, "width": width, "height": height}
    return element("rect", *inside, **{k: f"{v:.1f}" for k, v in place.items()}, **look)


def color(number: int) -> str:
    """The class of the n-th series; negative numbers stand for series that share grey."""
    return "rest" if number < 0 else f"c{number % COLORS}"


def _axes(x: Scale, y: Scale, x_label: str, y_label: str) -> list[Markup]:
    """Grid lines, ticks and the labels of both axes."""
    bottom = y.start
    drawn = []
    for value in y.ticks():
        drawn.append(line(x.start, y(value), x.end, y(value), "grid"))
        # SVG positions text by its baseline; a few units lower it is centred on the grid line.
        drawn.append(text(x.start - 6, y(value) + 4, label(value), "end", class_="tick"))
    for value in x.ticks():
        drawn.append(text(x(value), bottom + 16, label(value), class_="tick"))
    drawn.append(line(x.start, bottom, x.end, bottom, "axis"))
    drawn.append(text((x.start + x.end) / 2, bottom + 33, x_label, class_="label"))
    drawn.append(_turned(y, y_label))
    return drawn


def _turned(y: Scale, label: str) -> Markup:
    """The rotated label of a vertical axis along the left edge, read from bottom to top."""
    middle = (y.start + y.end) / 2
    look = {"transform": f"rotate(-90 12 {middle:.1f})", "class_": "label"}
    return text(12, middle, label, **look)


# --- charts ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Series:
    """A named line; `number` selects its colour, `marks` whether its points have marks."""

    name: str
    points: Sequence[Point]
    number: int = 0
    marks: bool = False
    dashed: bool = False


def lines(
    series: Sequence[Series], x_label: str, y_label: str, name: str, log: bool = False
) -> Markup:
    """Lines over common axes, of which the vertical one may be logarithmic."""
    drawn = [s for s in series if s.points]
    points = [point for s in drawn for point in s.points]
    log = log and all(y > 0 for _, y in points)  # 0 cannot be drawn on a logarithmic axis
    y = spanning([value for _, value in points], HEIGHT - _BOTTOM, _TOP, log)
    # Long tick numbers push the axis to the right, away from its label.
    longest = max(len(label(value)) for value in y.ticks())
    left = max(_LEFT, _TURNED + _DIGIT * longest)
    x = from_first_to_last([value for value, _ in points], left, WIDTH - _RIGHT)
    return svg(
        *_axes(x, y, x_label, y_label),
        *(_series(s, x, y) for s in drawn),
        name=name,
    )


def _series(series: Series, x: Scale, y: Scale) -> Markup:
    places = [(x(a), y(b)) for a, b in series.points]
    path = " ".join(f"{a:.1f},{b:.1f}" for a, b in places)
    look = f"line {color(series.number)}" + (" dashed" if series.dashed else "")
    parts = [element("polyline", points=path, class_=look)]
    if series.marks:
        for (a, b), (at, value) in zip(places, series.points, strict=True):
            title = element("title", f"{series.name}: {label(at)}, {value:.4g}")
            where = {"cx": f"{a:.1f}", "cy": f"{b:.1f}", "r": "3"}
            parts.append(element("circle", title, **where, class_=f"mark {color(series.number)}"))
    return element("g", *parts)


def legend(names: Sequence[tuple[str, int]]) -> Markup:
    """Names with their colours, as HTML so that they can wrap."""
    items = [element("li", element("i", class_=color(number)), said) for said, number in names]
    return element("ul", *items, class_="legend")


@dataclass(frozen=True)
class Spot:
    """A named mark with the intervals of both its values, if they are known."""

    name: str
    x: float
    y: float
    x_interval: Point | None = None
    y_interval: Point | None = None
    number: int = 0
    small: bool = False
    filled: bool = True


def frontier(
    spots: Sequence[Spot],
    curves: Sequence[Series],
    x_label: str,
    y_label: str,
    name: str,
    turned: bool = False,
) -> Markup:
    """VQA points lost over success; the upper right is best.

    The vertical axis is inverted, so that up is better. Beyond one point it is logarithmic, since
    the methods that keep most are within a few points of each other and the others lose dozens.

    Args:
        turned: whether the horizontal axis is inverted as well, because it shows errors.
    """
    width, height, line_y = 760, 430, 46
    spots = [replace(spot, x_interval=_possible(spot)) for spot in spots]
    values = [value for s in spots for value in (s.y, *(s.y_interval or ()))]
    lost = [symlog(value) for value in [*values, 0.0]]  # the line of no loss is always shown
    across = [value for s in spots for value in (s.x, *(s.x_interval or ()))]
    room = max(0.02 if turned else 2.0, 0.06 * (max(across) - min(across)))
    left, right = _LEFT, width - 24
    start, end = (right, left) if turned else (left, right)
    x = Scale(max(min(across) - room, 0), max(across) + room, start, end)
    y = Scale(min(lost) - 0.15, max(lost) + 0.15, 20, height - line_y)  # of `symlog` values
    drawn = []
    ticks = [t for t in (0, 0.5, 1, 2, 5, 10, 20, 50, 100) if y.low <= symlog(t) <= y.high]
    for value in ticks:
        at = y(symlog(value))
        drawn.append(line(left, at, right, at, "grid" if value else "zero"))
        drawn.append(text(left - 6, at + 4, label(value), "end", class_="tick"))
    for value in x.ticks():
        if value <= max(*across, _ALL):  # the margin at the right is beyond 100 %
            drawn.append(text(x(value), y.end + 18, label(value), class_="tick"))
    drawn.append(line(left, y.end, right, y.end, "axis"))
    drawn.append(text((left + right) / 2, height - 8, x_label, class_="label"))
    drawn.append(_turned(y, y_label))
    for curve in curves:
        bent = Series(curve.name, [(a, symlog(b)) for a, b in curve.points], curve.number)
        drawn.append(element("g", _series(bent, x, y), class_="tried"))
    drawn += [_spot(spot, x, y) for spot in spots]
    # There are too many small marks to label; they have names only in their tooltips.
    drawn += _names([s for s in spots if not s.small], x, y)
    return svg(*drawn, width=width, height=height, name=name)


def _possible(spot: Spot) -> Point | None:
    """The interval of a success clipped at 100 %, which Student's t may exceed.

    A return is a share of the expert's return and may exceed it.
    """
    if spot.x_interval is None or spot.x > _ALL:
        return spot.x_interval
    low, high = spot.x_interval
    return max(low, 0), min(high, _ALL)


def symlog(value: float) -> float:
    """Linear up to 1, logarithmic beyond; symmetric for negative values."""
    size = abs(value)
    bent = size if size <= 1 else 1 + math.log10(size) * 1.4  # both are 1 at size 1
    return math.copysign(bent, value)


def _spot(spot: Spot, x: Scale, y: Scale) -> Markup:
    at, down = x(spot.x), y(symlog(spot.y))
    look = color(spot.number)
    parts = [element("title", f"{spot.name}: {spot.x:.4g}, lost {spot.y:.4g}")]
    if spot.x_interval is not None:
        parts.append(line(x(spot.x_interval[0]), down, x(spot.x_interval[1]), down, f"bar {look}"))
    if spot.y_interval is not None:
        low, high = (y(symlog(end)) for end in spot.y_interval)
        parts.append(line(at, low, at, high, f"bar {look}"))
    place = {"cx": f"{at:.1f}", "cy": f"{down:.1f}", "r": "3" if spot.small else "6"}
    inside = "mark" if spot.filled else "mark open"
    parts.append(element("circle", **place, class_=f"{inside} {look}"))
    return element("g", *parts)


def _names(spots: Sequence[Spot], x: Scale, y: Scale) -> list[Markup]:
    """Each name beside its mark, moved so that it covers no other name, mark or interval."""
    taken = [box for spot in spots for box in _drawn(spot, x, y)]
    drawn = []
    first, last = sorted((x.start, x.end))  # an axis of errors is inverted
    for spot in spots:
        at, down, wide = x(spot.x), y(symlog(spot.y)), _NAME_LETTER * len(spot.name)
        # Places (left, middle), nearest first: to the right and the left, above and below.
        tries = []
        for shift in (0, -15, 15, -30, 30, -45, 45, -60, 60, -75, 75):
            tries.append((at + 11, down + shift))
            tries.append((at - 11 - wide, down + shift))
        inside = [t for t in tries if t[0] >= first and t[0] + wide <= last + 24]
        free = (t for t in inside if not any(_touch(_box(t, wide), other) for other in taken))
        left, middle = next(free, tries[0])
        taken.append(_box((left, middle), wide))
        look = f"name {color(spot.number)}"
        drawn.append(text(left, middle + 4, spot.name, "start", class_=look))
    return drawn


def _drawn(spot: Spot, x: Scale, y: Scale) -> list[tuple[float, float, float, float]]:
    """The boxes (left, top, right, bottom) of a mark and of each of its intervals."""
    at, down = x(spot.x), y(symlog(spot.y))
    found = [(at - 7, down - 7, at + 7, down + 7)]
    if spot.x_interval is not None:
        left, right = sorted(map(x, spot.x_interval))
        found.append((left, down - 1, right, down + 1))
    if spot.y_interval is not None:
        top, bottom = sorted(y(symlog(end)) for end in spot.y_interval)
        found.append((at - 1, top, at + 1, bottom))
    return found


def _box(place: Point, wide: float) -> tuple[float, float, float, float]:
    return place[0], place[1] - 7, place[0] + wide, place[1] + 7


def _touch(a: Sequence[float], b: Sequence[float]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


@dataclass(frozen=True)
class Row:
    """A row of a heat map: its name, a value for each column, and a text at its end."""

    name: str
    values: Sequence[float | None]
    end: str = ""


@dataclass(frozen=True)
class HeatMap:
    """A heat map over steps or tasks.

    Attributes:
        columns: the columns' names in tooltips.
        edges: (column, label) of the ticks below.
        shade: value -> depth of the colour in [0, 1].
        say: value -> text of the tooltip.
        write: whether cells show their values.
    """

    rows: Sequence[Row]
    columns: Sequence[str]
    edges: Sequence[tuple[float, str]]
    x_label: str
    shade: Callable[[float], float]
    say: Callable[[float], str]
    write: bool = False


def heat(chart: HeatMap, name: str) -> Markup:
    """Rows of cells, the first on top; a cell without a value is left blank."""
    tall = 22 if chart.write else 15
    # Names and means are beside the cells and take about 7 units per letter.
    left = 16 + 7.0 * max(len(row.name) for row in chart.rows)
    end = 10 + 7.0 * max(len(row.end) for row in chart.rows)
    width = 760.0
    wide = (width - left - end) / max(len(chart.columns), 1)
    drawn = []
    for number, row in enumerate(chart.rows):
        y = 6 + number * tall
        drawn.append(text(left - 6, y + tall / 2 + 4, row.name, "end", class_="tick"))
        for column, value in enumerate(row.values):
            if value is None:
                continue
            said = element("title", f"{row.name}, {chart.columns[column]}: {chart.say(value)}")
            depth = f"{min(max(chart.shade(value), 0), 1):.3f}"
            x = left + column * wide
            gap = 1 if chart.write else 0  # no gaps between thin columns without values
            cell = {"class_": "heat", "style": f"--depth:{depth}"}
            drawn.append(rectangle(x, y, wide - gap, tall - 1, said, **cell))
            if chart.write:
                look = "cell deep" if float(depth) > 0.55 else "cell"  # light text on deep colours
                drawn.append(text(x + wide / 2, y + tall / 2 + 4, chart.say(value), class_=look))
        drawn.append(text(width - 2, y + tall / 2 + 4, row.end, "end", class_="tick"))
    below = 6 + len(chart.rows) * tall
    for column, said in chart.edges:
        drawn.append(text(left + column * wide, below + 14, said, class_="tick"))
    drawn.append(text(left + (width - left - end) / 2, below + 31, chart.x_label, class_="label"))
    return svg(*drawn, width=width, height=below + 38, name=name)
