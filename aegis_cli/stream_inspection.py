"""`aegis inspect` on the run of a stream: who was used, who was pruned, and what it cost, a task
and map.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.continual import files, robot_files
from aegis_cli.continual.report import StreamReport
from aegis_cli.continual.robot_report import RobotStreamReport
from aegis_cli.recipes import is_robot_stream_run


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
    return StreamInspection("stream-run", str(path), files.report(path))
