"""Plots: the places, colours and scales of what is drawn, and the titles."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import LogNorm, to_hex
from samples.studies import found

from aegis_cli.cli import render
from aegis_cli.cli.render import frontier, open_loops, plots, training_curves
from aegis_cli.cli.render.labels import Box, Label, place
from aegis_cli.common.errors import AegisError
from aegis_cli.evaluation.open_loop import Trace
from aegis_cli.inspection import Bin, LayerEnergy

# --- the frontier ---------------------------------------------------------------------------------


def with_methods(report: Any) -> Any:
    """Each variant becomes a method with its own name."""
    (task,) = report.tasks
    results = [dataclasses.replace(r, method=r.variant) for r in task.results]
    tuning = [dataclasses.replace(p, method=p.variant) for p in report.tuning]
    return dataclasses.replace(
        report, tasks=[dataclasses.replace(task, results=results)], tuning=tuning
    )


def texts(figure: Any) -> dict[str, str]:
    """Each text of the first axis with its colour."""
    return {text.get_text(): text.get_color() for text in figure.axes[0].texts}


@pytest.mark.parametrize("count", [2, 10, 22])
def test_at_most_six_methods_have_a_colour_and_every_variant_its_name(count: int) -> None:
    names = ("naive", *(f"v{i}" for i in range(count - 1)))
    figure = frontier._figure(with_methods(found(names)))
    written = texts(figure)
    assert set(names) <= set(written)
    own = [written[name] for name in names if written[name] != frontier._REST]
    assert len(own) == len(set(own)) == min(count, 6) and "naive" in written
    assert written["naive"] != frontier._REST  # every other one is compared with it
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert len(legend) == 4 and not set(names) & set(legend)


def test_variants_of_one_method_share_its_colour() -> None:
    written = texts(frontier._figure(found(("naive", "a", "b"))))
    assert written["a"] == written["b"] != written["naive"]


def test_probe_results_are_stars_and_tried_values_circles_filled_where_chosen() -> None:
    report = found(("naive", "a", "x"))
    axis = frontier._figure(report).axes[0]
    stars = [line for line in axis.lines if line.get_marker() == "*"]
    circles = [line for line in axis.lines if line.get_marker() == "o"]
    assert len(stars) == 3 and len(circles) == len(report.tuning) == 6
    filled = [line.get_markerfacecolor() == line.get_color() for line in circles]
    assert filled == [point.chosen for point in report.tuning]
    assert stars[0].get_markersize() > circles[0].get_markersize()
    for star, result in zip(stars, report.tasks[0].results, strict=True):
        spot = (100 * result.success_seen.mean, result.drop_points.mean)
        assert (*star.get_xdata(), *star.get_ydata()) == pytest.approx(spot)


def test_the_coloured_curves_say_their_values() -> None:
    report = with_methods(found(("naive", *(f"v{i}" for i in range(8)))))
    figure = frontier._figure(report)
    colors = frontier._colors(frontier._tried(report), frontier._compared(report))
    coloured = sum(color != frontier._REST for color in colors.values())
    written = [text.get_text() for text in figure.axes[0].texts]
    assert (written.count("4"), written.count("16")) == (coloured, coloured) == (6, 6)


def test_up_and_right_is_better_and_an_arrow_says_so() -> None:
    axis = frontier._figure(found(("naive", "x"))).axes[0]
    low, high = axis.get_ylim()
    assert low > high and axis.get_yscale() == "symlog"  # losses point downwards
    (arrow,) = [text for text in axis.texts if text.get_text() == "better"]
    (x, y), (to_x, to_y) = arrow.get_position(), arrow.xy
    assert to_x > x and to_y > y


def test_where_nothing_is_rolled_out_right_is_less_error() -> None:
    report = found(("naive", "a", "x"), by_error=True)
    figure = frontier._figure(report)
    axis = figure.axes[0]
    first, last = axis.get_xlim()
    assert first > last and axis.get_xlabel() == "open-loop error on held-out episodes"
    assert "against open-loop error" in axis.get_title(loc="left")
    stars = [line for line in axis.lines if line.get_marker() == "*"]
    circles = [line for line in axis.lines if line.get_marker() == "o"]
    for star, result in zip(stars, report.tasks[0].results, strict=True):
        spot = (result.open_loop_error.mean, result.drop_points.mean)
        assert (*star.get_xdata(), *star.get_ydata()) == pytest.approx(spot)
    assert [line.get_xdata()[0] for line in circles] == [p.open_loop_error for p in report.tuning]
    assert all(last < line.get_xdata()[0] < first for line in [*stars, *circles])
    played = found(("naive", "a", "x"))
    own = [frontier._named(frontier._tried(r), frontier._compared(r)) for r in (report, played)]
    assert own[0] == own[1]  # the methods that no other beats


def test_references_and_unbeaten_methods_come_first() -> None:
    spots = [("a", 90.0, 2.0), ("b", 80.0, 1.0), ("worse", 79.0, 3.0), ("naive", 95.0, 20.0)]
    assert frontier._unbeaten(spots) == ["naive", "a", "b"]


def test_a_frontier_without_tuning_shows_the_means() -> None:
    figure = frontier._figure(found(("a", "x"), tuned=False))
    assert {text.get_text() for text in figure.legends[0].get_texts()} == {
        "mean over seeds, 95 % (probe)",
        "before fine-tuning",
    }
    assert set(texts(figure)) == {"a", "x", "better"}


def test_a_frontier_names_the_task_of_what_it_shows() -> None:
    """If the tuned task is not among the compared ones, the frontier has marks of both."""
    report = found(("naive", "a", "x"))
    elsewhere = dataclasses.replace(report, tuning_task="point")
    untuned = dataclasses.replace(report, tuning=[], tuning_task=None)
    tried = dataclasses.replace(elsewhere, tasks=[])
    assert frontier.shown_tasks(report) == frontier.shown_tasks(untuned) == "task reach"
    assert frontier.shown_tasks(elsewhere) == "task reach (values tried on point)"
    assert frontier.shown_tasks(tried) == "task point"


def test_success_of_a_task_without_held_out_colours_is_of_no_colours() -> None:
    report = found(("a", "x"))
    (task,) = report.tasks
    bare = [dataclasses.replace(r, success_held_out=None) for r in task.results]
    without = dataclasses.replace(report, tasks=[dataclasses.replace(task, results=bare)])
    assert frontier.acting_axis(report) == "success on seen colours (%)"
    assert frontier.acting_axis(without) == "success (%)"
    assert frontier._figure(without).axes[0].get_xlabel() == "success (%)"


# --- labels ---------------------------------------------------------------------------------------


def test_labels_of_marks_that_coincide_do_not_overlap() -> None:
    drawn = plots.figure(figsize=(6, 4))
    axis = drawn.subplots()
    axis.set(xlim=(0, 1), ylim=(0, 1))
    drawn.draw_without_rendering()
    labels = [Label(0.5, 0.5, f"label {i}", "black", 9, False) for i in range(6)]
    place(axis, labels, [(0.5, 0.5)])
    boxes = [Box(*text.get_window_extent().extents) for text in axis.texts]
    mark = axis.transData.transform((0.5, 0.5))
    assert len(boxes) == 6 and not any(box.holds(*mark) for box in boxes)
    assert all(a.overlap(b) == 0 for i, a in enumerate(boxes) for b in boxes[:i])


@pytest.mark.parametrize("corner", [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)])
def test_a_label_stays_on_the_axis(corner: tuple[float, float]) -> None:
    drawn = plots.figure(figsize=(6, 4))
    axis = drawn.subplots()
    axis.set(xlim=(0, 1), ylim=(0, 1))
    drawn.draw_without_rendering()
    place(axis, [Label(*corner, "a long label", "black", 9, True)], [corner])
    frame, box = (
        Box(*extents) for extents in (axis.bbox.extents, axis.texts[0].get_window_extent().extents)
    )
    assert box.left >= frame.left and box.right <= frame.right
    assert box.low >= frame.low and box.high <= frame.high


# --- the energy -----------------------------------------------------------------------------------


def energies(shares: list[list[float]]) -> Any:
    """A report with as many layers as columns, and one bin per row."""
    means = np.mean(shares, axis=0)
    layers = [LayerEnergy(f"layer{i}", float(m), 1.0, 0.5) for i, m in enumerate(means)]
    bins = [Bin(i, i, float(np.mean(row)), tuple(row)) for i, row in enumerate(shares)]
    mean = float(np.mean(shares))
    return SimpleNamespace(path="runs/x", layers=layers, over_time=bins, energy_shed_mean=mean)


def test_the_energys_title_is_its_finding_and_its_scale_a_log() -> None:
    figure = plots._energy(energies([[0.2, 0.001], [0.1, 0.0]]))
    said = figure.get_suptitle()
    assert said == (
        "The projection sheds 7.5 % of the gradient's energy:\n"
        "most in layer0 (15 %), least in layer1 (0.050 %)"
    )
    (heat,) = [c for c in figure.axes[0].collections if c.get_array() is not None]
    assert isinstance(heat.norm, LogNorm) and heat.norm.vmax == pytest.approx(20)
    assert np.ma.getmaskarray(heat.get_array()).sum() == 1  # a layer without shed energy is blank
    assert figure.axes[1].get_yscale() == "log"


def test_a_scale_within_a_decade_has_plain_numbers_and_steps_are_whole() -> None:
    figure = plots._energy(energies([[0.06, 0.03], [0.04, 0.02]]))
    figure.draw_without_rendering()
    labels = [
        text.get_text()
        for axes in figure.axes
        for text in axes.yaxis.get_minorticklabels() + figure.axes[1].get_xticklabels()
    ]
    assert "3" in labels and not any("times" in label or "." in label for label in labels)


@pytest.mark.parametrize("shares", [[[0.0, 0.0]], [[0.3]], [[1e-9, 0.5]]])
def test_energies_of_any_size_are_drawn(shares: list[list[float]]) -> None:
    figure = plots._energy(energies(shares))
    figure.draw_without_rendering()
    nothing = not np.any(shares)
    assert figure.get_suptitle().startswith("The projection sheds nothing") == nothing


# --- routing --------------------------------------------------------------------------------------


def routed(site: str, owners: tuple[int, ...], mass: tuple[float, ...], pruned: int = 0) -> Any:
    return SimpleNamespace(site=site, owners=owners, mass=mass, pruned=tuple(range(pruned)))


def routing_figure() -> Any:
    records = [
        SimpleNamespace(task="first", sites=(routed("a", (0, 0), (0.75, 0.25)),)),
        SimpleNamespace(task="second", sites=(routed("a", (0, 1), (0.3, 0.7), pruned=1),)),
        SimpleNamespace(task="third", sites=(routed("a", (0, 1), (0.6, 0.4), pruned=2),)),
    ]
    report = SimpleNamespace(tasks=("first", "second", "third"), records=records)
    return plots._routing(report, "runs/s")


def test_routing_writes_its_values_and_marks_what_was_pruned() -> None:
    panels = routing_figure().axes[:3]
    written = [[text.get_text() for text in panel.texts] for panel in panels]
    assert written == [["100"], ["30", "70", "×1"], ["60", "40", "×2"]]
    assert [panel.get_title() for panel in panels] == ["1. first", "2. second", "3. third"]
    marks = [text for panel in panels for text in panel.texts if "×" in text.get_text()]
    assert {text.get_color() for text in marks} == {plots._PRUNED}


def test_what_lay_in_memory_before_is_not_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not even without an expert: matplotlib scales masked values too, and warns."""
    most = np.finfo(float).max  # as uninitialized memory may be
    unset = lambda shape: np.ma.array(np.full(shape, most), mask=True)  # noqa: E731
    monkeypatch.setattr(np.ma, "masked_all", unset)
    routing_figure().draw_without_rendering()


