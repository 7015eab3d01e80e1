"""The cells of a study of image streams: learners on streams, and their results."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from aegis_cli import recipes
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent
from aegis_cli.continual import images, learners
from aegis_cli.continual.report import ImageStreamReport
from aegis_cli.recipes import (
    TEST,
    VALIDATION,
    StreamRecipe,
    StreamStudyRecipe,
    StreamTuning,
    study_cells,
)
from aegis_cli.studies.cells import Cell, CellStore, MakeRunner
from aegis_cli.studies.comparison import Findings, StreamStudyReport, stream_results
from aegis_cli.studies.figures import Divergence, Figures, StreamFigures
from aegis_cli.studies.stream_runs import StreamRuns
from aegis_cli.studies.tuning import STREAM_RULE, StreamPoint
from aegis_cli.training.up_to_date import digest


class StreamStudy:
    """The kind of study whose cells are learners of a stream."""

    figures: type[Figures] = StreamFigures
    rule = STREAM_RULE
    tunes_fixed = False  # variants without a knob are not shown with the tuned ones

    def __init__(self, recipe: StreamStudyRecipe) -> None:
        self.recipe = recipe
        self.make_runner: MakeRunner[StreamRecipe] = StreamRunner
        pairs = dataclasses.astuple(recipe.pairs) if recipe.pairs else ()
        self.places: Sequence[str] = (*recipe.streams, *pairs)

    def cell(self, variant: str, place: str, seed: int, value: Any) -> StreamRecipe:
        """The recipe of one learner on one stream."""
        return study_cells.cell(self.recipe, variant, place, seed, value)

    def trial(self, variant: str, value: Any) -> StreamRecipe:
        """The recipe that evaluates a knob's value."""
        tuning = self.recipe.tuning or StreamTuning(self.recipe.streams[0])
        return self.cell(variant, tuning.stream, tuning.seed, value)

    def check(self, trials: Sequence[StreamRecipe]) -> None:
        """Do nothing, because checking streams and encoders means loading them, as in `prepare`."""

    def prepare(
        self,
        runner: StreamRunner,
        cells: Sequence[Cell[StreamRecipe]],
        together: bool,
    ) -> None:
        """Load all streams and make their images once, which shows missing streams and bad pairs.

        Raises:
            AegisError: a stream or encoder does not exist, or a pair does not have two tasks.
        """
        study, recipe = self.recipe, cells[0].recipe
        size = images.encoder(recipe.encoder).image_size
        tuned = [study.tuning.stream] if study.tuning else []
        for stream in dict.fromkeys((*tuned, *self.places)):
            one = dataclasses.replace(recipe, stream=stream)
            count = len(images.tasks(one, size, runner.on_event))
            if stream not in study.streams and stream in self.places and count != 2:
                raise AegisError(
                    f"pairs: the stream '{stream}' has {count} tasks",
                    "two tasks",
                    "choose another stream",
                )

    def point(self, variant: str, value: Any, found: StreamFigures | Divergence) -> StreamPoint:
        """The result of a knob's value."""
        method = self.recipe.variants[variant].method
        if isinstance(found, Divergence):
            return StreamPoint(variant, method, value, None, None)
        return StreamPoint(variant, method, value, found.last, found.parameters)

    def costs(self, store: CellStore[StreamRecipe], chosen: Mapping[str, Any]) -> dict[str, Any]:
        """Nothing, because a learner's minutes are among its figures."""
        return {}

    def report(self, findings: Findings, store: CellStore[StreamRecipe]) -> StreamStudyReport:
        """The table of the results so far."""
        study = self.recipe
        methods = {variant.method for variant in study.variants.values()}
        known = {name: learners.get(name) for name in methods}
        # A learner that learns nothing has the same run for each seed. Future tasks are served by
        # the bare encoder only if each task has its own router.
        unseeded = {name for name, learner in known.items() if learner.trains == "nothing"}
        frozen = {name for name, learner in known.items() if learner.frozen and not learner.shared}
        return StreamStudyReport(
            name=study.name,
            finished=store.done,
            cells=store.total,
            streams=list(study.streams),
            seeds=list(study.seeds),
            pairs=study.pairs,
            results=stream_results(
                findings.cells, study.variants, findings.chosen, study.pairs, unseeded, frozen
            ),
            tuning_stream=None if study.tuning is None else study.tuning.stream,
            within=None if study.tuning is None else study.tuning.within,
            tuning=findings.points,
            out=str(store.folder),
        )


