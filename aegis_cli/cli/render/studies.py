"""A study's tables: each variant's VQA, success and costs, and who passes the bar.

The columns are those that the results declare; see `studies/metrics.py`.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from aegis_cli.cli.render.layout import (
    MARKS,
    Cell,
    acting,
    fixed,
    marked,
    number,
    percent,
    plain_table,
    spread,
    unmarked,
)
from aegis_cli.studies.metrics import Column, columns, deciding_decimals, unmeasured
from aegis_cli.studies.tuning import (
    OPEN_LOOP_RULE,
    POLICY_RULE,
    ROBOT_STREAM_RULE,
    STREAM_RULE,
    Rule,
)


def study(report: Any) -> RenderableType:
    """All results of a study of policies; with five seeds, each table fits into 120 columns."""
    parts: list[RenderableType] = []
    if not report.tasks:
        parts += [Text(f"{report.name}: tuning", "bold"), _tried(report.tuning)]
    for task in report.tasks:
        before = (
            f"VQA {percent(task.baseline_accuracy)} %, cross-entropy "
            f"{fixed(task.baseline_cross_entropy, 3)} nats"
        )
        majority = f"always the commonest answer: {percent(task.majority_accuracy)} %"
        asked = f", asked {task.vqa}" if task.vqa else ""  # if there are several question sets
        fields = (*_KEPT, *_acting(task.results))
        parts += [
            Text(f"{report.name}: {task.task}{asked}", "bold"),
            _table(task.results, fields, knob=any(r.knob for r in task.results)),
            _table(task.results, _COSTS),
            *_references(task.results),
            *_against_naive(task.results),
            *_diverged(task.results),
            Text(f"before fine-tuning: {before}; {majority}\n"),
        ]
    return Group(*parts, Text("\n".join(_notes(report))))


def stream_study(report: Any) -> RenderableType:
    """All results of a study of streams."""
    parts: list[RenderableType] = [Text(f"{report.name}: {', '.join(report.streams)}", "bold")]
    if report.tuning:
        parts += _stream_tuning(report)
    results = report.results
    if results:
        parts += [
            _table(results, part="told", knob=True, title="Task told"),
            _table(results, part="inferred", knob=True, title="Task inferred"),
            _table(results, _TRAINED, title="Parameters trained, mean of tasks"),
            _table(results, _STORED, title="Parameters kept, and time"),
        ]
        for letter in ("a", "b") if report.pairs else ():
            stream = getattr(report.pairs, letter)
            title = f"Pair {letter.upper()}, what its second task adds: {stream}"
            parts.append(_table(results, _PAIR, f"pair_{letter}", title=title))
        if any(r.bar for r in results):
            parts.append(_bars(results))
    return Group(*parts, Text("\n".join(_stream_notes(report))))


def robot_stream_study(report: Any) -> RenderableType:
    """All results of a study of a stream of robot tasks."""
    parts: list[RenderableType] = [Text(f"{report.name}: {', '.join(report.tasks)}", "bold")]
    if report.tuning:
        parts += _robot_tuning(report)
    if report.results:
        parts += [
            _table(report.results, _ACTED, knob=True, title="Success, with the task told"),
            _table(report.results, _KNOWN, title="What is known at the end, and its price"),
            *(_matrix(result, report.tasks) for result in report.results),
        ]
    return Group(*parts, Text("\n".join(_robot_notes(report))))


def _acting(results: Sequence[Any]) -> tuple[str, ...]:
    """The fields for how well policies act: in closed loop, or by their open-loop error."""
    closed = tuple(acting(results).values())
    acted = any(getattr(r, field) is not None for r in results for field in closed)
    opened = [field for field in _OPENED if any(getattr(r, field) is not None for r in results)]
    return tuple(opened) if opened and not acted else closed


OPEN_LOOP = (
    "nothing could be rolled out: the open-loop error is not a success rate, nor a measure of it.\n"
    "  It is the squared error of actions on held-out episodes over their variance in training:\n"
    "  the mean action has 1; no policy's error is the lesser of 1 and that of holding the position"
)


# --- columns that results declare -----------------------------------------------------------------

_KEPT = ("drop_points", "cross_entropy")
_OPENED = ("open_loop_error", "hold_error")
_GAINS = ("seen_gain_points", "held_out_gain_points")
_EVALUATED = ("open_loop_difference", "open_loop_over_still")  # if nothing was rolled out
_COSTS = ("validation_loss", "w2", "energy_shed", "step_time", "peak_memory")
_TRAINED = ("trained_phase1", "trained", "trained_mean")
_STORED = (
    "parameters",
    "parameters_ratio",
    "half_gain_points",
    "inference_parameters",
    "reuse",
    "minutes",
)
_PAIR = ("added", "new_experts", "reuse", "second_gain_points", "first_change_points")
_ACTED = ("last", "learned", "average", "forgetting", "last_gain_points")
_KNOWN = (
    "accuracy",
    "drop_points",
    "parameters",
    "parameters_ratio",
    "trained_mean",
    "reuse",
    "minutes",
)
_MEANS_ALONE = {"inference_parameters"}  # shown without an interval, since it hardly varies


def _table(
    results: Sequence[Any],
    fields: Iterable[str] | None = None,
    part: str | None = None,
    knob: bool = False,
    title: str | None = None,
) -> Table:
    """A line per variant and a column per field.

    Args:
        fields: fields of a result, or of its `part`; by default all declared fields.
        knob: whether each variant's knob is shown.
    """
    shown = results if part is None else [getattr(r, part) for r in results]
    declared = columns(type(shown[0]))
    fields = tuple(fields or declared)
    named = [(r.variant, knob_text(r)) if knob else (r.variant,) for r in results]
    drawn = [_column(shown, field) for field in fields]  # by column, since marks compare columns
    by_variant = zip(*drawn, strict=True)
    rows = [(*name, *cells) for name, cells in zip(named, by_variant, strict=True)]
    names = ("Variant", "Knob") if knob else ("Variant",)
    header = (*names, *(declared[field].header for field in fields))
    return plain_table(header, rows, left=len(names), title=title)


def _column(results: Sequence[Any], field: str) -> list[Cell]:
    """A field of each result, with marks for the best and the worst mean."""
    found = [getattr(result, field) for result in results]
    values = [x if x is None or isinstance(x, float) else x.mean for x in found]
    cells = [_figure(result, field) for result in results]
    declared = columns(type(results[0]))[field]
    show = shown_as(declared)
    by_mean = marked([show(value) for value in values], values, declared.more_is_better)
    # Means with the same text share a mark, even with different intervals.
    shown: list[Cell] = []
    for mean, cell in zip(by_mean, cells, strict=True):
        if isinstance(mean, Text):
            mark, _ = unmarked(mean)
            shown.append(Text(mark + cell, mean.style))
        else:
            shown.append(cell)
    return shown


def _figure(result: Any, field: str) -> str:
    """A figure in its declared form: a mean with its interval, or a plain number."""
    show = shown_as(columns(type(result))[field])
    found = getattr(result, field)
    if found is None or isinstance(found, float):
        return show(found)
    return show(found.mean) if field in _MEANS_ALONE else spread(found, show)


def shown_as(column: Column) -> Callable[[float | None], str]:
    """How a column shows a value: in its unit, with its digits and its sign.

    A value that rounds to 0 has no sign, because it may be slightly below 0.
    """

    def show(value: float | None) -> str:
        value = None if value is None else column.shown(value)
        if column.decimals is None:
            return number(value, column.significant)
        text = fixed(value, column.decimals)
        is_more = value is not None and value > 0 and float(text) > 0  # also after rounding
        return f"+{text}" if column.signed and is_more else text

    return show


# --- policies -------------------------------------------------------------------------------------


def _tried(points: Sequence[Any]) -> Table:
    """The knobs' values so far, before anything has been compared."""
    by_error = any(point.open_loop_error is not None for point in points)
    rows = []
    for point in points:
        value = "-" if point.value is None else value_text(point.value)
        acts = fixed(point.open_loop_error, 3) if by_error else percent(point.success)
        rows.append((point.variant, value, percent(point.accuracy), acts))
    acts = "Open-loop error" if by_error else "Success or return %"
    return plain_table(("Variant", "Value", "VQA %", acts), rows, left=2)


