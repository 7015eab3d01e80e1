"""What `aegis inspect` shows of an artifact, model, dataset or run, and `aegis compare` of runs."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from itertools import takewhile
from shlex import quote
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from aegis_cli.cli.render.layout import MARKS, Cell, fixed, marked, number, percent, plain_table
from aegis_cli.cli.render.paired import paired
from aegis_cli.cli.render.tables import pairs, watched
from aegis_cli.data.episodes import as_text

_ANSWER = 60  # characters of an answer in a table


def inspect(report: Any, tensors: bool = False) -> RenderableType:
    """The facts, then the available tables; tensors are listed on request."""
    told = dict(report.facts)
    measured_while_it_trained = watched(told)
    facts = {"kind": report.kind, "path": report.path, **_as_they_are_read(told)}
    facts["energy_shed_mean"] = report.energy_shed_mean  # no line if it is None
    parts: list[RenderableType] = [pairs(facts), *measured_while_it_trained]
    if report.by_checkpoint:
        parts.append(_checkpoints(report.by_checkpoint))
    if report.kind == "run":
        parts += _measured(report)
    if report.tensors and not tensors:
        parts.append(Text(f"{len(report.tensors)} tensors; --tensors lists them"))
    elif report.tensors:
        rows = [
            (t.name, " x ".join(map(str, t.shape)) or "scalar", t.dtype, t.unit)
            for t in report.tensors
        ]
        parts.append(plain_table(("Tensor", "Shape", "Type", "Unit"), rows, left=4))
    if report.moments:
        rows = [(m.name, number(m.mean_norm), number(m.variance_trace)) for m in report.moments]
        parts.append(plain_table(("Layer", "|mean|", "Trace of variance"), rows))
    if report.inputs:
        parts.append(_spectra("Inputs", report.inputs))
    if report.curvature:
        parts.append(_spectra("Curvature", report.curvature))
    if report.features:
        parts.append(_features(report.features))
    if report.layers:
        rows = [
            (x.name, percent(x.energy_shed, 3), percent(x.energy_shed_max), percent(x.conflict))
            for x in report.layers
        ]
        parts.append(
            plain_table(
                ("Group", "Energy shed, mean %", "Largest step %", "Steps in conflict %"), rows
            )
        )
        if report.frozen:
            parts.append(Text(f"nothing learned in {_as_ranges(report.frozen)}\n"))
        parts.append(_over_time(report.over_time))
    elif report.kind in ("run", "checkpoint", "ledger"):
        found = "no step took an anchor gradient, so no gradient energy was shed"
        parts.append(Text(found))
    return Group(*parts)


def questions(report: Any) -> RenderableType:
    """The contents of a question set: usable and bad questions, and the common answers."""
    given = report.answers_a_question
    facts = {
        "kind": report.kind,
        "path": report.path,
        "questions": report.questions,
        "images": report.images,
        "bad questions": report.bad,
        "asked twice of their image": report.repeated,
        "words of a question": _words(report.words),
        "words of an answer": _words(report.answer_words),
        "answers to a question": _from_to(given["least"], given["most"]),
        "distinct answers": report.distinct_answers,
    }
    parts: list[RenderableType] = [pairs(facts)]
    of = [(part.name, f"{part.questions:,}", f"{part.images:,}") for part in report.parts]
    parts.append(plain_table(("Part", "Questions", "Images"), of))
    if len(report.families) > 1:
        rows = [(family.name, f"{family.questions:,}") for family in report.families]
        parts.append(plain_table(("Family", "Questions"), rows))
    rows = [
        (
            textwrap.shorten(x.answer, _ANSWER, placeholder=" ..."),
            f"{x.questions:,}",
            percent(x.share),
        )
        for x in report.answers
    ]
    parts.append(plain_table(("Commonest answer", "Questions", "Of all %"), rows))
    if report.problems:
        first = "\n".join(f"- {problem}" for problem in report.problems)
        parts.append(Text(f"the first bad ones, which --skip-bad leaves out:\n{first}\n"))
    return Group(*parts)


def _words(counts: Mapping[str, float]) -> str:
    return f"{counts['median']:g} in the median, {counts['most']} at most"


def _from_to(least: int, most: int) -> str:
    return str(most) if least == most else f"{least} to {most}"


def _as_they_are_read(facts: Mapping[str, Any]) -> dict[str, Any]:
    """The facts as shown: a run's steps with the planned number if some are left, and its merge."""
    planned, steps = facts.get("planned_steps"), facts.get("steps")
    # "shared" is left out because an anchor's maps with a shared spectrum are rows of its table,
    # and "prepares" because it has all settings of a processor.
    apart = ("planned_steps", "measured_before", "shared", "prepares")
    left = {name: value for name, value in facts.items() if name not in apart}
    merged = facts.get("merge")
    if merged:
        # A merge has no validation loss if its sweep measured none.
        left["merge"] = {k.replace("_", " "): v for k, v in merged.items() if v is not None}
    if planned is None or steps is None or steps >= planned:
        return left
    return left | {"steps": _steps_taken(steps, planned)}


