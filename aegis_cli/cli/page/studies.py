"""The parts of a page about a study of policies: its frontier, and a table for each task."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

from aegis_cli.cli.page import charts
from aegis_cli.cli.page.charts import Point, Series, Spot
from aegis_cli.cli.page.cursor import At, between, decimal, farthest, share, shown
from aegis_cli.cli.page.html import Child, Markup, element
from aegis_cli.cli.page.runs import figure, note, section
from aegis_cli.cli.page.tables import table, verdict
from aegis_cli.cli.render.frontier import (
    acting_axis,
    by_error,
    chosen_task,
    coloured_methods,
    shown_tasks,
)
from aegis_cli.cli.render.studies import OPEN_LOOP, knob_text, shown_as
from aegis_cli.studies.comparison import PolicyResult
from aegis_cli.studies.metrics import columns, deciding_decimals, unmeasured

_DECLARED = columns(PolicyResult)
_LOST, _SEEN, _RETURN = "drop_points", "success_seen", "return_share"
_OPEN = "open_loop_error"
_OPEN_LOOP = " ".join(f"{OPEN_LOOP[0].upper()}{OPEN_LOOP[1:]}.".split())
_REST = -1  # number of a series without its own colour


def frontier(compared: At, report: Any) -> Markup | None:
    """Points of VQA accuracy lost over success, for compared means and for values in tuning.

    As in the plot of --plot, at most six methods have a colour.
    """
    number = {method: place for place, method in enumerate(coloured_methods(report))}
    chosen = chosen_task(report)
    # The document has its tasks in the report's order.
    spots = [] if chosen is None else _means(compared, report.tasks.index(chosen), number)
    tried, curves = _tried(compared, number)
    if not spots and not tried:
        return None
    chart = charts.frontier(
        [*tried, *spots],
        curves,
        acting_axis(report),
        _DECLARED[_LOST].axis or "",
        f"VQA accuracy lost over {'open-loop error' if by_error(report) else 'success'}",
        turned=by_error(report),
    )
    where = shown_tasks(report)
    said = (
        f"{where[0].upper()}{where[1:]}; better is to the upper right. Large marks: means over "
        "seeds with 95 % intervals. Small marks: values tried on validation data, filled where "
        "chosen."
    )
    return section("Frontier", figure(chart, said, wide=True))


def _means(compared: At, task: int, number: dict[str, int]) -> list[Spot]:
    """The compared variants of one task that have a figure for how they act."""
    found = []
    for result in compared["tasks"][task]["results"]:
        acted = result[_SEEN] or result[_RETURN]  # a task has one of them
        scale = 100.0 if acted else 1.0  # shares become percent, errors stay unchanged
        acted = acted or result[_OPEN]
        lost = result[_LOST]
        if not acted or not lost:
            continue
        own = number.get(str(result["method"]), _REST)
        wide, tall = _span(acted, scale), _span(lost, 1)  # `lost` is in percentage points
        x, y = scale * acted["mean"].value, lost["mean"].value
        found.append(Spot(str(result["variant"]), x, y, wide, tall, own))
    return found


def _span(estimate: At, scale: float) -> tuple[float, float] | None:
    ends = _ends(estimate)
    return None if ends is None else (scale * ends[0].value, scale * ends[1].value)


def _tried(compared: At, number: dict[str, int]) -> tuple[list[Spot], list[Series]]:
    """The values of knobs that did not diverge, and a line through those of each variant."""
    spots, lines = [], {}
    for point in compared["tuning"]:
        success, error = point["success"].value, point[_OPEN].value
        if success is None and error is None:  # it diverged
            continue
        own = number.get(str(point["method"]), _REST)
        place: Point = (
            error if success is None else 100 * success,
            100 * (point["baseline_accuracy"].value - point["accuracy"].value),
        )
        name = str(point["variant"])
        look = {"number": own, "small": True, "filled": bool(point["chosen"].value)}
        spots.append(Spot(f"{name} {point['value']}", *place, **look))
        lines.setdefault((name, own), []).append(place)
    curves = [Series(name, places, own) for (name, own), places in lines.items()]
    return spots, curves


def tasks(compared: At, report: Any) -> Iterator[Markup]:
    """A table for each task, with every declared figure that some variant has."""
    for task, found in zip(compared["tasks"], report.tasks, strict=True):
        asked = f", asked {task['vqa']}" if task["vqa"] else ""
        fields = [name for name in _DECLARED if any(r[name] for r in task["results"])]
        barred = any(r["bar"] for r in task["results"])
        turned = any(row.knob is not None for row in found.results)
        # Columns that no variant has a value for are left out: a list times False is empty.
        header = ["Variant", *["Knob"] * turned, *(_DECLARED[name].header for name in fields)]
        rows = []
        for result, own in zip(task["results"], found.results, strict=True):
            row: list[Child] = [result["variant"], *[knob_text(own)] * turned]
            row += [_figure(result[name], name) for name in fields]
            rows.append(row + [_bar(result)] * barred)
        yield section(
            f"{task['task']}{asked}",
            note(
                "Means over seeds; below each its 95 % interval, the wider of Student's "
                "t, which may reach beyond 0 and 100 %, and the crossed bootstrap. ",
                *_before(task),
            ),
            table(header + ["Bar"] * barred, rows, left=1 + turned),  # the knob is text too
            note(_OPEN_LOOP) if any(r["open_loop_error"] for r in task["results"]) else None,
            _demands(task["results"]) if barred else None,
        )


def passing(compared: At) -> str:
    """A sentence on the variants that pass the bar, if there is one."""
    said = []
    for task in compared["tasks"]:
        barred = [result for result in task["results"] if result["bar"]]
        names = [str(r["variant"]) for r in barred if r["bar"]["passed"].value]
        if not barred:
            continue
        asked = f" asked {task['vqa']}" if task["vqa"] else ""
        who = ", ".join(names) or "no variant"
        each = [
            {str(check["name"]): check["value"].value for check in result["bar"]["checks"]}
            for result in barred
        ]
        unknown = unmeasured(each)
        why = f", for there is no figure of {unknown}" if unknown else ""
        said.append(f"On {task['task']}{asked}, {who} passes the bar{why}.")
    return " ".join(said)


def _before(task: At) -> list[Child]:
    """The backbone's VQA accuracy before training."""
    if task["baseline_accuracy"].value is None:
        return []
    before, majority = share(task["baseline_accuracy"]), share(task["majority_accuracy"])
    return ["Before fine-tuning: VQA ", before, " %; always the commonest answer: ", majority, " %"]


