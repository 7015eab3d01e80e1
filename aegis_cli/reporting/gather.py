"""`aegis report`: the contents of a run's, job's or study's folder, or of several, as a document.

A job is the result of `aegis run` on a recipe with several methods. Nothing is measured here: all
figures were written by the stages.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aegis_cli import inspection, recipes, sim
from aegis_cli.common import artifacts, commands, machine
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.continual import files as stream_files
from aegis_cli.evaluation import kept_figures, results
from aegis_cli.recipes.study_cells import written_out
from aegis_cli.reporting import compare
from aegis_cli.reporting.paired import PairedRun
from aegis_cli.studies import table
from aegis_cli.studies.cells import CELLS
from aegis_cli.studies.comparison import (
    RobotStreamStudyReport,
    StreamStudyReport,
    StudyReport,
)
from aegis_cli.studies.pipeline import PipelineReport
from aegis_cli.training import folder
from aegis_cli.training import inputs as places
from aegis_cli.training.up_to_date import refuse_unfinished

_VIDEOS = (".mp4", ".gif", ".webm")


@dataclass(frozen=True)
class Video:
    """A video in a run's folder: its path relative to the reported folder, and its size."""

    name: str
    size_bytes: int


@dataclass(frozen=True)
class AnchorUse:
    """An anchor and its use.

    Attributes:
        measured_on: a description of its data, or of the file if its content is not known here.
        read: whether the weights depend on it; otherwise only the drift is measured against it.
    """

    measured_on: str
    read: bool


@dataclass(frozen=True)
class RunDocument:
    """One run.

    Attributes:
        label: a name that distinguishes it from other runs of a job: its method, and whether the
            trained policy was merged afterwards.
        recipe: every key with its value.
        anchor: None if the training did not read one and no drift was measured against one.
        facts: the facts that `aegis inspect` shows.
        metrics: the lines of metrics.jsonl.
        layers, over_time, energy_shed_mean: the energy that the projection shed; empty if no
            anchor gradient was computed.
        train: the figures of train.json; empty if `aegis run` did not train it.
        probes, rollouts, open_loops: measurements of the last checkpoint, with their settings.
        question_sets: the question set of each probe, as the user named it.
        gate: whether the drop is within `probe.max_drop` or `--max-drop`; None without a limit.
        machine: the machine that trained it; empty for a run of an earlier version.
        commands: the commands that reproduce it.
    """

    kind: str
    path: str
    label: str
    method: str
    task: str | None
    backbone: str
    recipe: dict[str, Any]
    anchor: AnchorUse | None
    facts: dict[str, Any]
    metrics: list[dict[str, Any]]
    layers: tuple[inspection.LayerEnergy, ...]
    over_time: tuple[inspection.Bin, ...]
    energy_shed_mean: float | None
    train: dict[str, Any]
    probes: list[results.Result]
    rollouts: list[results.PlayedResult]
    open_loops: list[results.Result]
    question_sets: list[str]
    gate: bool | None
    machine: dict[str, Any]
    videos: list[Video]
    commands: list[str]

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class JobDocument:
    """All methods of one recipe, and the table that compares them.

    Attributes:
        against, paired: as in a `Comparison` of its runs.
    """

    kind: str
    path: str
    table: PipelineReport
    runs: list[RunDocument]
    videos: list[Video]
    commands: list[str]
    against: str | None
    paired: list[PairedRun]

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class ComparisonDocument:
    """Several runs, and what `aegis compare` shows of them; `path` lists the given folders."""

    kind: str
    path: str
    comparison: compare.Comparison
    runs: list[RunDocument]
    commands: list[str]

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class StudyDocument:
    """A study as far as it is finished. `kind` is the kind of its recipe, such as `study`."""

    kind: str
    path: str
    table: Any
    commands: list[str]

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class StreamDocument:
    """The finished run of a stream."""

    kind: str
    path: str
    report: Any
    commands: list[str]

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


