"""The frontier plot: each variant's success and its loss of VQA accuracy.

If nothing can be rolled out, the open-loop error takes the place of success, with smaller errors to
the right.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from aegis_cli.cli.render.labels import Label, place
from aegis_cli.cli.render.plots import figure, save_figure
from aegis_cli.cli.render.studies import value_text
from aegis_cli.common.errors import AegisError
from aegis_cli.studies.comparison import PolicyResult
from aegis_cli.studies.metrics import columns

# Okabe and Ito's colours, which people with common kinds of colour blindness can distinguish.
_COLORS = ("#1a1a1a", "#d55e00", "#cc79a7", "#0072b2", "#009e73", "#e69f00")
_REST = "#9a9a9a"
_COLUMNS = columns(PolicyResult)  # each figure's name and unit
_LOST, _OPEN = "drop_points", "open_loop_error"
_REFERENCES = ("naive", "aegis", "cotrain")  # methods that all others are compared with
_LINEAR = 1.0  # points; the scale is linear for losses up to here, logarithmic beyond
_TICKS = (0, 0.5, 1, 2, 5, 10, 20, 50, 100)


def has_frontier(report: Any) -> bool:
    """Whether there is anything to draw.

    There is nothing if every training diverged, or if nothing measures how well policies act.
    """
    return bool(_tried(report) or _compared(report))


def frontier_plot(report: Any, path: Path) -> None:
    """Plot points of VQA accuracy lost over success; the upper right is best.

    Stars are the compared means over seeds with their intervals, measured on probe questions and
    evaluation episodes. Thin lines with small circles are the values tried in tuning, with one
    seed, on validation questions and episodes. At most six methods have a colour: first the
    references, then those that no other method beats in both; the rest is grey.

    Raises:
        AegisError: nothing to draw, matplotlib missing, unknown suffix, or `path` cannot be
            written.
    """
    if not has_frontier(report):
        found = "no variant with both VQA accuracy and a figure of how well it acts"
        raise AegisError(found, "a study with at least one measured training", "leave out --plot")
    save_figure(lambda: _figure(report), path)


def _figure(report: Any) -> Any:
    tried, compared = _tried(report), _compared(report)
    colors = _colors(tried, compared)
    drawn = figure(figsize=(9.5, 6.2), layout="constrained")
    axis = drawn.subplots()
    axis.axhline(0, color="0.3", linestyle="--", linewidth=1, zorder=1)
    for points in _curves(tried).values():
        _draw_tried(axis, points, colors[points[0].method])
    for result in compared:
        _draw_compared(axis, result, colors[result.method])
    _scale(axis, report)
    _explain(drawn, axis, bool(tried), bool(compared))
    drawn.draw_without_rendering()  # labels are placed in pixels, which needs the layout
    place(axis, _labels(tried, compared, colors), _taken(tried, compared))
    return drawn


def _tried(report: Any) -> list[Any]:
    """The values that did not diverge."""
    return [p for p in report.tuning if p.success is not None or p.open_loop_error is not None]


def _compared(report: Any) -> list[Any]:
    """The compared variants of the tuned task that have a figure for how they act.

    Without tuning, it is the first task.
    """
    chosen = chosen_task(report)
    return [] if chosen is None else [r for r in chosen.results if r.accuracy and _acts(r)]


def chosen_task(report: Any) -> Any:
    """The table of the frontier: that of the tuned task, or the first one; None without tables."""
    return next(
        (t for t in report.tasks if t.task == report.tuning_task),
        report.tasks[0] if report.tasks else None,
    )


def shown_tasks(report: Any) -> str:
    """The task of the means, and the task of the tried values if it is another."""
    tried, means = report.tuning_task, chosen_task(report) if _compared(report) else None
    if means is None or (_tried(report) and means.task == tried):
        return f"task {tried}"
    if not _tried(report):
        return f"task {means.task}"
    return f"task {means.task} (values tried on {tried})"


def acting_axis(report: Any) -> str:
    """The label of the frontier's axis of success; without colours if the task has none."""
    if by_error(report):
        return str(_COLUMNS[_OPEN].axis)
    acting = next(map(_acting, _compared(report)), "success_seen")
    return str(_COLUMNS[acting].axis) if _has_colors(report) else "success (%)"


def _has_colors(report: Any) -> bool:
    """Whether the frontier's task has held-out colours or a return; MetaWorld's have neither."""
    task = chosen_task(report)
    known = task.results if task is not None else []
    acted = [found for found in known if found.success_seen is not None]
    return not acted or any(found.success_held_out is not None for found in acted)


def _acting(result: Any) -> str:
    """The name of the figure for how well it acts: success on seen colours, a return, an error."""
    if result.return_share is not None:
        return "return_share"
    is_evaluated = result.success_seen is None and result.open_loop_error is not None
    return _OPEN if is_evaluated else "success_seen"


