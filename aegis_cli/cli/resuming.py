"""`aegis train RUN`: resumes a run from its own folder, and finds the command for that."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from aegis_cli.common import commands, launch
from aegis_cli.common.errors import AegisError
from aegis_cli.data.selection import Paths
from aegis_cli.recipes import Recipe, RobotStreamRecipe

RECIPE = "recipe.yaml"


def recipe_of(run: Path, out: Path | None) -> Path:
    """The recipe that a run was started with.

    Raises:
        AegisError: there is no run, or `out` is given, although a run resumes in its own folder.
    """
    if not (run / RECIPE).is_file():
        raise AegisError(
            f"no {RECIPE} in '{run}'",
            "a recipe, or the folder of a run that aegis train has begun",
            _instead(run),
        )
    if out is not None:
        raise AegisError(
            f"--out {out} with the run '{run}'",
            "the run alone, which resumes in its own folder",
            "leave out --out, or start a new run from its recipe: "
            f"{commands.aegis('train', run / RECIPE, *_given(run), '--out', out)}",
        )
    return run / RECIPE


def _given(run: Path) -> list[str]:
    """What a run was given beside its recipe, as options; nothing where it does not say."""
    from aegis_cli.recipes import is_stream_run
    from aegis_cli.training import inputs

    if is_stream_run(run):  # its recipe names what it reads
        return []
    kept = inputs.of(run)
    if kept is None:
        return []
    return _options(kept.demos) + ([] if kept.anchor is None else ["--anchor", kept.anchor])


def _instead(folder: Path) -> str:
    """A suggestion for a folder that is not a run."""
    from aegis_cli.training import checkpoint

    home = checkpoint.run_of(folder) if checkpoint.is_one(folder) else None
    if home is not None:  # an exported policy has no run
        return f"give the run of this checkpoint: {commands.aegis('train', home)}"
    inner = sorted(path.parent for path in folder.glob(f"*/{RECIPE}"))
    if inner:
        return (
            f"give one of its runs, e.g. {commands.aegis('train', inner[0])}; to "
            "resume a job or study of aegis run, run its command again"
        )
    if instead := _from_model(folder):
        return instead
    return "check the path, or begin a run: aegis train RECIPE --out RUN"


def _from_model(folder: Path) -> str:
    """How to train from a model or a policy that was given instead of a recipe; may be empty."""
    from aegis_cli.models.backbones import model_folder

    if model_folder.foreign_policy(folder) is not None:
        return model_folder.take_out(folder)
    is_policy = model_folder.is_policy(folder) or (folder / "expert.safetensors").is_file()
    if not is_policy and not model_folder.is_model(folder) and not model_folder.weights(folder):
        return ""
    words = ["--set", f"backbone={folder}"]
    if is_policy:
        words += ["--set", f"expert.start={folder}"]
    command = commands.aegis("train", "RECIPE", *words, "--demos", "PATH", "--out", "RUN")
    return f"name it in a recipe: {command}"


def inputs_of(
    run: Path, recipe: Recipe, demos: Sequence[Path], anchor: Path | None
) -> tuple[list[Path], Path | None]:
    """The demonstrations and the anchor to resume a run with: those given, or its own.

    If the run has not recorded its demonstrations but the recipe names them, the list is empty.

    Raises:
        AegisError: they are no longer where they were, an earlier version has not recorded them, or
            the run was merged.
    """
    from aegis_cli.training import checkpoint, inputs

    if checkpoint.begun(run):
        checkpoint.kept_state(run)  # raises for a merged run, which has no state
    kept = inputs.of(run)
    if kept is None:  # a run of an earlier version
        if not demos and recipe.demos.path is None:
            raise _unknown(run, "demonstrations", "--demos PATH")
        return list(demos), anchor or _no_anchor(run)
    if not demos:
        demos = _all_there(run, kept.demos)
    elif len(demos) != len(kept.demos):  # they are matched by their position in the list
        raise AegisError(
            f"{len(demos)} of --demos for the run in '{run}', which began with {len(kept.demos)}",
            f"each of its sets, in their order: {', '.join(kept.demos)}",
            f"name all of them: {commands.aegis('train', run, *_options(kept.demos))}",
        )
    if anchor is None and kept.anchor is not None:
        again = commands.aegis("train", run, "--anchor", "FILE")
        anchor = _there(run, kept.anchor, "anchor", again)
    return list(demos), anchor


def check_here(run: Path, recipe: Recipe) -> None:
    """Raise AegisError if the recipe's paths exist only relative to the folder of the start."""
    sets = recipe.probe.of_each_set() if recipe.probe.while_training else ()
    named = [recipe.backbone, recipe.expert.start, *(each.vqa for each in sets)]
    check_seen(run, [name for name in named if isinstance(name, str)], "train")


def check_seen(run: Path, names: Iterable[str], command: str) -> None:
    """Raise AegisError if one of these paths exists where the run was started, but not here."""
    from aegis_cli.training import inputs

    began = inputs.began_in(run)
    for name in [name.partition("#")[0] for name in names]:
        if began is not None and not Path(name).exists() and (began / name).exists():
            again = commands.aegis(command, run.absolute())
            raise AegisError(
                f"no '{name}' here, which the recipe of the run in '{run}' names",
                f"the folder that the run was started in, '{began}', which has it",
                f"run the command there: {commands.shell('cd', began)} && {again}",
            )


