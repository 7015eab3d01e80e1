"""What `train`, `probe`, `inspect` and `run` do with a stream of tasks instead of
demonstrations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from aegis_cli.cli import render
from aegis_cli.common.errors import AegisError
from aegis_cli.recipes import (
    RobotStreamRecipe,
    StreamRecipe,
    StreamStudyRecipe,
    is_robot_stream_run,
)


def train(
    resolved: StreamRecipe | RobotStreamRecipe,
    out: Path,
    resume: bool,
    unused: Mapping[str, Any],
    as_json: bool,
) -> None:
    """Learn a stream; `unused` are the options that belong to demonstrations."""
    _refuse([name for name, value in unused.items() if value], f"the stream of '{resolved.name}'")
    if isinstance(resolved, RobotStreamRecipe):
        from aegis_cli.continual import robot_train as stage
    else:
        from aegis_cli.continual import train as stage

    with render.progress() as on_event:
        report = stage.run(resolved, out, resume=resume, on_event=on_event)
    render.show(
        report,
        render.robot_stream if isinstance(resolved, RobotStreamRecipe) else render.stream,
        as_json,
    )


def probe(path: Path, given: Sequence[str], as_json: bool) -> None:
    """Measure a stream's matrix again, on the questions of its own recipe; `given` are the options
    that were.
    """
    _refuse([name for name in given if name != "--json"], f"the stream in '{path}'")
    robot = is_robot_stream_run(path)
    if robot:
        from aegis_cli.continual import robot_probe as stage
    else:
        from aegis_cli.continual import probe as stage

    with render.progress() as on_event:
        report = stage.run(path, on_event=on_event)
    render.show(report, render.robot_probe if robot else render.stream_probe, as_json)


def inspect(path: Path, plot: Path | None, as_json: bool) -> None:
    """Show a stream's routing."""
    from aegis_cli import stream_inspection as stage

    report = stage.run(path)
    if plot is not None:
        render.routing_plot(report, plot)
    render.show(
        report,
        render.robot_inspect if report.kind == "robot-stream-run" else render.stream_inspect,
        as_json,
    )


def study(resolved: StreamStudyRecipe, out: Path, workers: int, as_json: bool) -> None:
    """Compare learners over streams and seeds."""
    from aegis_cli.studies import study as stage

    with render.progress() as on_event:
        report = stage.run(resolved, out, on_event=on_event, workers=workers)
    render.show(report, render.stream_study, as_json)
    render.save_table(report, render.stream_study)


def _refuse(unused: Sequence[str], what: str) -> None:
    """Options that were given and mean nothing for a stream."""
    if unused:
        given = ", ".join(unused)
        raise AegisError(
            f"{given} with {what}", "no such option for a stream", f"leave out {given}"
        )
