"""Warnings before a stage starts that it would run, but not do what its user expects."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from aegis_cli.cli import render
from aegis_cli.common import launch
from aegis_cli.common.errors import AegisError
from aegis_cli.recipes import (
    AnyStudy,
    Insulate,
    Nullspace,
    Recipe,
    RobotStreamRecipe,
    RobotStreamStudyRecipe,
    StreamRecipe,
    StreamStudyRecipe,
    options,
    retired,
)
from aegis_cli.recipes.policy import CONSTANT
from aegis_cli.recipes.study_cells import cell, places
from aegis_cli.recipes.variants import SECTIONS

_SCENES = "scenes"
# Keys of a training that affect only how the backbone learns.
_OF_BACKBONE = ("train.backbone_lr", "train.backbone_until", "train.optimizer", "train.momentum")
_USUAL = Recipe(name="usual")
_OF_QUESTIONS = ("vqa", "skip_bad", "ask", "questions", "batch_size")


def of_questions(model: str, *names: str | None) -> None:
    """Warn if a real VLM is asked about drawn scenes, which show little of what it knows.

    Args:
        model: a backbone, or a run or policy that has one.
        names: the names of the question sets.
    """
    if launch.rank() == 0 and _SCENES in names and _is_of_the_hub(model):
        render.note(
            f"warning: 'scenes' are drawn toys: they neither measure nor protect what "
            f"'{model}' knows of the world. Give real questions, such as VQAv2's "
            "(--vqa, or anchor.vqa and probe.vqa of a recipe; docs/own-data.md)"
        )


def of_training(recipe: Recipe, anchor: Path | None) -> None:
    """Warn about the questions of a training: those of its anchor and those that it trains on."""
    of_questions(recipe.backbone, _measured_on(anchor), _trained_on(recipe))


def of_run(recipe: Recipe | AnyStudy, overrides: Sequence[str] = ()) -> None:
    """Warn about the questions of a recipe's anchors and probes; image streams have none.

    For the recipe of a job it also warns about settings; `overrides` are those of the command line.
    """
    if isinstance(recipe, AnyStudy) and launch.rank() == 0:
        for text in _of_retired(recipe, overrides):
            render.note(f"warning: {text}")
    if isinstance(recipe, StreamStudyRecipe):
        return
    if isinstance(recipe, Recipe):
        of_settings(recipe, overrides, recipe.methods)
        of_questions(recipe.backbone, *_asked(recipe))
        return
    if isinstance(recipe, RobotStreamStudyRecipe):
        # No variant may set the backbone or the probe, so any cell represents all.
        name, first = next(iter(recipe.variants.items()))
        asked = cell(recipe, name, recipe.tasks, recipe.seeds[0], first.values[0])
        of_questions(asked.backbone, asked.probe.only_set)
        return
    # Here a variant may have its own anchor. All tasks and seeds have the same questions.
    place, seed = places(recipe)[0], recipe.seeds[0]
    for name, variant in recipe.variants.items():
        one = cell(recipe, name, place, seed, variant.values[0])
        names = list(_asked(one))
        of_questions(one.backbone, *names)
        if _SCENES in names:
            return  # one warning is enough


def of_settings(
    recipe: Recipe | StreamRecipe | RobotStreamRecipe,
    overrides: Sequence[str] = (),
    methods: Sequence[str] = (),
) -> None:
    """Warn about settings that, together with others, do not do what they seem to do.

    Args:
        overrides: the KEY=VALUE of the command line, which are meant for this call. Keys in the
            file may be there for other methods.
        methods: the methods that are trained; by default the recipe's `train.method`.
    """
    if launch.rank() > 0:
        return
    methods = methods or (recipe.train.method,)
    texts = [
        *_of_schedule(recipe),
        *_of_unread(overrides, methods),
        *_of_retired(recipe, overrides),
    ]
    if isinstance(recipe, Recipe) and "nullspace" in methods:
        texts += _of_thresholds(recipe.nullspace)
    if isinstance(recipe, Recipe) and "insulate" in methods:
        texts += _of_unasked(recipe.insulate)
    for text in texts:
        render.note(f"warning: {text}")


def _of_schedule(recipe: Recipe | StreamRecipe | RobotStreamRecipe) -> Iterator[str]:
    train = recipe.train
    falls = train.schedule != CONSTANT
    if train.warmup > train.steps or (falls and train.warmup == train.steps):
        share = 100 * train.steps / train.warmup  # the warm-up is linear
        lost = ", and they never decay" if falls else ""
        yield (
            f"train.warmup: {train.warmup} with train.steps: {train.steps}: training ends within "
            f"the warmup, with the learning rates at {share:.3g} % of their peaks{lost}. Set "
            "train.warmup lower"
        )


def _of_unread(overrides: Sequence[str], methods: Sequence[str]) -> Iterator[str]:
    """Overrides without effect, such as options of other methods or of a frozen backbone.

    Sharing a training among processes has no effect if there is only one.
    """
    own = {method.replace("-", "_") for method in methods}  # the sections that these methods read
    named = " and ".join(methods)
    for override in overrides:
        dotted, _, value = map(str.strip, override.partition("="))
        section = dotted.partition(".")[0]
        frozen = dotted in _OF_BACKBONE and set(methods) == {"stop-gradient"}
        if frozen or (section in SECTIONS and section not in own):
            yield f"--set {dotted} changes nothing: {named} does not read it"
        if (dotted, value) == ("train.parallel", "fsdp") and launch.world_size() == 1:
            yield f"--set {dotted} changes nothing in one process: start several with torchrun"


def _of_retired(
    recipe: Recipe | StreamRecipe | RobotStreamRecipe | AnyStudy, overrides: Sequence[str]
) -> Iterator[str]:
    """Keys that no longer have an effect, in the recipe or among the overrides."""
    given = {override.partition("=")[0].strip().removeprefix("shared.") for override in overrides}
    for dotted in sorted(retired()):
        section, name = dotted.split(".")
        if isinstance(recipe, Recipe):
            own, usual = (getattr(getattr(each, section), name) for each in (recipe, _USUAL))
            is_set = own != usual
        else:
            shared = getattr(recipe, "shared", {}).get(section)
            is_set = isinstance(shared, Mapping) and name in shared
        if is_set or dotted in given:
            yield f"{dotted} has no effect any more: what it set is no longer measured. Delete it"


def _of_thresholds(chosen: Nullspace) -> Iterator[str]:
    if chosen.energy is not None and chosen.soft != Nullspace().soft:
        yield (
            f"nullspace.soft: {chosen.soft:g} changes nothing beside nullspace.energy: "
            f"{chosen.energy:g}, which replaces it. Delete one of them"
        )


def _of_unasked(chosen: Insulate) -> Iterator[str]:
    """Settings of the training questions although none are trained on."""
    own = [name for name in _OF_QUESTIONS if getattr(chosen, name) != getattr(Insulate(), name)]
    if chosen.vqa_weight == 0 and own:
        yield (
            f"insulate.{own[0]}: {getattr(chosen, own[0])} changes nothing beside "
            "insulate.vqa_weight: 0, which trains on no questions. Set it above 0, or delete "
            f"{' and '.join(own)}"
        )


def _asked(recipe: Recipe) -> Iterator[str | None]:
    yield from recipe.probe.sets
    if recipe.anchor.source == "questions":
        yield recipe.anchor.vqa
    yield _trained_on(recipe)


def _trained_on(recipe: Recipe) -> str | None:
    """The question set of a method that trains on questions; None for other methods."""
    from aegis_cli import methods  # imports torch

    own = options(recipe)
    trains_on_some = methods.get(recipe.train.method).trains_on_questions(own)
    return own["vqa"] if trains_on_some else None


def _measured_on(anchor: Path | None) -> str | None:
    """The question set that an anchor was measured on; None if the file is not an anchor."""
    if anchor is None:
        return None
    from aegis_cli.common import artifacts

    try:
        return str(artifacts.read_header(anchor).meta.get("vqa"))
    except AegisError:
        return None  # the stage will report the problem


def _is_of_the_hub(model: str) -> bool:
    """Whether a model, or the backbone of a policy, has the layout of the hub."""
    from aegis_cli.models import backbones
    from aegis_cli.models.backbones import model_folder

    try:
        path = backbones.locate(model)
    except AegisError:
        return False  # the stage will report the problem
    # A policy in LeRobot's layout is one file, with its backbone's configuration beside it.
    return path.is_dir() or model_folder.is_model(path.parent / "backbone")
