"""Plots into files: the projection energy of a run, and the routing of a stream."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aegis_cli.common.errors import AegisError
from aegis_cli.common.files import write_atomically

if TYPE_CHECKING:
    import numpy as np

_DECADES = 4  # of the log scale of the energy
_PANELS, _CELL = 5, 0.29  # of the routing: tasks per line; width of a cell in inches
_TITLED = 6.8  # width in inches of the routing's title and legend
_WRITTEN = {"fontsize": 6.5, "ha": "center", "va": "center"}
_PATCH = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}
_IMPOSSIBLE, _NOTHING, _PRUNED = "#b8b8b8", "#ededed", "#c81e2d"


def energy_plot(report: Any, path: Path) -> None:
    """Draw the energy shed by layer and step, and its course over all layers.

    The image is a PNG, PDF or SVG, on log scales and with the finding as its title.

    Raises:
        AegisError: no energies in the report, matplotlib missing, unknown suffix, or `path` cannot
            be written.
    """
    if not report.layers:
        raise AegisError(
            f"no projection energy in {report.path}",
            "a run, or a checkpoint or ledger of method aegis",
            "leave out --plot, or give the run of a checkpoint",
        )
    save_figure(lambda: _energy(report), path)


def save_figure(draw: Callable[[], Any], path: Path) -> None:
    """Save the figure of `draw` to a file, in the format of its suffix.

    Raises:
        AegisError: matplotlib missing, unknown suffix, or `path` cannot be written.
    """
    check_plot(path)
    # Drawn in memory, because matplotlib would leave a partial file if it fails.
    image = io.BytesIO()
    draw().savefig(image, format=path.suffix.lower()[1:], dpi=150)
    write_atomically(path, lambda file: file.write(image.getvalue()))


def check_plot(path: Path) -> None:
    """Raise AegisError for a file whose suffix is not an image format."""
    if path.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise AegisError(
            f"--plot {path}",
            "a file name ending in .png, .pdf or .svg",
            f"--plot {path.with_suffix('.png')}",
        )


def literal(text: str) -> str:
    """A name or a path with $ escaped: matplotlib reads text between two $ as maths."""
    return text.replace("$", r"\$")


def figure(**options: Any) -> Any:
    """An empty figure with matplotlib's Agg canvas: no pyplot, no display, no global state."""
    from matplotlib.figure import Figure

    return Figure(**options)


def _energy(report: Any) -> Any:
    """A heat map of layers and steps above the curve of all layers, with a common step axis."""
    from matplotlib.ticker import LogFormatter

    count, bins = len(report.layers), report.over_time
    # Sizes in inches; the heat map and its row of the grid grow with the number of layers.
    drawn = figure(figsize=(9.5, 3.6 + 0.24 * count), layout="constrained")
    top, below = drawn.subplots(2, 1, sharex=True, height_ratios=(max(1.0, 0.15 * count), 0.8))
    edges = [b.first_step - 0.5 for b in bins] + [bins[-1].last_step + 0.5]  # [bins + 1]
    drawn.suptitle(_finding(report), x=0.01, ha="left", fontsize=12, fontweight="bold")
    heat, least = _energy_of_layers(top, report, edges)
    bar = drawn.colorbar(heat, ax=top, label="energy shed (%)", pad=0.01, format="%g")
    bar.ax.yaxis.set_minor_formatter(LogFormatter())  # for scales within a decade
    _energy_of_all(below, report, edges, least)
    return drawn