_STUDIES: dict[type, str] = {
    StudyReport: "study",
    StreamStudyReport: "stream-study",
    RobotStreamStudyReport: "robot-stream-study",
}

Document = RunDocument | JobDocument | ComparisonDocument | StudyDocument | StreamDocument


def run(path: Path, on_event: OnEvent = ignore, against: str | None = None) -> Document:
    """The document of a folder.

    Args:
        against: as in `compare.run`; only for a job, or a folder of runs.

    Raises:
        AegisError: the folder was not written by `aegis train` or `aegis run` and has no run in it,
            a file is damaged, or `against` does not fit.
    """
    path = Path(path)
    # A table first: a study that has just started has only cells, which `table.load` reports.
    if (path / table.NAME).is_file() or (path / CELLS).is_file():
        return _of_table(path, against)
    if (path / "recipe.yaml").is_file():
        _refuse_against(against, path)
    if recipes.is_stream_run(path):
        report = stream_files.read(path)
        repeat = commands.aegis("train", path / "recipe.yaml", "--out", "NEW_FOLDER")
        return StreamDocument(report.kind, str(path), report, [repeat])
    if (path / "recipe.yaml").is_file():
        return run_document(path, videos=True)
    refuse_unfinished(path, "report")
    if compare.runs_inside(path, ignore):
        return of_runs([path], on_event, against)
    inside = sorted(p.parent for p in path.glob(f"*/{table.NAME}"))
    inside += sorted(p.parent for p in path.glob("*/recipe.yaml"))
    example = next(iter(inside), "runs/quickstart")
    expected = "a folder that aegis train or aegis run wrote, or one with runs in it"
    if not path.exists():
        raise AegisError(f"nothing is at '{path}'", expected, "check the path")
    fix = commands.aegis("report", example)
    raise AegisError(f"'{path}' is not a run, job or study", expected, fix)


def _refuse_against(against: str | None, path: Path) -> None:
    if against is not None:
        found = f"--against {against} for the page of '{path}', which does not compare runs"
        expected = "a job, a folder of runs, or several folders"
        raise AegisError(found, expected, f"{commands.aegis('report', path)} without it")


def of_runs(
    paths: Sequence[Path], on_event: OnEvent = ignore, against: str | None = None
) -> ComparisonDocument:
    """The document of several runs; one that is named twice is in it once.

    Args:
        against: as in `compare.run`.

    Raises:
        AegisError: a path is not a run of a policy, nor a folder with such runs, a file is damaged,
            or `against` is none of these runs.
    """
    first, *others = (compare.runs_in(Path(given), on_event) for given in paths)
    by_place: dict[Path, compare.Inspected] = {}
    for one in itertools.chain(first, *others):
        by_place.setdefault(one[0].resolve(), one)
    found = list(by_place.values())
    if against is None:
        reference = list(by_place).index(first[compare.first_naive(first)][0].resolve())
    else:
        reference = compare.named(against, found)
    comparison = compare.of(found, reference, on_event)
    runs = [run_document(path, videos=True, found=one) for path, one in found]
    labels = zip(runs, _labels(runs), strict=True)
    runs = [dataclasses.replace(one, label=label) for one, label in labels]
    listed = ", ".join(map(str, paths))
    chosen = () if against is None else ("--against", against)
    again = commands.aegis("report", *paths, *chosen, "--out", "PAGE.html")
    return ComparisonDocument("comparison", listed, comparison, runs, [again])


def _labels(runs: Sequence[RunDocument]) -> list[str]:
    """A name for each run: its method, its folder's name or its path, whichever is its own."""
    for names in ([one.label for one in runs], [Path(one.path).absolute().name for one in runs]):
        if len(set(names)) == len(names):
            return names
    return [one.path for one in runs]


