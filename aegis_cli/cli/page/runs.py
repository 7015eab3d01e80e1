"""The parts of a page about one run, or about several runs side by side."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from aegis_cli.cli.page import charts
from aegis_cli.cli.page.charts import HeatMap, Row, Series
from aegis_cli.cli.page.cursor import At, between, decimal, plain, share, whole, with_interval
from aegis_cli.cli.page.html import Child, Markup, element
from aegis_cli.cli.page.tables import pairs, shaded, table, verdict
from aegis_cli.cli.render import training_curves
from aegis_cli.cli.render.layout import INSTRUCTIONS, is_number
from aegis_cli.evaluation.results import Played, evaluated_on, told_apart

_TICKS = 5  # number of ticks below a heat map


def section(title: str, *children: Child) -> Markup:
    return element("section", element("h2", title), *children)


def figure(chart: Markup, caption: Child = None, wide: bool = False) -> Markup:
    """A chart with its caption; a wide one scrolls sideways on a phone."""
    said = None if caption is None else element("figcaption", caption)
    if wide:
        return element("figure", element("div", chart, class_="scroll"), said, class_="wide")
    return element("figure", chart, said)


def note(*children: Child) -> Markup:
    return element("p", *children, class_="note")


# --- figures --------------------------------------------------------------------------------------


def probe(run: At, having: str = "accuracy") -> At:
    """The figures of the run's first probe that has the figure `having`; empty if none has it."""
    each = [result["figures"] for result in run["probes"]]
    return next((figures for figures in each if figures[having]), At(None))


def rollout(run: At, colors: str) -> At:
    """The run's closed-loop figures on these colours, or on a task without colours."""
    for result in run["rollouts"]:
        if result["figures"]["colors"].value in (colors, None):
            return result["figures"]
    return At(None)


def at_a_glance(run: At) -> Markup:
    """The most important figures of a run."""
    vqa = probe(run)
    shown: list[tuple[str, Child]] = []
    if vqa:
        accuracy = [share(vqa["accuracy"]), " %"]
        if vqa["baseline_accuracy"]:
            accuracy.append(element("small", "before: ", share(vqa["baseline_accuracy"]), " %"))
        # The figures are those of one probe. With several question sets, its set is named.
        several = len(set(run["question_sets"].value)) > 1
        asked = f" on {run['question_sets'][0]}" if several else ""
        shown.append((f"VQA accuracy{asked}", accuracy))
        if vqa["drop_points"].value is not None:
            ends = between(vqa["drop_interval"], decimal)
            shown.append((f"VQA accuracy lost{asked}, points", [decimal(vqa["drop_points"]), ends]))
    shown += _acted_apart(run["rollouts"])
    for result in run["open_loops"]:
        on = evaluated_on(result["figures"].value)
        shown.append((f"Open-loop error on {on}", _off(result["figures"])))
    if run["gate"].value is not None:
        shown.append(("Gate", verdict(run["gate"].value, "passed", "failed")))
    return pairs(shown, big=True)


def _acted_apart(rollouts: At) -> Iterator[tuple[str, Child]]:
    """Each rollout by its colours, and by other settings if several have the same colours."""
    each = [result["figures"] for result in rollouts]
    names = [_acted(played)[0] for played in each]
    for played, otherwise in zip(each, _otherwise(rollouts), strict=True):
        name, success = _acted(played)
        if names.count(name) > 1:
            told = [str(played["task"]), f"{played['episodes']} episodes", otherwise]
            name = ", ".join([name, *filter(None, told)])
        yield name, success


def _otherwise(rollouts: Iterable[At]) -> list[str]:
    """The settings in which each rollout differs from the others."""
    return told_apart([Played(**result["played"].value) for result in rollouts])


def _acted(played: At) -> tuple[str, Child]:
    """The success of a rollout, or its return if the task is measured by it."""
    colors = f", {played['colors']} colours" if played["colors"] else ""
    if played["success"].value is None:
        ends = between(played["return_interval"], plain)
        return f"Mean return{colors}", [plain(played["mean_return"]), ends]
    ends = between(played["interval"], share)
    return f"Success %{colors}", [share(played["success"]), ends]


