"""Reports as plain, aligned tables: units in the headers, shares in percent."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from aegis_cli.cli.render.layout import (
    INSTRUCTIONS,
    MARKS,
    Cell,
    acting,
    fixed,
    marked,
    number,
    percent,
    plain_table,
)

_SHARE_INTERVALS = ("interval", "soft_interval")
_OPEN_LOOP_INSTEAD = (
    "nothing could be rolled out. The open-loop error is the squared error of the actions on "
    "held-out episodes over their variance in training: always predicting the mean action scores "
    "1. It is not a success rate, nor a measure of one. aegis inspect RUN shows its interval"
)
# Fields with a share in [0, 1], shown in percent; `_is_share` finds some more by their names.
_SHARES = {
    "accuracy",
    "success",
    "conflict",
    "wrong_target",
    "majority",
    "energy_shed",
    "return_share",
    "drop_below",
    "image_to_text",
    "text_to_image",
}


def facts(report: Any) -> Table:
    """Every plain value of a report, one per line; an empty list has no line."""
    values = {field.name: getattr(report, field.name) for field in dataclasses.fields(report)}
    return pairs({name: value for name, value in values.items() if value != ()})


def trained(report: Any) -> RenderableType:
    """The end of a training, and the requested measurements of its weights."""
    values = dataclasses.asdict(report)
    shown = watched(values)
    return Group(pairs(values), *shown)


def watched(found: dict[str, Any]) -> list[Table]:
    """Move a training's measurements of its last weights from its figures into tables."""
    asked = validation_vqa(found.pop("validation_vqa", {}))
    acted = validation_rollout(found.pop("validation_rollout", {}))
    predicted = validation_actions(found.pop("validation_actions", {}))
    return [*asked, *acted, *predicted]


def validation_vqa(found: Mapping[str, Any]) -> Iterator[Table]:
    """A table of the answers to validation questions, a line per set; none without questions."""
    rows = []
    for name, own in found.items():
        ends = " to ".join(fixed(end, 2) for end in own["drop_interval"])
        rows.append((name, percent(own["accuracy"]), fixed(own["drop_points"], 2), ends))
    if rows:
        head = ("Validation questions", "VQA %", "Drop (points)", "95 % interval")
        yield plain_table(head, rows)


def validation_rollout(found: Mapping[str, Any]) -> Iterator[Table]:
    """A table of how the policy acted in validation episodes; none without episodes."""
    shown = {
        "success": ("success %", "interval", percent),
        "mean_return": ("mean return", "return_interval", number),
    }
    for measure, (name, interval, show) in shown.items():
        if measure in found:
            ends = found[interval]
            between = "-" if ends is None else " to ".join(map(show, ends))
            head = ("Validation episodes", "Mean", "95 % interval")
            yield plain_table(head, [(name, show(found[measure]), between)])


def validation_actions(found: Mapping[str, Any]) -> Iterator[Table]:
    """A table of the errors of predicted actions on held-out ones; none without predictions."""
    if found:
        ends, hold = found["relative_interval"], found["hold_error"]
        between = "-" if ends is None else " to ".join(map(number, ends))
        rows = [("the policy's", number(found["relative_error"]), between)]
        rows += [] if hold is None else [("standing still", number(hold), "")]
        yield plain_table(("Error of held-out actions", "Mean", "95 % interval"), rows)


def serving(report: Any) -> RenderableType:
    """Where a policy is served, and what a client must send."""
    said = report.metadata  # sent to each client on connection
    images = dict.fromkeys(said["images"], "[H, W, 3] uint8, RGB")
    prompt = "text" if said["default_prompt"] is None else f"text, or '{said['default_prompt']}'"
    sent = {**images, said["state"]: f"[{said['positions']}]", said["prompt"]: prompt}
    parts = {"url": report.url, "health": report.health, "task": said["task"]}
    got = f"[{said['chunk']}, {said['actions']}], {said['replan']} of which are to be executed"
    table = plain_table(("An observation's key", "Value"), list(sent.items()), left=2)
    return Group(pairs(parts), table, pairs({"answer": f"'actions': {got}"}), Text("Ctrl-C ends"))


