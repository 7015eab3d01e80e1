"""The HTML page of a run, a job, a study or a stream, in a self-contained file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

from rich.console import RenderableType

from aegis_cli.cli import render
from aegis_cli.cli.page import about, charts, paired, runs, studies
from aegis_cli.cli.page.charts import HeatMap, Row, Spot
from aegis_cli.cli.page.cursor import At, between, decimal, plain, share
from aegis_cli.cli.page.html import Child, Markup, element, join
from aegis_cli.cli.page.runs import figure, note, section
from aegis_cli.cli.page.tables import pairs, table, verdict, view
from aegis_cli.cli.render.output import document
from aegis_cli.common import files
from aegis_cli.common.version import __version__
from aegis_cli.inspection import steps_taken
from aegis_cli.recipes.policy import CONSTANT, COSINE
from aegis_cli.reporting import differences
from aegis_cli.studies.comparison import PolicyResult
from aegis_cli.studies.metrics import columns

# The page forbids loading anything from elsewhere and running scripts. It never does so itself, but
# this also holds for anything that a file's metadata may have brought in.
_POLICY = "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'"


def save(report: Any, path: Path) -> None:
    """Write the page of a document of `reporting.gather`."""
    files.write_text(path, page(report, path.parent))


def page(report: Any, folder: Path) -> Markup:
    """The whole page.

    Args:
        folder: the folder that it will be written to.
    """
    found = At(document(report))
    title, parts = _PAGES[report.kind](found, report, folder)
    style = resources.files("aegis_cli.cli.page").joinpath("page.css").read_text("utf-8")
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        element("meta", name="generator", content=f"aegis {__version__}"),
        element("link", rel="icon", href="data:,"),
        element("title", f"{title} – Aegis"),
        element("style", Markup(style)),
    )
    foot = element("footer", note(f"Written by aegis {__version__} from {report.path}"))
    body = element("body", element("main", *parts, foot))
    return join(Markup("<!doctype html>\n"), element("html", head, body, lang="en"))


def _header(kind: str, title: str, lead: Child, *further: Child) -> Markup:
    said = element("p", lead, class_="lead")
    return element(
        "header", element("p", kind, class_="kind"), element("h1", title), said, *further
    )


# --- a run ----------------------------------------------------------------------------------------


def _run(found: At, report: Any, folder: Path) -> tuple[str, list[Child]]:
    title = f"{found['facts']['recipe']}: {found['label']}"
    parts = [
        _header("Run", title, _lead(found), runs.at_a_glance(found)),
        _trained(found, _anchor([found])),
        *_measured([found]),
        about.videos(found["videos"], Path(report.path), folder),
        about.commands(found),
        about.machine([found]),
        about.recipe(found),
    ]
    return title, parts


def _lead(run: At) -> str:
    """What a run was trained on, in a sentence."""
    said = f"Method {run['method']} fine-tuned {run['backbone']} on {_task(run)}, "
    return said + f"{_steps(run)} steps, seed {run['facts']['seed']}."


def _task(run: At) -> str:
    """The demonstrations that a run was trained on, in words."""
    if given := _demonstrations(run["recipe"]):
        return f"the demonstrations in {given}"
    return f"demonstrations of {run['task']} ({run['recipe']['demos']['episodes']} episodes)"


def _demonstrations(recipe: At) -> str:
    """The sets of demonstrations that a recipe names; "" if it names none."""
    given = recipe["demos"]["path"]
    return " and ".join(map(str, given)) if isinstance(given.value, list) else str(given)


def _anchor(runs: Sequence[At]) -> str | None:
    """The anchor in words, and whether a training read it; None without an anchor."""
    used = [run["anchor"] for run in runs if run["anchor"]]
    if not used:
        return None
    # All methods of a job share one anchor, but some may not have read it.
    told = next((anchor for anchor in used if anchor["read"].value), used[0])
    if told["read"].value:
        return str(told["measured_on"])
    return f"{told['measured_on']}; it measures the drift, and no training used it"


def _trained(run: At, anchor: str | None) -> Markup:
    """A short summary of the training and its data."""
    recipe, train = run["recipe"], run["recipe"]["train"]
    shown: list[tuple[str, Child]] = [
        ("Backbone", str(run["backbone"])),
        ("Demonstrations", _demonstrations(recipe) or f"{recipe['demos']['episodes']} episodes"),
        *_weights(recipe),
        *([("Anchor", anchor)] if anchor else []),
        ("Steps", f"{_steps(run)}, of {train['batch_size']} frames each"),
        ("Learning rates", _rates(train)),
        ("Precision", _precision(run)),
        ("Seed", str(run["facts"]["seed"])),
    ]
    if "merge" in run["facts"].value:
        shown.append(("Merged afterwards", _merge(run["facts"]["merge"])))
    return pairs(shown)


def _rates(train: At) -> str:
    """The peak learning rates, with their warm-up and schedule."""
    shown = [f"{train['backbone_lr']} and {train['expert_lr']} of the expert"]
    if train["warmup"].value:
        shown.append(f"up over {train['warmup']} steps")
    schedule = train["schedule"].value
    if schedule == CONSTANT:
        shown.append("then constant")
    else:
        left = f"{100 * train['final_lr_share'].value:g} %"
        shown.append(f"down to {left} along a {'cosine' if schedule == COSINE else 'line'}")
    return ", ".join(shown)


def _precision(run: At) -> str:
    """The precision of matrix products; for `auto` the actual one, if the run recorded it."""
    asked, taken = str(run["recipe"]["train"]["precision"]), run["machine"].value.get("precision")
    return asked if taken in (None, asked) else f"{taken} ({asked})"


def _weights(recipe: At) -> list[tuple[str, str]]:
    """A line with the weights of several sets, if the recipe sets any."""
    weights = recipe["demos"]["weights"]
    if not weights:
        return []
    return [("Their shares", " : ".join(f"{weight.value:g}" for weight in weights))]


def _steps(run: At) -> str:
    """The number of steps taken, and the planned number if some are left."""
    facts = run["facts"].value
    return steps_taken(facts["steps"], facts["planned_steps"])


def _merge(merge: At) -> list[Child]:
    """A description of the merge after the training."""
    how = f"{merge['method']}, strength {merge['strength']}, damping {merge['damping']}; "
    return [how, share(merge["kept"]), " % of the maps' displacement is left"]


def _measured(found: Sequence[At]) -> list[Child]:
    """The sections that runs and jobs have in common."""
    return [
        runs.successes(found),
        runs.open_loops(found),
        *runs.families(found),
        runs.drift(found),
        *runs.energy(found),
        runs.curves(found),
        runs.wrong_answers(found),
    ]


# --- a job ----------------------------------------------------------------------------------------


def _job(found: At, report: Any, folder: Path) -> tuple[str, list[Child]]:
    own, compared = list(found["runs"]), found["table"]
    title = str(compared["name"])
    first = own[0]
    methods = "1 method" if len(own) == 1 else f"{len(own)} methods"
    lead = f"{methods} fine-tuned {first['backbone']} on {_task(first)}, "
    lead += f"{_steps(first)} steps each."
    parts = [
        _header("Job", title, [lead, " ", _verdict(compared)]),
        _trained(first, _anchor(own)),
        _comparison(list(found["table"]["rows"]), own),
        paired.differences(found, own),
        *_measured(own),
        about.videos(found["videos"], Path(report.path), folder),
        about.commands(found),
        about.machine(own),
        about.recipe(first),
    ]
    return title, parts


def _verdict(compared: At) -> Child:
    """A summary of the table in a sentence or two."""
    if compared["verdict"].value:  # `.value`, because "" counts as a value
        return compared["verdict"]
    rows = sorted(compared["rows"], key=lambda row: row["drop_points"].value)
    before = compared["baseline_accuracy"]
    said: list[Child] = ["Before, it answered ", share(before), " % of the questions correctly. "]
    if len(rows) == 1:
        lost = decimal(rows[0]["drop_points"])
        return join(*said, rows[0]["method"], " lost ", lost, " percentage points.")
    least, most = rows[0], rows[-1]
    said += [element("strong", least["method"]), " lost the least ("]
    said += [decimal(least["drop_points"]), " points), "]
    said += [element("strong", most["method"]), " the most ("]
    said += [decimal(most["drop_points"]), " points). "]
    return join(*said, *_most_successful(rows))


def _most_successful(rows: Sequence[At]) -> list[Child]:
    """A sentence on the method that acts best; empty if that is not known."""
    name = _acting(rows)
    acting = [row for row in rows if row[name].value is not None]
    if not acting:
        return []
    if name == _OPEN:
        best = min(acting, key=lambda row: row[name].value)
        error = decimal(best[name], 3)
        return [element("strong", best["method"]), " has the least open-loop error: ", error, "."]
    best = max(acting, key=lambda row: row[name].value)
    what = "succeeds most often" if name == "success_seen" else "returns most"
    said: list[Child] = [element("strong", best["method"]), f" {what}: ", share(best[name]), " %"]
    if name == "return_share":
        return [*said, " of the highest."]
    return [*said, " on seen colours." if _has_colors(rows) else "."]


def _acting(rows: Sequence[At]) -> str:
    """The name of the figure for how well policies act in these rows."""
    figures = ("return_share", "success_seen", _OPEN)
    known = (name for name in figures if any(row[name].value is not None for row in rows))
    return next(known, "success_seen")


def _has_colors(rows: Sequence[At]) -> bool:
    """Whether any row has a rollout on held-out colours, which MetaWorld's tasks do not have."""
    return any(row["success_held_out"].value is not None for row in rows)