def successes(runs: Sequence[At]) -> Markup | None:
    """Every rollout of every run, with its interval."""
    each = [(run["label"], result) for run in runs for result in run["rollouts"]]
    if not each:
        return None
    apart = _otherwise(result for _, result in each)  # all empty if all have the same settings
    rows = []
    for (label, result), otherwise in zip(each, apart, strict=True):
        for row in (_success(label, result["figures"]), *_by_suite(label, result["figures"])):
            rows.append((*row, otherwise) if any(apart) else row)
    header = (
        "Run",
        "Task",
        "Colours",
        "Episodes",
        "Success % (or return)",
        "Wrong target %",
        "Final distance (m)",
        *(["Played with"] if any(apart) else []),
    )
    return section(
        "Success in closed loop",
        note("Under each success, its 95 % interval (Wilson), over the episodes played."),
        table(header, rows, left=3),
    )


def _success(label: At, played: At) -> tuple[Child, ...]:
    """The row of a rollout."""
    distance = played["final_distance_m"]
    return (
        label,
        played["task"],
        played["colors"] or "–",
        whole(played["episodes"]),
        _acted(played)[1],
        share(played["wrong_target"]),
        "–" if distance.value is None else plain(distance),
    )


def _by_suite(label: At, played: At) -> Iterator[tuple[Child, ...]]:
    """A row for each suite if a rollout covers several, such as LIBERO's four."""
    for part in played["suites"]:
        success = with_interval(part["success"], part["interval"], share)
        yield label, f"{part.key}, of these", "–", whole(part["episodes"]), success, "–", "–"


def _off(evaluated: At) -> Child:
    """The relative error of an open-loop evaluation, with its interval."""
    error, interval = evaluated["relative_error"], evaluated["relative_interval"]
    return with_interval(error, interval, lambda at: decimal(at, 3))


def open_loops(runs: Sequence[At]) -> Markup | None:
    """Every open-loop evaluation of every run, with its interval."""
    rows = []
    for run in runs:
        for result in run["open_loops"]:
            found = result["figures"]
            on, hold = evaluated_on(found.value), decimal(found["hold_error"], 3)
            rows.append((run["label"], on, whole(found["frames"]), _off(found), hold))
    if not rows:
        return None
    return section(
        "Open-loop error",
        note(
            "Predicted against recorded actions; nothing is executed. Squared error over the "
            "variance in training, mean over the dimensions of the actions: always predicting the "
            "training's mean action scores 1. Hold repeats the current position. Under each error, "
            "its 95 % interval (Student's t) over episodes."
        ),
        table(("Run", "Episodes", "Frames", "Relative error", "Hold's"), rows, left=2),
        *(_by_instruction(run, result["figures"]) for run in runs for result in run["open_loops"]),
    )


def _by_instruction(run: At, found: At) -> Markup | None:
    """The worst instructions of an open-loop evaluation, if it has several."""
    every = list(found["instructions"])
    if len(every) < 2:
        return None
    rows = [
        (
            str(one["instruction"]) or "(none)",
            whole(one["episodes"]),
            whole(one["frames"]),
            _off(one),
            decimal(one["hold_error"], 3),
        )
        for one in every[:INSTRUCTIONS]  # the worst come first
    ]
    which = "" if len(every) <= INSTRUCTIONS else f"the worst {INSTRUCTIONS} of "
    title = f"{run['label']}, {evaluated_on(found.value)}: {which}{len(every):,} instructions"
    return table(("Instruction", "Episodes", "Frames", "Relative error", "Hold's"), rows, 1, title)


def families(runs: Sequence[At]) -> Iterator[Markup]:
    """VQA accuracy by family of questions, with one table for each question set."""
    by_questions = _by_questions(runs)
    for (name, count, again, *_), found in by_questions.items():
        asked, probes = list(found), list(found.values())
        names = list(dict.fromkeys(name for p in probes for name in p["families"].value or ()))
        header = ["Family", "Questions", "Always the commonest %", "Before %"]
        header += asked
        rows = [_family(name, probes) for name in names]
        if len(names) > 1:  # for a single family, its row has all questions
            rows.append(_every_family(probes))
        title = "VQA by family of questions"
        if len(by_questions) > 1:
            title += f": {name}, {count:,} questions" + ", asked again" * again
        yield section(
            title,
            note(
                "Accuracy in percent with its 95 % interval. A fuller colour means that more was "
                "kept of what the backbone knew before."
            ),
            table(header, rows),
        )


