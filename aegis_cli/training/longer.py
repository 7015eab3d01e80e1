"""Extending a finished run: which recipe it is resumed with, and when that is refused.

`train.extended_from` keeps the earlier planned numbers of steps. The learning rate follows each
plan up to its end, so a run that starts with that key ends in the same bytes.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from aegis_cli import recipes
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Warned
from aegis_cli.models import backbones
from aegis_cli.recipes import Recipe
from aegis_cli.training import checkpoint, folder, inputs
from aegis_cli.training.schedule import rate_factor


def plan(out: Path, recipe: Recipe) -> Recipe:
    """The recipe that the run in `out` is resumed with: the given one, with the earlier plans.

    It is unchanged if there is no run, or if more than the number of steps differs.
    """
    saved = out / "recipe.yaml"
    if not saved.exists():
        return recipe
    there, steps = recipes.load(saved, kind=Recipe).train, recipe.train.steps
    # The run's own recipe has its earlier plans already.
    if recipe.train.extended_from not in (None, there.extended_from):
        return recipe
    plans = there.plans if there.steps == steps else (*there.plans, steps)
    if plans != tuple(sorted(plans)):  # fewer steps than before: `folder.check` refuses that
        return recipe
    planned = _replanned(recipe, plans)
    return planned if folder.continues(out, planned) or lengthens(out, planned) else recipe


def check(
    out: Path,
    recipe: Recipe,
    resume: bool,
    overwrite: bool,
    places: inputs.Inputs,
    on_event: OnEvent,
) -> None:
    """Refuse an existing run as `folder.check` does, except for a finished one that is extended.

    Args:
        recipe: the recipe that it is resumed with, as `plan` returns it.
        places: of the data that it reads.
    """
    if resume and lengthens(out, recipe):
        _check_ended(out, recipe, on_event)
    else:
        models = (backbones.divided(recipe.backbone)[0], recipe.expert.start)
        read = (*models, *places.demos, places.anchor)
        folder.check(out, recipe, resume, overwrite, read)


def lengthens(out: Path, recipe: Recipe) -> bool:
    """Whether `recipe` is the recipe of the run in `out`, extended by a plan of more steps."""
    earlier = recipe.train.plans[:-1]
    there = (out / "recipe.yaml").exists()
    return bool(earlier) and there and folder.continues(out, _replanned(recipe, earlier))


def _check_ended(out: Path, recipe: Recipe, on_event: OnEvent) -> None:
    """Refuse to extend a run that has not ended, belongs to a job, or froze its backbone."""
    settings, planned = recipe.train, recipe.train.plans[-2]
    done = checkpoint.step_of(checkpoint.last(out)) if checkpoint.begun(out) else 0
    if done != planned:
        raise AegisError(
            f"train.steps={settings.steps} for the run in '{out}', which has taken {done} of "
            f"{planned} steps",
            "a finished run to extend",
            f"finish it first: the same command with --set train.steps={planned}",
        )
    if (out / folder.JOBS_REPORT).exists():
        raise AegisError(
            f"train.steps={settings.steps} for '{out}', which belongs to a job of aegis run",
            "a run of aegis train",
            f"set train.steps in the job's recipe, or copy the run first: cp -r '{out}' ELSEWHERE",
        )
    if settings.backbone_until < 1:
        raise AegisError(
            f"train.steps={settings.steps} for '{out}', whose backbone is frozen by now "
            f"(train.backbone_until: {settings.backbone_until:g})",
            "a run whose backbone learns to its end",
            "begin another run from it: --set backbone=… --set expert.start=…",
        )
    share = rate_factor(planned, settings)  # at the first step of the new plan
    rises = share > rate_factor(planned - 1, settings)  # a constant schedule's do not
    text = (
        f"'{out}' goes on from step {planned} to {settings.steps}; the learning rates "
        f"{'rise again to' if rises else 'stay at'} {100 * share:.0f} % of their peaks"
    )
    on_event(Warned("train", text))


def _replanned(recipe: Recipe, plans: tuple[int, ...]) -> Recipe:
    *earlier, steps = plans
    train = dataclasses.replace(recipe.train, steps=steps, extended_from=tuple(earlier) or None)
    return dataclasses.replace(recipe, train=train)
