"""The curves of a training from `metrics.jsonl`: which figures, and a plot of one run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from aegis_cli.cli.render.layout import is_number
from aegis_cli.cli.render.plots import figure, literal, save_figure
from aegis_cli.common.errors import AegisError

_VQA_DROP = "vqa_drop_points"  # of the first question set; for others, their number follows
_DROP_ENDS = ("vqa_drop_low", "vqa_drop_high")
_COLUMNS = 2  # panels side by side


class Curve(NamedTuple):
    """A figure in the lines of metrics.

    Attributes:
        name: its field.
        log: whether its axis is logarithmic.
        scale: a factor that is applied before it is shown.
        ends: fields of the ends of its 95 % interval.
    """

    name: str
    title: str
    log: bool = False
    scale: float = 1.0
    ends: tuple[str, str] | None = None


_CURVES = (
    Curve("loss", "Training loss", log=True),
    Curve("validation_loss", "Validation loss"),
    Curve(_VQA_DROP, "VQA drop, validation (points)", ends=_DROP_ENDS),
    Curve(
        "rollout_success",
        "Success, validation (%)",
        scale=100.0,
        ends=("rollout_low", "rollout_high"),
    ),
    Curve("rollout_mean_return", "Mean return, validation", ends=("rollout_low", "rollout_high")),
    Curve(
        "action_error",
        "Error of held-out actions (1: of their mean)",
        ends=("action_error_low", "action_error_high"),
    ),
    Curve("energy_shed", "Energy shed (%)", log=True, scale=100.0),
    Curve("lr_backbone", "Learning rate of the backbone"),
    Curve("step_s", "Time of a step (s)"),
)


def curves(sets: Sequence[str]) -> Iterator[Curve]:
    """The figures that a training may have logged, with a VQA drop for each question set."""
    for curve in _CURVES:
        if curve.name != _VQA_DROP or len(sets) < 2:
            yield curve
            continue
        for number, name in enumerate(sets, start=1):
            end = "" if number == 1 else f"_{number}"
            short = name.rpartition("/")[2]  # the last part of a path
            low, high = _DROP_ENDS
            yield Curve(
                f"{_VQA_DROP}{end}",
                f"VQA drop on {short}, validation (points)",
                ends=(f"{low}{end}", f"{high}{end}"),
            )


def points(
    lines: Sequence[Mapping[str, Any]], name: str, scale: float
) -> list[tuple[float, float]]:
    """(step, value) of the lines that have the figure; not every line has every figure."""
    return [(line["step"], scale * line[name]) for line in lines if is_number(line.get(name))]


def curves_plot(
    lines: Sequence[Mapping[str, Any]], sets: Sequence[str], title: str, path: Path
) -> None:
    """Draw a panel for each figure that a run has logged, over its steps.

    Figures of validations have their 95 % intervals as bars.

    Args:
        lines: the lines of its `metrics.jsonl`.
        sets: the question sets that it was asked.

    Raises:
        AegisError: nothing was logged yet, matplotlib missing, unknown suffix, or `path` cannot be
            written.
    """
    there = [curve for curve in curves(sets) if points(lines, curve.name, 1.0)]
    if not there:
        raise AegisError(
            f"no metrics logged yet by {title}",
            "a run that has logged its first step",
            "leave out --plot, or let the run train on",
        )
    save_figure(lambda: _drawn(lines, there, title), path)


def _drawn(lines: Sequence[Mapping[str, Any]], there: Sequence[Curve], title: str) -> Any:
    columns = min(_COLUMNS, len(there))
    count = -(-len(there) // columns)
    drawn = figure(figsize=(9.5, 0.5 + 2.3 * count), layout="constrained")
    drawn.suptitle(literal(title), x=0.01, ha="left", fontsize=12, fontweight="bold")
    panels = list(drawn.subplots(count, columns, squeeze=False).flat)
    for axes, curve in zip(panels, there, strict=False):
        _draw_curve(axes, lines, curve)
    for axes in panels[len(there) :]:
        axes.set_visible(False)
    return drawn


def _draw_curve(axes: Any, lines: Sequence[Mapping[str, Any]], curve: Curve) -> None:
    from matplotlib.ticker import LogLocator, MaxNLocator

    steps, values = zip(*points(lines, curve.name, curve.scale), strict=True)
    # With few lines, each one has a mark.
    axes.plot(steps, values, color="tab:blue", marker="o" if len(steps) <= 40 else None, ms=3)
    if curve.ends is not None:
        low, high = curve.ends
        known = [line for line in lines if is_number(line.get(low)) and is_number(line.get(high))]
        axes.vlines(
            [line["step"] for line in known],
            [curve.scale * line[low] for line in known],
            [curve.scale * line[high] for line in known],
            color="tab:blue",
            alpha=0.4,
        )
    # Within a factor of two, a logarithmic axis looks linear and has no ticks.
    if curve.log and 0 < 2 * min(values) < max(values):
        axes.set_yscale("log")
        axes.yaxis.set_minor_locator(LogLocator(subs=(2, 5)))
        axes.yaxis.set_minor_formatter("{x:g}")
    axes.set_title(literal(curve.title), loc="left", fontsize=9)
    axes.set_xlabel("training step", fontsize=8)
    axes.tick_params(labelsize=8, which="both")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3)
