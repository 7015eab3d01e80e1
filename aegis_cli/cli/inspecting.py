"""`aegis inspect`: what it shows for each kind of path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import RenderableType

from aegis_cli.cli import render
from aegis_cli.common import commands
from aegis_cli.common.errors import AegisError
from aegis_cli.recipes import Recipe, describe, load, shipped, study_cells
from aegis_cli.recipes.strict_yaml import dump

# Files of `aegis run` in a study's folder; the modules that write them need torch.
_TABLE, _CELLS = "table.json", "cells.json"
_RECIPES = (".yaml", ".yml")
_LISTED = 3  # maximum number of files that a note names


@dataclass(frozen=True)
class RecipeReport:
    """A recipe with every key written out."""

    kind: str
    path: str
    what: str
    recipe: dict[str, Any]


def show(
    path: Path,
    plot: Path | None,
    as_json: bool,
    tensors: bool = False,
    wide: bool = False,
    verify: bool = False,
) -> None:
    """Find out from a path's files what it is, and show it.

    Args:
        tensors: list each tensor of a file.
        wide: let a table's lines be wider than the terminal.
        verify: first read every artifact completely, or decode every image of questions.
    """
    # First of all, because nothing else is shown for a damaged file.
    verified = _verified(path) if verify else None
    if path.suffix in _RECIPES and path.is_file():
        _recipe(path, plot, as_json)
    elif path.name.endswith(_CELLS) and path.is_file():  # also NAME.cells.json, as shipped
        _cells(path, plot, as_json, wide)
    elif (path / _TABLE).is_file() or (path / _CELLS).is_file():
        _table(path, plot, as_json, wide)
    else:
        _anything(path, plot, as_json, tensors, wide, verify, verified)


@dataclass(frozen=True)
class VerifiedReport:
    """A folder without a report of its own: how many of its files agree with their digests."""

    kind: str
    path: str
    verified: int
    without_digest: int


def _verified(path: Path) -> VerifiedReport | None:
    """Read the artifacts at a path completely, and count those with a digest; None for questions.

    The result may be all that can be reported about a folder.

    Raises:
        AegisError: an artifact is damaged, or there is none.
    """
    from aegis_cli import inspection

    if inspection.is_questions(path):  # their images are decoded when they are counted
        return None
    found = inspection.verify(path)
    bare = [str(file) for file, has_digest in found.items() if not has_digest]
    agreeing = len(found) - len(bare)
    said = "file agrees with its digest" if agreeing == 1 else "files agree with their digests"
    render.note(f"{agreeing} {said}")
    if bare:
        listed = ", ".join(bare[:_LISTED])
        if len(bare) > _LISTED:
            listed += " ..."
        render.note(f"{len(bare)} without a digest, written by an earlier Aegis: {listed}")
    return VerifiedReport("folder", str(path), agreeing, len(bare))


def _recipe(path: Path, plot: Path | None, as_json: bool) -> None:
    """Show the recipe as YAML that can be read again."""
    if plot is not None:
        found = f"--plot with the recipe '{path}'"
        raise AegisError(found, "a run, a study or a dataset", "leave out --plot")
    resolved = study_cells.load_any(path)
    what, keys = describe(type(resolved)), study_cells.written_out(resolved)
    if as_json:
        render.show(RecipeReport("recipe", str(path), what, keys), render.facts, as_json)
    else:
        render.text(f"# {what}, every key with its value\n{dump(keys)}")


def _cells(path: Path, plot: Path | None, as_json: bool, wide: bool) -> None:
    """Show the tables of a study's finished cells, with the recipe of the same name."""
    from aegis_cli.studies import study

    resolved = study_cells.load(_recipe_of(path))
    if isinstance(resolved, Recipe):
        fix = "give the folder that aegis run wrote"
        raise AegisError(f"'{path}', whose recipe is not a study's", "cells of a study", fix)
    _study(study.told(resolved, path), path, plot, as_json, wide)