def test_experts_of_tasks_that_had_not_come_are_grey() -> None:
    for task, panel in enumerate(routing_figure().axes[:3]):
        grey = [p for p in panel.patches if to_hex(p.get_facecolor()) == plots._IMPOSSIBLE]
        assert [round(p.get_x()) for p in grey] == list(range(task + 1, 3))


@pytest.mark.parametrize("count", [1, 7, 11])
def test_a_stream_of_any_length_has_a_panel_a_task(count: int) -> None:
    tasks = tuple(f"t{i}" for i in range(count))
    records = [
        SimpleNamespace(task=name, sites=(routed("a", (i,), (1.0,)),))
        for i, name in enumerate(tasks)
    ]
    figure = plots._routing(SimpleNamespace(tasks=tasks, records=records), "runs/s")
    figure.draw_without_rendering()
    assert sum(bool(axes.get_title()) and axes.get_visible() for axes in figure.axes) == count


@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_routing_plots_title_and_legend_have_room_above_few_tasks(count: int) -> None:
    records = [
        SimpleNamespace(task=f"t{i}", sites=(routed("expert.layers.0.down", (i,), (1.0,)),))
        for i in range(count)
    ]
    report = SimpleNamespace(tasks=tuple(r.task for r in records), records=records)
    figure = plots._routing(report, "runs/s")
    figure.draw_without_rendering()
    for drawn in (figure._suptitle, *figure.legends):
        place = drawn.get_window_extent()
        assert place.x0 >= 0 and place.x1 <= figure.bbox.x1


