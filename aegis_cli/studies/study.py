"""`aegis run` with a study: tune, train and measure variants x seeds x tasks; what is finished is
never run again.

cells.json   what every finished cell led to, by a digest of everything that shapes it
table.json   the comparison so far
<task>/<variant>/<seed>/, tuning/<variant>/<value>/   run folders
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from aegis_cli import methods, recipes, sim
from aegis_cli.common import files, gl
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.data import demonstrations
from aegis_cli.evaluation import bench
from aegis_cli.recipes import Recipe, StudyRecipe, study_cells
from aegis_cli.studies.cells import Desk, slug
from aegis_cli.studies.comparison import NAIVE, Cost, StudyReport, task_results
from aegis_cli.studies.crew import Cell
from aegis_cli.studies.policy_cells import Job
from aegis_cli.studies.row import Divergence, Row
from aegis_cli.studies.tuning import Point, choose
from aegis_cli.training import assemble
from aegis_cli.training.up_to_date import digest


def run(
    study: StudyRecipe, root: Path, on_event: OnEvent = ignore, workers: int = 1
) -> StudyReport:
    """Run `study` under `root/<name>`; called again, it goes on where it was interrupted.

    The knobs are tuned first; then all variants and tasks of the first seed are compared, then of
    the next, so that an interrupted study is balanced; the costs come last. `table.json` is written
    after every cell, of tuning too. A training that diverges is a finding: it is written down, and
    the study goes on. With several `workers`, so many cells are measured at once, each with its
    share of the cores.

    Raises:
        AegisError: a cell that is no recipe (before any work), or whatever a stage finds wrong.
    """
    ceilings = frozenset(v.method for v in study.variants.values() if methods.get(v.method).ceiling)
    for task in (*study.tasks, *([study.tuning.task] if study.tuning else [])):
        sim.check(task)
    trials = {
        name: list(_trials(study, name)) for name in study.variants
    }  # made now: a bad one is refused now
    if study.tuning is not None:
        _check_playable([cell.recipe for own in trials.values() for _, cell in own])
    desk = _Desk(study, Path(root) / study.name, on_event, workers)
    desk.total = (sum(map(len, trials.values())) if study.tuning else 0) + len(study.seeds) * len(
        study.tasks
    ) * len(trials)
    table = _Table(desk, ceilings)
    _tune(table, trials)
    chosen = table.chosen
    with contextlib.closing(desk.rows(list(_compared(study, chosen)))) as rows:
        for cell, found in rows:
            task, name, seed = cell.label.rsplit("/", 2)  # a task may hold a slash
            table.add(task, name, int(seed), found)
    return table.write(_costs(desk, chosen))


def _compared(study: StudyRecipe, chosen: Mapping[str, Any]) -> Iterator[Cell]:
    for seed in study.seeds:
        for task in study.tasks:
            for name in study.variants:
                yield Cell(
                    f"{task}/{name}/{seed}", study_cells.cell(study, name, task, seed, chosen[name])
                )


# --- what is finished -----------------------------------------------------------------------------


class _Desk(Desk[Row]):
    """The study's cells are trainings of a job, which also makes what they share."""

    kind = Row

    def __init__(
        self, study: StudyRecipe, folder: Path, on_event: OnEvent, workers: int = 1
    ) -> None:
        super().__init__(Job, folder, on_event, workers, study.keep_runs)
        self.study = study

    def key(self, cell: Cell) -> str:
        given = None if cell.recipe.demos.path is None else self.bench.demos(cell.recipe).sha256
        return cell_key(
            cell, self.bench.backbone_sha256(cell.recipe), given, self.bench.vqa_state(cell.recipe)
        )

    def prepare(self, cells: Sequence[Cell], together: bool) -> None:
        gl.check()
        # those that are compared once the knobs are tuned, too: not when all tuning has been done
        for cell in cells:
            for split in ("validation", "probe") if cell.validation else ("probe",):
                self.bench.check_questions(cell.recipe, split)
        for recipe in {
            (r.backbone, r.demos, r.task): r for r in (cell.recipe for cell in cells)
        }.values():
            assemble.check_demonstrations(recipe, self.on_event)
        for cell in cells if together else ():  # what they share is made once, here
            self.bench.demos(cell.recipe)
            self.bench.anchor(cell.recipe)

    def clear(self, label: str) -> None:
        shutil.rmtree(self.folder / label / "checkpoints", ignore_errors=True)  # room, not a result


