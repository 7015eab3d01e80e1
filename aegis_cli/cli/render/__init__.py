"""All output: progress and messages on stderr, reports as tables or JSON on stdout, plots."""

from __future__ import annotations

from aegis_cli.cli.render.foreign import extracted, inserted
from aegis_cli.cli.render.frontier import frontier_plot, has_frontier
from aegis_cli.cli.render.inspected import compared, inspect, questions
from aegis_cli.cli.render.markdown import save_table
from aegis_cli.cli.render.merges import merge, merge_plot
from aegis_cli.cli.render.open_loops import open_loop, open_loop_plot
from aegis_cli.cli.render.output import (
    STDOUT,
    error,
    name_errors,
    note,
    show,
    text,
    write_any_character,
)
from aegis_cli.cli.render.plans import plan
from aegis_cli.cli.render.plots import check_plot, energy_plot, routing_plot
from aegis_cli.cli.render.progress import progress
from aegis_cli.cli.render.streams import (
    compared_streams,
    stream,
    stream_inspect,
    stream_probe,
    unfinished_stream,
)
from aegis_cli.cli.render.studies import robot_stream_study, stream_study, study
from aegis_cli.cli.render.tables import (
    bench,
    bench_shape,
    doctor,
    dual,
    facts,
    measured,
    pipeline,
    pretrain,
    probe,
    recipe_list,
    scores,
    serving,
    trained,
)
from aegis_cli.cli.render.training_curves import curves_plot

__all__ = [
    "compared_streams",
    "unfinished_stream",
    "STDOUT",
    "bench",
    "bench_shape",
    "check_plot",
    "compared",
    "curves_plot",
    "doctor",
    "dual",
    "energy_plot",
    "error",
    "extracted",
    "facts",
    "frontier_plot",
    "has_frontier",
    "inserted",
    "inspect",
    "measured",
    "merge",
    "merge_plot",
    "name_errors",
    "note",
    "open_loop",
    "open_loop_plot",
    "pipeline",
    "plan",
    "pretrain",
    "probe",
    "progress",
    "questions",
    "recipe_list",
    "robot_stream_study",
    "routing_plot",
    "save_table",
    "scores",
    "serving",
    "show",
    "stream",
    "stream_inspect",
    "stream_probe",
    "stream_study",
    "study",
    "text",
    "trained",
    "write_any_character",
]
