"""The frontier plot: how much success each variant buys with how much of the VQA skill."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from aegis_cli.cli.render.plots import figure, save_figure
from aegis_cli.cli.render.studies import value_text
from aegis_cli.common.errors import AegisError

_MARKERS = "osD^vP<X>phH"
_ZOOM = (
    0.03  # of VQA accuracy below the baseline: where the variants that keep it lie close together
)


def has_frontier(report: Any) -> bool:
    """Whether there is anything to draw: not where every training diverged, or none can be rolled
    out.
    """
    return bool(_tried(report) or _compared(report))


def frontier_plot(report: Any, path: Path) -> None:
    """VQA accuracy over success: a line a variant through its knob's values (validation), and the
    compared means (stars).

    Above, everything; below, what lies close to the accuracy before fine-tuning.

    Raises:
        AegisError: nothing to draw, matplotlib missing, unknown suffix, or `path` cannot be
            written.
    """
    if not has_frontier(report):
        found = "no variant with both VQA accuracy and success"
        raise AegisError(
            found, "a study some of whose trainings can be rolled out", "leave out --plot"
        )
    save_figure(lambda: _figure(report), path)


def _figure(report: Any) -> Any:
    tried = _tried(report)
    compared, curves = _compared(report), _curves(tried)
    names = list(dict.fromkeys([*curves, *(r.variant for r in compared)]))
    baseline = tried[0].baseline_accuracy if tried else report.tasks[0].baseline_accuracy
    spots = [(100 * p.success, 100 * p.accuracy) for p in tried]
    spots += [(100 * _acts(r).mean, 100 * r.accuracy.mean) for r in compared]
    least = 100 * (baseline - _ZOOM)
    panels = 2 if min(y for _, y in spots) < 100 * (baseline - 2 * _ZOOM) else 1
    drawn = figure(figsize=(10.5, 4.6 * panels), layout="constrained")
    axes = drawn.subplots(panels, 1, squeeze=False)[:, 0]
    for axis in axes:
        _draw(axis, names, curves, compared)
        axis.axhline(100 * baseline, color="0.3", linestyle="--", linewidth=1, zorder=1)
        axis.grid(alpha=0.3)
        axis.set(
            xlabel=_across(report),
            ylabel="VQA accuracy (%)",
            xlim=_limits([x for x, _ in spots], 3),
        )
        axis.set_ylim(_limits([100 * baseline, *(y for _, y in spots)], 0.5))
    if panels == 2:
        axes[1].set_ylim(
            least, _limits([100 * baseline, *(y for _, y in spots if y > least)], 0.2)[1]
        )
        axes[1].set_title(
            f"the top, enlarged: less than {100 * _ZOOM:g} points lost", loc="left", fontsize=9
        )
    for point in tried:  # where it is enlarged, the value is written there only
        if point.value is not None:
            _label(axes[-1 if 100 * point.accuracy > least else 0], point, tried, names)
    axes[0].set_title(_title(report), loc="left", fontsize=11)
    drawn.legend(
        handles=list(_legend(names, bool(tried), bool(compared))),
        loc="outside right upper",
        fontsize=8,
    )
    return drawn


def _limits(values: Sequence[float], least: float) -> tuple[float, float]:
    """Around the markers; of two seeds' intervals, which can be wider than the whole scale, the
    ends are cut.
    """
    margin = max(least, 0.08 * (max(values) - min(values)))
    return min(values) - margin, max(values) + margin


def _title(report: Any) -> str:
    task = report.tuning_task if report.tuning else report.tasks[0].task
    return f"{report.name}: what is kept over what is learned, task {task}"


def _tried(report: Any) -> list[Any]:
    """The values that did not diverge."""
    return [p for p in report.tuning if p.success is not None]


def _compared(report: Any) -> list[Any]:
    """The compared variants of the task that was tuned, else of the first, as far as they were
    rolled out.
    """
    chosen = _task(report)
    return [] if chosen is None else [r for r in chosen.results if r.accuracy and _acts(r)]


def _task(report: Any) -> Any:
    return next(
        (t for t in report.tasks if t.task == report.tuning_task),
        report.tasks[0] if report.tasks else None,
    )


def _acts(result: Any) -> Any:
    """How well it acts: on seen colours, or as a share of the highest return."""
    return result.success_seen if result.return_share is None else result.return_share


def _across(report: Any) -> str:
    results = [] if _task(report) is None else _task(report).results
    return (
        "return (% of the highest)"
        if any(r.return_share for r in results)
        else "success, seen colours (%)"
    )


def _curves(points: Sequence[Any]) -> dict[str, list[Any]]:
    curves: dict[str, list[Any]] = {}
    for point in points:
        curves.setdefault(point.variant, []).append(point)
    return curves


def _draw(axis: Any, names: list[str], curves: dict[str, list[Any]], compared: list[Any]) -> None:
    for name, points in curves.items():
        color, marker = _style(names.index(name), len(names))
        across, up = [100 * p.success for p in points], [100 * p.accuracy for p in points]
        axis.plot(across, up, color=color, linewidth=1, alpha=0.6, zorder=2)
        for p in points:
            inside = color if p.chosen else "white"
            axis.plot(
                100 * p.success,
                100 * p.accuracy,
                marker,
                color=color,
                markerfacecolor=inside,
                markersize=7,
                zorder=3,
            )
    for r in compared:
        color, marker = _style(names.index(r.variant), len(names))
        shape, size = ("*", 13) if curves else (marker, 8)
        x, y = 100 * _acts(r).mean, 100 * r.accuracy.mean
        bars = {"xerr": _bars(_acts(r)), "yerr": _bars(r.accuracy)}
        axis.errorbar(x, y, **bars, ecolor=(*color[:3], 0.5), elinewidth=0.9, fmt="none")
        axis.plot(
            x,
            y,
            shape,
            color=color,
            markersize=size,
            markeredgecolor="black",
            markeredgewidth=0.6,
            zorder=4,
        )


def _label(axis: Any, point: Any, all_points: Sequence[Any], names: list[str]) -> None:
    """A knob's value beside its marker; of markers that nearly coincide, each gets
    another corner.
    """
    x, y = 100 * point.success, 100 * point.accuracy
    earlier = all_points[: all_points.index(point)]
    crowd = sum(abs(x - 100 * p.success) < 4 and abs(y - 100 * p.accuracy) < 1 for p in earlier)
    right, up = ((6, 4), (-6, -9), (6, -9), (-6, 4))[crowd % 4]
    color, _ = _style(names.index(point.variant), len(names))
    axis.annotate(
        value_text(point.value),
        (x, y),
        (right, up),
        textcoords="offset points",
        fontsize=7,
        color=color,
        ha="left" if right > 0 else "right",
        annotation_clip=True,
        zorder=5,
    )


def _bars(estimate: Any) -> list[list[float]] | None:
    if estimate.interval is None:
        return None
    low, high = estimate.interval
    return [[100 * (estimate.mean - low)], [100 * (high - estimate.mean)]]


def _style(index: int, count: int) -> tuple[Any, str]:
    """A colour and a marker of its own for each of `count` variants."""
    from matplotlib import colormaps

    color = colormaps["tab10"](index) if count <= 10 else colormaps["tab20"](index % 20)
    return color, _MARKERS[index % len(_MARKERS)]


def _legend(names: list[str], tuned: bool, compared: bool) -> Iterator[Any]:
    from matplotlib.lines import Line2D

    for i, name in enumerate(names):
        color, marker = _style(i, len(names))
        yield Line2D(
            [],
            [],
            color=color,
            marker=marker,
            markersize=6,
            linestyle="-" if tuned else "",
            label=name,
        )
    if tuned:
        yield Line2D(
            [],
            [],
            color="0.3",
            marker="o",
            markerfacecolor="white",
            linestyle="",
            label="knob value, validation",
        )
        yield Line2D(
            [], [], color="0.3", marker="o", linestyle="", label="chosen value, validation"
        )
    if compared:
        shape = {"marker": "*", "markersize": 11} if tuned else {"linewidth": 0.9}
        yield Line2D([], [], color="0.3", label="mean over seeds, 95 %", **shape)
    yield Line2D([], [], color="0.3", linestyle="--", label="before fine-tuning")