def _steps_taken(steps: int | None, planned: int | None) -> str:
    from aegis_cli.inspection import steps_taken  # imports safetensors, which --help must not

    return steps_taken(steps, planned)


def _checkpoints(found: Sequence[Any]) -> Table:
    """What was measured of each checkpoint while the run trained; the best one is marked."""
    columns: dict[str, list[Cell]] = {
        "Checkpoint": [f"{x.name} (best)" if x.best else x.name for x in found],
        "Validation loss": [number(x.validation_loss) for x in found],
    }
    for name in dict.fromkeys(name for x in found for name in x.drop_points):
        columns[f"Lost of {name} (points)"] = [fixed(x.drop_points.get(name), 2) for x in found]
    shown: Mapping[str, tuple[str, Callable[[float | None], str]]] = {
        "success": ("Success %", percent),
        "mean_return": ("Mean return", number),
        "relative_error": ("Error of held-out actions", number),
    }
    for attribute, (head, show) in shown.items():
        values = [getattr(x, attribute) for x in found]
        if any(value is not None for value in values):
            columns[head] = [show(value) for value in values]
    return plain_table(tuple(columns), list(zip(*columns.values(), strict=True)))


def _measured(report: Any) -> list[RenderableType]:
    """A run's rollouts, open-loop errors and probes, and whether its gate is passed."""
    parts: list[RenderableType] = []
    if report.rollouts:
        parts.append(_played(report.rollouts))
    if report.open_loops:
        parts.append(_evaluated(report.open_loops))
    if report.probes:
        parts.append(_known(report.probes, report.question_sets))
    if not parts:
        return [_not_measured(report.facts)]
    verdict = {True: "passed", False: "failed", None: "none: no drop was held to a limit"}
    return [*parts, Text(f"gate: {verdict[report.gate]}\n")]


def _not_measured(facts: Mapping[str, Any]) -> Text:
    """Why a run has no figures, and how to measure some."""
    into, before = facts.get("merged_into"), facts.get("measured_before")
    if into:
        return Text(f"not measured: its weights were merged, see aegis inspect {quote(into)}")
    does = "aegis probe, aegis rollout and aegis evaluate do that"
    if facts.get("task", "") is None:  # a robot that is not simulated
        does = "aegis probe and aegis evaluate do that"
    if before:  # the run has trained further since
        steps = f"step{'s' * (len(before) > 1)} {', '.join(map(str, before))}"
        of = f"measured at {steps}, not at the last checkpoint"
        return Text(f"{of}: measure again ({does})\n")
    return Text(f"nothing is measured yet: {does}")


def _played(rollouts: Sequence[Any]) -> Table:
    from aegis_cli.evaluation import results  # imports torch, as the inspection did

    header = ("Task", "Colours", "Success %", "95 % interval", "Return %", "Episodes")
    apart = results.told_apart([result.played for result in rollouts])
    rows = []
    for result, otherwise in zip(rollouts, apart, strict=True):
        found = result.figures
        row = (
            str(found["task"]),
            str(found.get("colors") or "-"),
            percent(found.get("success")),
            _ends(found.get("interval"), percent),
            percent(found.get("return_share")),
            str(found["episodes"]),
        )
        rows.append((*row, otherwise) if any(apart) else row)
    return plain_table((*header, "Played with") if any(apart) else header, rows, left=2)


def _evaluated(open_loops: Sequence[Any]) -> Table:
    from aegis_cli.evaluation import results  # imports torch, as the inspection did

    header = ("Open loop on", "Relative error", "95 % interval", "Hold's", "Frames")
    rows = []
    for result in open_loops:
        found = result.figures
        error, hold = (fixed(found.get(name), 3) for name in ("relative_error", "hold_error"))
        ends = _ends(found.get("relative_interval"), lambda end: fixed(end, 3))
        rows.append((results.evaluated_on(found), error, ends, hold, f"{found['frames']:,}"))
    return plain_table(header, rows)