def by_error(report: Any) -> bool:
    """Whether the frontier shows open-loop errors, because nothing was rolled out."""
    compared = [_acting(result) == _OPEN for result in _compared(report)]
    return any(compared or [point.success is None for point in _tried(report)])


def _acts(result: Any) -> Any:
    return getattr(result, _acting(result))


def _curves(points: Sequence[Any]) -> dict[str, list[Any]]:
    curves: dict[str, list[Any]] = {}
    for point in points:
        curves.setdefault(point.variant, []).append(point)
    return curves


def _tried_at(point: Any) -> tuple[float, float]:
    """Percent of success or an error, and points of VQA lost on the validation questions."""
    acts = point.open_loop_error if point.success is None else 100 * point.success
    return acts, 100 * (point.baseline_accuracy - point.accuracy)


def _compared_at(result: Any) -> tuple[float, float]:
    """Percent of success or an error, and points of VQA lost on the probe questions."""
    success = _COLUMNS[_acting(result)].shown(_acts(result).mean)
    return success, _COLUMNS[_LOST].shown(getattr(result, _LOST).mean)


# --- colours --------------------------------------------------------------------------------------


def _colors(tried: Sequence[Any], compared: Sequence[Any]) -> dict[str, str]:
    """One colour per method: its own for at most six, grey for the rest."""
    own = dict(zip(_named(tried, compared), _COLORS, strict=False))
    return {measured.method: own.get(measured.method, _REST) for measured in [*compared, *tried]}


def coloured_methods(report: Any) -> list[str]:
    """The methods with their own colour: references, those that no other beats, then others."""
    return _named(_tried(report), _compared(report))


def _named(tried: Sequence[Any], compared: Sequence[Any]) -> list[str]:
    methods = list(dict.fromkeys(m.method for m in [*compared, *tried]))
    if compared:
        spots = [(r.method, *_compared_at(r)) for r in compared]
    else:
        spots = [(p.method, *_tried_at(p)) for p in tried]
    if any(_acting(r) == _OPEN for r in compared) or any(p.success is None for p in tried):
        spots = [(method, -error, lost) for method, error, lost in spots]  # lower error is better
    first = [method for method in _REFERENCES if method in methods]
    return list(dict.fromkeys([*first, *_unbeaten(spots), *methods]))[: len(_COLORS)]


def _unbeaten(spots: Sequence[tuple[str, float, float]]) -> list[str]:
    """Methods that no other method beats in both success and loss, most successful first."""
    best = []
    for method, success, lost in spots:
        beaten = False
        for _, other_success, other_lost in spots:
            as_good = other_success >= success and other_lost <= lost
            if as_good and (other_success, other_lost) != (success, lost):
                beaten = True
        if not beaten:
            best.append((success, method))
    return [method for _, method in sorted(best, reverse=True)]


# --- drawing --------------------------------------------------------------------------------------


def _draw_tried(axis: Any, points: Sequence[Any], color: str) -> None:
    spots = [_tried_at(p) for p in points]
    front = 2 if color == _REST else 3
    line = {"linewidth": 0.8, "alpha": 0.4} if color == _REST else {"linewidth": 1.2, "alpha": 0.6}
    axis.plot(*zip(*spots, strict=True), color=color, zorder=front, **line)
    for point, (success, lost) in zip(points, spots, strict=True):
        inside = color if point.chosen else "white"
        size = 3.5 if color == _REST else 5
        look = {"color": color, "markerfacecolor": inside, "markersize": size}
        axis.plot(success, lost, "o", zorder=front + 0.5, **look)


def _draw_compared(axis: Any, result: Any, color: str) -> None:
    success, lost = _compared_at(result)
    front = 4 if color == _REST else 5  # grey is behind colours
    bars = {"xerr": _bars(_acts(result), _unit(result)), "yerr": _bars(result.drop_points, 1)}
    shade = 0.25 if color == _REST else 0.45
    look = {"ecolor": color, "elinewidth": 1.1, "alpha": shade, "fmt": "none"}
    axis.errorbar(success, lost, **bars, **look, zorder=front - 0.5)
    look = {"color": color, "markeredgecolor": "white", "markeredgewidth": 0.8}
    axis.plot(success, lost, "*", markersize=10 if color == _REST else 15, zorder=front, **look)


def _unit(result: Any) -> float:
    """The length of 1 on the axis of the figure: 100 for a share in percent."""
    return _COLUMNS[_acting(result)].shown(1.0)


def _bars(estimate: Any, unit: float) -> list[list[float]] | None:
    """The lengths of an interval's two sides [2, 1], as matplotlib expects for error bars."""
    if estimate.ends is None:
        return None
    low, high = estimate.ends
    return [[unit * (estimate.mean - low)], [unit * (high - estimate.mean)]]


