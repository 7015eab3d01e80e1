"""`aegis run` with a study: tune, train and compare variants x tasks or streams x seeds.

Finished cells are never run again. The study's folder holds:

cells.json   the result of every finished cell, by a digest of everything that affects it
table.json   the comparison so far
<task or stream>/<variant>/<seed>/, tuning/<variant>/<value>/   run folders
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from aegis_cli.common import files, locks
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.recipes import AnyStudy, PolicyVariant, RobotStreamStudyRecipe, StudyRecipe
from aegis_cli.studies.cells import CELLS, Cell, CellStore, R, StudyKind
from aegis_cli.studies.comparison import Findings, Report
from aegis_cli.studies.figures import Outcome
from aegis_cli.studies.metrics import Setting
from aegis_cli.studies.policy_cells import PolicyStudy
from aegis_cli.studies.robot_stream_cells import RobotStreamStudy
from aegis_cli.studies.stream_cells import StreamStudy
from aegis_cli.studies.tuning import choose

_LONGEST_NAME = 100  # bytes of a folder's name; file systems allow 143 or more
Trials = Mapping[str, list[tuple[Any, Cell[R]]]]  # variant -> its knob's values and their cells


def run(
    study: AnyStudy,
    root: Path,
    on_event: OnEvent = ignore,
    workers: int = 1,
    overwrite: bool = False,
) -> Report:
    """Run `study` under `root/<name>`; another call continues an interrupted study.

    The knobs are tuned first. Then all variants are compared on all tasks or streams with the first
    seed, then with the next, so that an interrupted study is balanced; the costs come last.
    `table.json` is written after every measured cell, including those of tuning. A training that
    diverges is recorded as a result, and the study continues.

    Args:
        workers: number of cells that are measured at once, each with its share of the cores.
        overwrite: forget all finished cells and measure them again.

    Raises:
        AegisError: a cell is not a valid recipe (before any work), another process is using the
            folder, or a stage raised it.
    """
    kind = kind_of(study)
    tried = trials(kind)
    kind.check([cell.recipe for own in tried.values() for _, cell in own])
    folder = Path(root) / study.name
    with locks.alone(folder):
        store = CellStore(kind, folder, on_event, workers)
        store.finish_clearing()
        if overwrite:
            store.begin_anew()
        return _run(kind, tried, store)


def told(study: AnyStudy, cells: Path, on_event: OnEvent = ignore) -> Report:
    """The report of a study's finished cells; nothing is measured.

    Variants whose tuning is unfinished are left out, unless none is finished. If a variant that
    sets the margin for all others is unfinished, no values are chosen, and the report has only the
    tuning so far.

    Args:
        cells: a study's `cells.json`, under any name.

    Raises:
        AegisError: there are no cells, or none of this study.
    """
    kind = kind_of(study)
    # A temporary copy, because a store reads `cells.json` in its folder and writes a table there.
    with tempfile.TemporaryDirectory() as aside:
        shutil.copy(cells, Path(aside) / CELLS)
        store = CellStore(kind, Path(aside), on_event, known_only=True)
        if names := _tuned_whole(kind, store):
            kept: dict[str, Any] = {name: study.variants[name] for name in names}
            store.kind = kind = kind_of(dataclasses.replace(study, variants=kept))
        report = _run(kind, trials(kind), store)
    if not report.finished:
        raise AegisError(
            f"{len(store.cells)} cells in '{cells}', none of them of the study '{study.name}'",
            "cells that were measured by this recipe",
            "give the recipe its earlier values, or run the study",
        )
    return dataclasses.replace(report, out=str(cells))


def planned(
    study: AnyStudy, root: Path, on_event: OnEvent = ignore, overwrite: bool = False
) -> Iterator[tuple[str, bool | None]]:
    """Every cell's label and whether it is finished; nothing is measured or written.

    None stands for a cell whose value has yet to be chosen by tuning.

    Args:
        overwrite: treat all cells as unfinished.

    Raises:
        AegisError: a cell is not a valid recipe, or files cannot be read.
    """
    kind = kind_of(study)
    tried = trials(kind)
    kind.check([cell.recipe for own in tried.values() for _, cell in own])
    kept, tuned = Path(root) / study.name / CELLS, _tuned(kind, tried)
    with tempfile.TemporaryDirectory() as aside:
        if kept.exists() and not overwrite:
            shutil.copy(kept, Path(aside) / CELLS)
        store = CellStore(kind, Path(aside), on_event, known_only=True)
        store.total = sum(map(len, tuned.values()))  # the store delivers only the known ones
        # In the order in which `run` measures them.
        for own in tuned.values():
            for _, cell in own:
                yield cell.label, store.runner.key(cell) in store.cells
        chosen = {name: own[0][0] for name, own in tried.items() if name not in tuned}
        chosen |= _tune(kind, store, tuned).chosen
        for setting in _settings(kind):
            name = setting[0]
            if name in chosen:
                cell = _cell(kind, *setting, chosen[name])
                yield cell.label, store.runner.key(cell) in store.cells
            else:
                yield _label(*setting), None


def kind_of(study: AnyStudy) -> StudyKind[Any]:
    """The kind of a study, which defines how its cells are measured and reported."""
    if isinstance(study, StudyRecipe):
        return PolicyStudy(study)
    if isinstance(study, RobotStreamStudyRecipe):
        return RobotStreamStudy(study)
    return StreamStudy(study)


def _tuned_whole(kind: StudyKind[R], store: CellStore[R]) -> list[str]:
    """The variants whose values have all been measured, and those without values to choose.

    The result is empty if a variant that sets the margin for all others is not among them. Without
    it another variant would set the margin, and other values would be chosen.
    """
    variants, tuned = kind.recipe.variants, _tuned(kind, trials(kind))
    whole = []
    for name in variants:
        # A variant without a choice has no cells here and counts as measured.
        own = [cell for _, cell in tuned.get(name, ())]
        if all(store.runner.key(cell) in store.cells for cell in own):
            whole.append(name)
    return whole if set(_judges(kind)) <= set(whole) else []


def _judges(kind: StudyKind[R]) -> list[str]:
    """The variants whose best value sets the margin for all; empty if each sets its own."""
    variants, reference = kind.recipe.variants, kind.rule.reference
    if reference is None:
        return []
    own = [
        name
        for name, variant in variants.items()
        if isinstance(variant, PolicyVariant) and variant.is_plain(reference)
    ]
    return own or list(variants)


def _run(kind: StudyKind[R], tried: Trials[R], store: CellStore[R]) -> Report:
    study, tuned = kind.recipe, _tuned(kind, tried)
    store.total = sum(map(len, tuned.values()))
    store.total += len(study.seeds) * len(kind.places) * len(study.variants)

    findings = _tune(kind, store, tuned)
    if tuned and not findings.chosen:
        return _write(kind, store, findings)  # only known cells are delivered, and some are missing
    # A variant that is not tuned uses its first value.
    chosen = {name: own[0][0] for name, own in tried.items()} | dict(findings.chosen)
    findings = dataclasses.replace(findings, chosen=chosen)
    found: dict[str, dict[Setting, Outcome]] = {}
    cells = list(_compared(kind, chosen))
    known = store.count_known(cells)
    with contextlib.closing(store.measured(cells)) as measured:
        for number, (cell, figures) in enumerate(measured, 1):
            place, name, seed = cell.label.rsplit("/", 2)  # a task's name may hold a slash
            # Cells arrive as they finish; they are ordered for the table.
            found.setdefault(name, {})[place, int(seed)] = figures
            findings = dataclasses.replace(findings, cells=_ordered(kind, found))
            # A table of many cells takes seconds, so it is not written after each known cell
            # (these come first). The last one is written below.
            if known <= number < len(cells):
                _write(kind, store, findings)
    store.tidy([cell for own in tuned.values() for _, cell in own] + cells)
    costs = kind.costs(store, chosen)
    return _write(kind, store, dataclasses.replace(findings, costs=costs))


def trials(kind: StudyKind[R]) -> Trials[R]:
    """Every variant's values and their cells on the validation split.

    All are created here, so that a bad one is refused before any work.
    """
    made: dict[str, list[tuple[Any, Cell[R]]]] = {}
    judging = tuple(kind.recipe.seeds)
    for name, variant in kind.recipe.variants.items():
        made[name] = []
        for value, folder in zip(variant.values, _folders(variant.values), strict=True):
            label = f"tuning/{name}/{folder}"
            recipe = kind.trial(name, value)
            made[name].append((value, Cell(label, recipe, validation=True, judging=judging)))
    return made


def _folders(values: Sequence[Any]) -> list[str]:
    """A distinct folder name for each of a knob's values."""
    found: list[str] = []
    for value in values:
        slug = _slug(value)
        name = _cut(slug) or "value"
        if name != slug or name in found:  # different values may have the same allowed characters
            name += "-" + hashlib.sha256(repr(value).encode()).hexdigest()[:8]
        found.append(name)
    return found