def _every_family(probes: Sequence[At]) -> list[Child]:
    """The row with each run's accuracy over all questions."""
    first = probes[0]
    return [
        "all",
        whole(first["questions"]),
        share(first["majority"]),
        share(first["baseline_accuracy"]),
        *(with_interval(p["accuracy"], p["interval"], share) for p in probes),
    ]


_Asked = tuple[str, int, int, Any, Any]  # a key of `_by_questions`


def _by_questions(runs: Sequence[At]) -> dict[_Asked, dict[str, At]]:
    """The figures of the runs' probes by label, for each question set and number of questions.

    Runs of other backbones, or other questions of the same name, are apart: what was known before,
    or the share of the commonest answers, tells them. If a run was probed several times, as with
    other seeds, each time has a separate entry.
    """
    found: dict[_Asked, dict[str, At]] = {}
    for run in runs:
        label = str(run["label"])
        for name, probed in zip(run["question_sets"], run["probes"], strict=True):
            figures, again = probed["figures"], 0
            count = figures["questions"].value
            told = figures["majority"].value, figures["baseline_accuracy"].value
            while label in found.get((str(name), count, again, *told), ()):
                again += 1
            found.setdefault((str(name), count, again, *told), {})[label] = figures
    return found


def _family(name: str, probes: Sequence[At]) -> list[Child]:
    """The row with the family's figures in each run's probe."""
    own = [p["families"][name] for p in probes]
    first = next(family for family in own if family)  # the questions are the same in any probe
    row: list[Child] = [name, whole(first["questions"]), share(first["majority"])]
    row.append(share(first["baseline_accuracy"]))
    for family in own:
        if not family:
            row.append("–")
            continue
        cell = with_interval(family["accuracy"], family["interval"], share)
        before = family["baseline_accuracy"].value
        kept = family["accuracy"].value / before if before else family["accuracy"].value
        # A family that loses half is as pale as one that loses everything.
        row.append(shaded(cell, 2 * kept - 1))
    return row


def wrong_answers(runs: Sequence[At]) -> Markup | None:
    """Some wrong answers of each run with their images."""
    parts: list[Child] = []
    for run in runs:
        examples = probe(run, "wrong")["wrong"]
        if examples:
            if len(runs) > 1:
                parts.append(element("h3", run["label"]))
            parts.append(element("div", *map(_wrong, examples), class_="wrong"))
    if not parts:
        return None
    return section(
        "Wrong answers",
        note("The first wrong answers of each family of questions, with the right answer."),
        *parts,
    )


def _wrong(example: At) -> Markup:
    source = f"data:image/png;base64,{example['png']}"
    image = element("img", src=source, alt=f"image of the question: {example['question']}")
    said = element(
        "figcaption",
        example["question"],
        element("br"),
        element("del", example["said"] or "(nothing)"),
        " – right: ",
        element("ins", example["reference"]),
    )
    return element("figure", image, said)


# --- learning -------------------------------------------------------------------------------------


def curves(runs: Sequence[At]) -> Markup | None:
    """The figures in metrics.jsonl, with a chart for each figure that some run has."""
    given = [run["recipe"]["probe"]["vqa"].value for run in runs]
    sets = max((names for names in given if isinstance(names, list)), key=len, default=[])
    drawn = []
    for curve in training_curves.curves(sets):
        series = []
        for number, run in enumerate(runs):
            points = training_curves.points(run["metrics"].value, curve.name, curve.scale)
            series.append(Series(str(run["label"]), points, number, marks=True))
        if any(s.points for s in series):
            chart = charts.lines(series, "step", curve.title, curve.title, curve.log)
            drawn.append(figure(chart))
    if not drawn:  # the run was interrupted before its first line
        return None
    names = [(str(run["label"]), number) for number, run in enumerate(runs)]
    legend = charts.legend(names) if len(runs) > 1 else None
    return section("Learning", legend, element("div", *drawn, class_="charts"))