def cell_key(
    cell: Cell,
    backbone_sha256: str,
    demos_sha256: str | None = None,
    vqa_state: Sequence[Mapping[str, Any]] = (),
) -> str:
    """Digest of all that shapes a cell's row; not of its label, its folder, or where the backbone
    lies.

    Options at the defaults that they came with are left out: an option that is added later, or
    whose default changes, makes no finished cell stale, and none passes for another.

    Args:
        demos_sha256: of the demonstrations that the recipe names; None where it has them recorded.
        vqa_state: of the question files that it reads, if any.
    """
    key = _shaping(cell.recipe) | {"backbone": backbone_sha256, "validation": cell.validation}
    key |= {
        name: recipes.changed(getattr(cell.recipe, name))
        for name in ("demos", "anchor", "probe", "rollout")
    }
    if demos_sha256 is not None:
        key["demos"] = {"sha256": demos_sha256}
    return digest(key | ({"vqa": vqa_state} if any(vqa_state) else {}))


def _shaping(recipe: Recipe) -> dict[str, Any]:
    """What shapes a training, as far as it is not at the default that it came with."""
    sections = {
        name: getattr(recipe, name, None) for name in ("train", "expert", recipe.train.method)
    }
    changed = {
        name: recipes.changed(section) for name, section in sections.items() if section is not None
    }
    return {"task": recipe.task, "seed": recipe.seed, "method": recipe.train.method, **changed}


# --- tuning ---------------------------------------------------------------------------------------


def _trials(study: StudyRecipe, name: str) -> Iterator[tuple[Any, Cell]]:
    """A variant's values and their cells, on the validation split; without tuning they are only
    checked.
    """
    tuning = study.tuning or recipes.Tuning(task=study.tasks[0])
    for value in study.variants[name].values:
        recipe = study_cells.cell(study, name, tuning.task, tuning.seed, value)
        asked = replace(recipe.probe, questions=tuning.questions)
        played = replace(recipe.rollout, episodes=tuning.episodes)
        if not sim.is_suite(tuning.task):
            played = replace(played, colors=("seen",))
        recipe = replace(recipe, probe=asked, rollout=played)
        yield value, Cell(f"tuning/{name}/{slug(value)}", recipe, validation=True)


def _check_playable(learned: Sequence[Recipe]) -> None:
    """Values are chosen by their success: refuse demonstrations whose policies cannot be rolled
    out.
    """
    for path, camera in dict.fromkeys(
        (r.demos.path, r.demos.camera) for r in learned if r.demos.path is not None
    ):
        if demonstrations.playable_task(Path(path), camera) is None:
            raise AegisError(
                (
                    f"'tuning' with demonstrations in '{path}', whose policies cannot be rolled "
                    "out "
                    "here"
                ),
                (
                    "demonstrations of a simulated task seen by one camera, since values are "
                    "chosen "
                    "by success"
                ),
                (
                    "delete 'tuning' and put the values under 'set', or tune on demonstrations "
                    "of a "
                    "simulated task"
                ),
            )


def _tune(table: _Table, trials: Mapping[str, list[tuple[Any, Cell]]]) -> None:
    """Measure every value of every variant, and choose the one that each variant is
    compared with.
    """
    desk = table.desk
    if desk.study.tuning is None:
        table.chosen = {
            name: own[0][0] for name, own in trials.items()
        }  # one each: `studies` refuses knobs without tuning
        return
    found: dict[str, Row | Divergence] = {}
    with contextlib.closing(
        desk.rows([cell for own in trials.values() for _, cell in own])
    ) as rows:
        for cell, row in rows:
            found[cell.label] = row
            points = _points(desk.study, trials, found)
            table.points = [point for own in points.values() for point in own]
            table.write({})
    best = choose(points, desk.study.tuning.within)
    table.points = [
        replace(p, chosen=i == best[name])
        for name, own in points.items()
        for i, p in enumerate(own)
    ]
    table.chosen = {name: own[best[name]].value for name, own in points.items()}