def _slug(value: Any) -> str:
    """A knob's value in characters that are allowed in a folder name."""
    return "fixed" if value is None else re.sub(r"[^\w.+-]+", "_", str(value)).strip("_")


def _cut(slug: str) -> str:
    """`slug` shortened to fit a folder name; "" for only dots, which name other folders."""
    if not slug.strip("."):
        return ""
    # Counted in bytes, as file systems do; a character that is cut in two is dropped.
    return slug.encode()[:_LONGEST_NAME].decode(errors="ignore")


def _tuned(kind: StudyKind[R], tried: Trials[R]) -> Trials[R]:
    """The variants whose values are measured; empty without tuning."""
    if kind.recipe.tuning is None:
        return {}
    return {name: own for name, own in tried.items() if kind.tunes_fixed or len(own) > 1}


def _tune(kind: StudyKind[R], store: CellStore[R], tuned: Trials[R]) -> Findings:
    """Measure the values, and choose one for each variant to be compared with."""
    tuning = kind.recipe.tuning
    if tuning is None or not tuned:
        return Findings()
    found: dict[str, Any] = {}
    points: dict[str, list[Any]] = {}
    cells = [cell for own in tuned.values() for _, cell in own]
    known = store.count_known(cells)
    with contextlib.closing(store.measured(cells)) as measured:
        for number, (cell, figures) in enumerate(measured, 1):
            found[cell.label] = figures
            points = _points(kind, tuned, found)
            so_far = [point for own in points.values() for point in own]
            if number >= known and known < len(cells):
                _write(kind, store, Findings(so_far))
    if len(found) < len(cells):  # only finished cells are delivered, and some are missing
        return Findings([point for own in points.values() for point in own])
    best = choose(kind.rule, points, tuning.within)
    decided = []
    for name, own in points.items():
        for number, point in enumerate(own):
            decided.append(dataclasses.replace(point, chosen=number == best[name]))
    return Findings(decided, {name: own[best[name]].value for name, own in points.items()})


