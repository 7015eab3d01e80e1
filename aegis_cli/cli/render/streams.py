"""A stream as tables: its matrix with the figures, parameters, and the routing per map.

The matrix has accuracies for images; for robots it has successes or open-loop errors, beside the
backbone's VQA figures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from aegis_cli.cli.render.layout import Cell, fixed, number, percent, plain_table
from aegis_cli.common import commands

_UNIT = "squared, over the variance of the training's actions"


def stream(report: Any) -> RenderableType:
    """What `aegis train` shows of a stream: its matrix, then the parameters."""
    title = Text(f"{report.name}: {report.method} on {report.source}", "bold")
    last = f"{_sums(report)}\n{report.minutes:.1f} minutes; files: {report.out}"
    tables = [*_matrix(report), *_published(report)]
    return Group(title, *tables, parameters(report), Text(last))


def stream_probe(report: Any) -> RenderableType:
    """What `aegis probe` shows of a stream: its matrix, measured again."""
    said = (
        f"measured again: {report.measured} of {len(report.tasks)} rows, largest difference "
        f"{report.largest_difference:g}"
    )
    return Group(*_matrix(report), Text(f"{said}\nfiles: {report.out}"))


def stream_inspect(inspection: Any) -> RenderableType:
    """What `aegis inspect` shows of a stream: matrix, parameters and, if there is any, routing."""
    report = inspection.report
    title = Text(f"{inspection.path}: {report.method} on {report.source}", "bold")
    parts = [title, *_matrix(report), parameters(report)]
    if any(record.sites for record in report.records):
        parts.append(routing(report))
    return Group(*parts, Text(_sums(report)))


def compared_streams(report: Any) -> RenderableType:
    """A line per stream: the figures of its matrix, VQA, and what it stores."""
    share = number if report.score == "errors" else percent
    unit = "" if report.score == "errors" else " %"
    shown: dict[str, Callable[[Any], Cell]] = {
        "Run": lambda row: row.run,
        "Method": lambda row: row.method,
        f"Transfer{unit}": lambda row: share(row.transfer),
        f"Average{unit}": lambda row: share(row.average),
        f"Last{unit}": lambda row: share(row.last),
        f"Forgetting{' (points)' if unit else ''}": lambda row: share(row.forgetting),
        "VQA lost (points)": lambda row: fixed(row.drop_points, 2),
        "Stored numbers": lambda row: f"{row.parameters:,}",
        "Minutes": lambda row: fixed(row.minutes, 1),
    }
    columns = {head: [show(row) for row in report.rows] for head, show in shown.items()}
    columns = {head: cells for head, cells in columns.items() if set(cells) != {"-"}}
    lines = list(zip(*columns.values(), strict=True))
    names = {"accuracy": "Accuracies", "success": "Successes", "errors": "Open-loop errors"}
    title = f"{names[report.score]} on {', '.join(report.tasks)}"
    return plain_table(tuple(columns), lines, left=2, title=title)


def unfinished_stream(inspection: Any) -> RenderableType:
    """How far a stream of robot tasks is, and its matrix of the tasks so far."""
    tasks, learned = inspection.tasks, inspection.learned
    title = Text(f"{inspection.path}: {inspection.method} on {', '.join(tasks)}", "bold")
    far = f"unfinished: {learned} of {len(tasks)} tasks are learned"
    if learned < len(tasks):
        far += f", and '{tasks[learned]}' has taken {inspection.step} of {inspection.steps} steps"
    matrix = [] if inspection.matrix is None else _matrix(inspection.matrix)
    on = f"continue it: {commands.aegis('train', inspection.path)}"
    return Group(title, Text(far), *matrix, Text(on))


def _matrix(report: Any) -> list[RenderableType]:
    """The tables of the measurements."""
    views = {"accuracy": _accuracy, "success": _success, "errors": _errors}
    return views[report.score](report)


def _accuracy(report: Any) -> list[RenderableType]:
    """The accuracies with the task told and inferred, and their figures."""
    parts: list[RenderableType] = [_rows("Accuracy %, task told", report.oracle, report.tasks)]
    if report.inferred != report.oracle:  # equal if one set of weights serves all tasks
        parts.append(_rows("Accuracy %, task inferred", report.inferred, report.tasks))
    lines = [
        (name, percent(s.transfer), percent(s.average), percent(s.last), percent(s.forgetting, 2))
        for name, s in (("task told", report.scores), ("task inferred", report.inferred_scores))
    ]
    on = f"On {report.split} parts"
    header = (on, "Transfer %", "Average %", "Last %", "Forgetting (points)")
    return [*parts, plain_table(header, lines)]


def _success(report: Any) -> list[RenderableType]:
    """The successes beside the backbone's VQA figures."""
    s = report.scores
    figures = [(percent(s.average), percent(s.last), percent(s.forgetting, 2))]
    return [
        plain_table(*_beside_vqa(report, "Success %", report.success, percent)),
        plain_table(("Average %", "Last %", "Forgetting (points)"), figures, left=0),
    ]