class StreamRunner(StreamRuns[StreamRecipe]):
    """Learns the cells of streams of images."""

    def __init__(self, folder: Path, on_event: OnEvent) -> None:
        super().__init__(folder, on_event)
        self._fingerprints: dict[str, str] = {}
        self._image_sets: dict[tuple[Any, ...], str] = {}

    def key(self, cell: Cell[StreamRecipe]) -> str:
        """Digest of everything that affects the figures.

        The run's label and the locations of encoder and images are not part of it.
        """
        recipe = cell.recipe
        # Loading an encoder and digesting its images takes long, and many cells share them.
        if recipe.encoder not in self._fingerprints:
            self._fingerprints[recipe.encoder] = images.encoder(recipe.encoder).fingerprint()
        which = (recipe.stream, recipe.path, recipe.order)
        if which not in self._image_sets:
            self._image_sets[which] = images.image_set(recipe)
        return cell_key(cell, self._fingerprints[recipe.encoder], self._image_sets[which])

    def learned(self, cell: Cell[StreamRecipe]) -> StreamRecipe:
        """The recipe that is learned, measured on validation parts if the cell is for tuning."""
        return dataclasses.replace(cell.recipe, split=VALIDATION if cell.validation else TEST)

    def figures(self, report: ImageStreamReport) -> StreamFigures:
        """The figures of a learned stream that a study compares."""
        return stream_figures(report)


def cell_key(cell: Cell[StreamRecipe], fingerprint: str, image_set: str) -> str:
    """Digest of a stream's settings.

    Options at their defaults are left out, so a later option does not make finished cells stale.

    Args:
        fingerprint: fingerprint of the encoder that the recipe names.
        image_set: digest of the images that it names.
    """
    recipe = cell.recipe
    method = recipe.train.method
    sections = {"train": recipe.train, method: getattr(recipe, method.replace("-", "_"), None)}
    if not learners.get(method).shared:  # a single state for all tasks does not infer the task
        sections["inference"] = recipe.inference
    changed = {
        name: recipes.changed(section) for name, section in sections.items() if section is not None
    }
    shaping: dict[str, Any] = {
        "stream": recipe.stream,
        "order": recipe.order,
        "method": method,
        "validation": cell.validation,
    }
    if learners.get(method).trains != "nothing":  # otherwise all seeds are the same
        shaping["seed"] = recipe.seed
    return digest({**changed, **shaping, "encoder": fingerprint, "images": image_set})


def stream_figures(report: ImageStreamReport) -> StreamFigures:
    """The figures of a learned stream that a study compares."""
    told, inferred = report.scores, report.inferred_scores
    # Per task, the number of its own experts that it uses at its end, over all maps.
    owned = []
    for task, record in enumerate(report.records):
        owned.append(sum(site.owners.count(task) for site in record.sites))
    return StreamFigures(
        method=report.method,
        transfer=told.transfer,
        average=told.average,
        last=told.last,
        forgetting=told.forgetting,
        inferred_transfer=inferred.transfer,
        inferred_average=inferred.average,
        inferred_last=inferred.last,
        inferred_forgetting=inferred.forgetting,
        parameters=report.parameters,
        inference_parameters=report.inference_parameters,
        trained_phase1=report.trained_phase1,
        trained=report.trained,
        trained_mean=report.trained_mean,
        reuse=report.reuse,
        # Row t has the accuracies after task t, so the diagonal is right after learning each task.
        own=tuple(row[task] for task, row in enumerate(report.oracle)),
        added=tuple(record.added for record in report.records),
        new_experts=tuple(owned),
        first_change=report.oracle[-1][0] - report.oracle[0][0],
        minutes=report.minutes,
    )