def drift(runs: Sequence[At]) -> Markup | None:
    """Squared W2 distance of each layer's activations to the anchor's."""
    series, rows, names = [], [], []
    for number, run in enumerate(runs):
        layers = probe(run, "layers")["layers"]
        if not layers:  # none of its probes was given an anchor
            continue
        w2 = [layer["w2"] for layer in layers]
        points = [(k, at.value) for k, at in enumerate(w2) if is_number(at.value)]
        series.append(Series(str(run["label"]), points, number, True))
        own = [str(layer["layer"]) for layer in layers]
        names = names if len(names) >= len(own) else own  # another backbone may have more layers
        rows.append([run["label"], *map(plain, w2)])
    if not any(s.points for s in series):
        return None
    rows = [[*row, *["–"] * (1 + len(names) - len(row))] for row in rows]
    chart = charts.lines(series, "layer", "W2²", "drift per layer", log=True)
    legend = charts.legend([(s.name, s.number) for s in series]) if len(runs) > 1 else None
    return section(
        "Drift per layer",
        note(
            "Squared 2-Wasserstein distance between the activations on questions now and those "
            "that the anchor measured before fine-tuning."
        ),
        legend,
        element("div", figure(chart), class_="charts"),
        table(["Run", *names], rows),
    )


def energy(runs: Sequence[At]) -> Iterator[Markup]:
    """A heat map for each run whose projection could shed energy of the gradient."""
    for run in runs:
        bins, layers = run["over_time"], run["layers"]
        if not bins:
            continue
        shares = [part for b in bins.value for part in b["layers"] if part > 0]
        most = max(shares, default=1.0)
        # Four decades at most: with more, the largest shares would all look the same.
        least = max(min(shares, default=most / 10), most / 1e4)
        rows = []
        for k, layer in enumerate(layers.value):
            over_time = [b["layers"][k] or None for b in bins.value]  # 0 has no logarithm
            rows.append(Row(layer["name"], over_time, f"{100 * layer['energy_shed']:.2g} %"))
        chart = HeatMap(
            rows=rows,
            columns=[f"steps {b['first_step']} to {b['last_step']}" for b in bins.value],
            edges=_edges(bins.value),
            x_label="training step",
            # Bound now, because the next run has other limits.
            shade=lambda value, low=least, high=most: _log_share(value, low, high),
            say=lambda value: f"{100 * value:.3g} % shed",
        )
        title = "Energy shed" + (f": {run['label']}" if len(runs) > 1 else "")
        yield section(
            title,
            note(
                "Share of the task gradient's energy that the projection removes, by parameter "
                "group and step, on a logarithmic scale; on the right each group's mean. Blank: "
                "nothing was shed. Over all groups: ",
                share(run["energy_shed_mean"], 2),
                " %.",
            ),
            figure(charts.heat(chart, title), wide=True),
            _energy_table(layers),
        )


def _energy_table(layers: At) -> Markup:
    rows = [
        (
            layer["name"],
            share(layer["energy_shed"], 3),
            share(layer["energy_shed_max"], 1),
            share(layer["conflict"], 1),
        )
        for layer in layers
    ]
    header = ("Group", "Energy shed, mean %", "Largest step %", "Steps in conflict %")
    return element("details", element("summary", "The figures"), table(header, rows))


def _log_share(value: float, low: float, high: float) -> float:
    """The position of a value between two others, on a logarithmic scale."""
    if high <= low:
        return 1.0
    return math.log(max(value, low) / low) / math.log(high / low)


def _edges(bins: Sequence[dict[str, Any]]) -> list[tuple[float, str]]:
    """About five ticks: a column's number, and its first step."""
    every = max(1, round(len(bins) / _TICKS))
    found = [(float(k), str(bins[k]["first_step"])) for k in range(0, len(bins), every)]
    # The end of the last column too, if the tick before it leaves room for its number.
    if len(bins) - found[-1][0] > every / 2:
        found.append((float(len(bins)), str(bins[-1]["last_step"])))
    return found
