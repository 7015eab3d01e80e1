"""The `aegis` command. Each of its commands parses arguments, calls one stage and shows its report.

exits.py says with which code it ends, job_commands.py has the commands of more than one stage.
Stages are imported inside the commands, so that `aegis --help` needs neither torch nor OpenGL.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from aegis_cli.cli import inspect_commands, job_commands, render, stream_commands
from aegis_cli.cli.exits import Commands
from aegis_cli.cli.options import (
    AnchorIn,
    BatchSize,
    Colors,
    DropBelow,
    Episodes,
    Format,
    Json,
    RecipeArg,
    Resume,
    Set,
    SkipBad,
    Vqa,
    given,
    not_negative,
    positive,
    seed_number,
)
from aegis_cli.common.errors import AegisError
from aegis_cli.common.version import __version__
from aegis_cli.recipes import (
    ANCHOR_PARTS,
    LEARNERS,
    METHODS,
    TASK,
    Anchor,
    RobotStreamRecipe,
    StreamRecipe,
    is_stream_run,
    load_training,
    read_anchor,
)

app = typer.Typer(
    cls=Commands, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None
)


@app.callback(invoke_without_command=True)
def aegis(
    ctx: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Fine-tune a vision-language model into a robot policy without losing what it knew.

    \b
    Start with: aegis run recipes/quickstart.yaml
    Exit codes: 0 done, 1 a gate failed, 2 a problem to fix, 3 a defect of Aegis, 130 Ctrl-C
    """
    if version:
        typer.echo(f"aegis {__version__}")
    elif ctx.invoked_subcommand is None:
        typer.echo(ctx.get_help())


@app.command(short_help="Record demonstrations of a simulated task.")
def demos(
    task: Annotated[
        str, typer.Argument(metavar="TASK", help=f"{TASK.expected}.", show_default=False)
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="PATH",
            help="File to write, replacing one that is there; for lerobot, a new folder.",
            show_default=False,
        ),
    ],
    episodes: Episodes = 300,
    seed: Annotated[
        int, typer.Option(help="Seed; equal seeds give equal bytes.", callback=seed_number)
    ] = 0,
    noise: Annotated[
        float,
        typer.Option(
            help="Standard deviation of the noise on executed actions, 1 = full range.",
            callback=not_negative,
        ),
    ] = 0.3,
    preview: Annotated[
        Path | None,
        typer.Option(metavar="PNG", help="Also write a contact sheet.", show_default=False),
    ] = None,
    form: Annotated[
        Format, typer.Option("--format", help="One file, or a LeRobot dataset v3.0.")
    ] = Format.safetensors,
    video: Annotated[
        bool, typer.Option("--video", help="Keep a LeRobot dataset's frames as H.264, not as PNG.")
    ] = False,
    drop_below: DropBelow = None,
    as_json: Json = False,
) -> None:
    """Record demonstrations: noisy execution, clean expert labels.

    For a suite task, a planner is the expert, and enough episodes are recorded that --episodes of
    them are left after dropping.

    \b
    Example: aegis demos reach --episodes 300 --out reach.safetensors
    Example: aegis demos reach --episodes 300 --format lerobot --out reach-dataset
    Example: aegis demos suite/cartpole-swingup --episodes 20 --out cartpole.safetensors
    """
    from aegis_cli.data import record as stage

    with render.progress() as on_event:
        report = stage.run(
            task,
            episodes,
            seed,
            out,
            noise=noise,
            preview=preview,
            on_event=on_event,
            form=form.value,
            as_video=video,
            drop_below=drop_below,
        )
    render.show(report, render.measured, as_json)


