"""`aegis run` with a recipe: runs every stage in order, skips those up to date, makes one table."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aegis_cli import recipes, sim
from aegis_cli.common import files, gl, leading, locks
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.data.vqa.gate import passes
from aegis_cli.models import backbones
from aegis_cli.recipes import Probe, Recipe
from aegis_cli.studies.figures import PolicyFigures
from aegis_cli.studies.policy_cells import PolicyRunner
from aegis_cli.training import loading, track

_LEAST_DROP = 1.0  # VQA points that naive must lose before a verdict on protection is given
_KEPT_SHARE = 0.5  # a method keeps VQA if it loses at most this share of naive's drop


@dataclass(frozen=True)
class PipelineReport:
    """The recipe's table, also written to `table.json`.

    `gate_failed` names the methods that exceed the recipe's `probe.max_drop`. `verdict` summarizes
    the table in a sentence; it is "" if there is no naive to compare with, or no measure of how
    policies act. `merge` has the recipe's `merge` section if the rows are of merged policies.
    """

    name: str
    rows: list[PolicyFigures]
    baseline_accuracy: float
    baseline_cross_entropy: float
    majority_accuracy: float
    out: str
    gate_failed: list[str]
    verdict: str = ""
    merge: dict[str, Any] | None = None

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def run(
    recipe: Recipe, root: Path, on_event: OnEvent = ignore, overwrite: bool = False
) -> PipelineReport:
    """Run `recipe` under `root/<name>`; a stage runs again only if its inputs have changed.

    If torchrun has started several processes, each calls this. They share the work of anchor,
    trainings and probes; the first one does everything else alone, and writes the files.

    Args:
        overwrite: run every stage again.

    Raises:
        AegisError: another process is using the folder, or a stage raised it; the results of
            earlier stages are kept.
    """
    return leading.led(lambda: _check_and_run(recipe, root, on_event, overwrite))


def _check_and_run(
    recipe: Recipe, root: Path, on_event: OnEvent, overwrite: bool
) -> PipelineReport:
    check(recipe)
    folder = Path(root) / recipe.name
    with locks.alone(folder):
        return _run(recipe, folder, overwrite, on_event)


def check(recipe: Recipe) -> None:
    """Refuse a recipe that a stage could not run, before any work.

    Raises:
        AegisError: keys that do not fit together, or a tracker, OpenGL or a task is missing.
    """
    recipes.check_run(recipe)
    track.check(recipe)
    gl.check()
    if recipe.demos.path is None:
        sim.check_recordable(recipe.task)
    sim.check(recipe.task)


def _run(recipe: Recipe, folder: Path, overwrite: bool, on_event: OnEvent) -> PipelineReport:
    runner = PolicyRunner(folder, on_event, plain=recipe)
    check_inputs(runner, recipe)
    if overwrite:  # after the check, so that a refused job does not lose finished stages
        runner.begin_anew()
    rows = []
    for done, method in enumerate(recipe.methods):
        on_event(Progress(recipe.name, done, len(recipe.methods), "methods"))
        on_event(Progress(method, 0, 1, "method"))
        rows.append(runner.figures(method, of_method(recipe, method)))
        on_event(Progress(method, 1, 1, "method", _shown(rows[-1])))
    on_event(Progress(recipe.name, len(rows), len(rows), "methods"))
    rows = _with_ratios(rows)
    first = rows[0]  # the baseline is the same in every row
    report = PipelineReport(
        recipe.name,
        rows,
        first.baseline_accuracy,
        first.baseline_cross_entropy,
        first.majority_accuracy,
        str(folder),
        [row.method for row in rows if _past(row, recipe.probe)],
        verdict(rows),
        None if recipe.merge.method is None else dataclasses.asdict(recipe.merge),
    )
    files.save_json(folder / "table.json", report.to_json())
    return report


def _shown(row: PolicyFigures) -> dict[str, float]:
    """A method's main figures, for its progress line."""
    figures = {
        "VQA %": 100 * row.accuracy,
        "drop": row.drop_points,
        "success seen %": _percent(row.success_seen),
        "held-out %": _percent(row.success_held_out),
        "return %": _percent(row.return_share),
        "open-loop error": row.open_loop_error,
    }
    return {name: value for name, value in figures.items() if value is not None}


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share


def verdict(rows: Sequence[PolicyFigures]) -> str:
    """A sentence on the method that acts best among those that keep VQA.

    A method keeps VQA if it loses at most half of what naive loses. With several question sets,
    each method counts by the set on which it lost most. The best method has the highest success,
    or, if nothing can be rolled out, the lowest open-loop error. If the questions do not show that
    naive lost anything, the sentence says so instead.
    """
    naive = next((row for row in rows if row.method == "naive"), None)
    if naive is None or _acts(naive) is None or len(rows) == 1:
        return ""
    unclear = _why_no_loss_is_told(naive)
    if unclear is not None:
        return unclear
    lost = f"{max(_drops(naive)):.1f} points of VQA"
    most = max(_drops(naive)) * _KEPT_SHARE
    others = [row for row in rows if row.method != "naive"]
    kept = [row for row in others if max(_drops(row)) <= most]
    if not kept:
        return (
            f"No method here kept VQA: naive lost {lost}, and each of the others over half of it."
        )

    def ability(row: PolicyFigures) -> float:
        acts = _acts(row)
        return -math.inf if acts is None else acts  # an unmeasured method is never the best

    best = max(kept, key=ability)
    of = ", each on the question set where it lost most" if naive.others else ""
    return (
        f"{best.method} lost {max(_drops(best)):.1f} points of VQA where naive lost "
        f"{max(_drops(naive)):.1f}{of}, at {_at_what(best, naive)} (one seed)."
    )


