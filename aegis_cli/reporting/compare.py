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
from aegis_cli.recipes.study_cells import NAIVE
from aegis_cli.reporting import differences, paired
from aegis_cli.reporting.paired import PairedRun
from aegis_cli.studies import table
from aegis_cli.studies.cells import CELLS
from aegis_cli.studies.pipeline import PipelineReport
from aegis_cli.training import checkpoint, folder
from aegis_cli.training.up_to_date import refuse_unfinished

Interval = tuple[float, float] | None
_Named = tuple[Any, results.Result]  # a result and the name by which runs are matched
Inspected = tuple[Path, InspectReport]
_FRAMES = ("episodes", "trained_on", "frames", "seed")  # figures that identify the frames
_MOST = 60  # characters of a list of episodes in a warning


@dataclass(frozen=True)
class ComparedRun:
    """One run's figures; None for those that were not measured.

    `method` says whether the trained policy was merged afterwards, as in `naive, merged`.
    Shares are in [0, 1], the drop in percentage points, times in seconds, W2^2 a mean over layers.
    The VQA figures are those of one probe, on the question set `vqa`. The open-loop error is that
    of one evaluation, on the episodes that `open_loop_on` describes.
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
    whether all rollouts on the same colours played the same episodes. `differs` has the settings
    other than the method in which the runs differ, with each run's value. `paired` has every other
    run's differences from the run `against`, which is None for a single run.
    """

    rows: list[ComparedRun]
    same_open_loop: bool = True
    same_episodes: bool = True
    differs: dict[str, list[differences.Value]] = field(default_factory=dict)
    against: str | None = None
    paired: list[PairedRun] = field(default_factory=list)

    @property
    def same_validation(self) -> bool:
        """Whether all validation losses are on the same held-out frames."""
        return differences.same_validation(self.differs)

    @property
    def same_questions(self) -> bool:
        """Whether the VQA figures are on the same questions."""
        return "questions" not in self.differs

    @property
    def question_sets(self) -> list[str]:
        """The question sets of the VQA figures."""
        return list(dict.fromkeys(row.vqa for row in self.rows if row.vqa is not None))

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def run(
    paths: Sequence[Path], on_event: OnEvent = ignore, against: str | None = None
) -> Comparison:
    """Read the measurements of each run.

    Args:
        against: the run that the others' paired differences are from: its folder, or a method that
            only one of them has. By default it is the first one; of a folder of several runs, its
            `naive`, if there is one.

    Raises:
        AegisError: a path is not a run of a policy, nor a folder with such runs; or `against` is
            none of these runs.
    """
    first, *others = (runs_in(Path(given), on_event) for given in paths)
    found = first + [one for several in others for one in several]
    reference = first_naive(first) if against is None else named(against, found)
    return of(found, reference, on_event)


def runs_in(path: Path, on_event: OnEvent) -> list[Inspected]:
    """The run at a path, or all runs in a folder.

    Raises:
        AegisError: there is no run of a policy.
    """
    return [(run, inspected(run)) for run in _runs(path, on_event)]


def first_naive(found: Sequence[Inspected]) -> int:
    """The number of the first naive run, with which all methods are compared; 0 without one."""
    naive = (i for i, (_, one) in enumerate(found) if one.facts["method"] == NAIVE)
    return next(naive, 0)


def of(found: Sequence[Inspected], reference: int, on_event: OnEvent = ignore) -> Comparison:
    """Compare runs.

    The first question set that every run was probed on is compared. If there is none, each run's
    own first set is shown, with a warning. Open-loop evaluations are compared likewise if they have
    the same episodes, frames and seed, whether the episodes were trained on or not.

    Args:
        reference: the number of the run that paired differences are from.
    """
    # The compared results are chosen over all runs together.
    probed = _one_of_each([_by_set(path, one) for path, one in found])
    evaluated = _one_of_each([_by_episodes(path, one) for path, one in found])
    rows = [_compared(*each, *own) for each, *own in zip(found, probed, evaluated, strict=True)]
    _warn_of_unfinished(found, on_event)
    _warn_of_merges(found, on_event)
    played = [_by_colors(one) for _, one in found]
    facts = [
        differences.of_run(path, row.steps, asked, own)
        for (path, _), row, asked, own in zip(found, rows, probed, played, strict=True)
    ]
    same_frames = len({own[0] for own in evaluated if own is not None}) < 2
    made = Comparison(rows, same_frames, _same_episodes(played), differences.between(facts))
    if len(rows) > 1:
        measured = []
        for i, row in enumerate(rows):
            asked = probed[i]
            told = None if asked is None else (facts[i]["questions"], asked[1])
            measured.append(paired.Measured(row.run, row.method, told, played[i], evaluated[i]))
        first = measured.pop(reference)
        pairs = [paired.between(first, other) for other in measured]
        made = dataclasses.replace(made, against=first.run, paired=pairs)
    _warn_of_differences(made, evaluated, on_event)
    return made


