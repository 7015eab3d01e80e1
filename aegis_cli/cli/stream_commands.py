"""What `train`, `probe`, `inspect` and `run` do with a stream of tasks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from aegis_cli.cli import render
from aegis_cli.common.errors import AegisError
from aegis_cli.recipes import RobotStreamRecipe, StreamRecipe, StreamStudyRecipe


def train(
    resolved: StreamRecipe | RobotStreamRecipe,
    out: Path,
    resume: bool,
    unused: Mapping[str, Any],
    as_json: bool,
) -> None:
    """Learn a stream; `unused` are the options that belong to demonstrations."""
    _refuse([name for name, value in unused.items() if value], f"the stream of '{resolved.name}'")
    from aegis_cli.continual import train as stage

    with render.progress() as on_event:
        report = stage.run(resolved, out, resume=resume, on_event=on_event)
    render.show(report, render.stream, as_json)


def probe(path: Path, given: Sequence[str], as_json: bool) -> None:
    """Measure a stream's matrix again, on the questions of its own recipe.

    `given` are the options that the user named.
    """
    _refuse([name for name in given if name != "--json"], f"the stream in '{path}'")
    from aegis_cli.continual import probe as stage

    with render.progress() as on_event:
        report = stage.run(path, on_event=on_event)
    render.show(report, render.stream_probe, as_json)


def inspect(path: Path, plot: Path | None, as_json: bool) -> None:
    """Show a stream's routing."""
    from aegis_cli import inspection as stage

    report = stage.run(path)
    if plot is not None:
        render.routing_plot(report, plot)
    render.show(report, render.stream_inspect, as_json)


def study(resolved: StreamStudyRecipe, out: Path, workers: int, as_json: bool) -> None:
    """Compare learners over streams and seeds."""
    from aegis_cli.studies import study as stage

    with render.progress() as on_event:
        report = stage.run(resolved, out, on_event=on_event, workers=workers)
    render.show(report, render.stream_study, as_json)
    render.save_table(report, render.stream_study)


def _refuse(unused: Sequence[str], what: str) -> None:
    """Raise AegisError for options that were given and mean nothing for a stream."""
    if unused:
        given = ", ".join(unused)
        raise AegisError(
            f"{given} with {what}", "no such option for a stream", f"leave out {given}"
        )
