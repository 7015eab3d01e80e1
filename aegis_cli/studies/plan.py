"""`aegis run --dry-run`: which stages a job would run, why, and what its trainings need.

The plan is made by the job's own code: the same stages ask their records whether they are up to
date, but these records let no stage run. Nothing is written.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from aegis_cli import methods
from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.data import mixture
from aegis_cli.recipes import AnyStudy, Recipe
from aegis_cli.studies import pipeline, study
from aegis_cli.studies.policy_cells import PolicyRunner, playable_colors
from aegis_cli.training import dry_run
from aegis_cli.training import folder as run_folder
from aegis_cli.training.dry_run import DryRunReport
from aegis_cli.training.up_to_date import StageRecords

_AFTER = "follows on "
_SHARED = ""  # stands for the method of stages that all methods share


@dataclass(frozen=True)
class PlannedStage:
    """A stage of a job.

    Attributes:
        method: the method that it belongs to; "" if all methods share it.
        command: the command that runs only this stage.
        due: why it would run; None if it is up to date and skipped.
    """

    stage: str
    method: str
    command: str
    due: str | None


@dataclass(frozen=True)
class JobPlan:
    """What `aegis run` would do with a recipe.

    Attributes:
        trainings: for each method that would train, the report of `aegis train --dry-run` with
            estimated memory only; None if an earlier stage has to run first.
        hours, disk_mb: sums over these trainings, as far as they are known.
        disk_free_mb: free disk space where they would be; None if there is no report.
    """

    name: str
    stages: list[PlannedStage]
    trainings: dict[str, DryRunReport | None]
    hours: float | None
    disk_mb: float
    disk_free_mb: float | None
    out: str

    def to_json(self) -> dict[str, Any]:
        asked = {}
        for method, report in self.trainings.items():
            asked[method] = None if report is None else report.to_json()
        return dataclasses.asdict(self) | {"trainings": asked}


class _Due(Exception):
    """A stage would run."""

    def __init__(self, stage: str) -> None:
        super().__init__(stage)
        self.stage = stage


class _Asked(StageRecords):
    """Records of a folder's stages that note which stages would run, and let none run.

    Attributes:
        reasons: why each requested stage would run; None if it is up to date.
    """

    def __init__(self, folder: Path, on_event: OnEvent, overwrite: bool) -> None:
        super().__init__(folder, on_event)
        self._overwrite = overwrite
        self.reasons: dict[str, str | None] = {}

    def fresh(
        self, stage: str, key: Any, outputs: list[Path], make: Callable[[OnEvent], object]
    ) -> None:
        """Note whether the stage would run.

        Raises:
            _Due: the stage would run.
        """
        self.reasons[stage] = "--overwrite" if self._overwrite else self.due(stage, key, outputs)
        # Raised, because the code after it reads the files that the stage would make.
        if self.reasons[stage] is not None:
            raise _Due(stage)


class _Step(NamedTuple):
    """A stage: its name, its command, and a function that asks the records for it.

    Attributes:
        makes: whether it makes the policy that later stages measure.
    """

    name: str
    command: str
    ask: Callable[[], object]
    makes: bool = False


def job(recipe: Recipe, root: Path, on_event: OnEvent = ignore, overwrite: bool = False) -> JobPlan:
    """What `aegis run` would do with a recipe now; nothing is written.

    Args:
        overwrite: plan for `aegis run --overwrite`, which runs every stage again.

    Raises:
        AegisError: `aegis run` would refuse the recipe before its first stage, or a training could
            not start.
    """
    pipeline.check(recipe)
    folder = Path(root) / recipe.name
    records = _Asked(folder, on_event, overwrite)
    runner = PolicyRunner(folder, on_event, plain=recipe, records=records)
    pipeline.check_inputs(runner, recipe)
    # First the shared stages, on which the methods' own stages depend.
    stages = list(_planned(_shared(runner, recipe), _SHARED, records))
    for method in recipe.methods:
        stages += _planned(_of_method(runner, method, recipe), method, records)
    due = {one.method for one in stages if one.command == "aegis train" and one.due is not None}
    trainings = {}
    for number, method in enumerate(one for one in recipe.methods if one in due):
        on_event(Progress(recipe.name, number, len(due), "trainings"))
        trainings[method] = _asked_training(runner, method, recipe)
    if due:
        on_event(Progress(recipe.name, len(due), len(due), "trainings"))
    asked = [report for report in trainings.values() if report is not None]
    hours = [report.hours for report in asked if report.hours is not None]
    return JobPlan(
        name=recipe.name,
        stages=stages,
        trainings=trainings,
        hours=sum(hours) if hours else None,
        disk_mb=sum(report.disk_mb for report in asked),
        disk_free_mb=min((report.disk_free_mb for report in asked), default=None),
        out=str(folder),
    )


def _planned(steps: Iterator[_Step], method: str, records: _Asked) -> Iterator[PlannedStage]:
    """Each step with the reason why it would run."""
    waits_for = None  # the stage that makes the policy, if it would run
    for step in steps:
        due = None if waits_for is None else _AFTER + waits_for
        if waits_for is None:
            try:
                step.ask()
            except _Due as end:
                # The reason may be another stage whose files this one reads, such as the anchor.
                its_own = end.stage == step.name
                due = records.reasons[end.stage] if its_own else _AFTER + end.stage
        if step.makes and due is not None:
            waits_for = step.name
        yield PlannedStage(step.name, method, step.command, due)


def _shared(runner: PolicyRunner, recipe: Recipe) -> Iterator[_Step]:
    """The stages whose files all methods read."""
    if recipe.demos.path is None:
        yield _Step("demos", "aegis demos", lambda: runner.demos(recipe))
    yield _Step("anchor", "aegis anchor", lambda: runner.anchor(recipe))


def _of_method(runner: PolicyRunner, method: str, recipe: Recipe) -> Iterator[_Step]:
    """The stages of one method, in their order."""
    own = pipeline.of_method(recipe, method)
    yield _Step(f"{method}/train", "aegis train", lambda: runner.train(method, own), makes=True)
    if own.merge.method is not None:
        yield _Step(f"{method}/merge", "aegis merge", lambda: runner.merge(method, own), makes=True)
    for number, settings in enumerate(own.probe.of_each_set(), start=1):
        name = "probe" if number == 1 else f"probe-{number}"
        ask = lambda s=settings, n=number: runner.probe(method, own, s, n)  # noqa: E731
        yield _Step(f"{method}/{name}", "aegis probe", ask)
    played = playable_colors(own)
    for colors in played:
        ask = lambda c=colors: runner.rollout(method, own, c)  # noqa: E731
        yield _Step(f"{method}/rollout {colors}", "aegis rollout", ask)
    if played:
        return
    given = runner.demos(own)
    for number, data in enumerate(mixture.each(given.path), start=1):
        name = "evaluate" if number == 1 else f"evaluate-{number}"
        ask = lambda d=data, n=number: runner.evaluated(method, own, d, given.sha256, n)  # noqa: E731
        yield _Step(f"{method}/{name}", "aegis evaluate", ask)


def _asked_training(runner: PolicyRunner, method: str, recipe: Recipe) -> DryRunReport | None:
    """The needs of a training; None if the files that it reads do not exist yet.

    Raises:
        AegisError: the training could not start.
    """
    own, out = pipeline.of_method(recipe, method), runner.folder / method
    run_folder.check_ours(out, ours=runner.has_begun(method))
    try:
        demos = runner.demos(own)
    except _Due:
        return None
    try:
        anchor = runner.anchor(own)
    except _Due:
        if methods.get(method).needs:
            return None
        anchor = None  # for a method that reads no anchor
    resumes = anchor is not None and runner.goes_on(
        method, runner.training_key(own, demos.sha256, anchor.sha256)
    )
    # The job would remove a run that it cannot resume. The dry run leaves it and uses another path.
    at = out if resumes else out.with_name(f".{out.name}.planned")
    path = None if anchor is None else anchor.path
    report = dry_run.run(own, method, demos.path, path, at, resumes, runner.on_event)
    # The process's growth does not measure one training, which reuses memory of earlier ones.
    return dataclasses.replace(report, memory_measured_mb=None, out=str(out))


def shortage(plan: JobPlan) -> str | None:
    """What does not fit, on one line; None if everything that is known fits."""
    reports = {method: one for method, one in plan.trainings.items() if one is not None}
    missing = []
    for method, one in reports.items():
        found = dry_run.shortage(one)
        if found is not None:
            missing.append(f"{method}: {found}")
    # Each may fit by itself, but not all together.
    if not missing and plan.disk_free_mb is not None and plan.disk_mb > plan.disk_free_mb:
        missing.append(
            f"the checkpoints of all methods need {plan.disk_mb:,.0f} MB on the disk of "
            f"'{plan.out}', and {plan.disk_free_mb:,.0f} MB are free: free some, choose another "
            "--out, or set train.keep_checkpoints"
        )
    return "; ".join(missing) or None


# --- studies --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PlannedCell:
    """A cell of a study, by its folder; `due` says why it would be measured, or None if skipped."""

    cell: str
    due: str | None


@dataclass(frozen=True)
class StudyPlan:
    """What `aegis run` would do with a study: `finished` of its cells are skipped."""

    name: str
    finished: int
    cells: list[PlannedCell]
    out: str

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


_WHY = {
    True: None,
    False: "has not been measured, or not with these keys and files",
    None: _AFTER + "the tuning, which chooses its value",
}


def of_study(
    recipe: AnyStudy, root: Path, on_event: OnEvent = ignore, overwrite: bool = False
) -> StudyPlan:
    """What `aegis run` would do with a study now; arguments as in `job`."""
    found = study.planned(recipe, root, on_event, overwrite)
    cells = [PlannedCell(label, _WHY[finished]) for label, finished in found]
    finished = sum(cell.due is None for cell in cells)
    return StudyPlan(recipe.name, finished, cells, str(Path(root) / recipe.name))


def run(
    recipe: Recipe | AnyStudy, root: Path, on_event: OnEvent = ignore, overwrite: bool = False
) -> JobPlan | StudyPlan:
    """What `aegis run` would do with a recipe or a study."""
    if isinstance(recipe, Recipe):
        return job(recipe, root, on_event, overwrite)
    return of_study(recipe, root, on_event, overwrite)
