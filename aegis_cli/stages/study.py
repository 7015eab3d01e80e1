"""`aegis run` with a study: tune, train and measure variants x seeds x tasks; what is finished is never run again.

    cells.json   what every finished cell led to, by a digest of everything that shapes it
    table.json   the comparison so far
    <task>/<variant>/<seed>/, tuning/<variant>/<value>/   run folders
"""

from __future__ import annotations

import contextlib
import dataclasses
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from aegis_cli import files, gl, methods, studies, tasks
from aegis_cli import recipe as recipes
from aegis_cli.errors import AegisError
from aegis_cli.events import OnEvent, Progress, ignore
from aegis_cli.recipe import Recipe, StudyRecipe
from aegis_cli.stages import bench, crew
from aegis_cli.stages.comparison import NAIVE, Cost, StudyReport, task_results
from aegis_cli.stages.crew import Cell
from aegis_cli.stages.job import Job, digest
from aegis_cli.stages.row import Divergence, Row
from aegis_cli.stages.selection import Point, choose

CELLS = "cells.json"
Entry = TypeVar("Entry", Row, Divergence, Cost)


def run(study: StudyRecipe, root: Path, on_event: OnEvent = ignore, workers: int = 1) -> StudyReport:
    """Run `study` under `root/<name>`; called again, it goes on where it was interrupted.

    The knobs are tuned first; then all variants and tasks of the first seed are compared, then of the next, so
    that an interrupted study is balanced; the costs come last. `table.json` is written after every cell.
    A training that diverges is a finding: it is written down, and the study goes on. With several `workers`, so many
    cells are measured at once, each with its share of the cores.

    Raises:
        AegisError: a cell that is no recipe (before any work), or whatever a stage finds wrong.
    """
    ceilings = frozenset(v.method for v in study.variants.values() if methods.get(v.method).ceiling)
    for task in (*study.tasks, *([study.tuning.task] if study.tuning else [])):
        tasks.check(task)
    trials = {name: list(_trials(study, name)) for name in study.variants}  # made now: a bad one is refused now
    desk = _Desk(study, Path(root) / study.name, on_event, workers)
    desk.total = (sum(map(len, trials.values())) if study.tuning else 0) + len(study.seeds) * len(study.tasks) * len(trials)
    points, chosen = _tune(desk, trials)
    table = _Table(desk, points, chosen, ceilings)
    with contextlib.closing(desk.rows(list(_compared(study, chosen)))) as rows:
        for cell, found in rows:
            task, name, seed = cell.label.rsplit("/", 2)  # a task may hold a slash
            table.add(task, name, int(seed), found)
    return table.write(_costs(desk, chosen))


def _compared(study: StudyRecipe, chosen: Mapping[str, Any]) -> Iterator[Cell]:
    for seed in study.seeds:
        for task in study.tasks:
            for name in study.variants:
                yield Cell(f"{task}/{name}/{seed}", studies.cell(study, name, task, seed, chosen[name]))


# --- what is finished -----------------------------------------------------------------------------


