"""`aegis compare`: several runs in one table."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from aegis_cli import inspection, recipes
from aegis_cli.common import commands
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Warned, ignore
from aegis_cli.data.episodes import as_text
from aegis_cli.evaluation import results
from aegis_cli.inspection import InspectReport
from aegis_cli.reporting import differences
from aegis_cli.studies import table
from aegis_cli.studies.cells import CELLS
from aegis_cli.studies.pipeline import PipelineReport
from aegis_cli.training import checkpoint, folder
from aegis_cli.training.up_to_date import refuse_unfinished

Interval = tuple[float, float] | None
_Named = tuple[Any, results.Result]  # by what two runs' results are compared
_FRAMES = ("episodes", "trained_on", "frames", "seed")  # the figures that say which they were
_MOST = 60  # letters of a list of episodes in a warning


@dataclass(frozen=True)
class ComparedRun:
    """One run's figures; None for what was not measured of it.

    `method` says whether what it trained was merged afterwards, as in `naive, merged`.
    Shares are in [0, 1], the drop in percentage points, times in seconds, W2^2 a mean over layers.
    The figures of VQA are those of one probe, on the question set `vqa`, and the open-loop error is
    that of one evaluation, on the episodes that `open_loop_on` says in words.
    """

    run: str
    method: str
    task: str | None
    steps: int | None
    planned_steps: int | None
    vqa: str | None
    accuracy: float | None
    baseline_accuracy: float | None
    drop_points: float | None
    drop_interval: Interval
    cross_entropy: float | None
    success_seen: float | None
    success_seen_interval: Interval
    success_held_out: float | None
    return_share: float | None
    open_loop_on: str | None
    open_loop_error: float | None
    open_loop_interval: Interval
    hold_error: float | None
    w2: float | None
    energy_shed: float | None
    loss: float | None
    validation_loss: float | None
    step_s: float | None
    gate: bool | None


@dataclass(frozen=True)
class Comparison:
    """The runs, in the order given.

    `same_open_loop` says whether all open-loop errors are of the same frames, `same_episodes`
    whether all rollouts of the same colours played the same episodes.
    `differs` has what the runs do not share beside their methods, with each run's value.
    """

    rows: list[ComparedRun]
    same_open_loop: bool = True
    same_episodes: bool = True
    differs: dict[str, list[differences.Value]] = field(default_factory=dict)

    @property
    def same_validation(self) -> bool:
        """Whether all validation losses are of the same held-out frames."""
        return differences.same_validation(self.differs)

    @property
    def same_questions(self) -> bool:
        """Whether the figures of VQA are of the same questions."""
        return "questions" not in self.differs

    @property
    def question_sets(self) -> list[str]:
        """Those that the figures of VQA are of."""
        return list(dict.fromkeys(row.vqa for row in self.rows if row.vqa is not None))

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def run(paths: Sequence[Path], on_event: OnEvent = ignore) -> Comparison:
    """Read what was measured of each run.

    The first question set that every run was probed on is compared. Where there is none, each
    run's own first is shown, and a warning says so. Likewise with open-loop evaluations: they are
    compared where episodes, frames and seed are the same, trained on or not.

    Raises:
        AegisError: a path that is no run of a policy, and no folder with such.
    """
    found = []
    for given in paths:  # a run, or a folder with several
        found += [(path, _inspected(path)) for path in _runs(Path(given), on_event)]
    # What is compared is chosen over all runs together.
    probed = _one_of_each([_by_set(path, one) for path, one in found])
    evaluated = _one_of_each([_by_episodes(path, one) for path, one in found])
    rows = [_compared(*each, *own) for each, *own in zip(found, probed, evaluated, strict=True)]
    _warn_of_unfinished(found, on_event)
    _warn_of_merges(found, on_event)
    facts = [
        differences.of_run(path, row.steps, asked, _by_colors(one))
        for (path, one), row, asked in zip(found, rows, probed, strict=True)
    ]
    same_frames = len({own[0] for own in evaluated if own is not None}) < 2
    same_episodes = _same_episodes([_by_colors(one) for _, one in found])
    made = Comparison(rows, same_frames, same_episodes, differences.between(facts))
    _warn_of_differences(made, evaluated, on_event)
    return made


def _warn_of_differences(
    made: Comparison, evaluated: Sequence[_Named | None], on_event: OnEvent
) -> None:
    """Say in what the runs differ beside their methods."""
    if made.differs:
        text = f"the runs differ in {differences.said(made.differs)}"
        on_event(Warned("compare", f"{text}: their figures compare more than their methods"))
    if len(made.question_sets) > 1:
        text = f"VQA was measured on different questions: {', '.join(made.question_sets)}"
        on_event(Warned("compare", f"{text}; aegis probe --vqa measures each run on one set"))
    if not made.same_open_loop:
        on = _other_frames(made, evaluated)
        text = f"open-loop errors were measured on different frames: {on}"
        on_event(Warned("compare", f"{text}; aegis evaluate --episodes measures each on the same"))


def _other_frames(made: Comparison, evaluated: Sequence[_Named | None]) -> str:
    """What each run's open-loop error is of, with the figures by which these are not the same."""
    shown = [(row, *own) for row, own in zip(made.rows, evaluated, strict=True) if own]
    differ = []
    for name in _FRAMES:
        if len({str(one.figures[name]) for _, _, one in shown}) > 1:
            differ.append(name)
    said = []
    for row, (data, *_), one in shown:
        # Two folders of one name may be all that is different.
        told = [] if differ else [f"in {data}"]
        told += [f"{name.replace('_', ' ')} {_short(one.figures[name])}" for name in differ]
        said.append(f"{row.run}, {row.open_loop_on} ({', '.join(told)})")
    return "; ".join(said)


