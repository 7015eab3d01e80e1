"""A study of streams as tables: accuracies told and inferred, parameters, reuse on the pairs, and
who passes the bar.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from aegis_cli.cli.render.layout import fixed, number, percent, plain_table, spread
from aegis_cli.cli.render.studies import knob_text, value_text, verdict_text


def stream_study(report: Any) -> RenderableType:
    """Everything a study of streams found."""
    parts: list[RenderableType] = [Text(f"{report.name}: {', '.join(report.streams)}", "bold")]
    if report.tuning:
        parts += _tuning(report)
    if report.results:
        parts += [
            _accuracies(report.results, "told"),
            _accuracies(report.results, "inferred"),
            _trained(report.results),
            _kept(report.results),
        ]
        parts += [_pair(report, letter) for letter in ("a", "b")] if report.pairs else []
        parts += [_bars(report.results)] if any(r.bar for r in report.results) else []
    return Group(*parts, Text("\n".join(_notes(report))))


def _tuning(report: Any) -> list[RenderableType]:
    rows = [
        (
            p.variant,
            value_text(p.value),
            percent(p.last),
            number(p.parameters),
            "x" if p.chosen else "",
        )
        for p in report.tuning
    ]
    header = ("Variant", "Value", "Validation Last %", "Final parameters", "Chosen")
    rule = (
        f"on validation parts of {report.tuning_stream}: of a variant's values within "
        f"{report.within:g} points of its best\n"
        "  Last, the one with the fewest final parameters; ties by Last"
    )
    return [plain_table(header, rows, title="Knobs"), Text(rule + "\n")]


def _accuracies(results: Sequence[Any], how: str) -> Table:
    rows = [
        (
            r.variant,
            knob_text(r),
            spread(found.transfer, percent),
            spread(found.average, percent),
            spread(found.last, percent),
            spread(found.forgetting, _points),
        )
        for r, found in ((r, getattr(r, how)) for r in results)
    ]
    header = ("Variant", "Knob", "Transfer %", "Average %", "Last %", "Forgetting (points)")
    return plain_table(header, rows, left=2, title=f"Task {how}")


def _trained(results: Sequence[Any]) -> Table:
    header = ("Variant", "In phase 1", "In phase 2, or the only one", "Mean of steps")
    rows = [
        (r.variant, *(spread(e, number) for e in (r.trained_phase1, r.trained, r.trained_mean)))
        for r in results
    ]
    return plain_table(header, rows, title="Parameters trained, mean of tasks")


def _kept(results: Sequence[Any]) -> Table:
    header = (
        "Variant",
        "Final parameters",
        "x isolated LoRA's",
        "Last - half rank's",
        "To tell tasks",
        "Mass on history %",
        "Minutes",
    )
    rows = [
        (
            r.variant,
            spread(r.parameters, number),
            spread(r.parameters_ratio, _two),
            spread(r.half_gain_points, _signed),
            _mean(r.inference_parameters),
            spread(r.reuse, percent),
            spread(r.minutes, _two),
        )
        for r in results
    ]
    return plain_table(header, rows, title="Parameters kept, and time")


def _pair(report: Any, letter: str) -> Table:
    header = (
        "Variant",
        "Stored, % of a fresh task's",
        "Experts, % of a fresh task's",
        "Second task - isolated LoRA's (points)",
        "First task afterwards (points)",
    )
    pairs = [(r.variant, getattr(r, f"pair_{letter}")) for r in report.results]
    rows = [
        (
            name,
            spread(p.added, percent),
            spread(p.new_experts, percent),
            spread(p.second_gain_points, _signed),
            spread(p.first_change_points, _signed),
        )
        for name, p in pairs
    ]
    stream = getattr(report.pairs, letter)
    return plain_table(
        header, rows, title=f"Pair {letter.upper()}, what its second task adds: {stream}"
    )


def _bars(results: Sequence[Any]) -> Table:
    """A line a demand, a column a variant."""
    barred = [r for r in results if r.bar]
    rows = [
        (check.name, *(_checked(r.bar.checks[i]) for r in barred))
        for i, check in enumerate(barred[0].bar.checks)
    ]
    rows.append(("all", *(verdict_text(r.bar.passed) for r in barred)))
    return plain_table(("Demand", *(r.variant for r in barred)), rows, title="Bar")


def _checked(check: Any) -> str:
    return f"{'-' if check.value is None else f'{check.value:.3g}'} {verdict_text(check.passed)}"


def _notes(report: Any) -> list[str]:
    notes = [
        "mean over streams, ±95 % interval (Student's t) over seeds "
        f"{', '.join(map(str, report.seeds))}; "
        "a fresh task is the first of the pair; what learns nothing has no seeds"
    ]
    if report.finished < report.cells:
        notes[0] += f"; {report.finished} of {report.cells} runs are finished"
    if any(r.half_gain_points for r in report.results):
        notes.append("half rank's: the variant isolated-lora-half's, in points")
    barred = [r.bar for r in report.results if r.bar]
    if barred:
        notes.append(
            "bar:\n" + "\n".join(f"  {check.name} {check.demand}" for check in barred[0].checks)
        )
    for r in report.results:
        if r.diverged:
            said = (
                f"diverged in {', '.join(r.diverged)}; its figures are of the other runs, "
                "the bar is missed"
            )
            notes.append(f"{r.variant}: {said}")
        if r.bar:
            notes.append(f"{r.variant} {_said(r)}")
    return [*notes, f"files: {report.out}"]


def _said(result: Any) -> str:
    """The verdict in words."""
    failed = [f"{c.name} {c.value:.3g}" for c in result.bar.checks if c.passed is False]
    unknown = [c.name for c in result.bar.checks if c.passed is None]
    if result.bar.passed:
        return "passes the bar"
    if result.bar.passed is None:
        return f"has no verdict; not measured: {', '.join(unknown)}"
    return "\n  ".join(["misses the bar" + (":" if failed else ""), *failed])


def _mean(estimate: Any) -> str:
    return number(None if estimate is None else estimate.mean)


def _points(value: float) -> str:
    return percent(value, 2)


def _signed(value: float) -> str:
    return f"{value:+.2f}"


def _two(value: float) -> str:
    return fixed(value, 2)