def named(against: str, found: Sequence[Inspected]) -> int:
    """The number of the run with this folder, or the only one with this method.

    Raises:
        AegisError: there is none, or several have the method.
    """
    place = Path(against).resolve()
    known = [i for i, (path, _) in enumerate(found) if path.resolve() == place]
    if known:
        return known[0]
    known = [i for i, (_, one) in enumerate(found) if against in (one.method, one.facts["method"])]
    if len(known) == 1:
        return known[0]
    listed = ", ".join(str(found[i][0]) for i in known or range(len(found)))
    what = f"the method of {len(known)} runs" if known else "none of the compared runs"
    expected = f"one of {listed}"
    fix = "give the folder of one of them" + ("" if known else ", or compare that run too")
    raise AegisError(f"--against {against}, which is {what}", expected, fix)


def _warn_of_differences(
    made: Comparison, evaluated: Sequence[_Named | None], on_event: OnEvent
) -> None:
    """Warn of settings other than the method in which the runs differ."""
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
    """The frames of each run's open-loop error, with the figures in which they differ."""
    shown = [(row, *own) for row, own in zip(made.rows, evaluated, strict=True) if own]
    differ = []
    for name in _FRAMES:
        if len({str(one.figures[name]) for _, _, one in shown}) > 1:
            differ.append(name)
    said = []
    for row, (data, *_), one in shown:
        # The only difference may be the folder, even with the same name.
        told = [] if differ else [f"in {data}"]
        told += [f"{name.replace('_', ' ')} {_short(one.figures[name])}" for name in differ]
        said.append(f"{row.run}, {row.open_loop_on} ({', '.join(told)})")
    return "; ".join(said)


def _short(value: Any) -> str:
    """A value as text; a long list of episodes is shortened to the first ones."""
    if not isinstance(value, list):
        return str(value)
    listed = as_text(value) or "none"
    return listed if len(listed) <= _MOST else f"{listed[:_MOST].rpartition(',')[0]},..."


def _warn_of_unfinished(found: Sequence[tuple[Path, InspectReport]], on_event: OnEvent) -> None:
    """Warn of runs with steps left, since other runs may only have trained for longer."""
    left = []
    for path, report in found:
        steps, planned = report.facts.get("steps"), report.facts.get("planned_steps")
        if steps is not None and planned is not None and steps < planned:
            taken = f"{path}, {inspection.steps_taken(steps, planned)} steps"
            left.append(taken + _what_goes_on(path, report))
    if left:
        on_event(Warned("compare", f"not finished: {'; '.join(left)}"))


def _what_goes_on(path: Path, report: InspectReport) -> str:
    """How to finish an unfinished run; "" if its training state is gone."""
    if "merge" in report.facts:
        return " (merged before its training had ended: the finished run can be merged again)"
    state = path / "checkpoints" / checkpoint.LAST / checkpoint.STATE
    return f" ({commands.aegis('train', path)} goes on)" if state.is_file() else ""


def _warn_of_merges(found: Sequence[tuple[Path, InspectReport]], on_event: OnEvent) -> None:
    """Warn of runs that `aegis run` has merged, since it measured the merged policy instead."""
    given = {path.resolve() for path, _ in found}
    for path, report in found:
        merged = report.facts.get("merged_into")
        if merged is not None and Path(merged).resolve() not in given:
            text = f"'{path}' has the weights before their merge"
            on_event(Warned("compare", f"{text}; what was merged and measured is in '{merged}'"))