def _short(value: Any) -> str:
    """A number, or a list of episodes, of which a warning names the first."""
    if not isinstance(value, list):
        return str(value)
    listed = as_text(value) or "none"
    return listed if len(listed) <= _MOST else f"{listed[:_MOST].rpartition(',')[0]},..."


def _warn_of_unfinished(found: Sequence[tuple[Path, InspectReport]], on_event: OnEvent) -> None:
    """Say which runs have steps left, for the others may only have had more of them."""
    left = []
    for path, report in found:
        steps, planned = report.facts.get("steps"), report.facts.get("planned_steps")
        if steps is not None and planned is not None and steps < planned:
            taken = f"{path}, {inspection.steps_taken(steps, planned)} steps"
            left.append(taken + _what_goes_on(path, report))
    if left:
        on_event(Warned("compare", f"not finished: {'; '.join(left)}"))


def _what_goes_on(path: Path, report: InspectReport) -> str:
    """How an unfinished run comes to its end; nothing where its training state is gone."""
    if "merge" in report.facts:
        return " (merged before its training had ended: the finished run can be merged again)"
    state = path / "checkpoints" / checkpoint.LAST / checkpoint.STATE
    return f" ({commands.aegis('train', path)} goes on)" if state.is_file() else ""


def _warn_of_merges(found: Sequence[tuple[Path, InspectReport]], on_event: OnEvent) -> None:
    """Say which runs have been merged by `aegis run`, which has measured what came of that."""
    given = {path.resolve() for path, _ in found}
    for path, report in found:
        merged = report.facts.get("merged_into")
        if merged is not None and Path(merged).resolve() not in given:
            text = f"'{path}' has the weights before their merge"
            on_event(Warned("compare", f"{text}; what was merged and measured is in '{merged}'"))


def _inspected(path: Path) -> InspectReport:
    found = inspection.run(path)
    assert isinstance(found, InspectReport)  # a stream's run is refused before
    return found


def _gate(path: Path, asked: _Named | None) -> bool | None:
    """The verdict on the drop that the row shows; `aegis inspect` tells of all the probes."""
    if asked is None:
        return None
    return results.gate([asked[1]], results.recipe_of(path).probe)


def _by_set(path: Path, found: InspectReport) -> dict[str, results.Result]:
    """The run's probes by their question sets, the first of each."""
    recipe, probed = results.recipe_of(path), dict[str, results.Result]()
    for result in found.probes:
        probed.setdefault(results.question_set(result, recipe), result)
    return probed


def _by_colors(found: InspectReport) -> dict[str | None, results.PlayedResult]:
    """The run's rollouts by their colours, the first of each; None where a task has no colours."""
    # The last of each wins: the first one in the run's own task. LIBERO's policies play others too.
    task = found.facts.get("task")
    backwards = reversed(found.rollouts)
    in_order = sorted(backwards, key=lambda result: result.figures.get("task") == task)
    return {result.figures.get("colors"): result for result in in_order}


def _same_episodes(each: Sequence[Mapping[str | None, results.PlayedResult]]) -> bool:
    """Whether all rollouts of the same colours played the same episodes, in whatever way."""
    known = dict[str | None, tuple[Any, ...]]()
    for rollouts in each:
        for colors, one in rollouts.items():
            episodes = one.figures.get("task"), one.figures["episodes"], one.played.seed
            if known.setdefault(colors, episodes) != episodes:
                return False
    return True


