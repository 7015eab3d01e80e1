"""What `aegis inspect` shows of each thing that it is given."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aegis_cli.cli import job_commands, render, stream_commands
from aegis_cli.common.errors import AegisError
from aegis_cli.recipes import describe, is_stream_run, study_cells
from aegis_cli.recipes.strict_yaml import dump

_RECIPES = (".yaml", ".yml")


@dataclass(frozen=True)
class RecipeReport:
    """A recipe with every key written out."""

    kind: str
    path: str
    what: str
    recipe: dict[str, Any]


def show(path: Path, plot: Path | None, as_json: bool) -> None:
    """Tell by a path's files what it is, and show that."""
    if path.suffix in _RECIPES and path.is_file():
        return _recipe(path, plot, as_json)
    if (path / "table.json").is_file() or (path / "cells.json").is_file():
        return job_commands.inspect(path, plot, as_json)
    if is_stream_run(path):
        return stream_commands.inspect(path, plot, as_json)
    from aegis_cli import inspection as stage

    report = stage.run(path)
    if plot is not None and report.kind == "dataset":
        from aegis_cli.data.lerobot import summary

        summary.save_sheet(path, plot)
    elif plot is not None:
        render.energy_plot(report, plot)
    return render.show(report, render.inspect, as_json)


def _recipe(path: Path, plot: Path | None, as_json: bool) -> None:
    """The recipe as YAML that can be read again."""
    if plot is not None:
        raise AegisError(
            f"--plot with the recipe '{path}'", "a run, a study or a dataset", "leave out --plot"
        )
    resolved = study_cells.load_any(path)
    report = RecipeReport(
        "recipe", str(path), describe(type(resolved)), study_cells.written_out(resolved)
    )
    if as_json:
        render.show(report, render.facts, as_json)
    else:
        render.text(f"# {report.what}, every key with its value\n{dump(report.recipe)}")