_Column = tuple[str, str, Callable[[At], Child]]  # a figure, its header, and how it is written
_COLUMNS: tuple[_Column, ...] = (
    ("success_seen", "Success seen %", share),
    ("success_held_out", "Success held-out %", share),
    ("wrong_target", "Wrong target %", share),
    ("return_share", "Return % of highest", share),
    ("open_loop_error", "Open-loop error", lambda at: decimal(at, 3)),
    ("w2", "W2²", plain),
    ("energy_shed", "Energy shed %", lambda at: share(at, 2)),
    ("validation_loss", "Validation loss", lambda at: decimal(at, 4)),
    ("step_s", "Step (s)", lambda at: decimal(at, 3)),
    ("step_time_ratio", "Step (x naive)", decimal),
)


def _comparison(
    rows: Sequence[At],
    own: Sequence[At],
    who: str = "Method",
    fields: Sequence[_Column] = _COLUMNS,
    charted: bool = True,
) -> Markup:
    """The table of all runs, and a chart of each run's loss over its success.

    Args:
        rows: a row of figures for each run.
        who: what tells the runs apart.
        charted: whether the figures can be compared, and so be in one chart.
    """
    shown = [c for c in fields if any(row[c[0]].value is not None for row in rows)]
    gated = any(run["gate"].value is not None for run in own)
    header = [who, "VQA %", "Lost (points)", "Cross-entropy (nats)", *(c[1] for c in shown)]
    cells = []
    for row, run in zip(rows, own, strict=True):
        cell: list[Child] = [
            run["label"],
            share(row["accuracy"]),
            [decimal(row["drop_points"]), between(row["drop_interval"], decimal)],
            decimal(row["cross_entropy"], 3),
        ]
        cell += [write(row[name]) for name, _, write in shown]
        if gated:
            cell.append(verdict(run["gate"].value, "passed", "failed"))
        cells.append(cell)
    explained = "Lost: percentage points of VQA accuracy, with the 95 % interval of one training."
    parts: list[Child] = [note(explained), table(header + ["Gate"] * gated, cells)]
    holds = [row["hold_error"] for row in rows if row["hold_error"]]
    if len({hold.value for hold in holds}) == 1:  # on the same frames one value holds for all
        hold = holds[0]
        parts.append(note("Open-loop error of a robot that holds its position: ", decimal(hold, 3)))
    if _acting(rows) == _OPEN:
        parts.append(note("An open-loop error is not a success rate, nor a measure of one."))
    spots = _spots(rows, own) if charted else []
    if spots:
        errs = _acting(rows) == _OPEN
        over = "open-loop error" if errs else "success"
        name = f"VQA accuracy lost over {over}"
        chart = charts.frontier(spots, [], _acting_axis(rows), _LOST, name, turned=errs)
        said = "Better is to the upper right. Bars are 95 % intervals of one training."
        parts.append(figure(chart, said, wide=True))
    return section(f"{who}s compared", *parts)