def _recipe_of(cells: Path) -> Path:
    """The study's recipe: beside its cells, in the parent folder, or a shipped one."""
    if cells.name == _CELLS:  # in a study's own folder, which has its recipe and its table
        raise AegisError(
            f"'{cells}', which does not name its study",
            "a study's folder, or NAME.cells.json with its recipe NAME.yaml beside it",
            commands.aegis("inspect", cells.parent),
        )
    name = cells.name.removesuffix(f".{_CELLS}")
    for folder in (cells.parent, cells.absolute().parent.parent):
        if (folder / f"{name}.yaml").is_file():
            return folder / f"{name}.yaml"
    return shipped.path(name)


def _table(folder: Path, plot: Path | None, as_json: bool, wide: bool) -> None:
    """Show the table of a job or study as far as it is finished."""
    from aegis_cli.studies import table

    _study(table.load(folder), folder, plot, as_json, wide)


def _study(report: Any, folder: Path, plot: Path | None, as_json: bool, wide: bool) -> None:
    """Show a table of `aegis run`, and draw a study's frontier."""
    from aegis_cli.studies.comparison import (
        RobotStreamStudyReport,
        StreamStudyReport,
        StudyReport,
    )
    from aegis_cli.studies.pipeline import PipelineReport

    if plot is not None and not isinstance(report, StudyReport):
        found = f"--plot with '{folder}', which holds a table without a plot"
        expected = "a study of variants on robot tasks, or one of the runs"
        raise AegisError(found, expected, "leave out --plot")
    if plot is not None:
        render.frontier_plot(report, plot)
    views = {
        PipelineReport: render.pipeline,
        StudyReport: render.study,
        StreamStudyReport: render.stream_study,
        RobotStreamStudyReport: render.robot_stream_study,
    }
    render.show(report, views[type(report)], as_json, wide)


def _anything(
    path: Path,
    plot: Path | None,
    as_json: bool,
    tensors: bool,
    wide: bool,
    verify: bool,
    verified: VerifiedReport | None,
) -> None:
    """Show an artifact, a run, a model or a dataset, or a folder whose files were verified."""
    from aegis_cli import inspection

    try:
        with render.progress() as on_event:
            report = inspection.run(path, on_event, images=verify)
    except inspection.UnknownFolder:
        if verified is None or plot is not None:  # for a folder of files there is no plot
            raise
        render.show(verified, render.facts, as_json)
        return
    if plot is not None:
        _draw(report, path, plot)
    render.show(report, _view(report, tensors), as_json, wide)


def _view(report: Any, tensors: bool) -> Callable[[Any], RenderableType]:
    """The view for a report of this kind."""
    from aegis_cli import inspection

    if isinstance(report, inspection.StreamInspection):
        return render.stream_inspect
    if isinstance(report, inspection.UnfinishedStream):
        return render.unfinished_stream
    if report.kind == "questions":
        return render.questions
    return partial(render.inspect, tensors=tensors)


def _draw(report: Any, path: Path, plot: Path) -> None:
    """Draw a stream's routing, a dataset's frames, questions with images, or a run's course."""
    from aegis_cli import inspection

    if isinstance(report, inspection.StreamInspection):
        render.routing_plot(report, plot)
    elif isinstance(report, inspection.UnfinishedStream):
        fix = f"continue it: {commands.aegis('train', path)}"
        raise AegisError(f"--plot of '{path}', an unfinished stream", "a finished one", fix)
    elif report.kind == "questions":
        from aegis_cli.data.vqa import summary

        with render.progress() as on_event:
            summary.save_sheet(str(path), plot, on_event)
    elif report.kind == "dataset":
        from aegis_cli.data.lerobot import dataset, download, summary

        home = path
        if not path.exists():  # an id on the hub; only the files of the shown frames are fetched
            found = dataset.load(download.meta(str(path)))
            shown = summary.on_sheet(found)
            home = download.fetch(str(path), found, found.info.cameras, shown)
        summary.save_sheet(home, plot)
    elif report.kind == "run" and not report.layers:
        from aegis_cli.training import folder

        sets = load(path / "recipe.yaml", kind=Recipe).probe.sets
        title = f"{report.facts['method']} in {path.absolute().name}"
        render.curves_plot(folder.read_metrics(path, "step"), sets, title, plot)
    else:
        render.energy_plot(report, plot)
