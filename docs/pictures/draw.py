"""Draw the illustrations of README and docs: `python docs/pictures/draw.py [FOLDER] [--png]`.

They are written beside this file, or into FOLDER, as SVG whose letters are paths, so that they look
the same everywhere; `--png` writes PNG instead, to look at.
`published.py` draws `published.png`. The other pictures of this folder are Aegis's own output:

    compare.png   aegis inspect runs/compare --plot docs/pictures/compare.png
    rollout.gif   aegis rollout runs/quickstart/naive --episodes 6 --colors held-out \\
                      --video docs/pictures/rollout.gif
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, FancyBboxPatch, Polygon, Rectangle

Spot = tuple[float, float]

INK, FAINT, CARD, LINE = "#1f2933", "#66727f", "#fbfbf8", "#c9cfd6"
BLUE, ORANGE, GREEN, RED, YELLOW = "#0072b2", "#d55e00", "#009e73", "#c81e2d", "#e69f00"
SETTINGS = {
    "svg.fonttype": "path",
    "svg.hashsalt": "aegis",  # equal drawings give equal bytes
    "font.family": "DejaVu Sans",  # comes with matplotlib
    "mathtext.fontset": "dejavusans",
}


def canvas(width: float, height: float) -> tuple[Figure, Axes]:
    """A card of that size, in units of an inch from its lower left corner; its own background
    makes it readable on a dark page too.
    """
    figure = Figure(figsize=(width, height))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, width), ylim=(0, height))
    axes.axis("off")
    shape = "round,pad=0,rounding_size=0.18"
    card = FancyBboxPatch((0.03, 0.03), width - 0.06, height - 0.06, boxstyle=shape)
    card.set(facecolor=CARD, edgecolor=LINE, linewidth=1)
    axes.add_patch(card)
    return figure, axes


def write(axes: Axes, spot: Spot, text: str, size: float = 10, **look: object) -> None:
    style: dict[str, object] = {"color": INK, "ha": "center", "va": "center", "linespacing": 1.35}
    axes.text(*spot, text, fontsize=size, zorder=5, **{**style, **look})


def box(axes: Axes, center: Spot, size: Spot, text: str, color: str, solid: bool = False) -> None:
    """A rounded box with text: solid for what is run, an outline for what is kept."""
    (x, y), (width, height) = center, size
    shape = "round,pad=0,rounding_size=0.09"
    patch = FancyBboxPatch((x - width / 2, y - height / 2), width, height, boxstyle=shape)
    patch.set(facecolor=color if solid else "white", edgecolor=color, linewidth=1.4, zorder=3)
    axes.add_patch(patch)
    if solid:
        write(axes, center, text, 11.5, color="white", fontweight="bold", family="DejaVu Sans Mono")
    else:
        write(axes, center, text, 9)


def arrow(
    axes: Axes, start: Spot, end: Spot, color: str = FAINT, width: float = 1.5, bend: float = 0
) -> None:
    style = {"arrowstyle": "-|>", "connectionstyle": f"arc3,rad={bend}"}
    path = FancyArrowPatch(start, end, shrinkA=0, shrinkB=0, **style)
    path.set(color=color, linewidth=width, mutation_scale=8 + 4 * width, zorder=4)
    axes.add_patch(path)


# --- the pictures ---------------------------------------------------------------------------------


def pipeline() -> Figure:
    """What each stage reads and hands on."""
    figure, axes = canvas(11, 3.9)
    title = "Fine-tune a VLM into a robot policy, and measure what it costs"
    write(axes, (0.35, 3.52), title, 13, ha="left", fontweight="bold")
    top, middle, low = 2.75, 1.85, 0.95
    box(axes, (1.1, top), (1.5, 0.72), "VQA questions\nand the VLM", FAINT)
    box(axes, (1.1, low), (1.5, 0.72), "dm-control task\nand its expert", FAINT)
    box(axes, (2.85, top), (1.1, 0.5), "anchor", BLUE, solid=True)
    box(axes, (2.85, low), (1.1, 0.5), "demos", ORANGE, solid=True)
    box(axes, (4.5, top), (1.55, 0.72), "anchor.safetensors\nmoments per layer", BLUE)
    box(axes, (4.5, low), (1.55, 0.72), "demos.safetensors\nframes, actions", ORANGE)
    box(axes, (5.85, middle), (1.0, 0.6), "train", GREEN, solid=True)
    box(axes, (7.4, middle), (1.3, 1.3), "run folder\n\nVLM, expert\nledger\nmetrics", GREEN)
    for y, edge in ((top, 0.33), (low, -0.33)):
        arrow(axes, (1.88, y), (2.27, y))
        arrow(axes, (3.43, y), (3.7, y))
        arrow(axes, (5.3, y), (5.75, middle + edge))
    arrow(axes, (6.37, middle), (6.73, middle))
    ends = (
        (top, 0.4, "probe", "VQA accuracy lost,\na gate for CI"),
        (middle, 0.0, "inspect", "gradient energy\nshed per layer"),
        (low, -0.4, "rollout", "success in closed\nloop, a video"),
    )
    for y, leaves, command, found in ends:
        box(axes, (9.0, y), (1.0, 0.46), command, INK, solid=True)
        write(axes, (9.58, y), found, 8.5, ha="left")
        arrow(axes, (8.08, middle + leaves), (8.48, y))
    note = "aegis run does all of it from one recipe; while training, only cotrain reads questions"
    write(axes, (5.5, 0.3), note, 9, color=FAINT, style="italic")
    return figure


def projection() -> Figure:
    """AEGIS's projection of one layer's gradient."""
    figure, axes = canvas(10, 4.4)
    write(
        axes,
        (0.35, 4.05),
        "AEGIS, layer by layer: keep the gradient, bend it where it conflicts",
        13,
        ha="left",
        fontweight="bold",
    )
    panels = (
        (2.5, r"$\langle g, a\rangle \geq 0$:  no conflict", np.array([1.25, 0.75]), GREEN),
        (7.4, r"$\langle g, a\rangle < 0$:  conflict", np.array([1.45, -0.85]), RED),
    )
    anchor = np.array([0.0, 1.45])
    for x, title, task, color in panels:
        origin = np.array([x - 0.45, 1.85])
        conflict = Rectangle((x - 2.0, 0.78), 4.0, origin[1] - 0.78)
        conflict.set(facecolor=RED, alpha=0.08, linewidth=0, zorder=1)
        axes.add_patch(conflict)
        axes.plot([x - 2.0, x + 2.0], [origin[1]] * 2, color=FAINT, linewidth=1, dashes=(4, 3))
        write(axes, (x, 3.6), title, 12, color=color, fontweight="bold")
        arrow(axes, tuple(origin), tuple(origin + anchor), BLUE, 2.4)
        write(axes, tuple(origin + anchor + (-0.3, -0.12)), "$a$", 15, color=BLUE)
        if color == GREEN:
            arrow(axes, tuple(origin), tuple(origin + task), INK, 2.4)
            write(axes, tuple(origin + task + (0.45, 0.08)), "$g' = g$", 14)
            continue
        bent = np.array([task[0], 0.0])
        arrow(axes, tuple(origin), tuple(origin + task), FAINT, 2.0)
        write(axes, tuple(origin + task + (-0.36, -0.06)), "$g$", 15, color=FAINT)
        arrow(axes, tuple(origin), tuple(origin + bent), INK, 2.6)
        write(axes, tuple(origin + bent + (0.24, 0.16)), "$g'$", 15)
        ends = np.array([origin + task, origin + bent])
        axes.plot(*ends.T, color=RED, linewidth=1.4, linestyle=":", zorder=3)
        write(axes, (origin[0] + task[0] + 0.08, 1.42), "removed", 9, color=RED, ha="left")
        corner = origin + bent
        square = np.array([[-0.14, 0], [-0.14, -0.14], [0, -0.14]]) + corner
        axes.plot(*square.T, color=INK, linewidth=1, zorder=4)
    write(
        axes,
        (5.55, 1.12),
        "here a step against $g$\nleads off the anchor",
        8.5,
        color=RED,
        ha="left",
        style="italic",
    )
    write(
        axes, (8.55, 2.75), r"$g' = g - \frac{\langle g,\,a\rangle}{\langle a,\,a\rangle}\,a$", 15
    )
    write(
        axes,
        (5.0, 0.4),
        "$g$: gradient of the robot task      $a$: gradient of the "
        "distance from the anchor (the activations' moments on VQA before fine-tuning)",
        9,
        color=INK,
    )
    return figure


def routing() -> Figure:
    """How igsp decides what a new task shares."""
    figure, axes = canvas(11, 5.0)
    write(
        axes,
        (0.35, 4.65),
        "iGSP: a new task reuses old experts, and keeps a new one only where none serves",
        13,
        ha="left",
        fontweight="bold",
    )
    before = (
        (0.42, BLUE, "task 1"),
        (0.1, BLUE, "task 2"),
        (0.4, ORANGE, "new"),
        (0.08, ORANGE, "new"),
    )
    after = ((0.48, BLUE, "task 1"), None, (0.52, ORANGE, "new"), None)
    _router(axes, 0.45, "1. Identify: candidates join, their use is charged", before, limit=0.125)
    _router(axes, 6.15, "2. Learn: what is left, the routers fixed", after, limit=None)
    arrow(axes, (5.2, 3.35), (5.85, 3.35), INK, 2.4)
    write(axes, (5.5, 3.62), "prune", 10, color=RED, fontweight="bold")
    write(
        axes,
        (5.5, 0.4),
        "A candidate with little routing mass and little load is pruned for "
        "good; an old expert leaves this task's router only, and still serves its own.",
        9.5,
    )
    return figure


def _router(
    axes: Axes,
    left: float,
    title: str,
    experts: Sequence[tuple[float, str, str] | None],
    limit: float | None,
) -> None:
    """A router's mass on four experts as bars over them; None is one that left."""
    write(axes, (left + 2.2, 4.15), title, 11, fontweight="bold")
    floor, scale = 2.25, 2.6
    names = ("expert 1", "expert 2", "candidate", "candidate")
    for i, expert in enumerate(experts):
        x = left + 0.95 + 1.0 * i
        gone = expert is None
        color = LINE if gone else expert[1]
        box(axes, (x, 1.7), (0.86, 0.62), "", color)
        write(axes, (x, 1.8), names[i], 8.5, color=FAINT if gone else INK)
        old = i < 2
        word = ("not used" if old else "pruned") if gone else ("frozen" if old else "learns")
        write(
            axes,
            (x, 1.57),
            word,
            8,
            color=RED if gone and not old else (FAINT if gone else color),
            style="italic",
        )
        if gone:
            if not old:
                for ends in ((-0.3, 0.3), (0.3, -0.3)):
                    axes.plot(
                        [x - 0.35, x + 0.35],
                        [1.7 + e * 0.75 for e in ends],
                        color=RED,
                        linewidth=1.6,
                        alpha=0.75,
                        zorder=6,
                    )
            continue
        mass = expert[0]
        bar = Rectangle((x - 0.26, floor), 0.52, mass * scale, facecolor=color, zorder=3)
        bar.set_alpha(0.9)
        axes.add_patch(bar)
        write(
            axes,
            (x, floor + mass * scale + 0.14),
            f"{100 * mass:.0f} %",
            9.5,
            color=color,
            fontweight="bold",
            bbox={"facecolor": CARD, "edgecolor": "none", "pad": 1},
        )
        axes.plot([x, x], [1.38, 1.12], color=FAINT, linewidth=1.2, zorder=2)
    axes.plot([left + 0.4, left + 4.5], [floor, floor], color=INK, linewidth=1)
    write(
        axes, (left + 0.12, floor + 0.8), "router's mass, an example", 9, color=FAINT, rotation=90
    )
    if limit is not None:
        height = floor + limit * scale
        axes.plot([left + 0.4, left + 4.5], [height] * 2, color=RED, linewidth=1.2, dashes=(4, 3))
        write(axes, (left + 4.55, height), "too little", 8.5, color=RED, ha="left")
    box(axes, (left + 2.45, 0.95), (3.9, 0.34), "", FAINT)
    write(
        axes, (left + 2.45, 0.95), "frozen map  $W x$  +  $\\Sigma_i\\, p_i(x)\\, B_i A_i x$", 9.5
    )


