"""What no single key of a recipe can tell: keys that do not go together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from aegis_cli.recipes.keys import changed
from aegis_cli.recipes.policy import NEEDS, SUITE, Recipe
from aegis_cli.recipes.pretraining import DualRecipe, PretrainRecipe
from aegis_cli.recipes.streams import RobotStreamRecipe, StreamRecipe
from aegis_cli.recipes.strict_yaml import Problem, refuse


def cross_checks(
    recipe: Recipe | PretrainRecipe | DualRecipe | StreamRecipe | RobotStreamRecipe,
) -> Iterator[Problem]:
    """What a single key cannot tell."""
    if isinstance(recipe, StreamRecipe):
        return
    if isinstance(recipe, PretrainRecipe | DualRecipe):
        section, model = (
            ("model", recipe.model)
            if isinstance(recipe, PretrainRecipe)
            else ("towers", recipe.towers)
        )
        if model.width % model.heads:
            found = f"{section}.width: {model.width} with {section}.heads: {model.heads}"
            fix = f"set {section}.width to {model.heads * max(1, model.width // model.heads)}"
            yield Problem(found, "a width that the heads divide", fix)
        return
    if recipe.rollout.replan > recipe.train.chunk:
        found = f"rollout.replan: {recipe.rollout.replan} with train.chunk: {recipe.train.chunk}"
        yield Problem(
            found,
            "no more actions executed than predicted",
            f"set rollout.replan to at most {recipe.train.chunk}",
        )
    if isinstance(recipe, RobotStreamRecipe):
        yield from _robot_checks(recipe)
        return
    if recipe.task.startswith(SUITE) and "colors" in changed(recipe.rollout):
        found = f"rollout.colors: {', '.join(recipe.rollout.colors)} with task: {recipe.task}"
        yield Problem(
            found, "no colours: a suite task has no coloured targets", "delete rollout.colors"
        )
    if not recipe.task.startswith(SUITE) and recipe.demos.drop_below is not None:
        found = f"demos.drop_below: {recipe.demos.drop_below:g} with task: {recipe.task}"
        yield Problem(
            found,
            "a suite task, whose episodes have a return",
            "delete demos.drop_below: failures are dropped",
        )


def _robot_checks(recipe: RobotStreamRecipe) -> Iterator[Problem]:
    paths, suite = recipe.demos.paths, [task for task in recipe.tasks if task.startswith(SUITE)]
    if paths is not None and len(paths) != len(recipe.tasks):
        found = f"demos.paths: {len(paths)} with {len(recipe.tasks)} tasks"
        yield Problem(
            found,
            "one a task, in their order",
            "correct demos.paths, or delete it and let them be recorded",
        )
    if recipe.probe.max_drop is not None:
        found = f"probe.max_drop: {recipe.probe.max_drop:g} with a stream"
        yield Problem(
            found, "no gate: a stream has a figure after each task", "delete probe.max_drop"
        )
    if not isinstance(recipe.probe.vqa, str):
        found = f"probe.vqa: {', '.join(recipe.probe.vqa)} with a stream"
        yield Problem(found, "one set of questions", f"set probe.vqa to {recipe.probe.vqa[0]}")
    if suite and "colors" in changed(recipe.rollout):
        found = f"rollout.colors: {recipe.rollout.colors} with task {suite[0]}"
        yield Problem(
            found, "no colours: a suite task has no coloured targets", "delete rollout.colors"
        )


def anchor_checks(recipe: Recipe, methods: Sequence[str]) -> Iterator[Problem]:
    """Whether the anchor that `aegis run` measures holds what these methods, and the leak, read."""
    measured = recipe.anchor
    for method in methods:
        missing = [part for part in NEEDS.get(method, ()) if part not in measured.parts]
        if missing:
            fix = f"set anchor.parts to [{', '.join((*measured.parts, *missing))}]"
            found = f"anchor.parts: {', '.join(measured.parts)} with method {method}"
            yield Problem(found, f"anchor.parts with {' and '.join(missing)}", fix)
    shares = {"train.leak_energy": recipe.train.leak_energy} if "inputs" in measured.parts else {}
    if "nullspace" in methods and recipe.nullspace.energy is not None:
        shares["nullspace.energy"] = recipe.nullspace.energy
    for name, share in shares.items():
        if share > measured.energy:
            found = f"{name}: {share:g} with anchor.energy: {measured.energy:g}"
            yield Problem(
                found, "an anchor that keeps at least that share", f"set anchor.energy to {share:g}"
            )


def check_anchor(recipe: Recipe) -> None:
    """Raise AegisError unless the recipe's anchor holds what its methods read."""
    refuse(list(anchor_checks(recipe, recipe.methods)), f"recipe {recipe.name}")