@pytest.mark.parametrize("name", ["runs/$x\\frac$/y", "a$b", "plain"])
def test_a_path_is_drawn_as_it_is_and_not_as_mathematics(name: str) -> None:
    report = energies([[0.5, 0.25]])
    report.path = name
    figure = plots._energy(report)
    figure.draw_without_rendering()
    title = figure.axes[0].get_title(loc="left")
    assert title.replace(r"\$", "$").startswith(f"{name};")


# --- the course of a training ---------------------------------------------------------------------


def test_a_course_has_a_panel_for_each_figure_that_was_logged() -> None:
    lines = [
        {"step": 1, "loss": 2.0, "step_s": 0.5},
        {"step": 2, "loss": 0.5, "rollout_success": 0.25, "rollout_low": 0.125, "rollout_high": 1},
        {"step": 3, "vqa_drop_points": 1.0, "vqa_drop_points_2": 3.0}
        | {"vqa_drop_low_2": 2.0, "vqa_drop_high_2": 5.0, "validation_loss": None},
    ]
    there = [
        curve
        for curve in training_curves.curves(["scenes", "sets/easy-vqa"])
        if training_curves.points(lines, curve.name, 1.0)
    ]
    drawn = training_curves._drawn(lines, there, "naive in runs/$x$")
    drawn.draw_without_rendering()
    panels = {axes.get_title(loc="left"): axes for axes in drawn.axes if axes.get_visible()}
    loss, first, second, success, time = panels.values()
    assert [*panels] == [
        "Training loss",
        "VQA drop on scenes, validation (points)",
        "VQA drop on easy-vqa, validation (points)",
        "Success, validation (%)",
        "Time of a step (s)",
    ]
    assert loss.get_yscale() == "log"
    assert [*loss.lines[0].get_xydata().ravel()] == [1, 2.0, 2, 0.5]
    assert [*success.lines[0].get_xydata().ravel()] == [2, 25.0]
    bars = [axes.collections[0].get_segments() for axes in (second, success)]
    assert [[*map(tuple, bar)] for (bar,) in bars] == [[(3, 2.0), (3, 5.0)], [(2, 12.5), (2, 100)]]
    assert first.collections[0].get_segments() == []  # its interval is unknown
    assert drawn._suptitle.get_text() == r"naive in runs/\$x\$"


