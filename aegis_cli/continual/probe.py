"""`aegis probe` on a run of a stream: measures its matrix again from the run's files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from aegis_cli import recipes
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.continual import files, train
from aegis_cli.continual.report import StreamProbe, probe_from


def run(
    path: Path,
    on_event: OnEvent = ignore,
    backbone: str | None = None,
    demos: Sequence[Path] = (),
) -> StreamProbe:
    """Load a finished run, measure every row that it can still give, and write the matrix.

    Args:
        backbone, demos: of a stream of robot tasks, new places of its backbone and of each task's
            demonstrations.

    Raises:
        AegisError: the run is not done, its files are damaged, or the model, images, words or
            questions that it was measured with have changed.
    """
    path = Path(path)
    before = files.read(path)
    moved: dict[str, Any] = {}
    if recipes.is_robot_stream_run(path):
        moved = {"backbone": backbone, "paths": demos}
    elif backbone is not None or demos:
        raise AegisError(
            f"a new place of a backbone or demonstrations for '{path}', a stream of images",
            "no such option: a stream of images has neither",
            "leave out --backbone and --demos",
        )
    built = train.load(path, before, on_event, **moved)
    found, measured = built.measure_again(before, on_event)
    files.write_matrix(path, found)
    return probe_from(before, found, measured)