def _of_table(path: Path, against: str | None) -> Document:
    found = table.load(path)
    if not isinstance(found, PipelineReport):
        _refuse_against(against, path)
        again = commands.aegis("run", "RECIPE", "--out", path.parent)
        return StudyDocument(_STUDIES[type(found)], str(path), found, [again])
    inside = [(run, compare.inspected(run)) for run in table.runs(found)]
    runs = [run_document(run, found=one) for run, one in inside]
    chosen = compare.first_naive(inside) if against is None else compare.named(against, inside)
    compared = compare.of(inside, chosen)
    # Each method's recipe names all methods of the job, and has every value that was set.
    recipe = path / found.rows[0].method / "recipe.yaml"
    again = commands.aegis("run", recipe, "--out", "NEW_FOLDER")
    return JobDocument(
        kind="job",
        path=str(path),
        table=found,
        runs=runs,
        videos=_videos(path),
        commands=[again],
        against=compared.against,
        paired=compared.paired,
    )


def run_document(
    path: Path, videos: bool = False, found: inspection.InspectReport | None = None
) -> RunDocument:
    """The document of a run of one policy.

    Args:
        videos: whether to list the videos in its folder; a job lists those of all its runs.
        found: what its inspection has found, if it has been inspected.

    Raises:
        AegisError: there is no checkpoint yet, or a file is damaged.
    """
    recipe = recipes.load(path / "recipe.yaml")
    found = compare.inspected(path) if found is None else found
    train = _jobs_report(path)
    about = path / machine.NAME
    anchor = _anchor(path, recipe, found)
    probes = results.probes(path)
    return RunDocument(
        kind="run",
        path=str(path),
        label=found.method,
        method=str(found.facts["method"]),
        task=found.facts.get("task"),
        backbone=recipe.backbone,
        recipe=written_out(recipe),
        anchor=anchor,
        facts=found.facts,
        metrics=folder.read_metrics(path, "step"),
        layers=found.layers,
        over_time=found.over_time,
        energy_shed_mean=found.energy_shed_mean,
        train=kept_figures.read(train, kept_figures.TrainFigures) if train.is_file() else {},
        probes=probes,
        rollouts=list(found.rollouts),
        open_loops=list(found.open_loops),
        question_sets=list(found.question_sets),
        gate=found.gate,
        machine=kept_figures.read(about, kept_figures.Plain) if about.is_file() else {},
        videos=_videos(path) if videos else [],
        commands=_commands(path, recipe, found.facts, anchor is not None),
    )


def _jobs_report(path: Path) -> Path:
    """The report of `aegis run` on a run's training; the file exists only if it trained the run."""
    return folder.trained_in(path) / folder.JOBS_REPORT


def _anchor(
    path: Path, recipe: recipes.Recipe, found: inspection.InspectReport
) -> AnchorUse | None:
    """A run's anchor and its use; None if nothing used an anchor, even if one was given."""
    read = recipe.reads_anchor(str(found.facts["method"]))
    if not read and not any(probed.figures.get("layers") for probed in found.probes):
        return None
    if _jobs_report(path).is_file():  # `aegis run` measures the anchor of the recipe
        asked = f"questions of {recipe.anchor.vqa}"
        what = "robot frames" if recipe.anchor.source == "demos" else asked
        return AnchorUse(f"{_samples(path, recipe):,} {what}", read)
    if not read:
        return AnchorUse("a file given to aegis probe", read)
    digest = artifacts.read_header(path / "ledger.safetensors").inputs.get("anchor", "unknown")
    kept = places.of(path)
    name = "a file" if kept is None or kept.anchor is None else f"'{Path(kept.anchor).name}'"
    return AnchorUse(f"{name} with sha256 {digest[:12]}", read)


def _samples(path: Path, recipe: recipes.Recipe) -> int:
    """The number of samples of a job's anchor; a set may have fewer than the recipe requests."""
    file = path.parent / "anchor.safetensors"
    header = artifacts.read_header(file) if file.is_file() else None
    found = None if header is None else header.meta.get("samples")
    return found if isinstance(found, int) else recipe.anchor.samples


