"""Plots into files: the projection energy of a run, and the routing of a stream."""

from __future__ import annotations

import io
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from aegis_cli.common.errors import AegisError
from aegis_cli.common.files import write_atomically


def can_plot() -> bool:
    """Whether matplotlib is installed."""
    return find_spec("matplotlib") is not None


def energy_plot(report: Any, path: Path) -> None:
    """Heat map of the energy shed by layer and step, and its course over all layers, into a PNG,
    PDF or SVG.

    Raises:
        AegisError: no energies in the report, matplotlib missing, unknown suffix, or `path` cannot
            be written.
    """
    if not report.layers:
        raise AegisError(
            f"no projection energy in {report.path}",
            "a run or ledger of method aegis",
            "leave out --plot",
        )
    save_figure(lambda: _energy(report), path)


def save_figure(draw: Callable[[], Any], path: Path) -> None:
    """What `draw` draws, into a file whose suffix says how.

    Raises:
        AegisError: matplotlib missing, unknown suffix, or `path` cannot be written.
    """
    if path.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise AegisError(
            f"--plot {path}",
            "a file name ending in .png, .pdf or .svg",
            f"--plot {path.with_suffix('.png')}",
        )
    image = io.BytesIO()
    draw().savefig(image, format=path.suffix.lower()[1:], dpi=150)
    write_atomically(path, lambda file: file.write(image.getvalue()))


def figure(**options: Any) -> Any:
    """An empty figure of matplotlib, without pyplot: the Agg canvas, no display, no
    global state.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as e:
        found = f"matplotlib cannot be imported ({e})"
        raise AegisError(found, "matplotlib for --plot", "pip install 'aegis-vla[media]'") from None
    return Figure(**options)


def _energy(report: Any) -> Any:
    names, bins = [x.name for x in report.layers], report.over_time
    drawn = figure(figsize=(9, 3.4 + 0.24 * len(names)), layout="constrained")
    top, below = drawn.subplots(2, 1, sharex=True, height_ratios=(max(1.0, 0.15 * len(names)), 0.8))
    edges = [b.first_step - 0.5 for b in bins] + [bins[-1].last_step + 0.5]
    shares = [[100 * b.layers[i] for b in bins] for i in range(len(names))]
    heat = top.pcolormesh(
        edges,
        range(len(names) + 1),
        shares,
        cmap="viridis",
        vmin=0,
        vmax=max(map(max, shares)) or 1,
    )
    top.set_yticks(
        [i + 0.5 for i in range(len(names))], names, fontsize=9 if len(names) <= 24 else 6
    )
    top.invert_yaxis()  # the first layer on top, as the data flows
    top.set_title(f"Gradient energy shed by the projection: {report.path}", loc="left", fontsize=11)
    drawn.colorbar(heat, ax=top, label="energy shed (%)", pad=0.01)
    below.stairs([100 * b.energy_shed for b in bins], edges, color="tab:blue", baseline=None)
    below.axhline(100 * report.energy_shed_mean, color="0.4", linestyle="--", linewidth=1)
    below.annotate(
        f"mean {100 * report.energy_shed_mean:.2f} %",
        (1, 100 * report.energy_shed_mean),
        (-4, 3),
        color="0.3",
        xycoords=("axes fraction", "data"),
        textcoords="offset points",
        ha="right",
        fontsize=9,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1},
    )
    below.set(xlabel="training step", ylabel="all groups (%)", xlim=(edges[0], edges[-1]))
    below.set_ylim(0, 100 * max(b.energy_shed for b in bins) * 1.1 or 1)
    below.grid(alpha=0.3)
    return drawn


def routing_plot(inspection: Any, path: Path) -> None:
    """Heat map: of each task and map, the routing mass on the experts that each task brought, into
    a PNG, PDF or SVG.

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
    count, sites = len(report.tasks), [site.site for site in report.records[-1].sites]
    found = [{site.site: site for site in record.sites} for record in report.records]

    def draw() -> Any:
        drawn = figure(
            figsize=(max(7.0, 2.2 + 0.16 * count * count), 1.8 + 0.2 * len(sites)),
            layout="constrained",
        )
        axes = drawn.subplots()
        shares = [
            [_from_owner(of.get(site), owner, count) for of in found for owner in range(count)]
            for site in sites
        ]
        heat = axes.pcolormesh(
            [[100 * share for share in row] for row in shares], cmap="viridis", vmin=0, vmax=100
        )
        axes.set_yticks([i + 0.5 for i in range(len(sites))], sites, fontsize=8)
        axes.set_xticks(
            [count * (i + 0.5) for i in range(count)],
            report.tasks,
            fontsize=8,
            rotation=30,
            ha="right",
        )
        for i in range(1, count):
            axes.axvline(count * i, color="white", linewidth=1)
        axes.invert_yaxis()
        axes.set_xlabel(f"task learned; in each, the experts of tasks 1 to {count}")
        axes.set_title(
            f"Routing mass by the task that brought the expert\n{inspection.path}",
            loc="left",
            fontsize=10,
        )
        drawn.colorbar(heat, ax=axes, label="routing mass (%)", pad=0.01)
        return drawn

    save_figure(draw, path)


def _from_owner(site: Any, owner: int, count: int) -> float:
    """Mass on the experts of one task; those that belong to nobody count as the last one's. No
    router, no mass.
    """
    return (
        0.0
        if site is None
        else sum(
            m for m, of in zip(site.mass, site.owners, strict=True) if min(of, count - 1) == owner
        )
    )