def _references(results: Sequence[Any]) -> list[RenderableType]:
    """The reference of each variant, and the difference of their drops.

    It is empty if all variants are compared with naive.
    """
    if not any(r.against for r in results):
        return []
    field = "drop_difference_points"
    header = ("Variant", "Reference", columns(type(results[0]))[field].header)
    compared = [r for r in results if r.against or r.variant != "naive"]
    rows = [(r.variant, r.against or "naive", _figure(r, field)) for r in compared]
    return [plain_table(header, rows, left=2)]


def _decimals_of_step_time(result: Any) -> int:
    """Two decimals, or as many as are needed to show the bar's verdict."""
    checks = result.bar.checks if result.bar else ()
    # The check of the step time is found by its value, because check names are for readers.
    judged = [c for c in checks if c.value is not None and c.value == result.step_time]
    return max([2, *(deciding_decimals(c.value, c.demand, 2) for c in judged)])


def _against_naive(results: Sequence[Any]) -> list[RenderableType]:
    """One line per variant: its differences by seed, and its verdict.

    For returns there are only differences.
    """
    others = [r for r in results if r.variant != "naive" or r.against]
    if any(r.return_gain_points for r in results):
        return [_table(others, ("return_gain_points",))]
    gains = next((each for each in (_GAINS, _EVALUATED) if _has_any(results, each)), None)
    if gains is None:
        return []
    declared = columns(type(results[0]))
    header = (
        "Variant",
        "Drop",
        *(declared[field].header for field in gains),
        "Step time",
        "No VQA data",
        "Bar",
    )
    rows = []
    for r in others:
        figures = (
            _figure(r, "drop_points"),
            *(_figure(r, field) for field in gains),
            fixed(r.step_time, _decimals_of_step_time(r)),
            "",
        )
        # Without a bar, a variant is either another naive, without VQA data, or a ceiling.
        verdicts = [""] * 4 + ["yes" if r.method == "naive" else "no"]
        if r.bar:  # its demands are in the order of these columns
            verdicts = [verdict_text(check.passed) for check in r.bar.checks]
        checked = []
        for figure, verdict in zip(figures, verdicts, strict=True):
            checked.append(f"{figure} {verdict}".strip())
        rows.append((r.variant, *checked, verdict_text(r.bar.passed) if r.bar else "-"))
    return [plain_table(header, rows)]