_LOST, _OPEN = "VQA accuracy lost (points)", "open_loop_error"


def _acting_axis(rows: Sequence[At]) -> str:
    if _acting(rows) == "return_share":
        return "return (% of the highest)"
    if _acting(rows) == _OPEN:
        return str(columns(PolicyResult)[_OPEN].axis)
    return "success on seen colours (%)" if _has_colors(rows) else "success (%)"


def _spots(rows: Sequence[At], own: Sequence[At]) -> list[Spot]:
    name = _acting(rows)
    found = []
    for number, (row, run) in enumerate(zip(rows, own, strict=True)):
        acted, lost = row[name].value, row["drop_points"].value
        if acted is None or lost is None or not row["drop_interval"]:
            continue
        # The interval of a success is in the run, not in the table; a return has none.
        ends = runs.rollout(run, "seen")["interval"].value if name == "success_seen" else None
        wide = None if ends is None else (100 * ends[0], 100 * ends[1])
        across = acted if name == _OPEN else 100 * acted
        tall = tuple(row["drop_interval"].value)
        found.append(Spot(str(run["label"]), across, lost, wide, tall, number))
    return found


# --- several runs ---------------------------------------------------------------------------------


def _runs(found: At, report: Any, folder: Path) -> tuple[str, list[Child]]:
    own, compared = list(found["runs"]), found["comparison"]
    labels = [str(run["label"]) for run in own]
    title = ", ".join(labels) if len(labels) <= _NAMED else f"{len(labels)} runs"
    lead = f"{len(own)} {'run' if len(own) == 1 else 'runs, side by side'}."
    apart = differences.said(compared["differs"].value)
    if apart:
        lead += f" They differ in {apart}: their figures compare more than their methods."
    made = report.comparison
    alike = made.same_questions and made.same_episodes and made.same_open_loop
    one_set = len(made.question_sets) < 2
    fields: list[_Column] = [] if one_set else [("vqa", "Questions", str)]
    if labels != [row.method for row in made.rows]:
        fields.append(("method", "Method", str))
    fields += [("baseline_accuracy", "Before %", share), *_COLUMNS]
    parts = [
        _header("Comparison", title, lead),
        _comparison(list(compared["rows"]), own, "Run", fields, alike and one_set),
        paired.differences(compared, own),
        *_measured(own),
        *(_part(run, folder) for run in own),
        about.machine(own),
        about.commands(found),
    ]
    return title, parts