def _energy_of_layers(axes: Any, report: Any, edges: Sequence[float]) -> tuple[Any, float]:
    """The heat map with a row per layer, and the smallest percentage on its scale."""
    import numpy as np
    from matplotlib.colors import LogNorm

    names = [layer.name for layer in report.layers]
    by_bin = np.array([bin.layers for bin in report.over_time])  # [bins, layers]
    shares = 100 * by_bin.T  # percent [layers, bins]
    least, most = _decades(shares)
    # Layers that shed nothing cannot be drawn on a log scale and show the background's grey.
    axes.set_facecolor(_NOTHING)
    heat = axes.pcolormesh(
        edges,
        range(len(names) + 1),
        np.ma.masked_less_equal(shares, 0).clip(least, most),
        cmap="viridis",
        norm=LogNorm(least, most),
    )
    rows, size = [i + 0.5 for i in range(len(names))], 9 if len(names) <= 24 else 6
    axes.set_yticks(rows, names, fontsize=size)
    axes.invert_yaxis()  # the first layer on top, in the order of the data flow
    means = axes.secondary_yaxis("right")  # only for texts
    means.set_yticks(rows, [_percent(x.energy_shed) for x in report.layers], fontsize=size)
    means.tick_params(length=0)
    title = f"{literal(report.path)}; on the right each group's mean; grey: nothing shed"
    axes.set_title(title, loc="left", fontsize=9)
    return heat, least


def _energy_of_all(axes: Any, report: Any, edges: Sequence[float], least: float) -> None:
    """The energy shed by all layers together over time, with its mean as a dashed line."""
    import numpy as np
    from matplotlib.ticker import LogFormatter, MaxNLocator

    course = 100 * np.array([b.energy_shed for b in report.over_time])
    # Zero cannot be drawn on a log scale and is drawn at its lower end.
    axes.stairs(np.maximum(course, least), edges, color="tab:blue", baseline=None)
    axes.set_yscale("log")
    if report.energy_shed_mean:
        mean = 100 * report.energy_shed_mean
        axes.axhline(mean, color="0.4", linestyle="--", linewidth=1)
        axes.annotate(
            f"mean\n{_percent(report.energy_shed_mean)}",
            (1, mean),
            (5, 0),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            va="center",
            fontsize=9,
        )
    axes.set(xlabel="training step", ylabel="all groups (%)", xlim=(edges[0], edges[-1]))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(LogFormatter())
    axes.grid(alpha=0.3)


def _decades(shares: np.ndarray) -> tuple[float, float]:
    """The ends of the log scale in percent: at most `_DECADES` decades below the largest share."""

    positive = shares[shares > 0]
    if not positive.size:
        return 0.1, 1.0
    most = float(positive.max())
    least = max(float(positive.min()), most / 10**_DECADES)
    return min(least, most / 10), most  # at least one decade, even if all shares are equal


def _finding(report: Any) -> str:
    """The finding of the plot in a sentence."""
    mean = report.energy_shed_mean
    if not mean:
        return "The projection sheds nothing: no gradient ever conflicts with the anchor's"
    ranked = sorted(report.layers, key=lambda layer: -layer.energy_shed)
    most, least = ranked[0], ranked[-1]
    found = f"The projection sheds {_percent(mean)} of the gradient's energy"
    if len(ranked) == 1:
        return found
    ends = [f"{layer.name} ({_percent(layer.energy_shed)})" for layer in (most, least)]
    return f"{found}:\nmost in {ends[0]}, least in {ends[1]}"


def _percent(share: float) -> str:
    """A percentage with two significant digits."""
    digits = f"{100 * share:#.2g}".removesuffix(".")
    return f"{digits if share else 0} %"


def routing_plot(inspection: Any, path: Path) -> None:
    """Draw each task's routing mass on the experts that each task added, for each map.

    The image is a heat map in a PNG, PDF or SVG.

    There is one panel per task, with values in percent. Grey: the experts' task had not come yet.
    Pale: the router uses none of that task's experts. A cross with a number: this many of the
    task's own candidates were pruned.

    Raises:
        AegisError: no routers in the run, matplotlib missing, unknown suffix, or `path` cannot be
            written.
    """
    report = inspection.report
    if not any(record.sites for record in report.records):
        raise AegisError(
            f"no routers in {inspection.path}",
            "a run of a learner with experts",
            "leave out --plot",
        )
    save_figure(lambda: _routing(report, inspection.path), path)