@app.command(short_help="Measure what the backbone knows, before it is fine-tuned.")
def anchor(
    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE",
            help="Anchor to write; a file that is there is replaced.",
            show_default=False,
        ),
    ],
    backbone: Annotated[
        str,
        typer.Option(
            help=(
                "'embedded', a checkpoint's folder or file, or a Hugging Face model's folder or id."
            )
        ),
    ] = "embedded",
    vqa: Vqa = "scenes",
    skip_bad: SkipBad = False,
    samples: Annotated[
        int,
        typer.Option(
            help="Number of (image, question) pairs; of files, at most.", callback=positive
        ),
    ] = 3000,
    parts: Annotated[
        str, typer.Option(help=f"What to measure, of {','.join(ANCHOR_PARTS)}.")
    ] = ",".join(Anchor().parts),
    energy: Annotated[
        float,
        typer.Option(help="Share of each map's input energy up to which eigenvectors are kept."),
    ] = Anchor().energy,
    fisher_samples: Annotated[
        int, typer.Option(help="Questions of the Fisher information.", callback=positive)
    ] = Anchor().fisher_samples,
    batch_size: BatchSize = 64,
    seed: Annotated[int, typer.Option(help="Seed of the question set.", callback=seed_number)] = 0,
    as_json: Json = False,
) -> None:
    """Measure what the backbone does with questions: activations, inputs, curvature, Fisher
    information.

    \b
    moments:   a Gaussian a layer and token type (aegis)
    inputs:    the directions in which each map reads (nullspace, and every method's leak)
    curvature: how much answers mind each direction in which a map reads and writes (kfac)
    fisher:    how much each parameter matters to the answers (ewc)
    Example: aegis anchor --backbone embedded --samples 3000 --out anchor.safetensors
    """
    keys = {
        "vqa": vqa,
        "skip_bad": skip_bad,
        "samples": samples,
        "batch_size": batch_size,
        "seed": seed,
        "energy": energy,
    }
    settings = read_anchor({**keys, "fisher_samples": fisher_samples, "parts": parts.split(",")})
    from aegis_cli.anchors import measure as stage

    with render.progress() as on_event:
        report = stage.run(backbone, settings, out, on_event=on_event)
    render.show(report, render.facts, as_json)


@app.command(short_help="Fine-tune a backbone on demonstrations, or on a stream.")
def train(
    recipe: RecipeArg,
    out: Annotated[
        Path, typer.Option(metavar="FOLDER", help="Run folder to write.", show_default=False)
    ],
    demos: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="Demonstrations: a file, or a LeRobot folder; none for a stream.",
            show_default=False,
        ),
    ] = None,
    method: Annotated[
        str | None,
        typer.Option(
            metavar="METHOD",
            show_default=False,
            help=(
                f"{', '.join(METHODS)}; of a stream {', '.join(LEARNERS)}; default: the "
                "recipe's train.method."
            ),
        ),
    ] = None,
    anchor: AnchorIn = None,
    resume: Resume = False,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run",
            help="Check all, estimate memory and disk, train nothing; exit 1 if they do not fit.",
        ),
    ] = False,
    overrides: Set = None,
    as_json: Json = False,
) -> None:
    """Fine-tune the backbone and an action expert on demonstrations, or a dual encoder on a stream
    of tasks.

    \b
    Example: aegis train recipes/reach.yaml --method aegis --demos reach.safetensors \\
                 --anchor anchor.safetensors --out runs/x
    Example: aegis train recipes/igsp-stream.yaml --method igsp --out runs/y
    """
    chosen = [f"train.method={method}"] if method is not None else []
    resolved = load_training(recipe, (overrides or []) + chosen)
    if isinstance(resolved, (StreamRecipe, RobotStreamRecipe)):
        return stream_commands.train(
            resolved,
            out,
            resume,
            {"--demos": demos, "--anchor": anchor, "--dry-run": dry_run},
            as_json,
        )
    if demos is None:
        fix = "record some with aegis demos, and give them as --demos"
        raise AegisError(
            f"no --demos for '{recipe}'", "demonstrations: a file, or a LeRobot folder", fix
        )
    if dry_run:
        from aegis_cli.training import dry_run as stage
    else:
        from aegis_cli.training import train as stage

    with render.progress() as on_event:
        report = stage.run(
            resolved, resolved.train.method, demos, anchor, out, resume=resume, on_event=on_event
        )
    render.show(report, render.facts, as_json)
    if dry_run and (shortage := stage.shortage(report)) is not None:
        render.note(f"gate failed: {shortage}")
        raise typer.Exit(1)