_NAMED = 4  # runs that a title names


def _part(run: At, folder: Path) -> Markup:
    """What is only about one of several runs."""
    title = str(run["label"])
    lead = f"{run['path']}: {_lead(run)}"
    return join(
        section(
            title,
            element("p", lead),
            runs.at_a_glance(run),
            _trained(run, _anchor([run])),
            element("details", element("summary", "How to repeat it"), about.command_lines(run)),
            about.recipe_keys(run, "Every key of its recipe"),
        ),
        about.videos(run["videos"], Path(str(run["path"])), folder, f"Videos of {title}"),
    )


# --- studies and streams --------------------------------------------------------------------------


def _study(found: At, report: Any, _: Path) -> tuple[str, list[Child]]:
    compared = found["table"]
    title = str(compared["name"])
    tasks = list(dict.fromkeys(str(task["task"]) for task in compared["tasks"]))
    lead = f"{compared['finished']} of {compared['cells']} trainings are finished, "
    lead += f"on {', '.join(tasks) or compared['tuning_task']} with seeds {_seeds(compared)}. "
    lead += studies.passing(compared)
    terminal = element("summary", "As the terminal shows them")
    parts = [
        _header("Study", title, lead),
        studies.frontier(compared, report.table),
        *studies.tasks(compared, report.table),
        section("Notes", element("details", terminal, *view(render.study(report.table)))),
        about.commands(found),
    ]
    return title, parts