def _routing(report: Any, path: str) -> Any:
    count, sites = len(report.tasks), [site.site for site in report.records[-1].sites]
    rows = math.ceil(count / _PANELS)
    columns = math.ceil(count / rows)
    width = max(_TITLED, 3.2 + _CELL * count * columns)
    drawn = figure(
        figsize=(width, 1.6 + (0.5 + 0.23 * len(sites)) * rows),
        layout="constrained",
    )
    panels = drawn.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    heats = []
    for task, (axes, record) in enumerate(zip(panels, report.records, strict=False)):
        # A map may have no router in an early task; its row is left empty.
        routed = {site.site: site for site in record.sites}
        heats.append(_task_routing(axes, task, [routed.get(name) for name in sites], count))
        axes.set_title(f"{task + 1}. {literal(record.task)}", fontsize=9)
        axes.tick_params(length=0, labelsize=8)
        axes.spines[:].set_visible(False)
    for axes in panels[len(report.records) :]:
        axes.set_visible(False)
    panels[0].set_yticks([i + 0.5 for i in range(len(sites))], sites)
    panels[0].set_xticks([i + 0.5 for i in range(count)], range(1, count + 1))
    panels[0].invert_yaxis()  # for all panels, which share it
    title = "Routing mass (%) after each task; a column holds the experts that one task brought"
    drawn.suptitle(f"{title}\n{literal(path)}", x=0.01, ha="left", fontsize=11)
    drawn.colorbar(heats[-1], ax=panels, label="routing mass (%)", pad=0.01, aspect=40)
    _explain_routing(drawn)
    return drawn


def _task_routing(axes: Any, task: int, sites: Sequence[Any], count: int) -> Any:
    """One task's panel, with a row per map and a column per earlier or later task."""
    import numpy as np

    # Percent [maps, owners]; masked: no expert. Filled with 0, as matplotlib scales masked values.
    mass = np.ma.array(np.zeros((len(sites), count)), mask=True)
    for row, site in enumerate(sites):
        pruned = 0 if site is None else len(site.pruned)
        for owner in range(count):
            share = _from_owner(site, owner, count)
            if share is not None:
                mass[row, owner] = 100 * share
                # If candidates were pruned, their mark needs the upper right corner.
                x, y = (0.4, 0.62) if pruned and owner == task else (0.5, 0.5)
                look = {**_WRITTEN, "color": "black" if share > 0.6 else "white"}
                axes.text(owner + x, row + y, f"{100 * share:.0f}", **look)
        if pruned:
            look = {**_WRITTEN, "color": _PRUNED, "fontweight": "bold"}
            if np.ma.getmaskarray(mass)[row, task]:  # none of the new experts is left
                axes.text(task + 0.5, row + 0.5, f"×{pruned}", **look)
            else:
                look |= {"fontsize": 4.5, "bbox": _PATCH}
                axes.text(task + 0.82, row + 0.2, f"×{pruned}", **look)
    axes.set_facecolor(_NOTHING)
    # If the last column stands for experts without an owner, it is never empty.
    later = [owner for owner in range(task + 1, count) if mass[:, owner].count() == 0]
    for owner in later:
        axes.axvspan(owner, owner + 1, color=_IMPOSSIBLE, linewidth=0)
    return axes.pcolormesh(mass, cmap="viridis", vmin=0, vmax=100, edgecolors="white", linewidth=1)


def _explain_routing(drawn: Any) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    marks = [
        Patch(color=_IMPOSSIBLE, label="the task had not come yet"),
        Patch(facecolor=_NOTHING, edgecolor="0.8", label="none of that task's experts in use"),
        Line2D([], [], color=_PRUNED, marker="x", linestyle="", label="×n: n candidates pruned"),
    ]
    drawn.legend(handles=marks, loc="outside lower center", ncols=3, fontsize=8, frameon=False)


def _from_owner(site: Any, owner: int, count: int) -> float | None:
    """Mass on the experts of one task; experts without an owner count as the last task's.

    It is None without a router, or without such an expert.
    """
    if site is None:
        return None
    masses = []
    for mass, of in zip(site.mass, site.owners, strict=True):
        if min(of, count - 1) == owner:  # no owner is a number past the last task's
            masses.append(mass)
    return sum(masses) if masses else None