def _has_any(results: Sequence[Any], fields: Iterable[str]) -> bool:
    return any(getattr(r, field) is not None for r in results for field in fields)


def _diverged(results: Sequence[Any]) -> list[RenderableType]:
    return [
        Text(
            f"{r.variant}: diverged with seed {', '.join(map(str, r.diverged))}; its figures "
            "are of the other seeds, the bar is missed"
        )
        for r in results
        if r.diverged
    ]


def _notes(report: Any) -> list[str]:
    runs = ", ".join(map(str, report.seeds))
    notes = [
        f"mean ±95 % interval over seeds {runs}: the wider of Student's t and, where cells tell,\n"
        f"  of a bootstrap over seeds and images or episodes; {MARKS}"
    ]
    if report.finished < report.cells:
        notes.append(f"{report.finished} of {report.cells} trainings are finished")
    results = [r for task in report.tasks for r in task.results]
    bars = [r.bar for r in results if r.bar]
    if results and not any(r.variant == "naive" for r in results):
        notes.append(
            "no variant is named naive, so there are no differences to it, no bar and no costs"
        )
    elif bars:
        demands = [f"{check.name} {check.demand}" for check in bars[0].checks]
        said = f"bar, by the worse end of each interval: {'; '.join(demands)}"
        notes.append(textwrap.fill(said, 100, subsequent_indent="  "))
        for task in report.tasks:
            barred = [r.bar for r in task.results if r.bar]
            unknown = unmeasured([{c.name: c.value for c in bar.checks} for bar in barred])
            if unknown:
                notes.append(f"on {task.task} no variant can pass the bar: no figure of {unknown}")
    if any(r.open_loop_error is not None for r in results):
        notes.append(OPEN_LOOP)
    if any(r.against for r in results):
        notes.append("where a variant has a reference of its own, 'naive' stands for that")
    mixed = sum(task.across_versions for task in report.tasks)
    pairs = sum(task.compared for task in report.tasks)
    if mixed:
        notes.append(
            f"{mixed} of {pairs} paired differences are of cells that two versions of the code "
            "measured"
        )
    if report.costs_on:
        notes.append(f"step times and memory were measured on: {'; '.join(report.costs_on)}")
    if report.tuning:
        by_error = any(point.open_loop_error is not None for point in report.tuning)
        rule = OPEN_LOOP_RULE if by_error else POLICY_RULE
        notes.append(_rule(rule, report.tuning_task, report.within))
    return [*notes, f"files: {report.out}"]