def _points(kind: StudyKind[R], tuned: Trials[R], found: Mapping[str, Any]) -> dict[str, list[Any]]:
    """The results of the finished values, in the recipe's order."""
    points: dict[str, list[Any]] = {}
    for name, own in tuned.items():
        finished = [(value, cell.label) for value, cell in own if cell.label in found]
        points[name] = [kind.point(name, value, found[label]) for value, label in finished]
    return points


def _compared(kind: StudyKind[R], chosen: Mapping[str, Any]) -> Iterator[Cell[R]]:
    for name, place, seed in _settings(kind):
        yield _cell(kind, name, place, seed, chosen[name])


def _settings(kind: StudyKind[Any]) -> Iterator[tuple[str, str, int]]:
    """Variant, task or stream, and seed of every compared cell, in the order of measuring."""
    # Seeds outermost, so that an interrupted study has all variants for its finished seeds.
    for seed in kind.recipe.seeds:
        for place in kind.places:
            for name in kind.recipe.variants:
                yield name, place, seed


def _label(name: str, place: str, seed: int) -> str:
    return f"{place}/{name}/{seed}"


def _cell(kind: StudyKind[R], name: str, place: str, seed: int, value: Any) -> Cell[R]:
    return Cell(_label(name, place, seed), kind.cell(name, place, seed, value))


def _ordered(
    kind: StudyKind[R], found: Mapping[str, Mapping[Setting, Outcome]]
) -> dict[str, dict[Setting, Outcome]]:
    """Variants and cells in the recipe's order."""
    settings = [(place, seed) for place in kind.places for seed in kind.recipe.seeds]
    ordered: dict[str, dict[Setting, Outcome]] = {}
    for name in kind.recipe.variants:
        if name in found:
            own = found[name]
            ordered[name] = {setting: own[setting] for setting in settings if setting in own}
    return ordered


def _write(kind: StudyKind[R], store: CellStore[R], findings: Findings) -> Report:
    """Write and return the report of the results so far."""
    report = kind.report(findings, store)
    files.save_json(store.folder / "table.json", report.to_json())
    return report
