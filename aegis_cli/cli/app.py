"""The `aegis` command. Each of its commands parses arguments, calls one stage and shows its report.

stages.py defines which stage that is, and exits.py the exit codes.
"""

from __future__ import annotations

import faulthandler
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from aegis_cli.cli import (
    advice,
    inspecting,
    question_sets,
    render,
    reporting,
    resuming,
    stages,
)
from aegis_cli.cli.exits import GOES_ON, LIGHTER, Commands, ended_by
from aegis_cli.cli.options import (
    Against,
    AnchorIn,
    Ask,
    BackboneName,
    BatchSize,
    Colors,
    Device,
    DropBelow,
    Dtype,
    Ensemble,
    Episodes,
    Format,
    Gate,
    Json,
    MovedBackbone,
    OfStream,
    Overwrite,
    OwnAsk,
    OwnBatchSize,
    OwnVqa,
    PolicyArg,
    PolicyFormat,
    Precision,
    RecipeAction,
    RecipeArg,
    RecipeOrRunArg,
    Rename,
    Resume,
    ResumePretraining,
    Set,
    SkipBad,
    StoredIn,
    VlmPrefix,
    Vqa,
    Wide,
    above_zero,
    demonstrations_path,
    episode_numbers,
    given,
    listed_episodes,
    made,
    names,
    not_negative,
    numbers,
    port_number,
    positive,
    renaming,
    seed_number,
    share_or_one,
    strengths,
)
from aegis_cli.common import commands, files, garbage, interrupts, launch
from aegis_cli.common.errors import AegisError
from aegis_cli.common.version import __version__
from aegis_cli.data.selection import Paths, Selection
from aegis_cli.merging.settings import DAMPING, MergeSettings
from aegis_cli.recipes import (
    ANCHOR_PARTS,
    LEARNERS,
    MERGES,
    METHODS,
    RECORDED,
    TASK,
    Anchor,
    Recipe,
    RobotStreamRecipe,
    StreamRecipe,
    StudyRecipe,
    is_robot_stream_run,
    is_stream_run,
    load_pretrain,
    load_training,
    read_anchor,
    shipped,
)
from aegis_cli.recipes.strict_yaml import did_you_mean
from aegis_cli.recipes.study_cells import load as load_run
from aegis_cli.studies.metrics import deciding_decimals