def _known(probes: Sequence[Any], question_sets: Sequence[str]) -> Table:
    names = ["VQA %", "Before %", "Drop (points)", "95 % interval", "Largest W2²"]
    gated = any(result.figures.get("passed") is not None for result in probes)
    names += ["Gate"] * gated
    rows = []
    for result, asked in zip(probes, question_sets, strict=True):
        found = result.figures
        drifts = [layer["w2"] for layer in found.get("layers") or ()]
        rows.append(
            (
                asked,
                f"{found.get('questions', 0):,}",
                percent(found["accuracy"]),
                percent(found.get("baseline_accuracy")),
                fixed(found.get("drop_points"), 2),
                _ends(found.get("drop_interval"), lambda points: fixed(points, 2)),
                number(max(drifts, default=None)),
                *([_gate(result)] if gated else []),
            )
        )
    return plain_table(("Asked", "Questions", *names), rows)


def _gate(probed: Any) -> str:
    """A probe's verdict, and its limit if the probe recorded one."""
    verdict = _VERDICTS[probed.figures.get("passed")]
    limit = probed.settings.get("max_drop")
    if verdict == "-" or limit is None:
        return verdict
    upper = " by the upper end" if probed.settings.get("gate") == "upper" else ""
    return f"{verdict} at {limit:g}{upper}"


def _ends(interval: Sequence[float] | None, write: Callable[[float], str]) -> str:
    return "-" if interval is None else " to ".join(map(write, interval))


def _spectra(what: str, sites: Sequence[Any]) -> Table:
    """Each map's directions, and how many of them hold 90, 99 and 99.9 % of the energy.

    For a map that is stored with another map of the same input, the name of that map is shown.
    """
    header = ("Map", what, "Directions", "90 %", "99 %", "99.9 %", "Stored")
    rows = [(x.name, x.kind, str(x.size), *map(str, x.kept), _stored(x)) for x in sites]
    return plain_table(header, rows, left=2)


def _stored(site: Any) -> str:
    if site.same_as is not None:
        # That map is in a row above, so the common start of both names is omitted.
        own, other = site.name.split("."), site.same_as.split(".")
        pairwise = zip(own, other, strict=False)
        alike = sum(1 for _ in takewhile(lambda words: words[0] == words[1], pairwise))
        return f"with {'.'.join(other[alike:])}"
    return "-" if site.stored is None else str(site.stored)


def _features(features: Sequence[Any]) -> Table:
    """A line per feature, or a line per component if the dataset has statistics."""
    # Without medians: LeRobot merges the episodes' medians into their minimum.
    shown = ("min", "q01", "q99", "max", "mean", "std")
    rows = []
    for feature in features:
        kind = (feature.dtype, " x ".join(map(str, feature.shape)))
        columns = [feature.statistics.get(name, ()) for name in shown]  # a number per component
        count = max(1, *map(len, columns))
        parts = list(feature.components)
        if count == 1 and (feature.dtype in ("image", "video") or not any(parts)):
            # Without statistics, images and unnamed components get a single line.
            parts = []
        names = [f"{feature.name} {part}".rstrip() for part in parts]
        names += [feature.name] * (count - len(names))  # statistics of components without names
        for i, name in enumerate(names):
            figures = [number(column[i]) if i < len(column) else "-" for column in columns]
            rows.append((name, *kind, *figures))
    return plain_table(("Feature", "Type", "Shape", *shown), rows, left=3)


def _as_ranges(layers: Sequence[str]) -> str:
    """Names `layers.{i}` in the form of `train.freeze`: `layers.0-11, layers.13`."""
    numbers = sorted(int(name.rpartition(".")[2]) for name in layers)
    return ", ".join(f"layers.{one}" for one in as_text(numbers).split(","))


def _over_time(bins: Sequence[Any], rows: int = 8) -> Table:
    """The energy over time in a few lines; a report has many more bins for a plot."""
    size = max(1, math.ceil(len(bins) / rows))
    lines = []
    for i in range(0, len(bins), size):
        chunk = bins[i : i + size]
        steps = _steps(chunk[0].first_step, chunk[-1].last_step)
        lines.append((steps, percent(_mean_shed(chunk), 3)))
    return plain_table(("Steps", "Energy shed, mean %"), lines)


def _mean_shed(bins: Sequence[Any]) -> float:
    """The mean over the steps of some bins, whose numbers of steps may differ by one."""
    steps = [b.last_step - b.first_step + 1 for b in bins]
    return sum(b.energy_shed * n for b, n in zip(bins, steps, strict=True)) / sum(steps)