def _commands(
    path: Path, recipe: recipes.Recipe, facts: Mapping[str, Any], has_anchor: bool
) -> list[str]:
    """Commands for training, merge, probe and rollout of a run.

    The inputs are beside the run if `aegis run` made them. Without a simulated task there is no
    rollout.
    """
    method, task, merge = str(facts["method"]), facts.get("task"), facts.get("merge")
    named = recipe.demos.path or _beside(path, "demos.safetensors")
    sets = (named,) if isinstance(named, str) else named
    demos = [word for each in sets for word in ("--demos", each)]
    anchor = _beside(path, "anchor.safetensors")
    given = ("--anchor", anchor)
    again, new = path / "recipe.yaml", "NEW_FOLDER"
    read = given if recipe.reads_anchor(method) else ()
    inputs = ("--method", method, *demos, *read, "--out", new)
    asked = ("--baseline", recipe.backbone, *(given if has_anchor else ()))
    told = [commands.aegis("train", again, *inputs)]
    if merge is not None:
        trained, new = new, "MERGED_FOLDER"
        if facts["steps"] != recipe.train.steps:  # it was merged before the end of its training
            trained = f"{trained}/checkpoints/{facts['steps']:06d}"
        own = _merging(merge, recipe, demos, anchor)
        told.append(commands.aegis("merge", trained, *own, "--out", new))
    for probe in recipe.probe.of_each_set():
        counted = (*probe.asking, "--questions", probe.questions, *_seed(probe.seed))
        told.append(commands.aegis("probe", new, *counted, *asked))
    if task is not None:
        episodes = ("--episodes", recipe.rollout.episodes, *_seed(recipe.rollout.seed))
        colors: list[tuple[str, ...]] = [()]  # a single rollout if a task has no colours
        if sim.has_colors(task):
            colors = [("--colors", each) for each in recipe.rollout.colors]
        told += [commands.aegis("rollout", new, *episodes, *of_them) for of_them in colors]
    return told


def _merging(
    merge: Mapping[str, Any], recipe: recipes.Recipe, demos: Sequence[str], anchor: str
) -> Iterator[object]:
    """The options of a merge; merges of earlier versions do not record what they read.

    Args:
        demos: the option with the run's demonstrations, once for each set.
    """
    method = merge["method"]
    yield from ("--method", method, "--strength", merge["strength"])
    if merge["base"] != recipe.backbone:
        yield from ("--base", merge["base"])
    if method == "linear":
        return
    yield from ("--damping", merge["damping"])
    if method != "kfac-shrink":
        yield from demos
    if "frames" in merge:
        yield from ("--frames", merge["frames"])
    if "anchor" in merge:
        yield from ("--anchor", anchor)
    elif "vqa" in merge:
        # Compared with the defaults of `aegis merge`; options with None here are always given.
        for name, default in (("vqa", None), ("ask", "{}"), ("samples", None), ("temperature", 1)):
            if merge[name] != default:
                yield from (f"--{name}", merge[name])
        yield from ["--skip-bad"] * ("skip_bad" in merge)


def _seed(seed: int) -> tuple[object, ...]:
    """The option for a seed, if it is not the default."""
    return ("--seed", seed) if seed else ()


def _beside(path: Path, name: str) -> str:
    """An input of a run where `aegis run` puts it, or a placeholder if it is elsewhere."""
    found = folder.trained_in(path).parent / name
    return str(found) if found.is_file() else name.partition(".")[0].upper()


def _videos(path: Path) -> list[Video]:
    """The videos in a folder, in its direct subfolders, and in merged runs in these."""
    # No deeper: a run's checkpoints and a job's data hold thousands of files, but no videos.
    listed = [*path.glob("*"), *path.glob("*/*"), *path.glob(f"*/{folder.MERGED}/*")]
    found = sorted(p for p in listed if p.suffix.lower() in _VIDEOS and p.is_file())
    return [Video(p.relative_to(path).as_posix(), p.stat().st_size) for p in found]
