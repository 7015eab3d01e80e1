"""Warnings before a stage begins: it would run, and not measure what its user has in mind."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from aegis_cli.cli import render
from aegis_cli.common import launch
from aegis_cli.common.errors import AegisError
from aegis_cli.recipes import AnyStudy, Recipe, RobotStreamStudyRecipe, StreamStudyRecipe, options
from aegis_cli.recipes.study_cells import cell

_SCENES = "scenes"


def of_questions(model: str, *names: str | None) -> None:
    """Warn of a real VLM that is asked about drawn scenes, which tell little of what it knows.

    Args:
        model: a backbone, or a run or policy that has one.
        names: of the question sets.
    """
    if launch.rank() == 0 and _SCENES in names and _is_of_the_hub(model):
        render.note(
            f"warning: 'scenes' are drawn toys, and what '{model}' knows of the world is neither "
            "measured nor protected by them: give real questions, such as VQAv2's "
            "(--vqa, or anchor.vqa and probe.vqa of a recipe; docs/own-data.md)"
        )


def of_training(recipe: Recipe, anchor: Path | None) -> None:
    """Warn of what a training reads: its anchor, and questions that it trains on."""
    of_questions(recipe.backbone, _measured_on(anchor), _trained_on(recipe))


def of_run(recipe: Recipe | AnyStudy) -> None:
    """Warn of what a recipe's anchors and probes ask; streams of images have none."""
    if isinstance(recipe, StreamStudyRecipe):
        return
    if isinstance(recipe, Recipe):
        of_questions(recipe.backbone, *_asked(recipe))
        return
    if isinstance(recipe, RobotStreamStudyRecipe):
        name, first = next(iter(recipe.variants.items()))
        asked = cell(recipe, name, recipe.tasks, recipe.seeds[0], first.values[0])
        of_questions(asked.backbone, asked.probe.only_set)
        return
    place, seed = recipe.tasks[0], recipe.seeds[0]
    for name, variant in recipe.variants.items():
        one = cell(recipe, name, place, seed, variant.values[0])
        names = list(_asked(one))
        of_questions(one.backbone, *names)
        if _SCENES in names:
            return  # one warning is enough


def _asked(recipe: Recipe) -> Iterator[str | None]:
    yield from recipe.probe.sets
    if recipe.anchor.source == "questions":
        yield recipe.anchor.vqa
    yield _trained_on(recipe)


def _trained_on(recipe: Recipe) -> str | None:
    """The questions of a method that trains on some."""
    from aegis_cli import methods

    own = options(recipe)
    return own["vqa"] if methods.get(recipe.train.method).trains_on_questions(own) else None


def _measured_on(anchor: Path | None) -> str | None:
    """The questions that an anchor was measured on, where it is one and says so."""
    if anchor is None:
        return None
    from aegis_cli.common import artifacts

    try:
        return str(artifacts.read_header(anchor).meta.get("vqa"))
    except AegisError:
        return None  # the stage says what is wrong with it


def _is_of_the_hub(model: str) -> bool:
    """Whether a model, or a policy's own, has the layout of the hub."""
    from aegis_cli.models import backbones
    from aegis_cli.models.backbones import model_folder

    try:
        path = backbones.locate(model)
    except AegisError:
        return False  # the stage says what is wrong with it
    # A policy in LeRobot's layout is one file; the configuration of its backbone lies beside it.
    return path.is_dir() or model_folder.is_model(path.parent / "backbone")
