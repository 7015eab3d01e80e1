"""`aegis inspect` on the run of a stream: who was used, who was pruned, and what it cost, a task and map."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aegis_cli.events import OnEvent, ignore
from aegis_cli.recipe import is_robot_stream_run
from aegis_cli.stages import robot_files, stream_files
from aegis_cli.stages.robot_report import RobotStreamReport
from aegis_cli.stages.stream_report import StreamReport


@dataclass(frozen=True)
class StreamInspection:
    """A finished run and where it lies."""

    kind: str
    path: str
    report: StreamReport | RobotStreamReport

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def run(path: Path, on_event: OnEvent = ignore) -> StreamInspection:
    """Read a run's report; it is done at once, so `on_event` is never called.

    Raises:
        AegisError: the run is not done, or its report is damaged.
    """
    path = Path(path)
    if is_robot_stream_run(path):
        return StreamInspection("robot-stream-run", str(path), robot_files.report(path))
    return StreamInspection("stream-run", str(path), stream_files.report(path))
