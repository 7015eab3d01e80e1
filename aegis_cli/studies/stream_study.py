"""`aegis run` with a study of streams: tune, learn and compare variants x streams x seeds; what is
finished is never run again.

cells.json   what every finished cell led to, by a digest of everything that shapes it
table.json   the comparison so far
<stream>/<variant>/<seed>/, tuning/<variant>/<value>/   run folders, gone once they are measured
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.continual import images
from aegis_cli.recipes import StreamStudyRecipe, StreamTuning, stream_study_cells
from aegis_cli.studies.cells import Desk, slug
from aegis_cli.studies.crew import Cell
from aegis_cli.studies.row import Divergence
from aegis_cli.studies.stream_cells import StreamJob
from aegis_cli.studies.stream_comparison import Run, StreamStudyReport, results
from aegis_cli.studies.stream_row import StreamRow
from aegis_cli.studies.stream_tuning import StreamPoint, choose


def run(
    study: StreamStudyRecipe, root: Path, on_event: OnEvent = ignore, workers: int = 1
) -> StreamStudyReport:
    """Run `study` under `root/<name>`; called again, it goes on where it was interrupted.

    The knobs are tuned first, on validation parts; then all variants learn the first seed's streams
    and pairs, then the next's. `table.json` is written after every cell. A run that diverges is a
    finding. With several `workers`, so many cells are learned at once.

    Raises:
        AegisError: a cell that is no recipe, a stream or encoder that is not there, or whatever a
            stage finds wrong.
    """
    trials = {
        name: list(_trials(study, name)) for name in study.variants
    }  # made now: a bad one is refused now
    streams = _streams(study)
    desk = _Desk(study, Path(root) / study.name, on_event, workers)
    desk.total = sum(map(len, _tuned(trials).values())) + len(study.seeds) * len(streams) * len(
        trials
    )
    points, chosen = _tune(desk, trials)
    found: dict[str, dict[Run, StreamRow | Divergence]] = {}
    cells = [
        Cell(
            f"{stream}/{name}/{seed}",
            stream_study_cells.cell(study, name, stream, seed, chosen[name]),
        )
        for seed in study.seeds
        for stream in streams
        for name in study.variants
    ]
    report = _write(desk, found, points, chosen)
    with contextlib.closing(desk.rows(cells)) as rows:
        for cell, row in rows:
            stream, name, seed = cell.label.rsplit("/", 2)
            found.setdefault(name, {})[stream, int(seed)] = row
            report = _write(desk, found, points, chosen)
    return report


def _streams(study: StreamStudyRecipe) -> tuple[str, ...]:
    """Those of the main table, then the pairs."""
    return (*study.streams, *(dataclasses.astuple(study.pairs) if study.pairs else ()))


class _Desk(Desk[StreamRow]):
    """The study's cells are streams."""

    kind = StreamRow

    def __init__(
        self, study: StreamStudyRecipe, folder: Path, on_event: OnEvent, workers: int = 1
    ) -> None:
        super().__init__(StreamJob, folder, on_event, workers, study.keep_runs)
        self.study = study

    def key(self, cell: Cell) -> str:
        return self.bench.key(cell.recipe, cell.validation)

    def prepare(self, cells: Sequence[Cell], together: bool) -> None:
        """All streams are loaded, and their images made, once, here: a missing one, or no pair,
        shows before the work.
        """
        study, recipe = self.study, cells[0].recipe
        size = images.encoder(recipe.encoder).image_size
        for stream in dict.fromkeys(
            (*([study.tuning.stream] if study.tuning else []), *_streams(study))
        ):
            count = len(
                images.tasks(dataclasses.replace(recipe, stream=stream), size, self.on_event)
            )
            if stream not in study.streams and stream in _streams(study) and count != 2:
                raise AegisError(
                    f"pairs: the stream '{stream}' has {count} tasks",
                    "two tasks",
                    "choose another stream",
                )

    def clear(self, label: str) -> None:
        self.bench.remove(label)


# --- tuning ---------------------------------------------------------------------------------------


def _trials(study: StreamStudyRecipe, name: str) -> Iterator[tuple[Any, Cell]]:
    """A variant's values and their cells, on validation parts; without tuning they are only
    checked.
    """
    tuning = study.tuning or StreamTuning(study.streams[0])
    for value in study.variants[name].values:
        recipe = stream_study_cells.cell(study, name, tuning.stream, tuning.seed, value)
        yield value, Cell(f"tuning/{name}/{slug(value)}", recipe, validation=True)


def _tune(
    desk: _Desk, trials: Mapping[str, list[tuple[Any, Cell]]]
) -> tuple[list[StreamPoint], dict[str, Any]]:
    """Every value of every variant, and the value that each variant is compared with."""
    variants, tuning = desk.study.variants, desk.study.tuning
    tuned = _tuned(trials)  # nothing without a section for it: `stream_studies` refuses knobs then
    found = {
        cell.label: row
        for cell, row in desk.rows([cell for own in tuned.values() for _, cell in own])
    }
    points, chosen = [], {name: own[0][0] for name, own in trials.items()}
    for name, own in tuned.items():
        mine = [
            _point(name, variants[name].method, value, found[cell.label]) for value, cell in own
        ]
        best = choose(mine, tuning.within)
        points += [dataclasses.replace(point, chosen=i == best) for i, point in enumerate(mine)]
        chosen[name] = mine[best].value
    return points, chosen


def _tuned(trials: Mapping[str, list[tuple[Any, Cell]]]) -> dict[str, list[tuple[Any, Cell]]]:
    """The variants that have a choice."""
    return {name: own for name, own in trials.items() if len(own) > 1}


def _point(name: str, method: str, value: Any, found: StreamRow | Divergence) -> StreamPoint:
    if isinstance(found, Divergence):
        return StreamPoint(name, method, value, None, None)
    return StreamPoint(name, method, value, found.last, found.parameters)


# --- the table ------------------------------------------------------------------------------------


def _write(
    desk: _Desk,
    found: Mapping[str, Mapping[Run, StreamRow | Divergence]],
    points: list[StreamPoint],
    chosen: Mapping[str, Any],
) -> StreamStudyReport:
    """The report of what is known now, variants and runs in the recipe's order, whichever was
    finished first.
    """
    study = desk.study
    runs = [(stream, seed) for stream in _streams(study) for seed in study.seeds]
    ordered = {
        name: {run: found[name][run] for run in runs if run in found[name]}
        for name in study.variants
        if name in found
    }
    report = StreamStudyReport(
        name=study.name,
        finished=desk.done,
        cells=desk.total,
        streams=list(study.streams),
        seeds=list(study.seeds),
        pairs=study.pairs,
        results=results(ordered, study.variants, chosen, study.pairs),
        tuning_stream=study.tuning and study.tuning.stream,
        within=study.tuning and study.tuning.within,
        tuning=points,
        out=str(desk.folder),
    )
    files.save_json(desk.folder / "table.json", report.to_json())
    return report