def _steps(first: int, last: int) -> str:
    return f"{first} to {last}" if last > first else str(first)


_OF_QUESTIONS = ("VQA %", "Drop (points)", "W2²")
_OF_EPISODES = ("Success seen %", "Success held-out %", "Return % of highest")
_OPEN_LOOP = "Open-loop error"
_VALIDATION = "Validation loss"
# Columns with marks for the best and the worst: the figure, and whether more is better.
_BETTER = {
    "VQA %": ("accuracy", True),
    "Drop (points)": ("drop_points", False),
    "Success seen %": ("success_seen", True),
    "Success held-out %": ("success_held_out", True),
    "Return % of highest": ("return_share", True),
    _OPEN_LOOP: ("open_loop_error", False),
    "W2²": ("w2", False),
    _VALIDATION: ("validation_loss", False),
    "Step (s)": ("step_s", False),
}
_VERDICTS = {True: "passed", False: "failed", None: "-"}


def compared(report: Any) -> RenderableType:
    """A line per run, without columns that no run has, and the paired differences."""
    names = [(row.run, row.method, row.task or "-") for row in report.rows]
    shown = _shown_columns(report)
    figures = zip(*shown.values(), strict=True)
    rows = [(*name, *own) for name, own in zip(names, figures, strict=True)]
    table = plain_table(("Run", "Method", "Task", *shown), rows, left=3)
    is_marked = any(isinstance(cell, Text) for cells in shown.values() for cell in cells)
    notes = [MARKS] if is_marked else []
    on = next((row.open_loop_on for row in report.rows if row.open_loop_on), None)
    if "Hold's" in shown:
        notes.append("hold's: the open-loop error of the current position, repeated")
    if on is not None and report.same_open_loop:
        notes.append(f"open-loop error: on {on}")
    return Group(table, *map(Text, notes), *paired(report))


def _shown_columns(report: Any) -> dict[str, list[Cell]]:
    """The cells of each column that some run has a figure for, with marks if comparable."""
    apart = _not_compared(report)
    shown = dict[str, list[Cell]]()
    for name, write in _columns(report).items():
        cells = [write(row) for row in report.rows]
        if set(cells) == {"-"}:
            continue
        shown[name] = [*cells]
        if name in _BETTER and name not in apart:
            field, more_is_better = _BETTER[name]
            values = [getattr(row, field) for row in report.rows]
            shown[name] = marked(cells, values, more_is_better)
    return shown


def _not_compared(report: Any) -> set[str]:
    """The columns whose figures are on different questions, episodes or frames."""
    apart = set[str]()
    if len(report.question_sets) > 1 or not report.same_questions:
        apart |= {*_OF_QUESTIONS}
    if not report.same_episodes:
        apart |= {*_OF_EPISODES}
    if not report.same_open_loop:
        apart.add(_OPEN_LOOP)
    if not report.same_validation:
        apart.add(_VALIDATION)
    return apart


def _columns(report: Any) -> dict[str, Callable[[Any], str]]:
    """The function that formats a row for each column."""
    several, elsewhere = len(report.question_sets) > 1, not report.same_open_loop
    return {
        "Steps": lambda r: _steps_taken(r.steps, r.planned_steps),
        "Questions": lambda r: (r.vqa or "-") if several else "-",
        "VQA %": lambda r: percent(r.accuracy),
        "Before %": lambda r: percent(r.baseline_accuracy),
        "Drop (points)": lambda r: fixed(r.drop_points, 2),
        "95 % interval": lambda r: _ends(r.drop_interval, lambda points: fixed(points, 2)),
        "Success seen %": lambda r: percent(r.success_seen),
        "Success held-out %": lambda r: percent(r.success_held_out),
        "Return % of highest": lambda r: percent(r.return_share),
        "Open loop on": lambda r: (r.open_loop_on or "-") if elsewhere else "-",
        _OPEN_LOOP: lambda r: fixed(r.open_loop_error, 3),
        "Hold's": lambda r: fixed(r.hold_error, 3),
        "W2²": lambda r: number(r.w2),
        "Energy shed %": lambda r: percent(r.energy_shed, 2),
        _VALIDATION: lambda r: fixed(r.validation_loss, 4),
        "Step (s)": lambda r: fixed(r.step_s, 3),
        "Gate": lambda r: _VERDICTS[r.gate],
    }