def demonstrations_of(run: Path) -> Path:
    """The demonstrations that a run learned from, for `aegis evaluate` without --demos.

    Raises:
        AegisError: there is no policy, or its demonstrations are unknown, gone, or several sets.
    """
    from aegis_cli.evaluation import open_loop, results
    from aegis_cli.training import inputs

    home = results.run_of(run)
    kept = None if home is None else inputs.of(home)
    if kept is None:
        open_loop.check_policy(run)  # first, since a path without a policy is the larger mistake
        raise AegisError(
            f"no --demos for '{run}', which does not record what it was trained on",
            "demonstrations: a file, the folder of a LeRobot dataset, or its id on the hub",
            f"name them: {commands.aegis('evaluate', run, '--demos', 'PATH')}",
        )
    if len(kept.demos) > 1:
        raise AegisError(
            f"no --demos for '{run}', which learned from {len(kept.demos)} sets",
            f"one of {', '.join(kept.demos)}",
            f"evaluate on each: {commands.aegis('evaluate', run, '--demos', kept.demos[0])}",
        )
    again = commands.aegis("evaluate", run, "--demos", "PATH")
    return _there(run, kept.demos[0], "demonstrations", again)


def _all_there(run: Path, places: Sequence[str]) -> list[Path]:
    """The recorded sets of demonstrations; raises AegisError if one of them is gone."""
    from aegis_cli.training.inputs import is_gone

    # The command names all sets, since the run resumes with exactly those that are given.
    options = _options("PATH" if is_gone(place) else place for place in places)
    again = commands.aegis("train", run, *options)
    return [_there(run, place, "demonstrations", again) for place in places]


def _options(places: Iterable[str]) -> list[str]:
    return [word for place in places for word in ("--demos", place)]


def _there(run: Path, place: str, what: str, again: str) -> Path:
    """A recorded path; raises AegisError if it is gone, with `again` as the command to fix it."""
    from aegis_cli.training.inputs import is_gone

    if is_gone(place):
        raise AegisError(
            f"'{place}' is gone, the {what} of the run in '{run}'",
            f"the {what} that the run began with",
            f"bring it back, or give its new path: {again}",
        )
    return Path(place)


def _no_anchor(run: Path) -> None:
    """Raise AegisError if a checkpoint says that the run was given an anchor."""
    from aegis_cli.common import artifacts
    from aegis_cli.training import checkpoint

    if not checkpoint.begun(run):
        return
    header = artifacts.read_header(checkpoint.last(run) / checkpoint.EXPERT)
    if "anchor" in header.inputs:
        raise _unknown(run, "anchor", "--anchor FILE")


def _unknown(run: Path, what: str, option: str) -> AegisError:
    return AegisError(
        f"the run '{run}', which does not record its {what}: an earlier version started it",
        f"the {what} that it was trained with",
        f"give the path: {commands.aegis('train', run)} {option}",
    )


def command(
    recipe: Any, out: Path, demos: Paths | None, anchor: Path | None, options: Sequence[str]
) -> list[str] | None:
    """The words of the command to resume a run; None if its folder does not suffice.

    That is the case before the run has started, or if another run is still there.

    Args:
        recipe: the recipe of the run.
        options: the command's options that are not settings of the training.

    Raises:
        AegisError: `out` holds something else.
    """
    from aegis_cli.training import folder, inputs, longer

    if not (out / RECIPE).is_file():
        return None
    if isinstance(recipe, Recipe):
        if demos is None or inputs.of(out) != inputs.Inputs.given(demos, anchor):
            return None
        # If the run was extended, the recipe on disk is not this one.
        recipe = longer.plan(out, recipe)
    if isinstance(recipe, RobotStreamRecipe):
        from aegis_cli.continual import places

        if not places.is_kept(out, recipe):
            return None
        recipe = places.as_begun(out, recipe)
    return ["train", str(out), *options] if folder.goes_on(out, recipe) else None


def lighter(
    recipe: Recipe | RobotStreamRecipe,
    out: Path,
    demos: Paths | None,
    anchor: Path | None,
    options: Sequence[str],
) -> list[list[str]]:
    """The words of the commands that resume a run with less memory per step.

    What it learns stays the same but for rounding (see `recipes.adjustable`). There is none if
    `command` finds none, or if nothing is left to save memory with.

    Args:
        options: as for `command`.
    """
    from aegis_cli import recipes

    words = command(recipe, out, demos, anchor, options)
    if words is None:
        return []
    settings, found = recipe.train, list[list[str]]()
    if not settings.gradient_checkpointing and _is_of_hugging_face(recipe.backbone):
        compiled = isinstance(recipe, Recipe) and recipe.train.compile
        off = ["train.compile=false"] if compiled else []  # one of the two
        found.append(["train.gradient_checkpointing=true", *off])
    passes = 2 * settings.accumulate
    fits = passes * launch.world_size() <= settings.batch_size
    if fits and "accumulate" in recipes.adjustable(recipe):
        found.append([f"train.accumulate={passes}"])
    return [[*words, *(w for each in some for w in ("--set", each))] for some in found]


def _is_of_hugging_face(backbone: str) -> bool:
    """Whether a backbone can recompute its activations, as an embedded one cannot."""
    from aegis_cli.models import backbones
    from aegis_cli.models.backbones import shapes

    if shapes.of_backbone(backbone) is not None:
        return True
    return backbones.locate(backbones.divided(backbone)[0]).is_dir()