def test_a_training_that_has_logged_nothing_has_no_course(tmp_path: Path) -> None:
    with pytest.raises(AegisError, match="no metrics logged yet by naive in x"):
        render.curves_plot([], ["scenes"], "naive in x", tmp_path / "x.png")
    assert [*tmp_path.iterdir()] == []


# --- predicted and recorded actions ---------------------------------------------------------------


def open_loop_report(columns: int = 2, rows: int = 3) -> Any:
    def trace(episode: int) -> Trace:
        recorded = np.arange(7.0 * rows).reshape(7, rows)
        return Trace(episode, 3, recorded, recorded + 1)

    dimensions = [SimpleNamespace(name=f"joint {d}", unit=None) for d in range(rows)]
    return SimpleNamespace(
        dimensions=dimensions,
        traces=[trace(e) for e in range(columns)],
        trained_on=[1],
        relative_error=0.25,
    )


def test_each_predicted_chunk_is_a_line_beside_what_was_recorded() -> None:
    report = open_loop_report()
    drawn = open_loops._drawn(report)
    assert len(drawn.axes) == 2 * 3
    for axis, column, row in zip(drawn.axes, [0, 1] * 3, [0, 0, 1, 1, 2, 2], strict=True):
        trace = report.traces[column]
        recorded, *rest = axis.lines
        np.testing.assert_array_equal(recorded.get_ydata(), trace.recorded[:, row])
        chunks, dots = rest[::2], rest[1::2]
        assert [list(line.get_xdata()) for line in chunks] == [[0, 1, 2], [3, 4, 5], [6]]
        predicted = np.concatenate([line.get_ydata() for line in chunks])
        np.testing.assert_array_equal(predicted, trace.predicted[:, row])
        assert [*np.ravel([dot.get_xdata() for dot in dots])] == [0, 3, 6]


def test_the_open_loop_plots_finding_has_room_beside_a_single_episode() -> None:
    drawn = open_loops._drawn(open_loop_report(columns=1))
    drawn.draw_without_rendering()
    title = drawn._suptitle.get_window_extent()
    assert title.x0 >= 0 and title.x1 <= drawn.bbox.x1


def test_the_open_loop_plot_says_its_finding_and_what_was_trained_on() -> None:
    drawn = open_loops._drawn(open_loop_report())
    assert drawn.get_suptitle() == "Open-loop error: 0.25 of that of the training's mean action"
    assert [axis.get_title() for axis in drawn.axes[:2]] == ["episode 0", "episode 1 (trained on)"]
    assert [axis.get_ylabel() for axis in drawn.axes[::2]] == ["joint 0", "joint 1", "joint 2"]