def probe(report: Any) -> RenderableType:
    parts = [pairs(_scalars(report)), _families(report.families)]
    if report.layers:
        parts.append(_drifts(report.layers))
    return Group(*parts)


def _drifts(layers: Sequence[Any]) -> Table:
    """W2^2 by layer, beside that of the baseline if it was measured."""
    if layers[0].baseline_w2 is None:
        return plain_table(("Layer", "W2²"), [(str(x.layer), number(x.w2)) for x in layers])
    rows = [(str(x.layer), number(x.w2), number(x.baseline_w2)) for x in layers]
    return plain_table(("Layer", "W2²", "Before"), rows)


def scores(report: Any) -> RenderableType:
    """A line per score of a benchmark."""
    shown = {
        "Task": lambda s: s.task,
        "Metric": lambda s: s.metric,
        "Questions": lambda s: f"{s.questions:,}",
        "Before %": lambda s: percent(s.before, 2),
        "After %": lambda s: percent(s.after, 2),
        "Drop (points)": lambda s: fixed(s.drop_points, 2),
        "95 % interval": lambda s: " to ".join(fixed(end, 2) for end in s.drop_interval),
    }
    if report.max_drop is not None:
        shown["Gate"] = lambda s: "passed" if s.passed else "failed"
    rows = [[show(score) for show in shown.values()] for score in report.scores]
    return plain_table(list(shown), rows, left=2)


def doctor(report: Any) -> RenderableType:
    """A line per check, followed by what to do about those that are not ok."""
    rows = [(check.name, check.state, check.found) for check in report.checks]
    fixes = [f"{check.name}: {check.fix}" for check in report.checks if check.fix]
    parts: list[RenderableType] = [plain_table(("Check", "State", "Found"), rows, left=3)]
    return Group(*parts, *(Text(fix) for fix in fixes))


def recipe_list(report: Any) -> RenderableType:
    rows = [(recipe.name, recipe.kind, recipe.about) for recipe in report.recipes]
    return plain_table(("Recipe", "Kind", "What it is for"), rows, left=3)


def pretrain(report: Any) -> RenderableType:
    figures = {name: value for name, value in _scalars(report).items() if name != "easy_vqa"}
    parts: list[RenderableType] = [pairs(figures), _accuracies(report.families)]
    if report.easy_vqa is not None:
        parts += [
            Text("easy-VQA", "bold"),
            pairs(_scalars(report.easy_vqa)),
            _accuracies(report.easy_vqa.families),
        ]
    return Group(*parts)


def _accuracies(families: dict[str, float]) -> Table:
    rows = [(name, percent(accuracy)) for name, accuracy in families.items()]
    return plain_table(("Family", "Accuracy %"), rows)


def measured(report: Any) -> RenderableType:
    """The available figures of demonstrations or rollouts.

    A task has either a success or a return, and the other one is left out. Tables have the figures
    of each task of a set, each target colour and each instruction, if there are several.
    """
    found = {name: value for name, value in _scalars(report).items() if value is not None}
    # Figures with a table below are removed from the lines above.
    suites, tasks = found.pop("suites", None), found.pop("tasks", None)
    colors = found.pop("target_colors", None)
    instructions = _worst_first(found.pop("instructions", {}))
    tables: list[RenderableType] = []
    if suites:
        tables.append(_by_part("Suite", suites))
    if tasks:
        tables.append(_by_part("Task", tasks))
    if colors:
        tables.append(_by_part("Target", _worst_first(colors)))
    if instructions:
        shown = dict(itertools.islice(instructions.items(), INSTRUCTIONS))
        tables.append(_by_part("Instruction", shown))
        count = len(instructions)
        if len(shown) < count:
            tables.append(Text(f"the worst {len(shown)} of {count:,} instructions; --json has all"))
    return Group(pairs(found), *tables)