def _seeds(compared: At) -> str:
    return ", ".join(map(str, compared["seeds"].value))


def _stream_study(found: At, report: Any, _: Path) -> tuple[str, list[Child]]:
    on = f"{', '.join(found['table']['streams'].value)} with"
    results = render.stream_study(report.table)
    return _streams_compared("Study of streams", found, on, results)


def _robot_stream_study(found: At, report: Any, _: Path) -> tuple[str, list[Child]]:
    on = f"{', '.join(found['table']['tasks'].value)}, one after the other, with"
    results = render.robot_stream_study(report.table)
    return _streams_compared("Study of a robot stream", found, on, results)


def _streams_compared(
    kind: str, found: At, on: str, results: RenderableType
) -> tuple[str, list[Child]]:
    """The page of a study of learners, with the same tables as in the terminal."""
    compared = found["table"]
    title = str(compared["name"])
    lead = f"{compared['finished']} of {compared['cells']} runs are finished, "
    lead += f"on {on} seeds {_seeds(compared)}."
    parts = [
        _header(kind, title, lead),
        section("Results", *view(results)),
        about.commands(found),
    ]
    return title, parts


def _stream(found: At, report: Any, _: Path) -> tuple[str, list[Child]]:
    stream = found["report"]
    title = Path(report.path).resolve().name
    lead = f"A stream of {len(stream['tasks'].value)} tasks, learned one after the other."
    parts = [
        _header("Stream", title, lead, pairs([("Tasks", ", ".join(stream["tasks"].value))])),
        *_matrix(stream),
        section("Figures", *view(render.stream(report.report))),
        about.commands(found),
    ]
    return title, parts


def _matrix(stream: At) -> list[Markup]:
    """The scores on each task after each task, as a heat map and a table."""
    rows = stream["oracle"] or stream["success"]  # for images, or for simulated robots
    if rows:
        title = "What was reached on each task, after each task (%)"
        return _matrix_of(stream, rows, "accuracy matrix", title, share, 1.0)
    rows = stream["errors"]  # for other robots
    if not rows:
        return []
    title = "The open-loop error in each task, after each task"
    largest = max(float(error.value) for row in rows for error in row) or 1.0
    return _matrix_of(stream, rows, "error matrix", title, partial(decimal, digits=3), largest)


def _matrix_of(
    stream: At,
    rows: At,
    name: str,
    title: str,
    show: Callable[[At], Child],
    deepest: float,
) -> list[Markup]:
    """A matrix as a heat map and a table.

    Args:
        name: a description of the map for screen readers.
        show: formats a value for the table.
        deepest: the value with the deepest colour.
    """
    errors = stream["errors"]
    tasks = [str(task) for task in stream["tasks"]]
    numbers = [str(number + 1) for number in range(len(tasks))]
    chart = HeatMap(
        rows=[Row(f"after {tasks[k]}", row.value) for k, row in enumerate(rows)],
        columns=tasks,
        edges=[(k + 0.5, number) for k, number in enumerate(numbers)],
        x_label="task",
        shade=lambda value: value / deepest,
        say=lambda value: f"{value:.3f}" if errors else f"{100 * value:.0f}",
        write=True,
    )
    written = [[tasks[k], *map(show, row)] for k, row in enumerate(rows)]
    if errors and any(error.value is not None for error in stream["hold_errors"]):
        written.append(["holding the position", *map(show, stream["hold_errors"])])
    figures = table(["After", *tasks], written)
    return [
        section(
            title,
            figure(charts.heat(chart, name), wide=True),
            element("details", element("summary", "The figures"), figures),
        )
    ]


_PAGES = {
    "run": _run,
    "job": _job,
    "comparison": _runs,
    "study": _study,
    "stream-study": _stream_study,
    "robot-stream-study": _robot_stream_study,
    "stream-run": _stream,
    "robot-stream-run": _stream,
}