def _why_no_loss_is_told(naive: PolicyFigures) -> str | None:
    """Why the questions do not show that naive lost anything; None if they do."""
    sets = [naive, *naive.others.values()]
    # A VLM that is no better than the majority answer has no accuracy to lose.
    if all(asked.baseline_accuracy <= asked.majority_accuracy for asked in sets):
        before, common = 100 * naive.baseline_accuracy, 100 * naive.majority_accuracy
        return (
            f"The VLM answered {before:.1f} % of the questions correctly before training, where "
            f"always the commonest answer has {common:.1f} %: these questions cannot show what was "
            "lost. See anchor.ask and probe.ask."
        )
    lost = f"{max(_drops(naive)):.1f} points of VQA"
    if max(_drops(naive)) < _LEAST_DROP:
        return f"naive itself lost {lost}: this training has little to protect."
    # On the set where naive lost most: an interval that contains 0 does not show a loss.
    most_lost = max(sets, key=lambda asked: asked.drop_points)
    low, high = most_lost.drop_interval
    if low <= 0:
        return (
            f"naive lost {lost}, or none: its 95 % interval is {low:.1f} to {high:.1f}. So few "
            "questions cannot show which method kept VQA; raise probe.questions."
        )
    return None


def _at_what(best: PolicyFigures, naive: PolicyFigures) -> str:
    """How the best method acts, compared with naive."""
    if naive.success_seen is not None:
        ours, its = _percent(best.success_seen), _percent(naive.success_seen)
        return f"{ours:.1f} % success where naive has {its:.1f} %"
    error = f"an open-loop error of {best.open_loop_error:.3f} where naive has "
    error += f"{naive.open_loop_error:.3f}"
    if best.hold_error is not None:
        error += f" and a robot that holds its position {best.hold_error:.3f}"
    return error


def _drops(row: PolicyFigures) -> list[float]:
    """The points lost on each question set."""
    return [row.drop_points, *(other.drop_points for other in row.others.values())]


def _acts(row: PolicyFigures) -> float | None:
    """How well a policy acts (higher is better); None if that is not measured."""
    if row.success_seen is not None:
        return row.success_seen
    return None if row.open_loop_error is None else -row.open_loop_error  # lower error is better


def _past(row: PolicyFigures, settings: Probe) -> bool:
    """Whether a method lost more than the gate allows on any of its question sets."""
    if settings.max_drop is None:
        return False
    for asked in (row, *row.others.values()):
        drop, interval = asked.drop_points, asked.drop_interval
        if not passes(drop, interval, settings.max_drop, settings.gate):
            return True
    return False


def check_inputs(runner: PolicyRunner, recipe: Recipe) -> None:
    """Refuse bad files that the recipe names, before anything is written.

    Otherwise an error would appear only once the stage that reads them runs.
    """
    _refuse_own_models(runner.folder, recipe)
    runner.backbone_sha256(recipe)  # reads the model, and raises if it cannot
    for method in recipe.methods:
        runner.vqa_state(of_method(recipe, method))
    runner.check_questions(recipe, "probe")
    loading.check_named(recipe, runner.on_event)


def _refuse_own_models(folder: Path, recipe: Recipe) -> None:
    """Refuse a job that starts from one of its own runs, which it would remove and train again."""
    named = {"backbone": recipe.backbone, "expert.start": recipe.expert.start}
    # A backbone's path may end in # and the path of its layers.
    for key, name in named.items():
        if name is not None and files.lies_in(Path(backbones.divided(name)[0]), folder):
            raise AegisError(
                f"{key}: {name}, which lies in '{folder}', the folder of this job",
                "a model that lies elsewhere: a job trains its own runs anew",
                "give the recipe another name, or aegis run another --out",
            )


def of_method(recipe: Recipe, method: str) -> Recipe:
    """The recipe for one of its methods."""
    return dataclasses.replace(recipe, train=dataclasses.replace(recipe.train, method=method))


def _with_ratios(rows: list[PolicyFigures]) -> list[PolicyFigures]:
    """The rows with step times relative to naive's, if there is a naive."""
    naive_s = next((row.step_s for row in rows if row.method == "naive"), None)
    if naive_s is None:
        return rows
    return [dataclasses.replace(row, step_time_ratio=row.step_s / naive_s) for row in rows]