def _scale(axis: Any, report: Any) -> None:
    """Set the axes; the axis of the loss is inverted, so that up is better.

    Beyond one point it is logarithmic, because the variants that keep most are within a few points
    of each other and the others lose dozens.
    """
    tried, compared = _tried(report), _compared(report)
    spots = [*map(_tried_at, tried), *map(_compared_at, compared)]
    across, lost = [x for x, _ in spots], [y for _, y in spots]
    errs = by_error(report)
    margin = max(0.02 if errs else 2.0, 0.08 * (max(across) - min(across)))
    if errs:  # this axis is inverted as well, since a lower error is better
        left, right = max(across) + margin, max(min(across) - margin, 0.0)
    else:
        # A return may exceed the expert's, but a success is between 0 % and 100 %.
        left, right = max(min(across) - margin, -1.0), max(across) + margin
        if all(_acting(result) != "return_share" for result in compared):
            right = min(right, 101.0)
    axis.set(xlabel=acting_axis(report), ylabel=_COLUMNS[_LOST].axis, xlim=(left, right))
    axis.set_yscale("symlog", linthresh=_LINEAR, linscale=0.7)
    axis.set_yticks(_TICKS, [f"{tick:g}" for tick in _TICKS])
    axis.minorticks_off()
    # After the ticks, which extend the axis to the last of them. The larger end is at the bottom.
    axis.set_ylim(1.4 * max(max(lost), _LINEAR), min(min(lost), 0) - 0.2)
    axis.grid(alpha=0.25)
    axis.spines[["top", "right"]].set_visible(False)
    acting = "open-loop error" if errs else "success"
    title = f"{report.name}: VQA accuracy lost against {acting}, {shown_tasks(report)}"
    axis.set_title(title, loc="left", fontsize=11)


def _explain(drawn: Any, axis: Any, tuned: bool, compared: bool) -> None:
    """Explain the marks, and which direction is better."""
    from matplotlib.lines import Line2D

    def grey(label: str, marker: str, size: float, face: str | None = None) -> Line2D:
        return Line2D(
            [],
            [],
            color="0.35",
            linestyle="",
            marker=marker,
            markersize=size,
            markerfacecolor=face,
            label=label,
        )

    marks = []
    if compared:
        marks.append(grey("mean over seeds, 95 % (probe)", "*", 12))
    if tuned:
        marks.append(grey("tried (validation)", "o", 5, face="white"))
        marks.append(grey("chosen (validation)", "o", 5))
    marks.append(Line2D([], [], color="0.3", linestyle="--", label="before fine-tuning"))
    drawn.legend(
        handles=marks, loc="outside lower center", ncols=len(marks), fontsize=9, frameon=False
    )
    axis.annotate(
        "better",
        xy=(0.105, 0.145),
        xytext=(0.03, 0.05),
        xycoords="axes fraction",
        textcoords="axes fraction",
        color="0.25",
        fontsize=11,
        arrowprops={"arrowstyle": "-|>", "color": "0.25", "linewidth": 1.8, "mutation_scale": 18},
    )


# --- labels ---------------------------------------------------------------------------------------


def _labels(tried: Sequence[Any], compared: Sequence[Any], colors: dict[str, str]) -> list[Label]:
    """Each variant's name at its mean or its chosen value, and the values of coloured ones."""
    placed = {r.variant: (_compared_at(r), r.method) for r in compared}
    for name, points in _curves(tried).items():
        named = next((p for p in points if p.chosen), points[-1])
        placed.setdefault(name, (_tried_at(named), named.method))
    labels = []
    for name, (spot, method) in placed.items():
        color = colors[method]
        size, bold = (8, False) if color == _REST else (10, True)
        labels.append(Label(*spot, name, color, size, bold))
    for point in tried:
        color = colors[point.method]
        if point.value is not None and color != _REST:
            text = value_text(point.value)
            labels.append(Label(*_tried_at(point), text, color, size=7, bold=False))
    # Larger labels come first, because they are harder to place.
    return sorted(labels, key=lambda label: -label.size)


def _taken(tried: Sequence[Any], compared: Sequence[Any]) -> list[tuple[float, float]]:
    """Points that labels should not cover: marks, intervals, lines between a variant's values."""
    spots = [*map(_compared_at, compared), *map(_tried_at, tried)]
    for result in compared:
        success, lost = _compared_at(result)
        if result.drop_points.ends is not None:
            low, high = result.drop_points.ends
            spots += _between((success, low), (success, high))
        if _acts(result).ends is not None:
            low, high = _acts(result).ends
            unit = _unit(result)
            spots += _between((unit * low, lost), (unit * high, lost))
    for points in _curves(tried).values():
        ends = [_tried_at(p) for p in points]
        for first, second in zip(ends, ends[1:], strict=False):
            spots += _between(first, second)
    return spots


def _between(
    first: tuple[float, float], second: tuple[float, float], parts: int = 12
) -> list[tuple[float, float]]:
    """Points on the line from one to the other, without its ends."""
    (x0, y0), (x1, y1) = first, second
    shares = [k / parts for k in range(1, parts)]
    return [(x0 + share * (x1 - x0), y0 + share * (y1 - y0)) for share in shares]