class _Desk:
    """A study at work: its folder, its finished cells, and the job that makes the others."""

    def __init__(self, study: StudyRecipe, folder: Path, on_event: OnEvent, workers: int = 1) -> None:
        files.make_folder(folder)
        self.study, self.folder, self.on_event, self.workers = study, folder, on_event, workers
        self.job = Job(folder, on_event)
        self.cells = _load_cells(folder / CELLS)
        self.done = self.total = 0

    def rows(self, cells: Sequence[Cell]) -> Iterator[tuple[Cell, Row | Divergence]]:
        """What the cells led to: those that are known, then the others as they are measured; equal ones once."""
        keys = {cell.label: self._key(cell) for cell in cells}
        todo: dict[str, Cell] = {}
        for cell in cells:
            if keys[cell.label] in self.cells:
                yield cell, self._told(keys[cell.label])
            else:
                todo.setdefault(keys[cell.label], cell)
        waiting = [cell for cell in cells if keys[cell.label] in todo]
        with contextlib.closing(self._measured(list(todo.values()))) as measured:
            for first, found in measured:
                key = keys[first.label]
                self.keep(key, found)
                if not self.study.keep_runs:
                    shutil.rmtree(self.folder / first.label / "checkpoints", ignore_errors=True)  # room, not a result
                for cell in waiting:
                    if keys[cell.label] == key:
                        yield cell, self._told(key)

    def _measured(self, cells: list[Cell]) -> Iterator[tuple[Cell, Row | Divergence]]:
        """Train and measure cells, by several processes if there are to be some."""
        if cells:
            gl.check()
        if self.workers == 1 or len(cells) < 2:
            for cell in cells:
                yield cell, self.job.outcome(cell.label, cell.recipe, cell.validation)
            return
        for cell in cells:  # what they share is made once, here
            self.job.demos(cell.recipe)
            self.job.anchor(cell.recipe)
        with contextlib.closing(crew.measure(self.folder, cells, self.workers, self.on_event)) as finished:
            for number, found in finished:
                yield cells[number], found

    def _told(self, key: str) -> Row | Divergence:
        self.done += 1
        self.on_event(Progress("study", self.done, self.total, "cells"))
        return self.known(key, Divergence if "good_steps" in self.cells[key] else Row)

    def _key(self, cell: Cell) -> str:
        given = None if cell.recipe.demos.path is None else self.job.demos(cell.recipe).sha256
        return cell_key(cell, self.job.backbone_sha256(cell.recipe), given, self.job.vqa_state(cell.recipe))

    def keep(self, key: str, found: Row | Divergence | Cost) -> None:
        """Store what was found, at once."""
        self.cells[key] = dataclasses.asdict(found)
        files.write_text(self.folder / CELLS, files.canonical(self.cells) + "\n")

    def known(self, key: str, kind: type[Entry]) -> Entry:
        """A finished entry.

        Raises:
            AegisError: something else than what this version writes.
        """
        entry, names = self.cells[key], {f.name for f in dataclasses.fields(kind)}
        needed = {f.name for f in dataclasses.fields(kind) if f.default is dataclasses.MISSING}
        if not isinstance(entry, dict) or not needed <= entry.keys() <= names:
            problem = f"an entry of '{self.folder / CELLS}' that is no {kind.__name__.lower()} of this version"
            raise AegisError(problem, f"the keys {', '.join(sorted(names))}", f"delete the entry {key}, or the file")
        return kind(**{name: tuple(v) if isinstance(v, list) else v for name, v in entry.items()})


def _load_cells(path: Path) -> dict[str, Any]:
    cells = files.load_json(path) if path.exists() else {}
    if not isinstance(cells, dict):
        raise AegisError(f"'{path}' holds no cells", "a mapping of digests to rows", "delete it, or bring the file of a study")
    return cells


def cell_key(
    cell: Cell, backbone_sha256: str, demos_sha256: str | None = None, vqa_state: Sequence[Mapping[str, Any]] = ()
) -> str:
    """Digest of all that shapes a cell's row; not of its label, its folder, or where the backbone lies.

    Options at their defaults are left out: an option that a later change brings makes no finished cell stale.

    Args:
        demos_sha256: of the demonstrations that the recipe names; None where it has them recorded.
        vqa_state: of the question files that it reads, if any.
    """
    key = _shaping(cell.recipe) | {"backbone": backbone_sha256, "validation": cell.validation}
    key |= {name: recipes.changed(getattr(cell.recipe, name)) for name in ("demos", "anchor", "probe", "rollout")}
    if demos_sha256 is not None:
        key["demos"] = {"sha256": demos_sha256}
    return digest(key | ({"vqa": vqa_state} if any(vqa_state) else {}))


def _shaping(recipe: Recipe) -> dict[str, Any]:
    """What shapes a training, as far as it is not at its default."""
    sections = {name: getattr(recipe, name, None) for name in ("train", "expert", recipe.train.method)}
    changed = {name: recipes.changed(section) for name, section in sections.items() if section is not None}
    return {"task": recipe.task, "seed": recipe.seed, "method": recipe.train.method, **changed}


# --- tuning ---------------------------------------------------------------------------------------


def _trials(study: StudyRecipe, name: str) -> Iterator[tuple[Any, Cell]]:
    """A variant's values and their cells, on the validation split; without tuning they are only checked."""
    tuning = study.tuning or recipes.Tuning()
    for value in study.variants[name].values:
        recipe = studies.cell(study, name, tuning.task, tuning.seed, value)
        asked = dataclasses.replace(recipe.probe, questions=tuning.questions)
        played = dataclasses.replace(recipe.rollout, episodes=tuning.episodes)
        if not tasks.is_suite(tuning.task):
            played = dataclasses.replace(played, colors=("seen",))
        recipe = dataclasses.replace(recipe, probe=asked, rollout=played)
        yield value, Cell(f"tuning/{name}/{_slug(value)}", recipe, validation=True)