@app.command(short_help="Measure what a model still knows, and its drift.")
def probe(
    ctx: typer.Context,
    target: Annotated[
        str,
        typer.Argument(
            metavar="RUN_OR_BACKBONE",
            help="A run's or checkpoint's folder, a backbone, or 'embedded'.",
            show_default=False,
        ),
    ],
    vqa: Vqa = "scenes",
    baseline: Annotated[
        str | None,
        typer.Option(help="Run or backbone to measure the drop against.", show_default=False),
    ] = None,
    anchor: AnchorIn = None,
    questions: Annotated[
        int,
        typer.Option(help="Number of held-out questions; of files, at most.", callback=positive),
    ] = 5000,
    skip_bad: SkipBad = False,
    predictions: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Also write every answer, a JSON line each.", show_default=False
        ),
    ] = None,
    max_drop: Annotated[
        float | None,
        typer.Option(
            help="Exit 1 if accuracy drops by more percentage points than this.",
            callback=not_negative,
            show_default=False,
        ),
    ] = None,
    batch_size: BatchSize = 64,
    as_json: Json = False,
) -> None:
    """Measure what the VLM still knows, and its drift; of a stream, the accuracy on every task.

    \b
    Of question files it asks about half of the images, which no anchor is ever measured on.
    Example: aegis probe runs/x --baseline embedded --anchor anchor.safetensors --max-drop 0.5
    """
    if is_stream_run(Path(target)):
        return stream_commands.probe(Path(target), given(ctx), as_json)
    if max_drop is not None and baseline is None:
        raise AegisError(
            "--max-drop without --baseline",
            "something to measure the drop against",
            "add --baseline embedded",
        )
    from aegis_cli.evaluation import probe as stage

    with render.progress() as on_event:
        report = stage.run(
            target,
            vqa,
            questions,
            baseline,
            anchor,
            max_drop,
            batch_size=batch_size,
            predictions=predictions,
            skip_bad=skip_bad,
            on_event=on_event,
        )
    render.show(report, render.probe, as_json)
    if report.passed is False:
        render.note(
            f"gate failed: dropped {report.drop_points:.2f} points, more than --max-drop "
            f"{max_drop:g}"
        )
        raise typer.Exit(1)


@app.command(short_help="Say what a file, recipe, run, study or dataset is.")
def inspect(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="PATH",
            help=(
                "A recipe, artifact, model (also 'embedded'), or the folder of a run, "
                "checkpoint, study or LeRobot dataset."
            ),
            show_default=False,
        ),
    ],
    plot: Annotated[
        Path | None,
        typer.Option(
            metavar="PNG",
            help=(
                "Also draw a run's energy shed, a stream's routing, a study's frontier, or a "
                "dataset's frames."
            ),
            show_default=False,
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Say what a file, run or dataset is; a run's energies, a stream's routing, a study's tables as
    far as it is finished.

    Of a recipe, every key with its value: the file's own, or the default.

    \b
    Example: aegis inspect runs/x --plot energy.png
    Example: aegis inspect recipes/quickstart.yaml
    """
    inspect_commands.show(path, plot, as_json)


@app.command(short_help="Let a trained policy act, and count its successes.")
def rollout(
    run: Annotated[
        Path,
        typer.Argument(
            metavar="RUN", help="A run's folder, or one of its checkpoints'.", show_default=False
        ),
    ],
    task: Annotated[
        str | None,
        typer.Option(help=f"{TASK.expected}; default: the run's task.", show_default=False),
    ] = None,
    episodes: Episodes = 50,
    colors: Annotated[
        Colors, typer.Option(help="Colours the targets are drawn from.")
    ] = Colors.seen,
    video: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write a .mp4 or .gif.", show_default=False),
    ] = None,
    as_json: Json = False,
) -> None:
    """Let a trained policy act in closed loop and count its successes; of a suite task, its return.

    \b
    Example: aegis rollout runs/x --task reach --episodes 50 --colors held-out --video out.mp4
    """
    from aegis_cli.deploy import load_acting
    from aegis_cli.evaluation import rollout as stage

    with render.progress() as on_event:
        report = stage.run(
            run, task, episodes, colors.value, video, on_event=on_event, load=load_acting
        )
    render.show(report, render.measured, as_json)


for whole, short in job_commands.COMMANDS.items():
    app.command(short_help=short)(whole)


def main() -> None:
    """The console script."""
    app(prog_name="aegis")