def _worst_first(parts: dict[str, Any]) -> dict[str, Any]:
    return dict(sorted(parts.items(), key=lambda part: part[1].success))


def _by_part(what: str, parts: dict[str, Any]) -> Table:
    """A line per part of the episodes, with all figures of its entry."""
    first = next(iter(parts.values()))  # all are of the same class
    names = [field.name for field in dataclasses.fields(first)]
    header = [(_label(name) + _unit(name, 0.0)).capitalize() for name in names]
    rows = []
    for part, entry in parts.items():
        rows.append((part, *(_cell(getattr(entry, name), name) for name in names)))
    return plain_table((what, *header), rows)


def dual(report: Any) -> RenderableType:
    """The embedded dual encoder's figures."""
    tasks = [(name, percent(accuracy)) for name, accuracy in report.zero_shot.items()]
    rest = {name: value for name, value in _scalars(report).items() if name != "zero_shot"}
    return Group(pairs(rest), plain_table(("Task", "Zero-shot accuracy %"), tasks))


class _Column(NamedTuple):
    """A column of the table of methods: a field of its rows, and its format.

    Attributes:
        more_is_better: None if neither direction is better.
    """

    name: str
    field: str
    write: Callable[[float | None], str]
    more_is_better: bool | None


def pipeline(report: Any) -> RenderableType:
    """A line per method; figures that no method has, such as a success, have no column."""
    acts = acting(report.rows)
    columns = [
        _Column("VQA %", "accuracy", percent, True),
        _Column("Drop (points)", "drop_points", partial(fixed, digits=2), False),
        _Column("Cross-entropy (nats)", "cross_entropy", partial(fixed, digits=3), False),
        *(_Column(name, field, percent, field != "wrong_target") for name, field in acts.items()),
        _Column("Open-loop error", "open_loop_error", partial(fixed, digits=3), False),
        _Column("W2²", "w2", number, False),
        _Column("Energy shed %", "energy_shed", partial(percent, digits=2), None),
        _Column("Step time (x naive)", "step_time_ratio", partial(fixed, digits=2), False),
        _Column("Validation loss", "validation_loss", partial(fixed, digits=4), False),
    ]
    shown = [c for c in columns if any(getattr(row, c.field) is not None for row in report.rows)]
    header = ("Method", *(column.name for column in shown))
    named = [r.method if report.merge is None else f"{r.method}, merged" for r in report.rows]
    figures = [_marked_column(report.rows, column) for column in shown]
    rows = zip(named, *figures, strict=True)
    table = plain_table(header, rows)
    notes = [Text(note) for note in _pipeline_notes(report, acts)]
    return Group(Text(report.name, "bold"), table, *_other_sets(report.rows), *notes)


def _pipeline_notes(report: Any, acts: Mapping[str, str]) -> Iterator[str]:
    """The notes below the table of methods, one per line."""
    before = f"before fine-tuning: VQA {percent(report.baseline_accuracy)} %"
    yield f"{before}; always the commonest answer: {percent(report.majority_accuracy)} %"
    if len(report.rows) > 1:  # there is no best or worst of a single method
        yield MARKS
    if report.verdict:
        yield report.verdict
    if report.merge is not None:
        yield _merged(report.merge)
    if not _acted(report.rows, acts):
        yield _OPEN_LOOP_INSTEAD
    hold = _held_still(report.rows)
    if hold is not None:
        yield hold
    yield f"files: {report.out}"


def _held_still(rows: Sequence[Any]) -> str | None:
    """The open-loop error of a robot that holds its position, to compare with these methods.

    None if it was not measured. All methods are measured on the same frames.
    """
    hold = next((row.hold_error for row in rows if row.hold_error is not None), None)
    if hold is None:
        return None
    text = f"A robot that holds its position has an open-loop error of {hold:.3f}"
    errors = [(row.method, row.open_loop_error) for row in rows if row.open_loop_error is not None]
    behind = [method for method, error in errors if error >= hold]
    if behind:
        text += f"; not below it: {', '.join(behind)}"
    return text