def _by_episodes(path: Path, found: InspectReport) -> dict[Any, results.Result]:
    """The run's open-loop evaluations by what has to be the same for them to be compared."""
    by_episodes = {}
    for one in found.open_loops:
        told = [str(one.figures[name]) for name in _FRAMES]  # lists as texts, which can be keys
        by_episodes[results.evaluated_data(path, one), *told] = one
    return by_episodes


def _one_of_each(measured: Sequence[Mapping[Any, results.Result]]) -> list[_Named | None]:
    """Each run's first result whose name all runs with any have, else its own first."""
    some = [own for own in measured if own]
    shared = [name for name in next(iter(some), {}) if all(name in own for own in some)]
    chosen: list[_Named | None] = []
    for own in measured:
        name = next(iter([*shared, *own] if own else ()), None)  # where none is shared, its first
        chosen.append(None if name is None else (name, own[name]))
    return chosen


def _runs(path: Path, on_event: OnEvent) -> list[Path]:
    """The path of a run, or those of all runs in the folder of a job, or in any folder.

    Of any folder, runs without a checkpoint are left out with a warning.
    """
    if (path / table.NAME).is_file():
        found = table.load(path)
        if isinstance(found, PipelineReport):
            return table.runs(found)
    elif _is_run(path):
        return [path]
    elif not (path / CELLS).is_file():  # a study's has stages too, and no table of runs
        refuse_unfinished(path, "compare")
        if inside := _runs_inside(path, on_event):
            return inside
    expected = (
        "folders that aegis train wrote, one that aegis run made of a recipe, or one with runs in "
        "it"
    )
    if not path.exists():
        raise AegisError(f"nothing is at '{path}'", expected, "check the path")
    raise AegisError(
        f"'{path}' is not the run of a policy",
        expected,
        "aegis inspect shows studies and streams; two models are compared by aegis probe MODEL "
        "--baseline MODEL",
    )


def _is_run(path: Path) -> bool:
    return (path / "recipe.yaml").is_file() and not recipes.is_stream_run(path)


def _runs_inside(folder: Path, on_event: OnEvent) -> list[Path]:
    """The runs right in a folder by their names, as far as they have a checkpoint."""
    runs: list[Path] = []
    for saved in sorted(folder.glob("*/recipe.yaml")):
        try:
            runs += [saved.parent] * recipes.is_policy_run(saved.parent)
        except AegisError as error:  # a recipe that cannot be read
            on_event(Warned("compare", f"left out '{saved.parent}': {error.found}"))
    begun = [run for run in runs if not (run / "ledger.safetensors").is_file()]
    if begun:
        listed = ", ".join(str(run) for run in begun)
        on_event(Warned("compare", f"left out, because they have no checkpoint yet: {listed}"))
    return [run for run in runs if run not in begun]


def _compared(
    path: Path, found: InspectReport, asked: _Named | None, evaluated: _Named | None
) -> ComparedRun:
    """A run's row.

    Args:
        asked: the question set to show with its probe; None where the run was probed on none.
        evaluated: the open-loop evaluation to show; None without one.
    """
    vqa, probed = (None, {}) if asked is None else (asked[0], asked[1].figures)
    open_loop = {} if evaluated is None else evaluated[1].figures
    played = {colors: result.figures for colors, result in _by_colors(found).items()}
    seen, held_out = played.get("seen", {}), played.get("held-out", {})
    # A task without colours has one rollout, by its return or its success.
    only = played.get(None, {})
    lines = folder.read_metrics(path)
    times = [line["step_s"] for line in lines if "step_s" in line]
    layers = [layer["w2"] for layer in probed.get("layers", [])]
    return ComparedRun(
        run=str(path),
        method=found.method,
        task=found.facts.get("task"),
        steps=found.facts.get("steps"),
        planned_steps=found.facts.get("planned_steps"),
        vqa=vqa,
        accuracy=probed.get("accuracy"),
        baseline_accuracy=probed.get("baseline_accuracy"),
        drop_points=probed.get("drop_points"),
        drop_interval=probed.get("drop_interval"),
        cross_entropy=probed.get("cross_entropy"),
        success_seen=(seen or only).get("success"),
        success_seen_interval=(seen or only).get("interval"),
        success_held_out=held_out.get("success"),
        return_share=only.get("return_share"),
        open_loop_on=None if evaluated is None else results.evaluated_on(open_loop),
        open_loop_error=open_loop.get("relative_error"),
        open_loop_interval=open_loop.get("relative_interval"),
        hold_error=open_loop.get("hold_error"),
        w2=statistics.fmean(layers) if layers else None,
        energy_shed=found.energy_shed_mean,
        loss=found.loss,
        validation_loss=found.validation_loss,
        step_s=statistics.median_high(times) if times else None,
        gate=_gate(path, asked),
    )