def _errors(report: Any) -> list[RenderableType]:
    """The open-loop errors and those of holding the position, beside the VQA figures."""
    header, rows = _beside_vqa(report, "Open-loop error", report.errors, _error)
    if any(ends is not None for ends in report.error_intervals[-1]):
        shown = ("-" if ends is None else _between(ends) for ends in report.error_intervals[-1])
        rows.append(["95 % interval at the end", *shown, "-", "-", "-"])
    if any(error is not None for error in report.hold_errors):
        rows.append(["holding the position", *map(_error, report.hold_errors), "-", "-", "-"])
    s = report.scores
    figures = [(_error(s.average), _error(s.last), _error(s.forgetting))]
    named = ("Average error", "Last error", "Forgetting (rise of the error)")
    return [
        plain_table(header, rows),
        plain_table(named, figures, left=0),
        Text(f"Errors are at held-out frames, {_UNIT}: always predicting their mean scores 1"),
    ]


def _between(ends: Sequence[float]) -> str:
    """The ends of an interval."""
    return " to ".join(map(_error, ends))


def _error(value: float | None) -> str:
    return "-" if value is None else fixed(value, 3)


def _beside_vqa(
    report: Any,
    title: str,
    matrix: Sequence[Sequence[float]],
    show: Callable[[float], str],
) -> tuple[Sequence[str], list[list[str]]]:
    """The header and the rows of a triangular matrix beside the backbone's VQA figures.

    Tasks that have not come yet are '-'.
    """
    header = (title, *report.tasks, "VQA %", "Drop (points)", "Cross-entropy (nats)")
    rows = []
    # VQA is also measured before the first task.
    measured = zip(("", *report.tasks), ((), *matrix), report.vqa, strict=True)
    for after, found, known in measured:
        line = [f"after {after}" if after else "before", *map(show, found)]
        line += ["-"] * (len(report.tasks) - len(found))
        line += [
            percent(known.accuracy),
            fixed(known.drop_points, 2),
            fixed(known.cross_entropy, 3),
        ]
        rows.append(line)
    return header, rows


def _published(report: Any) -> list[RenderableType]:
    """Published figures for the same image stream, to compare with this run's line above."""
    if report.kind != "stream-run" or not report.published:
        return []
    rows = [
        (method, *(f"{value:.1f}" for value in figures))
        for method, figures in report.published.items()
    ]
    title = "As published, on the whole data sets, not run here; compare with task inferred"
    return [plain_table(("Published", "Transfer %", "Average %", "Last %"), rows, title=title)]


def _rows(title: str, rows: Sequence[Sequence[float]], tasks: Sequence[str]) -> Table:
    """A line per row of a matrix."""
    lines = [
        (f"after {task}", *(percent(v) for v in row)) for task, row in zip(tasks, rows, strict=True)
    ]
    return plain_table(("", *tasks), lines, title=title)


def parameters(report: Any) -> Table:
    """A line per task: the parameters that learned and the numbers added."""
    header = (
        "Task",
        "Phase 1 (steps)",
        "Trained in phase 1",
        "Trained after",
        "Trained, mean of steps",
        "Added",
        "Mass on history %",
        "Maps without a new expert %",
        "Pruned",
        "Dropped",
        "Loss",
    )
    rows = [
        (
            r.task,
            _count(r.phase1_steps),
            _count(r.trained_phase1),
            _count(r.trained),
            _count(round(r.trained_mean)),
            _count(r.added),
            percent(r.history_mass),
            percent(r.untouched),
            str(sum(len(s.pruned) for s in r.sites)),
            str(sum(len(s.dropped) for s in r.sites)),
            number(r.loss),
        )
        for r in report.records
    ]
    return plain_table(header, rows)


def routing(report: Any) -> Table:
    """A line per task and map: which experts the router uses."""
    header = (
        "Task",
        "Map",
        "Old experts",
        "Mass %",
        "New experts",
        "Mass %",
        "Pruned",
        "Dropped",
        "Trained in phase 1",
        "Trained after",
        "Added",
    )
    rows = []
    for task, record in enumerate(report.records):
        for s in record.sites:
            # Positions in the router's lists; `owners` has the number of the task that added each.
            old = [i for i, owner in enumerate(s.owners) if owner < task]
            new = [i for i, owner in enumerate(s.owners) if owner >= task]
            row = [record.task, s.site]
            for part in (old, new):
                row += [_numbers(s.experts[i] for i in part), percent(sum(s.mass[i] for i in part))]
            row += [_numbers(s.pruned), _numbers(s.dropped)]
            row += map(_count, (s.trained_phase1, s.trained, s.added))
            rows.append(row)
    return plain_table(header, rows, left=2)


def _sums(report: Any) -> str:
    """How many numbers a run stores and how many of them learned, in a sentence."""
    first, after, mean = report.trained_phase1, report.trained, report.trained_mean
    phases = "" if first is None else f"{first:,.0f} in phase 1, {after:,.0f} after it, "
    return (
        f"{_stored(report)}; trained, mean of tasks: {phases}{mean:,.0f} mean of steps; mass on "
        f"history {percent(report.reuse)} %"
    )


def _stored(report: Any) -> str:
    """How many numbers a run stores.

    A learner that trains the model itself stores its own model, and nothing beside it.
    """
    model = report.model_name
    whose = f" beside the bare {model}"
    if report.method == "sequential":
        whose = f", the {model} that it has changed among them"
    said = f"{report.parameters:,} numbers stored{whose}"
    if report.kind == "stream-run":
        said += f", {report.inference_parameters:,} of them to tell tasks"
    return said


def _numbers(values: Any) -> str:
    return " ".join(map(str, values)) or "-"


def _count(value: int | None) -> str:
    return "-" if value is None else f"{value:,}"