def _acted(rows: Sequence[Any], acts: Mapping[str, str]) -> bool:
    """Whether any policy was rolled out."""
    return any(getattr(row, field) is not None for row in rows for field in acts.values())


def _merged(merge: Mapping[str, Any]) -> str:
    """The merge of each policy between its training and its measurements."""
    how = f"merged by {merge['method']}, strength {merge['strength']:g}, after the training"
    return f"{how}: the policies are those in METHOD/merged"


def _marked_column(rows: Sequence[Any], column: _Column) -> list[Cell]:
    values = [getattr(row, column.field) for row in rows]
    return marked([column.write(value) for value in values], values, column.more_is_better)


def _other_sets(rows: Sequence[Any]) -> list[RenderableType]:
    """The methods' figures on each further question set."""
    header = ("Method", "VQA %", "Drop (points)", "Cross-entropy (nats)", "W2²", "Before %")
    tables: list[RenderableType] = []
    for name in rows[0].others:  # all methods were asked the same sets
        shown = []
        for row in rows:
            kept = row.others[name]
            figures = (fixed(kept.drop_points, 2), fixed(kept.cross_entropy, 3), number(kept.w2))
            shown.append(
                (row.method, percent(kept.accuracy), *figures, percent(kept.baseline_accuracy))
            )
        tables.append(plain_table(header, shown, title=f"Asked {name}"))
    return tables


def bench(report: Any) -> RenderableType:
    """A line per method, followed by the costs of an anchor's pass and of the guard."""
    rows = [
        (name, fixed(ratio, 2), fixed(report.peak_memory[name], 2))
        for name, ratio in report.step_time.items()
    ]
    table = plain_table(("Method", "Step time (x naive)", "Peak memory (x naive)"), rows)
    anchor = f"anchor pass: {fixed(report.anchor_throughput, 2)} x the throughput of a bare forward"
    if report.guard is not None:
        steps = ", ".join(
            f"{name} {fixed(ratio, 2)}" for name, ratio in report.guard.step_time.items()
        )
        anchor += f"\nguard in a plain loop: {steps} x the step of aegis train; "
        anchor += f"backward {fixed(report.guard.backward, 2)} x loss.backward()"
    return Group(
        table, Text(f"{anchor}\nbatch size {report.batch_size}, medians of {report.repeats} rounds")
    )


def bench_shape(report: Any) -> RenderableType:
    """A line per method and per part of an anchor, followed by how they were measured."""

    def row(name: str, cost: Any) -> tuple[str, ...]:
        if cost.step_s is None:
            return name, "out of memory", *("-",) * 5
        return (
            name,
            fixed(cost.step_s, 2),
            fixed(cost.step_time, 2),
            percent(cost.own_share),
            fixed(cost.peak_gb, 2),
            fixed(cost.peak_memory, 2),
            percent(cost.mfu),  # None if the device's peak is unknown
        )

    header = ("Method", "s/step", "x naive", "Own %", "Peak GB", "x naive", "MFU %")
    parts = [plain_table(header, [row(*each) for each in report.methods.items()])]
    if report.anchor:
        rows = []
        for name, cost in report.anchor.items():
            figures = fixed(cost.question_s, 2), fixed(cost.peak_gb, 2), fixed(cost.megabytes, 0)
            rows.append((name, *figures))
        parts.append(plain_table(("Part of an anchor", "s/question", "Peak GB", "File MB"), rows))
    peak, clock = "peak not known", {"cpu": "CPU seconds", "wall": "seconds"}[report.clock]
    if (assumed := report.assumed) is not None:
        peak = f"peak of {assumed.device} in {assumed.dtype}: {assumed.tflops:g} TFLOP/s"
    lines = (
        f"{report.shape}: {report.parameters:,} M parameters with random weights",
        f"{report.device}, {report.threads} threads, {peak}",
        f"batch size {report.batch_size}, {report.tokens} tokens a frame, precision "
        f"{report.precision}, weights {report.weights}; {clock}, medians of {report.turns} turns",
    )
    return Group(*parts, Text("\n".join(lines)))


