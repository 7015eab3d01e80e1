"""A study's tables, task by task: what each variant keeps and does, what it costs, and who passes
the bar.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from aegis_cli.cli.render.layout import acting, fixed, percent, plain_table, spread


def study(report: Any) -> RenderableType:
    """Everything a study found; with five seeds, each table fits 120 columns."""
    parts: list[RenderableType] = (
        [] if report.tasks else [Text(f"{report.name}: tuning", "bold"), _tried(report.tuning)]
    )
    for task in report.tasks:
        before = (
            f"VQA {percent(task.baseline_accuracy)} %, cross-entropy "
            f"{fixed(task.baseline_cross_entropy, 3)} nats"
        )
        majority = f"always the commonest answer: {percent(task.majority_accuracy)} %"
        parts += [
            Text(f"{report.name}: {task.task}", "bold"),
            _kept(task.results),
            _costs(task.results),
        ]
        parts += [
            *_against_naive(task.results),
            *_diverged(task.results),
            Text(f"before fine-tuning: {before}; {majority}\n"),
        ]
    return Group(*parts, Text("\n".join(_notes(report))))


def _tried(points: Sequence[Any]) -> Table:
    """The knobs' values so far, while nothing has been compared yet."""
    rows = [
        (
            p.variant,
            "-" if p.value is None else value_text(p.value),
            *map(percent, (p.accuracy, p.success)),
        )
        for p in points
    ]
    return plain_table(("Variant", "Value", "VQA %", "Success or return %"), rows, left=2)


def _kept(results: Sequence[Any]) -> Table:
    acts = acting(results)
    header = ["Variant", "Knob", "Drop (points)", "Cross-entropy (nats)", *acts]
    rows = [
        [
            r.variant,
            knob_text(r),
            spread(r.drop_points, _digits(2)),
            spread(r.cross_entropy, _digits(3)),
            *(spread(getattr(r, field), percent) for field in acts.values()),
        ]
        for r in results
    ]
    if not any(r.knob for r in results):
        header, rows = [header[0], *header[2:]], [[row[0], *row[2:]] for row in rows]
    return plain_table(header, rows, left=len(header) - 2 - len(acts))


def _costs(results: Sequence[Any]) -> Table:
    header = (
        "Variant",
        "Validation loss",
        "W2²",
        "Energy shed %",
        "Leak %",
        "Step x naive",
        "Memory x naive",
    )
    rows = [
        (
            r.variant,
            spread(r.validation_loss, _digits(4)),
            spread(r.w2, _three),
            spread(r.energy_shed, _percent_2),
            spread(r.leak, _percent_2),
            fixed(r.step_time, 2),
            fixed(r.peak_memory, 2),
        )
        for r in results
    ]
    return plain_table(header, rows)


def _against_naive(results: Sequence[Any]) -> list[RenderableType]:
    """One line a variant: differences by seed, and its verdict; of returns, the
    differences alone.
    """
    if any(r.return_gain_points for r in results):
        rows = [
            (r.variant, spread(r.return_gain_points, _signed))
            for r in results
            if r.variant != "naive"
        ]
        return [plain_table(("Variant", "Return - naive (points)"), rows)]
    if all(r.seen_gain_points is None and r.held_out_gain_points is None for r in results):
        return []
    header = (
        "Variant",
        "Drop",
        "Seen - naive (points)",
        "Held-out - naive (points)",
        "Step time",
        "No VQA data",
        "Bar",
    )
    rows = []
    for r in results:
        figures = (
            fixed(r.drop_points and r.drop_points.mean, 2),
            spread(r.seen_gain_points, _signed),
            spread(r.held_out_gain_points, _signed),
            fixed(r.step_time, 2),
            "",
        )
        verdicts = (
            [verdict_text(check.passed) for check in r.bar.checks]
            if r.bar
            else [""] * 4 + [_data_free(r.method)]
        )
        if r.variant != "naive":
            cells = [
                f"{figure} {verdict}".strip()
                for figure, verdict in zip(figures, verdicts, strict=True)
            ]
            rows.append((r.variant, *cells, verdict_text(r.bar.passed) if r.bar else "-"))
    return [plain_table(header, rows)]


def _diverged(results: Sequence[Any]) -> list[RenderableType]:
    return [
        Text(
            f"{r.variant}: diverged with seed {', '.join(map(str, r.diverged))}; its figures "
            "are of the other seeds, the bar is missed"
        )
        for r in results
        if r.diverged
    ]


def _data_free(method: str) -> str:
    """Of a variant without a bar: another naive has no VQA data either, the rest are ceilings."""
    return "yes" if method == "naive" else "no"


def _notes(report: Any) -> list[str]:
    runs = ", ".join(map(str, report.seeds))
    notes = [f"mean ±95 % interval (Student's t) over seeds {runs}"]
    if report.finished < report.cells:
        notes[0] += f"; {report.finished} of {report.cells} trainings are finished"
    results = [r for task in report.tasks for r in task.results]
    bars = [r.bar for r in results if r.bar]
    if results and not any(r.variant == "naive" for r in results):
        notes.append(
            "no variant is named naive, so there are no differences to it, no bar and no costs"
        )
    elif bars:
        demands = [f"{check.name} {check.demand}" for check in bars[0].checks]
        notes.append(f"bar: {'; '.join(demands[:3])};\n  {'; '.join(demands[3:])}")
    if report.tuning:
        notes.append(
            f"knobs, by validation scenes and episodes of {report.tuning_task}: of a variant's "
            f"values within {report.within:g} "
            "points of naive's best success,\n"
            "  the one with the highest VQA accuracy; if none is within, the one with the "
            "highest success"
        )
    return [*notes, f"files: {report.out}"]


def knob_text(result: Any) -> str:
    """The key's last word and its value: `energy 0.999`."""
    return (
        "-"
        if result.knob is None
        else f"{result.knob.rpartition('.')[2]} {value_text(result.value)}"
    )


def value_text(value: Any) -> str:
    """A knob's value, short."""
    if isinstance(value, (list, tuple)):
        return "+".join(map(value_text, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def verdict_text(passed: bool | None) -> str:
    """Of a demand or a bar."""
    return {True: "yes", False: "no", None: "?"}[passed]


def _digits(count: int) -> Callable[[float], str]:
    return lambda value: fixed(value, count)


def _percent_2(value: float) -> str:
    return percent(value, 2)


def _three(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _signed(value: float) -> str:
    return f"{value:+.1f}"