def _knobs(
    points: Sequence[Any], shown: Mapping[str, Callable[[Any], str]], rule: str
) -> list[RenderableType]:
    """The values that were tried on validation data, and how one of them was chosen.

    Args:
        shown: header -> a function that formats a value's figure.
    """
    rows = []
    for point in points:
        figures = [show(point) for show in shown.values()]
        chosen = "x" if point.chosen else ""
        rows.append((point.variant, value_text(point.value), *figures, chosen))
    header = ("Variant", "Value", *shown, "Chosen")
    return [plain_table(header, rows, title="Knobs"), Text(rule + "\n")]


def _rule(rule: Rule, place: str, within: float) -> str:
    """How knobs were chosen, in lines of the same length as other notes."""
    return textwrap.fill(f"knobs {rule.explain(place, within)}", 100, subsequent_indent="  ")


# --- streams --------------------------------------------------------------------------------------


def _stream_tuning(report: Any) -> list[RenderableType]:
    shown = {
        "Validation Last %": lambda p: percent(p.last),
        "Final parameters": lambda p: number(p.parameters),
    }
    return _knobs(report.tuning, shown, _rule(STREAM_RULE, report.tuning_stream, report.within))


def _bars(results: Sequence[Any]) -> Table:
    """A line per demand, a column per variant."""
    barred = [r for r in results if r.bar]
    rows = []
    for i, check in enumerate(barred[0].bar.checks):  # all variants have the same demands
        rows.append((check.name, *(_checked(r.bar.checks[i]) for r in barred)))
    rows.append(("all", *(verdict_text(r.bar.passed) for r in barred)))
    return plain_table(("Demand", *(r.variant for r in barred)), rows, title="Bar")


def _checked(check: Any) -> str:
    value = "-" if check.value is None else _judged(check)
    design = ", by design" if check.by_design and check.passed else ""
    return f"{value} {verdict_text(check.passed)}{design}"


def _judged(check: Any) -> str:
    """A value with three digits, or as many as are needed to show its verdict."""
    shown = f"{check.value:.3g}"
    if check.interval is not None:  # judged by an end of the interval, not by this value
        return shown
    decimals = len(shown.partition(".")[2]) if "e" not in shown else 2  # 1e+06 has no decimals
    needed = deciding_decimals(check.value, check.demand, decimals)
    return shown if needed == decimals else fixed(check.value, needed)