def _points(
    study: StudyRecipe,
    trials: Mapping[str, list[tuple[Any, Cell]]],
    found: Mapping[str, Row | Divergence],
) -> dict[str, list[Point]]:
    """Those of the cells that have been found, in the order of the recipe, whichever was finished
    first.
    """
    return {
        name: [
            _point(name, study.variants[name].method, value, found[cell.label])
            for value, cell in own
            if cell.label in found
        ]
        for name, own in trials.items()
    }


def _point(name: str, method: str, value: Any, found: Row | Divergence) -> Point:
    if isinstance(found, Divergence):
        return Point(name, method, value, None, None, None)
    acts = found.success_seen if found.return_share is None else found.return_share
    return Point(name, method, value, found.accuracy, found.baseline_accuracy, acts)


# --- costs and table ------------------------------------------------------------------------------


def _costs(desk: _Desk, chosen: Mapping[str, Any]) -> dict[str, Cost]:
    """Step time and memory over naive's, by variant; nothing where no variant is named naive."""
    study = desk.study
    if NAIVE not in study.variants:
        return {}
    made = {
        name: study_cells.cell(study, name, study.tasks[0], study.seeds[0], chosen[name])
        for name in study.variants
    }
    keys = {
        name: _cost_key(recipe, made[NAIVE], desk.bench.backbone_sha256(recipe))
        for name, recipe in made.items()
    }
    missing = {name: recipe for name, recipe in made.items() if keys[name] not in desk.cells}
    for settings in dict.fromkeys(recipe.anchor for recipe in missing.values()):
        group = {name: recipe for name, recipe in missing.items() if recipe.anchor == settings}
        measured = desk.bench.anchor(next(iter(group.values())))
        found = bench.compare({NAIVE: made[NAIVE], **group}, measured.path, on_event=desk.on_event)
        for name in group:
            desk.keep(keys[name], Cost(found[name].step_time, found[name].peak_memory))
    return {name: desk.known(key, Cost) for name, key in keys.items()}


def _cost_key(recipe: Recipe, naive: Recipe, backbone_sha256: str) -> str:
    """Digest of what shapes a cost; the seed does not."""
    parts = [{**_shaping(r), "seed": 0, "backbone": backbone_sha256} for r in (recipe, naive)]
    return digest({"cost": parts, "anchor": recipes.changed(recipe.anchor)})


class _Table:
    """The tuned points and the comparison's rows as they come in, written out after each."""

    def __init__(self, desk: _Desk, ceilings: frozenset[str]) -> None:
        self.desk, self.ceilings = desk, ceilings
        self.points: list[Point] = []
        self.chosen: dict[str, Any] = {}  # the value that each variant is compared with
        self.found: dict[
            str, dict[str, dict[int, Row | Divergence]]
        ] = {}  # task -> variant -> seed

    def add(self, task: str, variant: str, seed: int, found: Row | Divergence) -> None:
        self.found.setdefault(task, {}).setdefault(variant, {})[seed] = found
        self.write({})

    def write(self, costs: Mapping[str, Cost]) -> StudyReport:
        """The report of what is known now."""
        study, desk = self.desk.study, self.desk
        report = StudyReport(
            name=study.name,
            finished=desk.done,
            cells=desk.total,
            seeds=list(study.seeds),
            tasks=[
                task_results(
                    task, self._ordered(task), study.variants, self.chosen, costs, self.ceilings
                )
                for task in study.tasks
                if task in self.found
            ],
            tuning_task=study.tuning and study.tuning.task,
            within=study.tuning and study.tuning.within,
            tuning=self.points,
            out=str(desk.folder),
        )
        files.save_json(desk.folder / "table.json", report.to_json())
        return report

    def _ordered(self, task: str) -> dict[str, dict[int, Row | Divergence]]:
        """In the order of the recipe, whichever was finished first."""
        found, study = self.found[task], self.desk.study
        seeds = {
            name: [seed for seed in study.seeds if seed in found.get(name, {})]
            for name in study.variants
        }
        return {
            name: {seed: found[name][seed] for seed in own} for name, own in seeds.items() if own
        }
