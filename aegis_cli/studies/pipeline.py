"""`aegis run` with a recipe: every stage in order, what is up to date skipped, and one table."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aegis_cli import recipes, sim
from aegis_cli.common import files, gl, locks
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.evaluation import results
from aegis_cli.recipes import Recipe
from aegis_cli.studies.figures import PolicyFigures
from aegis_cli.studies.policy_cells import PolicyRunner
from aegis_cli.training import assemble, track


@dataclass(frozen=True)
class PipelineReport:
    """The recipe's table, also written to `table.json`.

    `gate_failed` names the methods past the recipe's `probe.max_drop`.
    """

    name: str
    rows: list[PolicyFigures]
    baseline_accuracy: float
    baseline_cross_entropy: float
    majority_accuracy: float
    out: str
    gate_failed: list[str]

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def run(recipe: Recipe, root: Path, on_event: OnEvent = ignore) -> PipelineReport:
    """Run `recipe` under `root/<name>`; what a stage reads decides whether it runs again.

    Raises:
        AegisError: another process is at the folder, or whatever a stage finds wrong; the stages
            before it are kept.
    """
    recipes.check_run(recipe)
    track.check(recipe)
    folder = Path(root) / recipe.name
    gl.check()
    sim.check(recipe.task)
    with locks.alone(folder):
        return _run(recipe, folder, on_event)


def _run(recipe: Recipe, folder: Path, on_event: OnEvent) -> PipelineReport:
    runner = PolicyRunner(folder, on_event, plain=recipe)
    _check_inputs(runner, recipe)
    rows = _with_ratios([runner.figures(method, _of(recipe, method)) for method in recipe.methods])
    first = rows[0]  # the baseline is the same in each
    limit = recipe.probe.max_drop
    report = PipelineReport(
        recipe.name,
        rows,
        first.baseline_accuracy,
        first.baseline_cross_entropy,
        first.majority_accuracy,
        str(folder),
        [] if limit is None else [row.method for row in rows if _past(row, limit)],
    )
    files.save_json(folder / "table.json", report.to_json())
    return report


def _past(row: PolicyFigures, limit: float) -> bool:
    """Whether a method lost more than the gate lets pass on any of its sets of questions."""
    drops = [row.drop_points, *(other.drop_points for other in row.others.values())]
    return not all(results.within(drop, limit) for drop in drops)


def _check_inputs(runner: PolicyRunner, recipe: Recipe) -> None:
    """Refuse files that the recipe names before anything is written.

    Else a fault would show only after the stages before the one that reads them.
    """
    runner.backbone_sha256(recipe)
    for method in recipe.methods:
        runner.vqa_state(_of(recipe, method))
    runner.check_questions(recipe, "probe")
    assemble.check_demonstrations(recipe, runner.on_event)


def _of(recipe: Recipe, method: str) -> Recipe:
    return dataclasses.replace(recipe, train=dataclasses.replace(recipe.train, method=method))


def _with_ratios(rows: list[PolicyFigures]) -> list[PolicyFigures]:
    """The step times over naive's, if there is a naive."""
    naive = next((row.step_s for row in rows if row.method == "naive"), None)
    return (
        rows
        if naive is None
        else [dataclasses.replace(row, step_time_ratio=row.step_s / naive) for row in rows]
    )