def _figure(found: At, name: str) -> Child:
    """A mean with its interval below, or a plain number, with the declared digits."""

    def write(at: At) -> Markup:
        return shown(at, shown_as(_DECLARED[name]))

    if not isinstance(found.value, dict):
        return write(found)
    return [write(found["mean"]), between(_ends(found), write)]


def _ends(estimate: At) -> tuple[At, At] | None:
    """Both ends over Student's t and the crossed bootstrap, as in the terminal's tables."""
    return farthest(estimate["interval"], estimate["crossed"])


def _bar(result: At) -> Child:
    return verdict(result["bar"]["passed"].value) if result["bar"] else "–"


def _demands(results: At) -> Markup:
    """Each demand of the bar with each variant's figure."""
    barred = [result for result in results if result["bar"]]
    demands = barred[0]["bar"]["checks"]  # the same for every variant
    rows = []
    for number, demand in enumerate(demands):
        checks = [result["bar"]["checks"][number] for result in barred]
        rows.append([f"{demand['name']} {demand['demand']}", *map(_checked, checks)])
    header = ["Demand", *(result["variant"] for result in barred)]
    return element(
        "details",
        element("summary", "The bar, demand by demand"),
        note("An estimate is judged by the worse end of its interval."),
        table(header, rows),
    )


def _checked(check: At) -> Sequence[Child]:
    """A demand's figure and verdict, with the interval whose end is judged below."""
    judged, value, digits = verdict(check["passed"].value), check["value"].value, 2
    demand = check["demand"].value
    if check["interval"]:  # for a demand with a largest value, the upper end is judged
        value = check["interval"].value[demand.startswith("<")]
    if value is not None:
        digits = deciding_decimals(value, demand, digits)
    show = partial(decimal, digits=digits)
    return [show(check["value"]), " ", judged, between(check["interval"], show)]