def accuracy_matrix() -> Figure:
    """What the figures of a stream are means of."""
    figure, axes = canvas(10.4, 4.8)
    write(
        axes,
        (0.35, 4.42),
        "A stream of tasks: after each, the two towers are tested on all",
        13,
        ha="left",
        fontweight="bold",
    )
    _towers(axes, (1.75, 2.4))
    count, side, left, top = 5, 0.66, 4.35, 3.68
    for t in range(count):
        for i in range(count):
            kind = BLUE if i > t else (GREEN if i == t else YELLOW)
            cell = Rectangle((left + i * side, top - (t + 1) * side), side, side)
            cell.set(facecolor=kind, alpha=0.75 if i == t else 0.35, edgecolor=CARD, linewidth=2)
            axes.add_patch(cell)
            spot = (left + (i + 0.5) * side, top - (t + 0.5) * side)
            write(axes, spot, f"$R_{{{t + 1},{i + 1}}}$", 9.5)
    for k in range(count):
        write(axes, (left + (k + 0.5) * side, top + 0.15), f"{k + 1}", 9.5, color=FAINT)
        write(axes, (left - 0.16, top - (k + 0.5) * side), f"{k + 1}", 9.5, color=FAINT)
    width = count * side
    write(axes, (left + width / 2, top + 0.38), "tested on task", 9.5, color=FAINT)
    write(
        axes, (left - 0.42, top - width / 2), "after learning task", 9.5, color=FAINT, rotation=90
    )
    last = Rectangle((left, top - width), width, side, fill=False, edgecolor=INK, linewidth=2.2)
    last.set_zorder(4)
    axes.add_patch(last)
    x = left + 1.83 * side
    arrow(axes, (x, top - 1.7 * side), (x, top - 4.55 * side), RED, 2)
    right = left + width + 0.3
    notes = (
        (3.5, BLUE, "Transfer", "tasks not learned yet: mean of\neach column, then of these"),
        (2.72, GREEN, "Just learned", "on the diagonal"),
        (2.1, RED, "Forgetting", "yellow, along the arrow: the best\nsince learned, less the end"),
        (1.32, INK, "Last", "all tasks at the end"),
        (0.7, FAINT, "Average", "all cells"),
    )
    for y, color, name, meaning in notes:
        write(axes, (right, y), name, 11, color=color, ha="left", fontweight="bold")
        lower = 0.23 if "\n" not in meaning else 0.32
        write(axes, (right, y - lower), meaning, 8.5, ha="left")
    return figure


