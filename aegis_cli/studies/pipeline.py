"""`aegis run` with a recipe: every stage in order, what is up to date skipped, and one table."""

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

_LEAST_DROP = 1.0  # points of VQA that naive has to lose before protection is worth a word
_KEPT_SHARE = 0.5  # of naive's drop: at most so much a method loses that is said to keep VQA


@dataclass(frozen=True)
class PipelineReport:
    """The recipe's table, also written to `table.json`.

    `gate_failed` names the methods past the recipe's `probe.max_drop`, and `verdict` is a sentence
    on what the table says; "" where there is no naive to compare with, or no success. `merge` has
    the recipe's keys of that name where each row is of what was merged after its training.
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
    """Run `recipe` under `root/<name>`; what a stage reads decides whether it runs again.

    Where torchrun has started several processes, each calls this. They share anchor, trainings and
    probes; the first does all else alone, and writes.

    Args:
        overwrite: run every stage again.

    Raises:
        AegisError: another process is at the folder, or whatever a stage finds wrong; the stages
            before it are kept.
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
    """Refuse what no stage of a recipe's job could do, before any work.

    Raises:
        AegisError: keys that do not fit together, a tracker, OpenGL or a task that is not there.
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
    if overwrite:  # after the check, so that a job that is refused forgets nothing
        runner.begin_anew()
    rows = []
    for done, method in enumerate(recipe.methods):
        on_event(Progress(recipe.name, done, len(recipe.methods), "methods"))
        on_event(Progress(method, 0, 1, "method"))
        rows.append(runner.figures(method, of_method(recipe, method)))
        on_event(Progress(method, 1, 1, "method", _shown(rows[-1])))
    on_event(Progress(recipe.name, len(rows), len(rows), "methods"))
    rows = _with_ratios(rows)
    first = rows[0]  # the baseline is the same in each
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
    """A method's main figures, for its line among the progress."""
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

    To keep it means to lose at most half of what naive loses; of several sets of questions, each
    counts by the one that it lost most of. Who acts best succeeds most often, or, where nothing can
    be rolled out, has the least open-loop error. Where the questions do not even tell that naive
    has lost anything, there is no verdict.
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
        return -math.inf if acts is None else acts  # what was not measured is never the best

    best = max(kept, key=ability)
    of = ", each on the question set where it lost most" if naive.others else ""
    return (
        f"{best.method} lost {max(_drops(best)):.1f} points of VQA where naive lost "
        f"{max(_drops(naive)):.1f}{of}, at {_at_what(best, naive)} (one seed)."
    )


def _why_no_loss_is_told(naive: PolicyFigures) -> str | None:
    """Why naive's questions do not tell that it has lost anything; None where they do."""
    sets = [naive, *naive.others.values()]
    # A VLM that answers no better than by rote has nothing to lose that accuracy would show.
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
    # Of the questions that naive lost most of: an interval that holds 0 does not tell a loss.
    most_lost = max(sets, key=lambda asked: asked.drop_points)
    low, high = most_lost.drop_interval
    if low <= 0:
        return (
            f"naive lost {lost}, or none: its 95 % interval is {low:.1f} to {high:.1f}. So few "
            "questions cannot show which method kept VQA; raise probe.questions."
        )
    return None


def _at_what(best: PolicyFigures, naive: PolicyFigures) -> str:
    """How the best method acts, beside naive."""
    if naive.success_seen is not None:
        ours, its = _percent(best.success_seen), _percent(naive.success_seen)
        return f"{ours:.1f} % success where naive has {its:.1f} %"
    error = f"an open-loop error of {best.open_loop_error:.3f} where naive has "
    error += f"{naive.open_loop_error:.3f}"
    if best.hold_error is not None:
        error += f" and a robot that holds its position {best.hold_error:.3f}"
    return error


def _drops(row: PolicyFigures) -> list[float]:
    """The points lost of each set of questions."""
    return [row.drop_points, *(other.drop_points for other in row.others.values())]


def _acts(row: PolicyFigures) -> float | None:
    """How well a policy acts, more being better; None where that is not measured."""
    if row.success_seen is not None:
        return row.success_seen
    return None if row.open_loop_error is None else -row.open_loop_error  # less error is better


def _past(row: PolicyFigures, settings: Probe) -> bool:
    """Whether a method lost more than the gate lets pass on any of its sets of questions."""
    if settings.max_drop is None:
        return False
    for asked in (row, *row.others.values()):
        drop, interval = asked.drop_points, asked.drop_interval
        if not passes(drop, interval, settings.max_drop, settings.gate):
            return True
    return False


def check_inputs(runner: PolicyRunner, recipe: Recipe) -> None:
    """Refuse files that the recipe names before anything is written.

    Else a fault would show only after the stages before the one that reads them.
    """
    _refuse_own_models(runner.folder, recipe)
    runner.backbone_sha256(recipe)  # reads the model, and raises where it cannot
    for method in recipe.methods:
        runner.vqa_state(of_method(recipe, method))
    runner.check_questions(recipe, "probe")
    loading.check_named(recipe, runner.on_event)


def _refuse_own_models(folder: Path, recipe: Recipe) -> None:
    """Refuse a job that begins with one of its own runs, which it would train anew and remove."""
    named = {"backbone": recipe.backbone, "expert.start": recipe.expert.start}
    # A backbone's path may have the path of its layers behind a #.
    for key, name in named.items():
        if name is not None and files.lies_in(Path(backbones.divided(name)[0]), folder):
            raise AegisError(
                f"{key}: {name}, which lies in '{folder}', the folder of this job",
                "a model that lies elsewhere: a job trains its own runs anew",
                "give the recipe another name, or aegis run another --out",
            )


def of_method(recipe: Recipe, method: str) -> Recipe:
    """The recipe of one of its methods."""
    return dataclasses.replace(recipe, train=dataclasses.replace(recipe.train, method=method))


def _with_ratios(rows: list[PolicyFigures]) -> list[PolicyFigures]:
    """The step times over naive's, if there is a naive."""
    naive_s = next((row.step_s for row in rows if row.method == "naive"), None)
    if naive_s is None:
        return rows
    return [dataclasses.replace(row, step_time_ratio=row.step_s / naive_s) for row in rows]
