"""Draw docs/pictures/published.png: what SmolLM2-135M still names against how well it acts.

    python docs/pictures/published.py [FILE]

It reads the cells that lie beside docs/results/published.md.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

HERE = Path(__file__).parent
RESULTS = HERE.parent / "results"
PANELS = {"300 steps, three seeds": "published", "1,200 steps, one seed": "published-longer"}
# Colours that the common kinds of colour blindness tell apart, as in Aegis's own plots.
LOOKS = {
    ("frozen", "0.0001"): ("frozen", "#009e73"),
    ("naive", "0.0001"): ("naive", "#1a1a1a"),
    ("naive", "3e-05"): ("naive, a third of the rate", "#9a9a9a"),
    ("aegis", "0.0001"): ("aegis", "#d55e00"),
    ("nullspace", "0.0003"): ("nullspace", "#0072b2"),
    ("kfac", "0.0003"): ("kfac", "#cc79a7"),
}
ASKED = 249  # capitals


def draw(path: Path) -> None:
    """Write the picture."""
    figure = Figure(figsize=(10.5, 4.6), layout="constrained")
    panels = figure.subplots(1, len(PANELS), sharey=True)
    for axis, (title, name) in zip(panels, PANELS.items(), strict=True):
        text = (RESULTS / f"{name}.cells.json").read_text(encoding="utf-8")
        draw_panel(axis, title, json.loads(text))
    panels[0].set_ylabel(f"capitals named, of {ASKED}")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=7, frameon=False)
    figure.savefig(path, dpi=150)


def draw_panel(axis: Axes, title: str, cells: dict[str, dict[str, float]]) -> None:
    """One point a run; better to the upper right, where the error is small."""
    before = ASKED * cells["pretrained"]["capitals"]
    axis.axhline(before, color="0.3", linestyle="--", linewidth=1, label="before training")
    named: set[str] = set()
    for name, cell in cells.items():
        if name == "pretrained":
            continue
        method, rate, _ = name.rsplit("_", 2)
        label, color = LOOKS[method, rate]
        axis.plot(
            cell["error_seen"],
            ASKED * cell["capitals"],
            linestyle="",
            marker="o",
            markersize=8,
            alpha=0.8,
            color=color,
            label="" if label in named else label,
        )
        named.add(label)
    axis.set(title=title, xscale="log", xlim=(1.2, 0.004), ylim=(-2.5, before + 5))
    axis.set_xlabel("error of the actions, as a share of their variance")
    axis.set_xticks([1, 0.3, 0.1, 0.03, 0.01], ["1", "0.3", "0.1", "0.03", "0.01"])
    axis.minorticks_off()
    axis.grid(color="0.92")
    axis.spines[["top", "right"]].set_visible(False)
    arrow = {"arrowstyle": "->", "color": "0.3"}
    axis.annotate("better", (0.66, 0.5), (0.52, 0.36), "axes fraction", "axes fraction", arrow)


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "published.png")