def _slug(value: Any) -> str:
    """A folder's name for a knob's value."""
    return "fixed" if value is None else re.sub(r"[^\w.+-]+", "_", str(value)).strip("_")


def _tune(desk: _Desk, trials: Mapping[str, list[tuple[Any, Cell]]]) -> tuple[list[Point], dict[str, Any]]:
    """Every value of every variant, and the value that each variant is compared with."""
    if desk.study.tuning is None:
        return [], {name: own[0][0] for name, own in trials.items()}  # one each: `studies` refuses knobs without tuning
    found = {cell.label: row for cell, row in desk.rows([cell for own in trials.values() for _, cell in own])}
    points = {
        name: [_point(name, desk.study.variants[name].method, value, found[cell.label]) for value, cell in own]
        for name, own in trials.items()
    }
    best = choose(points, desk.study.tuning.within)
    marked = [dataclasses.replace(p, chosen=i == best[name]) for name, own in points.items() for i, p in enumerate(own)]
    return marked, {name: own[best[name]].value for name, own in points.items()}


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
    made = {name: studies.cell(study, name, study.tasks[0], study.seeds[0], chosen[name]) for name in study.variants}
    keys = {name: _cost_key(recipe, made[NAIVE], desk.job.backbone_sha256(recipe)) for name, recipe in made.items()}
    missing = {name: recipe for name, recipe in made.items() if keys[name] not in desk.cells}
    for settings in dict.fromkeys(recipe.anchor for recipe in missing.values()):
        group = {name: recipe for name, recipe in missing.items() if recipe.anchor == settings}
        measured = desk.job.anchor(next(iter(group.values())))
        found = bench.compare({NAIVE: made[NAIVE], **group}, measured.path, on_event=desk.on_event)
        for name in group:
            desk.keep(keys[name], Cost(found[name].step_time, found[name].peak_memory))
    return {name: desk.known(key, Cost) for name, key in keys.items()}


def _cost_key(recipe: Recipe, naive: Recipe, backbone_sha256: str) -> str:
    """Digest of what shapes a cost; the seed does not."""
    parts = [{**_shaping(r), "seed": 0, "backbone": backbone_sha256} for r in (recipe, naive)]
    return digest({"cost": parts, "anchor": recipes.changed(recipe.anchor)})


class _Table:
    """The comparison's rows as they come in, written out after each."""

    def __init__(self, desk: _Desk, points: list[Point], chosen: Mapping[str, Any], ceilings: frozenset[str]) -> None:
        self.desk, self.points, self.chosen, self.ceilings = desk, points, chosen, ceilings
        self.found: dict[str, dict[str, dict[int, Row | Divergence]]] = {}  # task -> variant -> seed

    def add(self, task: str, variant: str, seed: int, found: Row | Divergence) -> None:
        self.found.setdefault(task, {}).setdefault(variant, {})[seed] = found
        self.write({})

    def write(self, costs: Mapping[str, Cost]) -> StudyReport:
        """The report of what is known now."""
        study, desk = self.desk.study, self.desk
        report = StudyReport(
            name=study.name, finished=desk.done, cells=desk.total, seeds=list(study.seeds),
            tasks=[
                task_results(task, self._ordered(task), study.variants, self.chosen, costs, self.ceilings)
                for task in study.tasks
                if task in self.found
            ],
            tuning_task=study.tuning and study.tuning.task, within=study.tuning and study.tuning.within, tuning=self.points,
            out=str(desk.folder),
        )
        files.save_json(desk.folder / "table.json", report.to_json())
        return report

    def _ordered(self, task: str) -> dict[str, dict[int, Row | Divergence]]:
        """In the order of the recipe, whichever was finished first."""
        found, study = self.found[task], self.desk.study
        seeds = {name: [seed for seed in study.seeds if seed in found.get(name, {})] for name in study.variants}
        return {name: {seed: found[name][seed] for seed in own} for name, own in seeds.items() if own}