def _families(families: dict[str, Any]) -> Table:
    header = ("Family", "Questions", "Accuracy %", "95 % interval", "Majority %", "Baseline %")
    fields = ("questions", "accuracy", "interval", "majority", "baseline_accuracy")
    rows = []
    for name, family in families.items():
        cells = [_cell(getattr(family, field, None), field) for field in fields]
        rows.append((name, *cells))
    return plain_table(header, rows)


def pairs(values: dict[str, Any]) -> Table:
    """A line per value: its name, then the value with its unit. None has no line."""
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    for name, value in values.items():
        if value is not None:
            table.add_row(_label(name), Text(_cell(value, name) + _unit(name, value)))
    return table


_NO_SCALARS = ("families", "layers", "asked")  # fields of a probe's report


def _scalars(report: Any) -> dict[str, Any]:
    """The fields of a report that are shown on a line; the others have tables."""
    names = [field.name for field in dataclasses.fields(report) if field.name not in _NO_SCALARS]
    return {name: getattr(report, name) for name in names}


# Suffix of a field's name -> unit after its value. Suffixes that start with "_" are left out of the
# label.
_UNITS = {
    "_s": " s",
    "_ms": " ms",
    "_m": " m",
    "_mb": " MB",
    "_points": " points",
    "cross_entropy": " nats",
    "drop_interval": " points",
}


def _label(name: str) -> str:
    """`final_distance_m` -> final distance; `frames_per_s` -> frames per second."""
    if name.endswith("_per_s"):
        return name.removesuffix("_s").replace("_", " ") + " second"
    suffix = next((s for s in _UNITS if s.startswith("_") and name.endswith(s)), "")
    return name.removesuffix(suffix).replace("_", " ")


def _unit(name: str, value: Any) -> str:
    if value is None or isinstance(value, str) or name.endswith("_per_s"):
        return ""
    if _is_share(name) or name in _SHARE_INTERVALS:
        return " %"
    return next((unit for suffix, unit in _UNITS.items() if name.endswith(suffix)), "")


def _is_share(name: str) -> bool:
    by_name = name.endswith("accuracy") or name.startswith(("energy_shed", "success"))
    return name in _SHARES or by_name


def _cell(value: Any, name: str = "") -> str:
    """A value in a table, without the unit of its name."""
    if value is None:
        return "-"
    if isinstance(value, bool):  # before `int`, because a bool is an int
        return "yes" if value else "no"
    if name in _SHARE_INTERVALS:
        return " to ".join(percent(v) for v in value)
    if name in ("drop_interval", "return_interval"):
        return " to ".join(number(v) for v in value)
    if isinstance(value, dict):
        return _list([f"{k} {_within(v)}" for k, v in value.items()])
    if isinstance(value, (tuple, list)):
        return _list([_one_of(v) for v in value]) or "-"
    if isinstance(value, float):
        return percent(value) if _is_share(name) else number(value)
    # A seed is not a count, and users copy it, so it has no commas.
    return f"{value:,}" if isinstance(value, int) and name != "seed" else str(value)


def _one_of(value: Any) -> str:
    """An item of a list; an item that is itself a list is a size, such as that of an image."""
    return " x ".join(map(_cell, value)) if isinstance(value, (tuple, list)) else _cell(value)


def _within(value: Any) -> str:
    """A nested value; several are in brackets, with readable names."""
    if not isinstance(value, dict):
        return _cell(value)
    return f"({', '.join(f'{_label(k)} {_cell(v)}' for k, v in value.items())})"


def _list(items: Sequence[str], most: int = 12) -> str:
    if len(items) <= most:
        return ", ".join(items)
    return f"{', '.join(items[:most])}, ... ({len(items)})"
