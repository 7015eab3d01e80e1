"""The commands that do a whole job at once: `pretrain`, `run` and `bench`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from aegis_cli.cli import render, stream_commands
from aegis_cli.cli.options import Json, RecipeArg, Resume, Set, positive
from aegis_cli.common.errors import AegisError
from aegis_cli.recipes import DualRecipe, Recipe, StreamStudyRecipe, load_pretrain
from aegis_cli.recipes.study_cells import load as load_run


def pretrain(
    recipe: RecipeArg,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Folder to write; default: runs/<recipe name>.",
            show_default=False,
        ),
    ] = None,
    resume: Resume = False,
    overrides: Set = None,
    as_json: Json = False,
) -> None:
    """Train the embedded VLM, or the embedded dual encoder, from nothing.

    \b
    Example: aegis pretrain recipes/pretrain-embedded.yaml
    Example: aegis pretrain recipes/pretrain-dual.yaml
    """
    resolved = load_pretrain(recipe, overrides or [])
    from aegis_cli.pretraining import dual, vlm

    stage, view = (
        (dual, render.dual) if isinstance(resolved, DualRecipe) else (vlm, render.pretrain)
    )
    with render.progress() as on_event:
        report = stage.run(resolved, out or Path("runs") / resolved.name, resume, on_event=on_event)
    render.show(report, view, as_json)


def run(
    recipe: RecipeArg,
    overrides: Set = None,
    out: Annotated[
        Path, typer.Option(metavar="FOLDER", help="Folder that gets one folder per recipe.")
    ] = Path("runs"),
    workers: Annotated[
        int,
        typer.Option(
            help="Trainings of a study at a time, each with its share of the cores.",
            callback=positive,
        ),
    ] = 1,
    as_json: Json = False,
) -> None:
    """Run all stages for all methods of a recipe, or a study of several seeds, and compare.

    What is up to date is skipped, so the same command also resumes. Exits 1 if a method drops by
    more than probe.max_drop.

    \b
    Example: aegis run recipes/quickstart.yaml
    Example: aegis run recipes/igsp-compare.yaml
    """
    resolved = load_run(recipe, overrides or [])
    if isinstance(resolved, Recipe):
        if workers > 1:
            fix = "leave --workers out: a recipe's methods are timed against each other"
            raise AegisError(
                f"--workers {workers} with the recipe '{recipe}'", "a study of several seeds", fix
            )
        from aegis_cli.studies import pipeline

        with render.progress() as on_event:
            report = pipeline.run(resolved, out, on_event=on_event)
        render.show(report, render.pipeline, as_json)
        render.save_table(report, render.pipeline)
        if report.gate_failed:
            limit = f"more than probe.max_drop {resolved.probe.max_drop:g} points"
            render.note(f"gate failed: {', '.join(report.gate_failed)} dropped {limit}")
            raise typer.Exit(1)
        return None
    if isinstance(resolved, StreamStudyRecipe):
        return stream_commands.study(resolved, out, workers, as_json)
    from aegis_cli.studies import study

    with render.progress() as on_event:
        found = study.run(resolved, out, on_event=on_event, workers=workers)
    render.show(found, render.study, as_json)
    render.save_table(found, render.study)
    if not render.has_frontier(found):
        render.note("no frontier.png: every training diverged, or none can be rolled out")
    elif render.can_plot():
        render.frontier_plot(found, Path(found.out) / "frontier.png")
    else:
        render.note(
            "no frontier.png: matplotlib is missing; pip install 'aegis-vla[media]', then run "
            "the same command again"
        )


def inspect(folder: Path, plot: Path | None, as_json: bool) -> None:
    """Show the table of a run or study as far as it is finished."""
    from aegis_cli.studies import table
    from aegis_cli.studies.comparison import StudyReport
    from aegis_cli.studies.pipeline import PipelineReport

    report = table.load(folder)
    if plot is not None and not isinstance(report, StudyReport):
        found = f"--plot with '{folder}', which holds a table without a plot"
        raise AegisError(
            found, "a study of variants on robot tasks, or one of the runs", "leave out --plot"
        )
    if plot is not None:
        render.frontier_plot(report, plot)
    view = render.study if isinstance(report, StudyReport) else render.stream_study
    render.show(report, render.pipeline if isinstance(report, PipelineReport) else view, as_json)


def bench(
    backbone: Annotated[
        str,
        typer.Option(
            help=(
                "'embedded', a checkpoint's folder or file, or a Hugging Face model's folder or id."
            )
        ),
    ] = "embedded",
    batch_size: Annotated[int, typer.Option(help="Frames a step.", callback=positive)] = 32,
    repeats: Annotated[
        int, typer.Option(help="Rounds; medians are reported.", callback=positive)
    ] = 9,
    as_json: Json = False,
) -> None:
    """Compare the anchor pass with a bare forward, each method's step and peak memory with naive's,
    the guard with training.

    Times are taken in turn, so that a busy machine slows all alike; memory is that of a process for
    each method.

    \b
    Example: aegis bench --json
    """
    from aegis_cli.evaluation import bench as stage
    from aegis_cli.guard import Guard

    with render.progress() as on_event:
        report = stage.run(backbone, batch_size, repeats, on_event=on_event, guard=Guard)
    render.show(report, render.bench, as_json)


COMMANDS = {
    pretrain: "Train the embedded models from nothing.",
    run: "Run all stages of a recipe, or a study, and compare.",
    bench: "Compare the methods' step times and peak memory.",
}
