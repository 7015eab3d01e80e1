"""`aegis probe` on a run of a stream: measures its matrix again from the run's files."""

from __future__ import annotations

from pathlib import Path

from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.continual import files, train
from aegis_cli.continual.report import StreamProbe, probe_from


def run(path: Path, on_event: OnEvent = ignore) -> StreamProbe:
    """Load a finished run, measure every row that it can still give, and write the matrix.

    Raises:
        AegisError: the run is not done, its files are damaged, or the model, images, words or
            questions that it was measured with have changed.
    """
    path = Path(path)
    before = files.read(path)
    built = train.load(path, before, on_event)
    found, measured = built.measure_again(before, on_event)
    files.write_matrix(path, found)
    return probe_from(before, found, measured)