def _towers(axes: Axes, center: Spot) -> None:
    """A dual encoder: an image and a text tower whose outputs are compared."""
    x, y = center
    for side, name, read in (
        (-0.7, "image\ntower", "picture"),
        (0.7, "text\ntower", "class names"),
    ):
        shape = np.array([[-0.52, -0.7], [0.52, -0.7], [0.3, 0.6], [-0.3, 0.6]]) + (x + side, y)
        tower = Polygon(shape, facecolor="white", edgecolor=INK, linewidth=1.4, zorder=3)
        axes.add_patch(tower)
        write(axes, (x + side, y - 0.1), name, 9.5)
        write(axes, (x + side, y - 1.2), read, 9, color=FAINT)
        arrow(axes, (x + side, y - 1.05), (x + side, y - 0.74))
        arrow(axes, (x + side, y + 0.62), (x + side * 0.32, y + 1.05))
    axes.add_patch(Circle((x, y + 1.15), 0.22, facecolor="white", edgecolor=INK, zorder=4))
    write(axes, (x, y + 1.15), "cos", 8.5)
    write(
        axes,
        (x, y - 1.65),
        "frozen, with experts\nbeside their maps",
        8.5,
        color=FAINT,
        style="italic",
    )


PICTURES: dict[str, Callable[[], Figure]] = {
    "pipeline": pipeline,
    "projection": projection,
    "routing": routing,
    "accuracy-matrix": accuracy_matrix,
}


def main() -> None:
    parser = argparse.ArgumentParser(description="Draw the illustrations of README and docs.")
    parser.add_argument("folder", type=Path, nargs="?", default=Path(__file__).parent)
    parser.add_argument("--png", action="store_true", help="write PNG, to look at")
    asked = parser.parse_args()
    for name, draw in PICTURES.items():
        with rc_context(SETTINGS):
            # Without a date, equal drawings give equal bytes.
            options = {} if asked.png else {"metadata": {"Date": None}}
            path = asked.folder / f"{name}.{'png' if asked.png else 'svg'}"
            draw().savefig(path, transparent=True, dpi=120, **options)


if __name__ == "__main__":
    main()