app = typer.Typer(
    cls=Commands,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


@app.callback(invoke_without_command=True)
def aegis(
    ctx: typer.Context,
    version: Annotated[bool, Option("--version", help="Print the version.")] = False,
) -> None:
    """Fine-tune a vision-language model into a robot policy without losing what it knew.

    \b
    Start with: aegis run recipes/quickstart.yaml
    Exit codes: 0 done, 1 a gate failed, 2 a problem to fix, 3 a defect, 130 Ctrl-C
    """
    if version:
        typer.echo(f"aegis {__version__}")
    elif ctx.invoked_subcommand is None:
        typer.echo(ctx.get_help())


@app.command(short_help="Record demonstrations of a simulated task.")
def demos(
    task: Annotated[str, Argument(metavar="TASK", help=f"Task: {RECORDED}.")],
    out: Annotated[
        Path,
        Option(
            metavar="PATH",
            help="File to write, replacing one that is there; for lerobot, a new folder.",
        ),
    ],
    episodes: Episodes = 300,
    seed: Annotated[
        int, Option(help="Seed; equal seeds give equal bytes.", callback=seed_number)
    ] = 0,
    noise: Annotated[
        float,
        Option(
            help="Standard deviation of the noise on executed actions, 1 = full range.",
            callback=not_negative,
        ),
    ] = 0.3,
    preview: Annotated[Path | None, Option(metavar="PNG", help="Also write a contact sheet.")] = (
        None
    ),
    form: Annotated[
        Format, Option("--format", help="One file, or a LeRobot dataset v3.0.")
    ] = Format.safetensors,
    video: Annotated[
        bool, Option("--video", help="Keep a LeRobot dataset's frames as H.264, not as PNG.")
    ] = False,
    drop_below: DropBelow = None,
    camera: Annotated[
        list[str] | None,
        Option(
            metavar="NAME",
            help="For lerobot, a camera of MetaWorld's, e.g. gripperPOV; repeatable.",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Record demonstrations: noisy execution, clean expert labels.

    For a suite task, a planner is the expert, and enough episodes are recorded that --episodes of
    them are left after dropping. The tasks of a set of MetaWorld's, such as metaworld/mt4, take
    turns.

    \b
    Example: aegis demos reach --episodes 300 --out reach.safetensors
    Example: aegis demos reach --episodes 300 --format lerobot --out reach-dataset
    Example: aegis demos suite/cartpole-swingup --episodes 4 --drop-below 0.2 \\
                 --out cartpole.safetensors
    Example: aegis demos metaworld/mt4 --episodes 400 --out mt4.safetensors
    Example: aegis demos metaworld/door-open --format lerobot --out door-dataset \\
                 --camera corner2 --camera gripperPOV
    """
    stages.DEMOS.run(
        task,
        episodes,
        seed,
        out,
        noise=noise,
        preview=preview,
        form=form.value,
        as_video=video,
        drop_below=drop_below,
        cameras=camera or (),
        as_json=as_json,
    )


@app.command(short_help="Measure what the backbone knows, before it is fine-tuned.")
def anchor(
    ctx: typer.Context,
    out: Annotated[
        Path, Option(metavar="FILE", help="Anchor to write; a file that is there is replaced.")
    ],
    backbone: BackboneName = "embedded",
    vqa: Vqa = "scenes",
    ask: Ask = "{}",
    skip_bad: SkipBad = False,
    demos: Annotated[
        Path | None,
        Option(
            parser=demonstrations_path,
            metavar="PATH",
            help="Measure moments on the frames of these demonstrations instead of on questions.",
        ),
    ] = None,
    camera: Annotated[
        list[str] | None,
        Option(metavar="NAME", help="Camera of a LeRobot folder in --demos; repeatable."),
    ] = None,
    only: Annotated[
        str | None,
        Option(
            metavar="LIST",
            help="Episodes of --demos to read, as demos.only names them; default: all.",
        ),
    ] = None,
    rename: Rename = None,
    samples: Annotated[
        int,
        Option(
            help="(image, question) pairs or frames to measure on; fewer if the files hold fewer.",
            callback=positive,
        ),
    ] = 3000,
    parts: Annotated[str, Option(help=f"What to measure, of {','.join(ANCHOR_PARTS)}.")] = ",".join(
        Anchor().parts
    ),
    energy: Annotated[
        float,
        Option(help="Share of each map's input energy up to which eigenvectors are kept."),
    ] = Anchor().energy,
    fisher_samples: Annotated[
        int, Option(help="Number of questions for the Fisher information.", callback=positive)
    ] = Anchor().fisher_samples,
    exact_width: Annotated[
        int,
        Option(
            help="Widest linear map whose directions are found exactly; those of wider ones are "
            "found by a random sketch.",
            callback=positive,
        ),
    ] = Anchor().exact_width,
    tokens: Annotated[
        float,
        Option(
            help="Share of the tokens and patches that inputs are measured on, drawn anew in each "
            "pass."
        ),
    ] = Anchor().tokens,
    temperature: Annotated[
        float,
        Option(
            help="Divides the answers' scores for the curvature; 4 for a backbone that is sure of "
            "its answers."
        ),
    ] = Anchor().temperature,
    memory: Annotated[
        int | None,
        Option(
            metavar="MB",
            help="What the sums of inputs or curvature may take: maps are then measured in groups, "
            "each in separate passes; default: all at once.",
        ),
    ] = None,
    batch_size: BatchSize = 64,
    seed: Annotated[int, Option(help="Seed of the question set.", callback=seed_number)] = 0,
    device: Device = None,
    as_json: Json = False,
) -> None:
    """Measure how the backbone answers: activations, inputs, curvature, Fisher information.

    \b
    moments:   a Gaussian per layer and token type (aegis)
    inputs:    the directions in which each map reads (nullspace)
    curvature: how sensitive answers are to what each map reads and writes (kfac)
    fisher:    how much each parameter matters to the answers (ewc)
    Example: aegis anchor --samples 3000 --out anchor.safetensors
    Example: aegis anchor --demos reach.safetensors --out robot-anchor.safetensors
    """
    chosen = set(given(ctx))
    _check_frames_or_questions(demos is not None, chosen)
    if demos is not None and "--parts" not in chosen:
        parts = "moments"  # the option's default asks for parts that need answers
    settings = read_anchor(
        {
            "source": "questions" if demos is None else "demos",
            "vqa": vqa,
            "skip_bad": skip_bad,
            "ask": ask,
            "samples": samples,
            "batch_size": batch_size,
            "seed": seed,
            "energy": energy,
            "fisher_samples": fisher_samples,
            "exact_width": exact_width,
            "tokens": tokens,
            "temperature": temperature,
            "memory": memory,
            "parts": parts.split(","),
        }
    )
    if demos is None:
        advice.of_questions(backbone, vqa)
    stages.ANCHOR.run(
        backbone,
        settings,
        out,
        demos=demos,
        selection=Selection(_cameras(camera), only, rename=renaming(rename)),
        device=device,
        as_json=as_json,
    )


# Options without a meaning for an anchor measured on questions -> what they would need.
_OF_FRAMES = {
    "--camera": "demonstrations to choose a camera of",
    "--only": "demonstrations to choose episodes of",
    "--rename": "demonstrations with names of their own",
}
_OF_QUESTIONS = {"--vqa", "--ask", "--skip-bad"}


def _check_frames_or_questions(reads_frames: bool, chosen: set[str]) -> None:
    """Raise AegisError for options of `anchor` that do not apply to its source."""
    if reads_frames:
        unused = _OF_QUESTIONS & chosen
        if unused:
            found = f"{', '.join(sorted(unused))} with --demos"
            raise AegisError(found, "questions or robot frames", "leave one of them out")
        return
    for option, wanted in _OF_FRAMES.items():
        if option in chosen:
            fix = f"give the LeRobot folder as --demos, or leave {option} out"
            raise AegisError(f"{option} without --demos", wanted, fix)


def _cameras(names: list[str] | None) -> str | tuple[str, ...] | None:
    """Cameras as in a recipe's `demos.camera`: none, one name, or several."""
    if not names:
        return None
    return names[0] if len(names) == 1 else tuple(names)


@app.command(short_help="Fine-tune a backbone on demonstrations, or on a stream.")
def train(
    ctx: typer.Context,
    recipe: RecipeOrRunArg,
    out: Annotated[
        Path | None,
        Option(
            metavar="FOLDER", help="Run folder to write; not needed to resume a run by its folder."
        ),
    ] = None,
    demos: Annotated[
        list[Path] | None,
        Option(
            parser=demonstrations_path,
            metavar="PATH",
            help="Demonstrations: a file, the folder of a LeRobot dataset, or its id on the hub; "
            "default: the recipe's demos.path; none for a stream. Repeatable, to learn from "
            "several sets of one robot.",
        ),
    ] = None,
    method: Annotated[
        str | None,
        Option(
            "--method",
            metavar="METHOD",
            help=f"{', '.join(METHODS)}; for a stream {', '.join(LEARNERS)}; default: the recipe's "
            "train.method.",
        ),
    ] = None,
    anchor: AnchorIn = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
    dry_run: Annotated[
        bool,
        Option(
            "--dry-run",
            help="Check all inputs, estimate memory, disk and hours (policies and streams of robot "
            "tasks), and write nothing but the cache of decoded frames, which the training then "
            "reads; exit 1 if memory or disk does not suffice.",
        ),
    ] = False,
    overrides: Set = None,
    device: Device = None,
    as_json: Json = False,
) -> None:
    """Fine-tune a backbone and an action expert on demonstrations, or a model on a stream of tasks.

    \b
    Example: aegis train reach --method aegis --demos reach.safetensors \\
                 --anchor anchor.safetensors --out runs/x
    Example: aegis train recipes/igsp-stream.yaml --method igsp --out runs/y
    Example: aegis train runs/x
    """
    if resume and overwrite:
        raise AegisError("--resume with --overwrite", "one of them", "leave one out")
    run = recipe if recipe.is_dir() else None
    if run is not None:
        recipe, out, resume = resuming.recipe_of(run, out), run, not overwrite
    # Last, so that --method also overrides --set train.method.
    chosen = [f"train.method={method}"] if method is not None else []
    # Before a missing --out is reported, because the recipe's path may be mistyped.
    resolved = load_training(recipe, (overrides or []) + chosen)
    if out is None:
        fix = commands.aegis("train", recipe, "--out", "runs/NAME")
        raise AegisError("no --out", "a folder for the run", fix)
    if run is not None and isinstance(resolved, Recipe):
        demos, anchor = resuming.inputs_of(run, resolved, demos or [], anchor)
        resuming.check_here(run, resolved)
    # If a signal ends the command, exits.py asks for the command that resumes the run (GOES_ON).
    as_they_are = _kept_options(ctx, device, as_json)
    advice.of_settings(resolved, overrides or [])
    if not isinstance(resolved, Recipe):
        no_dry_run = dry_run and isinstance(resolved, StreamRecipe)
        unused = {"--demos": demos, "--anchor": anchor, "--dry-run": no_dry_run}
        given_in_vain = [name for name, value in unused.items() if value]
        stages.refuse_options(given_in_vain, f"of '{resolved.name}'")
        if isinstance(resolved, RobotStreamRecipe):
            advice.of_questions(resolved.backbone, resolved.probe.only_set)
            if run is not None:
                resuming.check_seen(run, [resolved.probe.only_set], "train")
        options = {"resume": resume, "overwrite": overwrite, "device": device, "as_json": as_json}
        _train_stream(ctx, resolved, out, as_they_are, dry_run, options)
        return
    paths, resolved = _learned_from(resolved, recipe, demos or [])
    advice.of_training(resolved, anchor)
    if not dry_run:
        own = resolved, out, paths, anchor, as_they_are
        ctx.meta[GOES_ON] = partial(resuming.command, *own)
        ctx.meta[LIGHTER] = partial(resuming.lighter, *own)
    stage = stages.DRY_RUN if dry_run else stages.TRAIN[Recipe]
    # The gate's verdict is printed inside the block, but the process ends outside of it: an exit
    # code other than 0 also ends the other processes, which may still be writing.
    with stages.joined(device):
        report = stage.run(
            resolved,
            resolved.train.method,
            paths,
            anchor,
            out,
            resume=resume,
            overwrite=overwrite,
            device=device,
            as_json=as_json,
        )
        failed = stage.module.shortage(report) if dry_run else None
        _say_gate(failed)
    _end_at_gate(failed)


def _train_stream(
    ctx: typer.Context,
    recipe: StreamRecipe | RobotStreamRecipe,
    out: Path,
    as_they_are: Sequence[str],
    dry_run: bool,
    options: Mapping[str, Any],
) -> None:
    """Train on a stream, or only measure what that needs.

    Args:
        as_they_are: options that a command to resume the run repeats.
        options: those of the stage.
    """
    if dry_run:
        stage = stages.DRY_RUN_STREAM
        report = stage.run(recipe, out, **options)
        _gate(stage.module.shortage(report))
        return
    more = out, None, None, as_they_are
    ctx.meta[GOES_ON] = partial(resuming.command, recipe, *more)
    if isinstance(recipe, RobotStreamRecipe):
        ctx.meta[LIGHTER] = partial(resuming.lighter, recipe, *more)
    stages.TRAIN[type(recipe)].run(recipe, out, **options)


def _kept_options(ctx: typer.Context, device: str | None, as_json: bool) -> list[str]:
    """The options of this command that a command to resume the run repeats, as words."""
    # Without a device from AEGIS_DEVICE, which the next command reads too.
    kept = ["--device", str(device)] if "--device" in given(ctx) else []
    return kept + (["--json"] if as_json else [])


def _learned_from(recipe: Recipe, file: Path, demos: Sequence[Path]) -> tuple[Paths, Recipe]:
    """The demonstrations of a training, and its recipe, which names no others.

    Several given sets are always written into the recipe, which records what the run trained on.

    Raises:
        AegisError: neither the command nor the recipe names any.
    """
    named = recipe.demos.path
    if not demos:
        if named is None:
            raise AegisError(
                f"no --demos for '{file}', which names none as demos.path",
                "demonstrations: a file, the folder of a LeRobot dataset, or its id on the hub",
                "record some with aegis demos, and give them as --demos",
            )
        return _paths(named), recipe
    told = str(demos[0]) if len(demos) == 1 else tuple(map(str, demos))
    if named is not None or len(demos) > 1:
        recipe = replace(recipe, demos=replace(recipe.demos, path=told))
    return _paths(told), recipe


def _paths(named: str | tuple[str, ...]) -> Paths:
    """One set of demonstrations or several, as named in a recipe."""
    if isinstance(named, str):
        return demonstrations_path(named)
    return tuple(map(demonstrations_path, named))


@app.command(short_help="Move a fine-tuned backbone back, where its task allows it.")
def merge(
    target: Annotated[
        str,
        Argument(
            metavar="RUN_OR_MODEL",
            help="A run's or checkpoint's folder, or a fine-tuned model's folder or file.",
        ),
    ],
    method: Annotated[
        str, Option("--method", metavar="METHOD", help=f"Rule of the merge: {', '.join(MERGES)}.")
    ] = "factors",
    strength: Annotated[
        float | None,
        Option(help="How far back; 0 changes nothing.", callback=not_negative),
    ] = None,
    out: Annotated[
        Path | None,
        Option(
            metavar="FOLDER",
            help="New folder for the merged run or model; needed with --strength or --max-drop.",
        ),
    ] = None,
    sweep: Annotated[
        str | None,
        Option(
            metavar="LIST",
            help="Strengths to try, e.g. 1,10,100; default without --strength: the method's grid.",
            callback=strengths,
        ),
    ] = None,
    max_drop: Annotated[
        float | None,
        Option(
            help="Write the weakest merge that loses at most these percentage points of accuracy "
            "on validation questions; exit 1 if none does.",
            callback=not_negative,
        ),
    ] = None,
    gate: Annotated[
        Gate | None,
        Option(
            help="What --max-drop limits: the drop as measured (mean, the default), or the upper "
            "end of its 95 % interval.",
        ),
    ] = None,
    base: Annotated[
        str | None, Option(help="The pre-trained model; default: the run's own backbone.")
    ] = None,
    demos: Annotated[
        list[Path] | None,
        Option(
            parser=demonstrations_path,
            metavar="PATH",
            help="Demonstrations of the run; default: those that it was trained on. Repeatable, "
            "for a run that learned from several sets, in their order.",
        ),
    ] = None,
    anchor: AnchorIn = None,
    vqa: OwnVqa = None,
    task_vqa: Annotated[
        str | None,
        Option(metavar="SET", help="For a model without a run: questions of the task it learned."),
    ] = None,
    ask: OwnAsk = None,
    skip_bad: SkipBad = False,
    samples: Annotated[
        int,
        Option(help="Questions to measure on if there is no --anchor.", callback=positive),
    ] = 1000,
    temperature: Annotated[
        float,
        Option(
            help="Without --anchor: divides the answers' scores before the words for the curvature "
            "are drawn; 4 for a model that is sure of its answers.",
            callback=above_zero,
        ),
    ] = 1.0,
    frames: Annotated[
        int, Option(help="Robot frames to measure on, at most.", callback=positive)
    ] = 1000,
    questions: Annotated[
        int,
        Option(help="Validation questions of a sweep; for files, the maximum.", callback=positive),
    ] = 2100,
    damping: Annotated[
        float,
        Option(help="Added to every curvature, whose mean is 1.", callback=share_or_one),
    ] = DAMPING,
    batch_size: OwnBatchSize = None,
    plot: Annotated[
        Path | None, Option(metavar="PNG", help="Also draw the sweep: points lost over the loss.")
    ] = None,
    device: Device = None,
    as_json: Json = False,
) -> None:
    """Move a fine-tuned backbone back towards the pre-trained one, after its training.

    The action expert stays as it is. With --strength one merge is written. Without it several are
    tried on validation data, and --max-drop chooses the one to write.

    \b
    linear:      all weights go the same share of the way; 1 is all (WiSE-FT)
    kfac-shrink: maps go back most where answers are sensitive to them
    inputs:      maps go back least in the directions that robot frames use
    factors:     maps go back least where the robot's task is sensitive to them
    Example: aegis merge runs/x --demos reach.safetensors --strength 10 \\
                 --out runs/merged
    Example: aegis merge runs/x --demos reach.safetensors --max-drop 0.5 \\
                 --out runs/merged
    Example: aegis merge tuned/ --base models/vlm --method linear \\
                 --strength 0.4 --out merged
    """
    if method not in MERGES:
        near = did_you_mean(method, MERGES)
        fix = f"did you mean --method {near}?" if near else "e.g. --method factors"
        raise AegisError(f"--method {method}", f"one of {', '.join(MERGES)}", fix)
    _check_sweep(strength, sweep, max_drop, gate, out, plot)
    # A sweep always needs questions to be judged; a single merge needs them only for curvature.
    asks_nothing = strength is not None and (method == "linear" or anchor is not None)
    if asks_nothing and vqa is not None:
        reason = "--method linear" if method == "linear" else "--anchor"
        found = f"--vqa {vqa} with {reason} and --strength, which ask no question"
        raise AegisError(found, "questions that are asked", "leave --vqa out, or give a sweep")
    asks = question_sets.chosen(target, vqa, ask, skip_bad, batch_size)
    if not asks_nothing:
        advice.of_questions(target, asks.only_set)
    settings = MergeSettings(
        method=method,
        damping=damping,
        base=base,
        demos=tuple(demos) if demos else None,
        anchor=anchor,
        vqa=asks.only_set,
        ask=asks.ask,
        skip_bad=asks.skip_bad,
        task_vqa=task_vqa,
        samples=samples,
        temperature=temperature,
        frames=frames,
        questions=questions,
        batch_size=asks.batch_size,
    )
    report = stages.MERGE.run(
        target,
        settings,
        out,
        strength,
        numbers(sweep),  # empty without --sweep; the stage then uses the method's grid
        max_drop,
        gate=(gate or Gate.mean).value,
        device=device,
        as_json=as_json,
    )
    if plot is not None:
        render.merge_plot(report, plot)
    if report.passed is False:
        _gate(f"no strength of the sweep keeps the drop within --max-drop {max_drop:g}")


def _check_sweep(
    strength: float | None,
    sweep: str | None,
    max_drop: float | None,
    gate: Gate | None,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Raise AegisError for options of `merge` that do not go together, before any work."""
    of_sweep = {"--sweep": sweep, "--max-drop": max_drop, "--gate": gate, "--plot": plot}
    given_too = [name for name, value in of_sweep.items() if value is not None]
    if strength is not None and given_too:
        options = " and ".join(given_too)
        raise AegisError(
            f"--strength with {options}, of a sweep",
            "one strength, or a sweep",
            f"leave out --strength, or {options}",
        )
    if gate is not None and max_drop is None:
        expected, fix = "a limit to hold the drop to", "add --max-drop POINTS, or leave --gate out"
        raise AegisError(f"--gate {gate.value} without --max-drop", expected, fix)
    writes = strength is not None or max_drop is not None
    if writes and out is None:
        name = "--strength" if strength is not None else "--max-drop"
        raise AegisError(f"{name} without --out", "a folder to write", "add --out FOLDER")
    if out is not None and not writes:
        found = f"--out {out} with a sweep that chooses nothing"
        fix = "add --max-drop POINTS, or give one --strength"
        raise AegisError(found, "something that says what to write", fix)
    if plot is not None:
        render.check_plot(plot)
        files.check_writable(plot)


@app.command(short_help="Measure what a model still knows, and its drift.")
def probe(
    ctx: typer.Context,
    target: Annotated[
        str,
        Argument(
            metavar="RUN_OR_BACKBONE",
            help="A run's, checkpoint's or exported folder, a backbone, 'embedded', or a policy's "
            "or model's id on the hub.",
        ),
    ],
    vqa: OwnVqa = None,
    baseline: Annotated[
        str | None,
        Option(
            help="Run or backbone to measure the drop against; none: measure only the accuracy. "
            "Default: the model that a run began from; without a gate or --anchor, only if it "
            "is on this machine."
        ),
    ] = None,
    anchor: AnchorIn = None,
    questions: Annotated[
        int | None,
        Option(
            help="Number of held-out questions; for files, the maximum; default: a run's own "
            "probe.questions, else 5000.",
            callback=positive,
        ),
    ] = None,
    seed: Annotated[
        int | None,
        Option(
            help="Seed of the choice of questions; default: a run's own probe.seed, else 0.",
            callback=seed_number,
        ),
    ] = None,
    ask: OwnAsk = None,
    skip_bad: SkipBad = False,
    predictions: Annotated[
        Path | None,
        Option(metavar="FILE", help="Also write every answer, one JSON line per question."),
    ] = None,
    max_drop: Annotated[
        float | None,
        Option(
            help="Exit 1 if accuracy drops by more percentage points than this; default: a run's "
            "own probe.max_drop, for the questions that its recipe names, else no gate.",
            callback=not_negative,
        ),
    ] = None,
    gate: Annotated[
        Gate | None,
        Option(
            help="What --max-drop limits: the drop as measured, or the upper end of its 95 % "
            "interval, so that too few questions cannot pass; default: a run's own probe.gate, "
            "else mean.",
        ),
    ] = None,
    batch_size: OwnBatchSize = None,
    backbone: MovedBackbone = None,
    demos: Annotated[
        list[Path] | None,
        Option(
            parser=demonstrations_path,
            metavar="PATH",
            help="New place of the demonstrations of a stream of tasks without a simulator: repeat "
            "it for each task, in their order, or give one path where the recipe has one. Default: "
            "where the stream found them.",
        ),
    ] = None,
    device: Device = None,
    as_json: Json = False,
) -> None:
    """Measure what the VLM still knows, and its drift; for a stream, the accuracy on every task.

    The figures of a run are also written into its folder, below results.

    About half of the images of question files are asked about; no anchor is ever measured on them.

    \b
    Example: aegis probe runs/x --max-drop 1 --gate upper
    """
    if is_stream_run(Path(target)):
        own = {"--json", "--device"}
        if is_robot_stream_run(Path(target)):
            own |= set(_OF_ROBOT_STREAMS)
        options = [name for name in given(ctx) if name not in own]
        stages.refuse_options(options, f"in '{target}'")
        if is_robot_stream_run(Path(target)):
            own_recipe = load_training(Path(target) / "recipe.yaml")
            assert isinstance(own_recipe, RobotStreamRecipe)
            resuming.check_seen(Path(target), [own_recipe.probe.only_set], "probe")
        moved = {"backbone": backbone, "demos": demos or []}
        stages.PROBE_STREAM.run(Path(target), device=device, as_json=as_json, **moved)
        return
    if unused := [name for name in _OF_ROBOT_STREAMS if name in given(ctx)]:
        found = f"{', '.join(unused)} with '{target}', which is no stream of robot tasks"
        raise AegisError(found, "no such option here", f"leave out {', '.join(unused)}")
    asks = question_sets.chosen(target, vqa, ask, skip_bad, batch_size, questions, seed)
    limit, is_default = "--max-drop", baseline is None
    if max_drop is None and asks.max_drop is not None and baseline != _NO_BASELINE:
        limit, max_drop = "the recipe's probe.max_drop", asks.max_drop
        if launch.rank() == 0:
            render.note(f"the gate is at a drop of {max_drop:g} points, {limit}")
    baseline = _drop_against(target, baseline, anchor, max_drop, gate)
    gate = Gate(asks.gate) if gate is None else gate
    advice.of_questions(target, asks.only_set)
    with stages.joined(device):
        report = stages.PROBE.run(
            target,
            asks.only_set,
            asks.questions,
            baseline,
            anchor,
            max_drop,
            batch_size=asks.batch_size,
            gate=gate.value,
            predictions=predictions,
            skip_bad=asks.skip_bad,
            ask=asks.ask,
            seed=asks.seed,
            keep=True,
            only_if_own=is_default and max_drop is None and anchor is None,
            device=device,
            as_json=as_json,
        )
        failed = None
        if report.passed is False and max_drop is not None:
            dropped = _dropped(report, gate, max_drop)
            failed = f"{dropped}, more than {limit} {max_drop:g}"
        _say_gate(failed)
    _end_at_gate(failed)


_OF_ROBOT_STREAMS = ("--backbone", "--demos")  # options of `probe`
_NO_BASELINE = "none"  # as --baseline


def _drop_against(
    target: str,
    baseline: str | None,
    anchor: Path | None,
    max_drop: float | None,
    gate: Gate | None,
) -> str | None:
    """The baseline of a probe's drop; None for a probe without one.

    Raises:
        AegisError: a gate without a limit, or a limit with nothing to measure the drop against.
    """
    if max_drop is None and gate is not None:
        expected = "a limit to hold the drop to: that, or probe.max_drop of the run's own recipe"
        fix = "add --max-drop POINTS, or leave --gate out"
        raise AegisError(f"--gate {gate.value} without --max-drop", expected, fix)
    # With an anchor, the drift is shown beside that of the model before fine-tuning.
    if baseline is None:
        needed = max_drop is not None or anchor is not None
        baseline = question_sets.baseline(target, anchor, needed)
    elif baseline == _NO_BASELINE:
        baseline = None
    if max_drop is not None and baseline is None:
        expected = "something to measure the drop against"
        raise AegisError(
            "--max-drop without a baseline", expected, "name one, e.g. --baseline embedded"
        )
    return baseline


def _dropped(report: Any, gate: Gate, max_drop: float) -> str:
    """A probe's drop in words, by the figure that the gate limits."""
    if gate is not Gate.upper_end:
        return f"a drop of {_beyond(report.drop_points, max_drop)} points"
    may_be = _beyond(report.drop_interval[1], max_drop)
    return f"a drop of {report.drop_points:.2f} points, which may be as large as {may_be}"


def _beyond(points: float, max_drop: float) -> str:
    """Points with two decimals, or as many as show that they are past the limit."""
    decimals = deciding_decimals(points, f"<= {max_drop!r}", 2)
    return f"{points:.{decimals}f}"


@app.command(short_help="Say what a file, run, dataset or set of questions is.")
def inspect(
    path: Annotated[
        Path,
        Argument(
            metavar="PATH",
            help="A recipe, artifact, model (also 'embedded'), the folder of a run, checkpoint or "
            "study, a LeRobot dataset or a set of questions, also by its id on the hub.",
        ),
    ],
    plot: Annotated[
        Path | None,
        Option(
            metavar="PNG",
            help="Also draw a run's course (of aegis, the energy that was shed), a stream's "
            "routing, a study's frontier, a dataset's frames, or images with questions.",
        ),
    ] = None,
    verify: Annotated[
        bool,
        Option(
            "--verify",
            help="Read every artifact whole, and compare it with its digest; decode every image "
            "that questions are about.",
        ),
    ] = False,
    tensors: Annotated[
        bool, Option("--tensors", help="Also list the tensors of an artifact or model.")
    ] = False,
    wide: Wide = False,
    as_json: Json = False,
) -> None:
    """Say what a file, run or dataset is, with a run's energies, routing or tables.

    For a run it tells what was trained, how well it does, what was lost, and whether its gate is
    passed, as far as `aegis run`, `aegis probe`, `aegis rollout` and `aegis evaluate` have measured
    that.

    A study's tables are shown as far as they are finished.

    A recipe is shown with every key and its value: the file's own, or the default.

    Of questions it tells which can be used and what is wrong with the others, how many images
    anchors and probes get, and which answers are common.

    \b
    Example: aegis inspect runs/x --plot energy.png
    Example: aegis inspect questions.jsonl --plot questions.png
    Example: aegis inspect runs/x --verify
    Example: aegis inspect recipes/quickstart.yaml
    """
    inspecting.show(path, plot, as_json, tensors, wide, verify)


@app.command(short_help="Compare runs in one table.")
def compare(
    paths: Annotated[
        list[Path],
        Argument(
            metavar="RUN ...",
            help="Folders of runs; a job's, or any other with runs in it, stands for all of them.",
        ),
    ],
    against: Against = None,
    wide: Wide = False,
    as_json: Json = False,
) -> None:
    """Compare runs in one table: what each keeps of VQA, how it acts, and what it costs.

    Shown is what `aegis run`, `aegis probe`, `aegis rollout` and `aegis evaluate` have measured of
    each. A second table has each run's differences from one of them, on the same questions and
    episodes, with 95 % intervals. Streams of the same tasks are compared by the figures of their
    matrices, the VQA that they lost, and how many numbers they store.

    \b
    Example: aegis compare runs/x runs/y
    Example: aegis compare runs
    Example: aegis compare runs/quickstart --against lora
    Example: aegis compare runs/quickstart runs/x --json
    """
    if all(map(is_stream_run, paths)):
        stages.refuse_options(["--against"] if against is not None else [], f"'{paths[0]}'")
        stages.COMPARE_STREAMS.run(paths, wide=wide, as_json=as_json)
        return
    stages.COMPARE.run(paths, against=against, wide=wide, as_json=as_json)


@app.command(short_help="Compare two models' scores on standard benchmarks.")
def scores(
    before: Annotated[
        Path,
        Argument(
            metavar="BEFORE",
            help="Folder that lmms-eval or lm-evaluation-harness wrote with --log_samples, or that "
            "VLMEvalKit wrote of a model.",
        ),
    ],
    after: Annotated[
        Path, Argument(metavar="AFTER", help="The same of the fine-tuned model, on the same tasks.")
    ],
    max_drop: Annotated[
        float | None,
        Option(
            help="Exit 1 if any score drops by more percentage points than this.",
            callback=not_negative,
        ),
    ] = None,
    gate: Annotated[
        Gate,
        Option(
            help="What --max-drop limits: the drop as measured, or the upper end of its 95 % "
            "interval, so that too few questions cannot pass."
        ),
    ] = Gate.mean,
    wide: Wide = False,
    as_json: Json = False,
) -> None:
    """Compare what two models scored on standard benchmarks, question by question.

    lmms-eval asks its benchmarks of any run or backbone as the model aegis:
    lmms-eval --model aegis --model_args pretrained=runs/x --tasks textvqa_val,pope --log_samples
    --output_path scores/x. Both models are asked the same questions, so that the drop is one of
    pairs. VLMEvalKit's tables of verdicts are read too, in .xlsx with the extra benchmarks.

    \b
    Example: aegis scores scores/before scores/x --max-drop 1 --gate upper
    """
    report = stages.SCORES.run(before, after, max_drop, gate.value, wide=wide, as_json=as_json)
    failed = None
    if report.passed is False:
        lost = [s for s in report.scores if not s.passed]
        failing = ", ".join(f"{s.task} ({s.metric})" for s in lost)
        failed = f"{failing} dropped {_past(f'--max-drop {max_drop:g}', gate)}"
    _gate(failed)


@app.command(short_help="Write runs, a job or a study as one HTML page.")
def report(
    paths: Annotated[
        list[Path],
        Argument(
            metavar="PATH ...",
            help="The folder of a run or stream, or one that aegis run wrote: a job or study; or "
            "several folders of runs, for one page that compares them.",
        ),
    ],
    out: Annotated[
        Path | None,
        Option(
            metavar="FILE",
            help="Page to write, ending in .html; default: PATH/report.html, and none for several.",
        ),
    ] = None,
    against: Against = None,
    as_json: Json = False,
) -> None:
    """Write all that a folder holds as one HTML page, which needs no other file and no network.

    The page shows what was trained on what, learning curves, drift per layer, the energy shed, VQA
    by family with wrong answers, success with intervals, videos, a study's frontier, the commands
    that repeat it, and the machine. Several runs are side by side, with paired differences. Its
    figures are those of --json.

    \b
    Example: aegis report runs/quickstart
    Example: aegis report runs/x runs/y --out compared.html
    Example: aegis report runs --against lora
    """
    reporting.write(paths, out, as_json, against)


@app.command(short_help="Let a trained policy act, and count its successes.")
def rollout(
    run: PolicyArg,
    task: Annotated[
        str | None, Option(help=f"Task: {TASK.expected}; default: the run's task.")
    ] = None,
    episodes: Episodes = 50,
    colors: Annotated[Colors, Option(help="Colours the targets are drawn from.")] = Colors.seen,
    seed: Annotated[
        int,
        Option(
            help="Seed of the episodes, none of which is a demonstration's.", callback=seed_number
        ),
    ] = 0,
    ensemble: Ensemble = None,
    delay: Annotated[
        int | None,
        Option(
            metavar="STEPS",
            help="Steps that a prediction takes, during which the robot continues with the "
            "previous chunk; default: it waits.",
        ),
    ] = None,
    guided: Annotated[
        bool,
        Option("--guided", help="With --delay: each chunk continues the previous one."),
    ] = False,
    video: Annotated[Path | None, Option(metavar="FILE", help="Also write a .mp4 or .gif.")] = None,
    backbone: MovedBackbone = None,
    device: Device = None,
    as_json: Json = False,
) -> None:
    """Let a trained policy act in closed loop and count its successes.

    A folder that aegis export wrote, or LeRobot trained on, is taken like a run. The result is also
    written into a run's folder, below results.

    A suite task is measured by its return. The success in each task of a set, by the target's
    colour and by instruction is shown too.

    \b
    Example: aegis rollout runs/x --episodes 50 --colors held-out --video out.mp4
    Example: aegis rollout runs/x --delay 2
    Example: aegis rollout runs/x --task libero/all --episodes 2000
    """
    if guided and delay is None:
        expected = "a delay, in which the chunk goes on that the next one continues"
        raise AegisError("--guided without --delay", expected, "add --delay STEPS, such as 0")
    from aegis_cli.deploy import load_acting  # imports torch

    stages.ROLLOUT.run(
        run,
        task,
        episodes,
        colors.value,
        video,
        # Passed in, since `evaluation` may not import `deploy`.
        load=partial(load_acting, backbone=backbone),
        seed=seed,
        keep=True,
        ensemble=ensemble,
        delay=delay,
        guided=guided,
        device=device,
        as_json=as_json,
    )


@app.command(short_help="Compare predicted actions with recorded ones.")
def evaluate(
    run: PolicyArg,
    task: OfStream = None,
    demos: Annotated[
        Path | None,
        Option(
            parser=demonstrations_path,
            metavar="PATH",
            help="Demonstrations: a file, the folder of a LeRobot dataset, or its id on the hub; "
            "default: those that the run, or its task, learned from.",
        ),
    ] = None,
    episodes: Annotated[
        str | None,
        Option(
            metavar="LIST",
            help="Numbers from 0, e.g. 0,4,7-9; default: the run's validation episodes, or all of "
            "data that it was not trained on.",
            callback=episode_numbers,
        ),
    ] = None,
    frames: Annotated[
        int, Option(help="Frames to predict at, at most, spread evenly.", callback=positive)
    ] = 1000,
    rename: Rename = None,
    seed: Annotated[int, Option(help="Seed of the policy's noise.", callback=seed_number)] = 0,
    batch_size: BatchSize = 64,
    plot: Annotated[
        Path | None,
        Option(metavar="FILE", help="Also draw predicted against recorded actions: .png or .pdf."),
    ] = None,
    backbone: MovedBackbone = None,
    device: Device = None,
    as_json: Json = False,
) -> None:
    """Compare predicted with recorded actions on held-out episodes, for robots without a simulator.

    The error is open loop: each chunk is predicted at a recorded frame and nothing is executed. It
    is reported by dimension of the actions, by steps ahead and by instruction, relative to the
    error of the training's mean action. Where actions are positions, the error of holding the
    current position stands beside it. A run of one policy keeps the figures.

    \b
    Example: aegis evaluate runs/x --plot actions.png
    Example: aegis evaluate runs/x --demos datasets/arm --episodes 40-49
    Example: aegis evaluate runs/bench --task open-drawer
    """
    if plot is not None:  # before the work, which takes minutes
        render.check_plot(plot)
        files.check_writable(plot)
    chosen = listed_episodes(episodes)
    # Traces of some episodes are kept only for a plot.
    asked: list[Any] = [chosen, frames, seed, batch_size, plot is not None]
    options: dict[str, Any] = {"rename": renaming(rename), "device": device, "as_json": as_json}
    if is_robot_stream_run(run):
        report = stages.EVALUATE_STREAM.run(run, task, demos, *asked, backbone=backbone, **options)
    else:
        if backbone is not None:
            raise AegisError(
                f"--backbone with '{run}', which is no stream of robot tasks",
                "no such option: a policy's run holds its backbone",
                "leave out --backbone",
            )
        learned = demos or resuming.demonstrations_of(run)
        report = stages.EVALUATE.run(run, learned, *asked, keep=True, task=task, **options)
    _warn_of(report)
    if plot is not None:
        render.open_loop_plot(report, plot)


def _warn_of(report: Any) -> None:
    """Warn of episodes on which the open-loop error may be too low."""
    if report.trained_on:
        listed = ", ".join(map(str, report.trained_on))
        render.note(f"trained on: {listed}; what is predicted there says nothing of new episodes")
    elif report.split != "validation":
        render.note("an episode that the policy was trained on, here or in other data, flatters it")


@app.command(short_help="Let other programs ask a trained policy.")
def serve(
    run: PolicyArg,
    host: Annotated[
        str, Option(help="Address to listen at; 0.0.0.0 lets every machine connect.")
    ] = "127.0.0.1",
    port: Annotated[int, Option(help="Port; 0 takes a free one.", callback=port_number)] = 8000,
    task: OfStream = None,
    prompt: Annotated[
        str | None, Option(metavar="TEXT", help="Instruction for observations without one.")
    ] = None,
    seed: Annotated[int, Option(help="Seed of the policy's noise.", callback=seed_number)] = 0,
    precision: Annotated[
        Precision,
        Option(help="Number format of matrix products; auto is bf16 on a GPU that has it."),
    ] = Precision.auto,
    ensemble: Ensemble = None,
    backbone: MovedBackbone = None,
    device: Device = None,
    as_json: Json = False,
) -> None:
    """Serve a policy by openpi's websocket protocol until Ctrl-C.

    The stock openpi-client connects to it. The report, printed once the server listens, says where,
    and the keys and sizes of an observation. Lines on stderr say who connects, what is refused, and
    how long the chunks took. There is no password: on an address other than
    127.0.0.1, whoever reaches the machine can ask the policy.

    \b
    Example: aegis serve runs/x
    Example: aegis serve runs/x --port 8001 --prompt 'pick up the cup'
    Example: aegis serve your-name/reach-aegis
    """
    from aegis_cli import serving

    serving.require()  # before the import below, which needs the extra's package
    from aegis_cli.serving import server

    def listening(report: Any) -> None:
        """Show at once where the server listens, since a waiting program may read a pipe."""
        render.show(report, render.serving, as_json)
        sys.stdout.flush()

    # Not a `Stage`, which shows its report at its end: a server shows it at its start.
    with stages.computing_on(device):
        given_to = run, task, host, port, prompt, seed, precision, listening, ensemble, render.note
        server.run(*given_to, backbone=backbone)


@app.command(short_help="Write a trained policy for others, or for LeRobot.")
def export(
    run: PolicyArg,
    out: Annotated[Path, Option(metavar="FOLDER", help="New folder to write.")],
    task: OfStream = None,
    form: Annotated[
        PolicyFormat,
        Option("--format", help="The layout of LeRobot's policies, or that of a checkpoint."),
    ] = PolicyFormat.lerobot,
    dtype: StoredIn = Dtype.source,
    camera: Annotated[
        str | None,
        Option(
            metavar="NAME",
            help="What LeRobot calls the picture of a single camera; default: as in training, else "
            "top.",
        ),
    ] = None,
    backbone: MovedBackbone = None,
    as_json: Json = False,
) -> None:
    """Write a trained policy as a folder in LeRobot's layout, or as a checkpoint to use.

    LeRobot, which is not needed here, loads it with the package lerobot_policy_aegis. In --format
    aegis, transformers loads the folder's backbone, if it is a Hugging Face model. aegis probe,
    rollout and inspect take either.

    A Hugging Face backbone is written in the type that it was stored in before it was trained;
    checkpoints have float32.

    Of a stream of robot tasks the policy of one task is written, with its low-rank terms as part of
    the weights. A task that weighs several experts at a map, as those of igsp may, is refused.

    \b
    Example: aegis export runs/x --format lerobot --out policies/x
    Example: aegis export runs/x --format aegis --dtype bfloat16 --out policies/x
    Example: aegis export runs/bench --task open-drawer --out policies/drawer
    """
    stages.EXPORT.run(
        run,
        out,
        form.value,
        camera,
        dtype=dtype.value,
        task=task,
        backbone=backbone,
        as_json=as_json,
    )


@app.command(short_help="Send a trained policy to the Hugging Face hub.")
def push(
    run: Annotated[
        Path,
        Argument(
            metavar="RUN",
            help="A run's folder, one of its checkpoints', or what aegis export wrote.",
        ),
    ],
    repo: Annotated[
        str, Argument(metavar="ORG/NAME", help="Model repository; made if it is not there.")
    ],
    form: Annotated[
        PolicyFormat | None,
        Option(
            "--format",
            help="The layout of a checkpoint, or that of LeRobot's policies; default: aegis, or "
            "an exported folder's own.",
        ),
    ] = None,
    dtype: StoredIn = Dtype.source,
    private: Annotated[
        bool, Option("--private", help="Make a private repository; refuse a public one.")
    ] = False,
    dry_run: Annotated[
        bool, Option("--dry-run", help="Check everything, list the files, and send nothing.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Send a trained policy with its model card to the Hugging Face hub, in one commit.

    The card has the VQA accuracy before and after with its interval, the gate's verdict, the
    success and the open-loop error, as far as aegis run, aegis probe, aegis rollout and aegis
    evaluate have measured them. A folder of aegis export is sent with its own card.

    \b
    Example: aegis push runs/x your-name/reach-aegis --dry-run
    Example: aegis push runs/x your-name/reach-aegis --format lerobot --private
    """
    stages.PUSH.run(run, repo, form and form.value, private, dry_run, dtype.value, as_json=as_json)


@app.command(short_help="Take the VLM out of a policy trained elsewhere.")
def extract(
    policy: Annotated[
        str,
        Argument(
            metavar="POLICY",
            help="A policy's folder or .safetensors file, as LeRobot or openpi wrote it, or its id "
            "on the hub.",
        ),
    ],
    base: Annotated[
        str,
        Option(
            metavar="MODEL",
            help="The VLM that the policy was made from: a Hugging Face model's folder or id.",
        ),
    ],
    out: Annotated[Path, Option(metavar="FOLDER", help="New folder to write.")],
    dtype: Annotated[
        Dtype,
        Option("--dtype", help="Type of the weights: what --base is stored in, or another."),
    ] = Dtype.source,
    prefix: VlmPrefix = None,
    as_json: Json = False,
) -> None:
    """Take the VLM out of a robot policy that another program trained, as a Hugging Face model.

    aegis probe FOLDER --baseline MODEL tells what it has forgotten. aegis anchor, train and merge
    take the folder as any backbone, and aegis insert puts a VLM back into the policy.

    The policy's tensors are found by their names and shapes. What it does not have, as SmolVLA the
    upper half of its VLM's layers, is the base's, and so are tokenizer and processor.

    \b
    Example: aegis extract pretrained_model --base google/paligemma-3b-pt-224 --out vlm
    """
    stages.EXTRACT.run(policy, base, out, dtype.value, prefix=prefix, as_json=as_json)


@app.command(short_help="Put a VLM back into a policy trained elsewhere.")
def insert(
    vlm: Annotated[
        str,
        Argument(
            metavar="MODEL",
            help="A VLM's folder, such as aegis merge made of what aegis extract wrote.",
        ),
    ],
    into: Annotated[
        str,
        Option(
            metavar="POLICY",
            help="The policy's folder, as LeRobot or openpi wrote it, or its id on the hub.",
        ),
    ],
    out: Annotated[Path, Option(metavar="FOLDER", help="New folder to write.")],
    prefix: VlmPrefix = None,
    as_json: Json = False,
) -> None:
    """Put a VLM back into a robot policy that another program trained, as a new folder.

    The policy's other files are copied, but for .git, .cache and the optimiser's state. The VLM's
    tensors stand under the policy's names, in its types; what the policy does not have is left out.
    What aegis extract took out gives the same weights again, unless --dtype or the base's type has
    rounded them.

    \b
    Example: aegis insert merged --into pretrained_model --out policy
    """
    stages.INSERT.run(vlm, into, out, prefix=prefix, as_json=as_json)


@app.command(short_help="Train the embedded models from scratch.")
def pretrain(
    recipe: RecipeArg,
    out: Annotated[
        Path | None,
        Option(metavar="FOLDER", help="Folder to write; default: runs/<recipe name>."),
    ] = None,
    resume: ResumePretraining = False,
    overrides: Set = None,
    device: Device = None,
    as_json: Json = False,
) -> None:
    """Train the embedded VLM, or the embedded dual encoder, from scratch.

    \b
    Example: aegis pretrain recipes/pretrain-embedded.yaml
    Example: aegis pretrain recipes/pretrain-embedded-easy.yaml
    Example: aegis pretrain recipes/pretrain-dual.yaml
    """
    resolved = load_pretrain(recipe, overrides or [])
    folder = out or Path("runs") / resolved.name
    stages.PRETRAIN[type(resolved)].run(resolved, folder, resume, device=device, as_json=as_json)


@app.command(short_help="Run all stages of a recipe, or a study, and compare.")
def run(
    recipe: RecipeArg,
    overrides: Set = None,
    out: Annotated[
        Path, Option(metavar="FOLDER", help="Folder that gets one folder per recipe.")
    ] = Path("runs"),
    workers: Annotated[
        int,
        Option(
            help="Trainings of a study at a time, each with its share of the cores.",
            callback=positive,
        ),
    ] = 1,
    overwrite: Overwrite = False,
    dry_run: Annotated[
        bool,
        Option(
            "--dry-run",
            help="List the stages, or a study's cells, that would run, and why; for trainings "
            "whose demonstrations and anchor exist, also memory, disk and hours; write nothing but "
            "the cache of decoded frames; exit 1 if memory or disk does not suffice.",
        ),
    ] = False,
    device: Device = None,
    wide: Wide = False,
    as_json: Json = False,
) -> None:
    """Run all stages for all methods of a recipe, or a study of several seeds, and compare.

    What is up to date is skipped, so the same command also resumes; with --overwrite every stage
    runs again. --dry-run says which stages these are. Exits 1 if a method drops by more than
    probe.max_drop.

    \b
    Example: aegis run recipes/quickstart.yaml
    Example: aegis run recipes/quickstart.yaml --dry-run
    Example: aegis run recipes/igsp-compare.yaml
    """
    resolved = load_run(recipe, overrides or [])
    one_run = isinstance(resolved, Recipe)  # otherwise a study of several seeds
    if one_run and workers > 1:
        fix = "leave --workers out: a recipe's methods are timed against each other"
        found = f"--workers {workers} with the recipe '{recipe}'"
        raise AegisError(found, "a study of several seeds", fix)
    advice.of_run(resolved, overrides or [])
    if dry_run:
        plan = stages.PLAN.run(
            resolved, out, overwrite=overwrite, device=device, wide=wide, as_json=as_json
        )
        failed = stages.PLAN.module.shortage(plan) if one_run else None
        _say_gate(failed)
        _end_at_gate(failed)
        return
    stage = stages.RUN[type(resolved)]
    options: dict[str, Any] = {"overwrite": overwrite}
    if not one_run:
        options["workers"] = workers
    with stages.joined(device) if stage.shared else nullcontext():
        report = stage.run(resolved, out, **options, device=device, wide=wide, as_json=as_json)
        if launch.rank() == 0:
            _save_tables(resolved, report, stage)
        failed = None
        if one_run and report.gate_failed:
            limit, gate = f"probe.max_drop {resolved.probe.max_drop:g}", Gate(resolved.probe.gate)
            failed = f"{', '.join(report.gate_failed)} dropped {_past(limit, gate)}"
        _say_gate(failed)
    _end_at_gate(failed)  # after the block, as in `train`


def _save_tables(resolved: Any, report: Any, stage: stages.Stage) -> None:
    """Write the results of a job or study as text and a page, and a study's also as a plot."""
    render.save_table(report, stage.view)
    if isinstance(resolved, StudyRecipe):
        _save_frontier(report)
    reporting.write_of(Path(report.out))  # last, because the page is made from these files


def _save_frontier(report: Any) -> None:
    """Draw a study's frontier beside its table, or print why there is none."""
    if render.has_frontier(report):
        render.frontier_plot(report, Path(report.out) / "frontier.png")
    else:
        render.note("no frontier.png: every training diverged, or nothing tells how well they act")


@app.command(short_help="Compare the methods' step times and peak memory.")
def bench(
    ctx: typer.Context,
    backbone: BackboneName = "embedded",
    batch_size: Annotated[
        int | None,
        Option(help="Frames per step; default: 32, or 2 with --shape.", callback=positive),
    ] = None,
    repeats: Annotated[
        int | None,
        Option(
            help="Rounds, or predictions to time; default: 9, 50, or 2 with --shape.",
            callback=made,
        ),
    ] = None,
    latency: Annotated[
        Path | None,
        Option(metavar="RUN", help="Time this run's policy instead: milliseconds per chunk."),
    ] = None,
    shape: Annotated[
        str | None,
        Option(
            "--shape",
            metavar="SHAPE",
            help="Random weights of a true shape instead: smolvlm2-256m, smolvlm2-500m or "
            "paligemma2-3b.",
        ),
    ] = None,
    chosen: Annotated[
        str | None,
        Option("--methods", metavar="NAMES", help="Methods to compare with naive; default: all."),
    ] = None,
    device: Device = None,
    overrides: Set = None,
    as_json: Json = False,
) -> None:
    """Time the anchor pass, each method's step and the guard, and measure their peak memory.

    The anchor pass is compared with a bare forward pass, each method's step with naive's, and the
    guard with training. --methods compares only some methods, and --set changes keys of the recipe,
    as in --set aegis.refresh=4; both leave the guard out.

    Times are taken in turn, so that a busy machine slows all alike. Memory is measured in a process
    of its own for each method.

    --latency times a trained policy alone, from pictures to actions, one observation at a time.

    --shape makes a Hugging Face model of true size from its configuration, with random weights and
    without a download. It measures each method and each part of an anchor one after the other,
    and says which share of the device's peak a step reaches (MFU).

    \b
    Example: aegis bench --json
    Example: aegis bench --methods aegis --set aegis.refresh=4
    Example: aegis bench --latency runs/x
    Example: aegis bench --shape smolvlm2-256m --methods aegis,kfac --batch-size 8
    """
    # The defaults of --batch-size and --repeats depend on what is timed, so they are set here.
    options = set(given(ctx))
    if latency is not None:
        unused = {"--backbone", "--batch-size", "--shape", "--methods", "--set"}
        _refuse_beside("--latency", options, unused)
        stages.LATENCY.run(latency, repeats or 50, device=device, as_json=as_json)
    elif shape is not None:
        _refuse_beside("--shape", options, {"--backbone"})
        stages.BENCH_SHAPES.run(
            shape,
            names(chosen),
            batch_size or 2,
            repeats or 2,
            overrides or [],
            device=device,
            as_json=as_json,
        )
    else:
        from aegis_cli.guard import Guard  # imports torch

        stages.BENCH.run(
            backbone,
            batch_size or 32,
            repeats or 9,
            guard=Guard,
            chosen=names(chosen),
            overrides=overrides or [],
            device=device,
            as_json=as_json,
        )


def _refuse_beside(option: str, options: set[str], unused: set[str]) -> None:
    """Raise AegisError for options that have no meaning together with `option`."""
    if beside := sorted(unused & options):
        expected = "a run alone, whose policy is timed"
        if option == "--shape":
            expected = "a shape, which is the backbone"
        raise AegisError(f"{', '.join(beside)} with {option}", expected, "leave them out")


@app.command(short_help="List the recipes that come with Aegis, or copy one.")
def recipes(
    action: Annotated[
        RecipeAction,
        Argument(metavar="ACTION", help="List them, show one, or copy one to change it."),
    ] = RecipeAction.ls,
    name: Annotated[str | None, Argument(metavar="NAME", help="Recipe to show or copy.")] = None,
    out: Annotated[
        Path | None,
        Argument(metavar="FILE", help="New file for the copy; default: NAME.yaml in this folder."),
    ] = None,
    as_json: Json = False,
) -> None:
    """List the recipes that come with Aegis, show one, or copy one to change it.

    Commands take a recipe by its name, too, as in aegis run quickstart.

    \b
    Example: aegis recipes ls
    Example: aegis recipes show quickstart
    Example: aegis recipes cp quickstart mine.yaml
    """
    # `ls` takes no argument, `show` one; arguments are in order, so a surplus one is the last.
    unused = out if action is RecipeAction.show else name
    if action is not RecipeAction.cp and unused is not None:
        fix = f"aegis recipes cp {name} {out or ''}".rstrip()
        raise AegisError(f"'{unused}' after {action}", "nothing more", f"to copy one: {fix}")
    if action is RecipeAction.ls:
        return render.show(shipped.listed(), render.recipe_list, as_json)
    if name is None:
        raise AegisError(f"aegis recipes {action} without a name", "one", "see aegis recipes ls")
    source = shipped.path(name)
    text = source.read_text(encoding="utf-8")
    if action is RecipeAction.show:
        if not as_json:
            return render.text(text)
        return render.show(shipped.Shown(name, str(source), text), render.facts, as_json)
    out = out or Path(source.name)
    if out.exists():
        raise AegisError(f"'{out}' exists", "a new file", f"aegis recipes cp {name} OTHER.yaml")
    files.write_text(out, text)
    if as_json:  # the note below is for people
        render.show(shipped.Copied(name, str(out)), render.facts, as_json)
    render.note(f"copied {name} to {out}")


@app.command(short_help="Check the installation and the machine.")
def doctor(
    quick: Annotated[
        bool, Option("--quick", help="Skip the job, which takes half a minute or more.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Check packages, extras, torch, OpenGL and the disk, and run a job in miniature.

    Exits 1 if something does not work. A missing extra is no failure.

    \b
    Example: aegis doctor
    """
    report = stages.DOCTOR.run(not quick, as_json=as_json)
    if report.failed:
        _gate(f"{', '.join(report.failed)} of aegis doctor")


def _past(limit: str, gate: Gate) -> str:
    """The message for a drop beyond the limit of a gate."""
    of_interval = ", by the upper end of the drop's interval" if gate is Gate.upper_end else ""
    return f"more than {limit} points{of_interval}"


def _gate(failed: str | None) -> None:
    """End with exit code 1 if a gate failed; `failed` says how, and is None if it passed."""
    _say_gate(failed)
    _end_at_gate(failed)


def _say_gate(failed: str | None) -> None:
    """Print how a gate failed, if it did; only the first process prints."""
    if failed is not None and launch.rank() == 0:
        render.note(f"gate failed: {failed}")


def _end_at_gate(failed: str | None) -> None:
    """End with exit code 1 if a gate failed."""
    if failed is not None:
        raise typer.Exit(1)


def main() -> None:
    """The console script."""
    for name in ("stdout", "stderr"):
        # A stream that was closed at the start of the process is None and cannot be written.
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))
        render.write_any_character(getattr(sys, name))
    render.name_errors(sys.stdout, render.STDOUT)
    # Shows where a fault happened, in a library or in a memory-mapped file that was truncated.
    # Without the other threads, which keep running: walking their frames could cause another fault.
    faulthandler.enable(all_threads=False)
    interrupts.leave_at_ctrl_c()
    try:
        app(prog_name="aegis")
    except OSError as error:  # from shell completion, which starts no command
        sys.exit(ended_by(error))
    finally:
        garbage.leave_at_end()