def _stream_notes(report: Any) -> list[str]:
    notes = [
        "mean over streams, ±95 % interval (Student's t) over seeds "
        f"{', '.join(map(str, report.seeds))}; "
        "a fresh task is the first of the pair; what learns nothing has no seeds"
    ]
    if report.finished < report.cells:
        notes[0] += f"; {report.finished} of {report.cells} runs are finished"
    notes.append(MARKS)
    if any(r.half_gain_points for r in report.results):
        notes.append("half rank's: the variant isolated-lora-half's, in points")
    barred = [r.bar for r in report.results if r.bar]
    if barred:
        demands = [f"  {check.name} {check.demand}" for check in barred[0].checks]
        notes.append("\n".join(["bar, by the worse end of each interval:", *demands]))
    for r in report.results:
        if r.diverged:
            runs = ", ".join(r.diverged)
            notes.append(
                f"{r.variant}: diverged in {runs}; its figures are of the other runs, "
                "the bar is missed"
            )
        if r.bar:
            notes.append(f"{r.variant} {_verdict(r.bar)}")
    return [*notes, f"files: {report.out}"]


def _verdict(bar: Any) -> str:
    """The verdict in words."""
    failed = [f"{check.name} {check.value:.3g}" for check in bar.checks if check.passed is False]
    unknown = [check.name for check in bar.checks if check.passed is None]
    if bar.passed:
        return "passes the bar"
    if bar.passed is None:
        said = f"has no verdict; not measured: {', '.join(unknown)}"
        return textwrap.fill(said, 100, subsequent_indent="  ")
    return "\n  ".join(["misses the bar" + (":" if failed else ""), *failed])


# --- robot streams --------------------------------------------------------------------------------


def _robot_tuning(report: Any) -> list[RenderableType]:
    shown = {
        "Validation success %": lambda p: percent(p.last),
        "Validation VQA %": lambda p: percent(p.accuracy),
    }
    return _knobs(report.tuning, shown, _rule(ROBOT_STREAM_RULE, "the stream", report.within))


def _matrix(result: Any, tasks: Sequence[str]) -> Table:
    """A line per learned task: the success on all tasks so far, and the VQA points lost."""
    rows = []
    for after in result.after:
        shown = [spread(found, percent) for found in after.success]
        missing = ["-"] * (len(tasks) - len(shown))
        lost = spread(after.drop_points, lambda value: fixed(value, 2))
        rows.append((after.task, *shown, *missing, lost))
    header = ("After", *(f"{task} %" for task in tasks), "VQA lost (points)")
    return plain_table(header, rows, title=f"{result.variant}: task by task")


def _robot_notes(report: Any) -> list[str]:
    seeds = ", ".join(map(str, report.seeds))
    notes = [f"mean ±95 % interval (Student's t) over seeds {seeds}; {MARKS}"]
    if report.finished < report.cells:
        notes.append(f"{report.finished} of {report.cells} runs are finished")
    for r in report.results:
        if r.diverged:
            runs = ", ".join(map(str, r.diverged))
            notes.append(f"{r.variant}: diverged with seed {runs}; its figures are of the others")
    return [*notes, f"files: {report.out}"]


# --- words ----------------------------------------------------------------------------------------


def knob_text(result: Any) -> str:
    """The last word of each knob's key with its value: `energy 0.999`."""
    if result.knob is None:
        return "-"
    knobs = result.knob.split(", ")  # joined like this by `Variant.knob`; no key has a comma
    values = result.value if len(knobs) > 1 else [result.value]
    named = zip(knobs, values, strict=True)
    return ", ".join(f"{knob.rpartition('.')[2]} {value_text(value)}" for knob, value in named)


def value_text(value: Any) -> str:
    """A knob's value, short."""
    if isinstance(value, (list, tuple)):
        return "+".join(map(value_text, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def verdict_text(passed: bool | None) -> str:
    """Whether a demand or bar is passed."""
    return {True: "yes", False: "no", None: "?"}[passed]
