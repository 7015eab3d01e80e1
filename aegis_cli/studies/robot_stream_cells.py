"""The cells of a study of robot streams: learners that share the data of one stream of tasks."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from aegis_cli import recipes, sim
from aegis_cli.common import gl, version
from aegis_cli.common.events import OnEvent
from aegis_cli.continual import robot_demos, robots
from aegis_cli.continual.report import RobotStreamReport
from aegis_cli.data import demonstrations
from aegis_cli.data.selection import Selection
from aegis_cli.data.vqa import sets
from aegis_cli.models import backbones
from aegis_cli.recipes import (
    Probe,
    RobotStreamRecipe,
    RobotStreamStudyRecipe,
    RobotStreamTuning,
    study_cells,
)
from aegis_cli.studies.cells import Cell, CellStore, MakeRunner
from aegis_cli.studies.comparison import Findings, RobotStreamStudyReport, robot_stream_results
from aegis_cli.studies.figures import Divergence, Figures, RobotStreamFigures
from aegis_cli.studies.stream_runs import StreamRuns
from aegis_cli.studies.tuning import ROBOT_STREAM_RULE, RobotStreamPoint
from aegis_cli.training.up_to_date import StageRecords, digest

PLACE = "stream"  # the single place on which all variants are measured


class RobotStreamStudy:
    """The kind of study whose cells are learners of one stream of robot tasks."""

    figures: type[Figures] = RobotStreamFigures
    rule = ROBOT_STREAM_RULE
    tunes_fixed = False  # variants without a knob are not shown with the tuned ones
    places: Sequence[str] = (PLACE,)

    def __init__(self, recipe: RobotStreamStudyRecipe) -> None:
        self.recipe = recipe
        self.make_runner: MakeRunner[RobotStreamRecipe] = RobotStreamRunner

    def cell(self, variant: str, place: str, seed: int, value: Any) -> RobotStreamRecipe:
        """The recipe of one learner; there is one `place`."""
        return study_cells.cell(self.recipe, variant, self.recipe.tasks, seed, value)

    def trial(self, variant: str, value: Any) -> RobotStreamRecipe:
        """The recipe that evaluates a knob's value."""
        tuning = self.recipe.tuning or RobotStreamTuning()
        return self.cell(variant, PLACE, tuning.seed, value)

    def check(self, trials: Sequence[RobotStreamRecipe]) -> None:
        """Raise AegisError for a task that does not exist, before any work."""
        recorded = any(trial.demos.paths is None for trial in trials)
        for task in self.recipe.tasks:
            if recorded:
                sim.check_recordable(task)
            sim.check(task)

    def prepare(
        self, runner: RobotStreamRunner, cells: Sequence[Cell[RobotStreamRecipe]], together: bool
    ) -> None:
        """Check the questions, and record demonstrations if several processes share them.

        Raises:
            AegisError: questions cannot be read, or this machine cannot render.
        """
        gl.check()
        for asked in dict.fromkeys(cell.recipe.probe for cell in cells):  # each set once
            runner.questions(asked)
        # A single process records these when needed, but several would each record their own.
        for cell in cells if together else ():
            runner.demonstrations(cell.recipe)

    def point(
        self, variant: str, value: Any, found: RobotStreamFigures | Divergence
    ) -> RobotStreamPoint:
        """The result of a knob's value."""
        method = self.recipe.variants[variant].method
        if isinstance(found, Divergence):
            return RobotStreamPoint(variant, method, value, None, None)
        return RobotStreamPoint(variant, method, value, found.last, found.vqa[-1])

    def costs(
        self, store: CellStore[RobotStreamRecipe], chosen: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Nothing, because a learner's minutes are among its figures."""
        return {}

    def report(
        self, findings: Findings, store: CellStore[RobotStreamRecipe]
    ) -> RobotStreamStudyReport:
        """The table of the results so far."""
        study = self.recipe
        return RobotStreamStudyReport(
            name=study.name,
            finished=store.done,
            cells=store.total,
            tasks=list(study.tasks),
            seeds=list(study.seeds),
            results=robot_stream_results(
                findings.cells, study.variants, findings.chosen, study.tasks
            ),
            within=None if study.tuning is None else study.tuning.within,
            tuning=findings.points,
            out=str(store.folder),
        )


class RobotStreamRunner(StreamRuns[RobotStreamRecipe]):
    """Learns the cells of a stream of robot tasks, which share demonstrations."""

    def __init__(self, folder: Path, on_event: OnEvent) -> None:
        super().__init__(folder, on_event)
        self._records = StageRecords(folder, on_event)
        self._fingerprints: dict[str, str] = {}
        self._sources: dict[Probe, robots.Questions] = {}
        self._digests: dict[tuple[Path, Selection], str] = {}

    def begin_anew(self) -> None:
        """Let everything be recorded and learned again."""
        super().begin_anew()
        self._records.begin_anew()

    def key(self, cell: Cell[RobotStreamRecipe]) -> str:
        """Digest of everything that affects the figures.

        The run's label and the locations of the backbone and given demonstrations are not part of
        it.
        """
        recipe = cell.recipe
        # Loading a backbone takes long, and many cells start from the same one.
        if recipe.backbone not in self._fingerprints:
            self._fingerprints[recipe.backbone] = backbones.load(recipe.backbone).fingerprint()
        given = list[str]()
        if recipe.demos.paths is not None:
            sources = (robot_demos.given(recipe, i) for i in range(len(recipe.tasks)))
            given = [self._digest(*source) for source in sources]
        state = self.questions(recipe.probe).state
        return cell_key(cell, self._fingerprints[recipe.backbone], given, state)

    def questions(self, settings: Probe) -> robots.Questions:
        """The question set that a recipe's probe asks.

        Raises:
            AegisError: it cannot be read.
        """
        if settings not in self._sources:
            self._sources[settings] = sets.read(
                settings.only_set, settings.skip_bad, self.on_event, settings.ask
            )
        return self._sources[settings]

    def demonstrations(self, recipe: RobotStreamRecipe) -> str | tuple[str, ...]:
        """Where the tasks' demonstrations are; they are recorded unless they are given."""
        if recipe.demos.paths is not None:
            return recipe.demos.paths
        made = [robot_demos.record(recipe, i, self._records) for i in range(len(recipe.tasks))]
        return tuple(str(one.path) for one in made)

    def _digest(self, path: Path, chosen: Selection) -> str:
        """Digest of given demonstrations."""
        if (path, chosen) not in self._digests:
            self._digests[path, chosen] = demonstrations.digest(path, chosen)
        return self._digests[path, chosen]

    def learned(self, cell: Cell[RobotStreamRecipe]) -> RobotStreamRecipe:
        """The recipe that is learned, measured on validation episodes if the cell is for tuning."""
        recipe = cell.recipe
        split = "validation" if cell.validation else "evaluation"
        # Filled-in paths let a run find the demonstrations that all cells share.
        return dataclasses.replace(
            recipe,
            demos=dataclasses.replace(recipe.demos, paths=self.demonstrations(recipe)),
            rollout=dataclasses.replace(recipe.rollout, split=split),
        )

    def figures(self, report: RobotStreamReport) -> RobotStreamFigures:
        """The figures of a learned stream that a study compares."""
        return RobotStreamFigures(
            method=report.method,
            success=report.success,
            average=report.scores.average,
            last=report.scores.last,
            forgetting=report.scores.forgetting,
            vqa=tuple(score.accuracy for score in report.vqa),
            cross_entropy=tuple(score.cross_entropy for score in report.vqa),
            parameters=report.parameters,
            trained_mean=report.trained_mean,
            reuse=report.reuse,
            minutes=report.minutes,
            code=version.code(),
        )


def cell_key(
    cell: Cell[RobotStreamRecipe],
    fingerprint: str,
    demos_sha256: Sequence[str],
    vqa_state: Mapping[str, Any],
) -> str:
    """Digest of a robot stream's settings.

    Options at their defaults are left out, so a later option does not make finished cells stale.

    Args:
        fingerprint: fingerprint of the backbone that the recipe names.
        demos_sha256: digests of given demonstrations, one per task; empty if they are recorded.
        vqa_state: state of the question files that it reads, if any.
    """
    recipe = cell.recipe
    method = recipe.train.method
    sections = {name: getattr(recipe, name) for name in ("train", "expert", "rollout", "probe")}
    sections["demos"] = dataclasses.replace(recipe.demos, paths=None)  # paths do not count
    sections[method] = getattr(recipe, method.replace("-", "_"), None)
    shaping: dict[str, Any] = {
        name: recipes.changed(section) for name, section in sections.items() if section is not None
    }
    shaping |= {
        "tasks": list(recipe.tasks),
        "method": method,
        "seed": recipe.seed,
        "validation": cell.validation,
        "backbone": fingerprint,
    }
    if demos_sha256:
        shaping["demos"] = list(demos_sha256)  # instead of the recording settings
        if chosen := recipes.selected(recipe):  # the digests do not cover the selection
            shaping["selected"] = chosen
    if vqa_state:  # scenes do not come from files and add no key
        shaping["vqa"] = dict(vqa_state)
    return digest(shaping)