def inspected(path: Path) -> InspectReport:
    found = inspection.run(path)
    assert isinstance(found, InspectReport)  # a stream's run is refused before
    return found


def _gate(path: Path, asked: _Named | None) -> bool | None:
    """The verdict on the drop in the row; `aegis inspect` judges all probes."""
    if asked is None:
        return None
    return results.gate([asked[1]], results.recipe_of(path).probe)


def _by_set(path: Path, found: InspectReport) -> dict[str, results.Result]:
    """The run's first probe on each question set."""
    recipe, probed = results.recipe_of(path), dict[str, results.Result]()
    for result in found.probes:
        probed.setdefault(results.question_set(result, recipe), result)
    return probed


def _by_colors(found: InspectReport) -> dict[str | None, results.PlayedResult]:
    """The run's first rollout on each colour set; the key is None if a task has no colours."""
    # In the dict the last one wins, so the first rollout in the run's own task comes last. LIBERO's
    # policies are rolled out on other tasks too.
    task = found.facts.get("task")
    backwards = reversed(found.rollouts)
    in_order = sorted(backwards, key=lambda result: result.figures.get("task") == task)
    return {result.figures.get("colors"): result for result in in_order}


def _same_episodes(each: Sequence[Mapping[str | None, results.PlayedResult]]) -> bool:
    """Whether all rollouts on the same colours played the same episodes."""
    known = dict[str | None, tuple[Any, ...]]()
    for rollouts in each:
        for colors, one in rollouts.items():
            if known.setdefault(colors, paired.episodes_of(one)) != paired.episodes_of(one):
                return False
    return True


def _by_episodes(path: Path, found: InspectReport) -> dict[Any, results.Result]:
    """The run's open-loop evaluations, by the values that must be equal for a comparison."""
    by_episodes = {}
    for one in found.open_loops:
        told = [str(one.figures[name]) for name in _FRAMES]  # as text: lists cannot be keys
        by_episodes[results.evaluated_data(path, one), *told] = one
    return by_episodes


def _one_of_each(measured: Sequence[Mapping[Any, results.Result]]) -> list[_Named | None]:
    """Each run's first result whose name all runs with results have, otherwise its own first."""
    some = [own for own in measured if own]
    shared = [name for name in next(iter(some), {}) if all(name in own for own in some)]
    chosen: list[_Named | None] = []
    for own in measured:
        name = next(iter([*shared, *own] if own else ()), None)  # its own first if none is shared
        chosen.append(None if name is None else (name, own[name]))
    return chosen


def _runs(path: Path, on_event: OnEvent) -> list[Path]:
    """The path of a run, or the paths of all runs in a job's folder or in any other folder.

    In other folders, runs without a checkpoint are left out with a warning.
    """
    if (path / table.NAME).is_file():
        found = table.load(path)
        if isinstance(found, PipelineReport):
            return table.runs(found)
    elif _is_run(path):
        return [path]
    elif not (path / CELLS).is_file():  # a study's folder has no table of runs
        refuse_unfinished(path, "compare")
        if inside := runs_inside(path, on_event):
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
        "streams are compared with streams, and aegis inspect shows studies; two models are "
        "compared by aegis probe MODEL --baseline MODEL",
    )


def _is_run(path: Path) -> bool:
    return (path / "recipe.yaml").is_file() and not recipes.is_stream_run(path)


def runs_inside(folder: Path, on_event: OnEvent) -> list[Path]:
    """The runs directly in a folder that have a checkpoint, sorted by name."""
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
        asked: the question set to show with its probe; None if the run was not probed.
        evaluated: the open-loop evaluation to show; None without one.
    """
    vqa, probed = (None, {}) if asked is None else (asked[0], asked[1].figures)
    open_loop = {} if evaluated is None else evaluated[1].figures
    played = {colors: result.figures for colors, result in _by_colors(found).items()}
    seen, held_out = played.get("seen", {}), played.get("held-out", {})
    # A task without colours has a single rollout, with its return or its success.
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
