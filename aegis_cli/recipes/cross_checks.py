"""Checks across the keys of a recipe: keys that do not go together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields

from aegis_cli.common.limits import MOST_MADE
from aegis_cli.data.vqa.gate import MEAN
from aegis_cli.recipes.keys import changed
from aegis_cli.recipes.policy import (
    CONSTANT,
    MERGE_NEEDS,
    MERGE_UNREAD,
    NEEDS,
    SUITE,
    TASK,
    TASKS,
    Recipe,
    Train,
)
from aegis_cli.recipes.pretraining import DualRecipe, Model, PretrainRecipe, Towers
from aegis_cli.recipes.streams import (
    RobotDemos,
    RobotRollout,
    RobotStreamRecipe,
    RobotTrain,
    StreamRecipe,
    StreamTrain,
)
from aegis_cli.recipes.strict_yaml import Problem, did_you_mean, refuse

_NO_COLORS = f"no colours: only {' and '.join(TASKS)} have coloured targets"


def cross_checks(
    recipe: Recipe | PretrainRecipe | DualRecipe | StreamRecipe | RobotStreamRecipe,
) -> Iterator[Problem]:
    """Problems that no single key shows."""
    if isinstance(recipe, StreamRecipe):
        yield from _schedule_checks(recipe.train)
        return
    if isinstance(recipe, PretrainRecipe):
        yield from _width_checks("model", recipe.model)
        return
    if isinstance(recipe, DualRecipe):
        yield from _width_checks("towers", recipe.towers)
        return
    if recipe.rollout.replan > recipe.train.chunk:
        found = f"rollout.replan: {recipe.rollout.replan} with train.chunk: {recipe.train.chunk}"
        yield Problem(
            found,
            "no more actions executed than predicted",
            f"set rollout.replan to at most {recipe.train.chunk}",
        )
    if recipe.rollout.ensemble is not None and recipe.rollout.replan != 1:
        yield Problem(
            f"rollout.ensemble: {recipe.rollout.ensemble:g} with rollout.replan: "
            f"{recipe.rollout.replan}",
            "a prediction at every step",
            "set rollout.replan to 1, or delete rollout.ensemble",
        )
    # Only for generated questions: from a file, a probe asks at most as many as there are.
    if recipe.probe.questions > MOST_MADE and "scenes" in recipe.probe.sets:
        found = f"probe.questions: {recipe.probe.questions} with probe.vqa: scenes"
        yield Problem(found, f"at most {MOST_MADE:,}", "ask for fewer")
    watched = recipe.probe.while_training
    if watched is not None and watched > MOST_MADE and "scenes" in recipe.probe.sets:
        found = f"probe.while_training: {watched} with probe.vqa: scenes"
        yield Problem(found, f"at most {MOST_MADE:,}", "ask for fewer")
    if isinstance(recipe, RobotStreamRecipe):
        yield from _robot_checks(recipe)
    else:
        yield from _policy_checks(recipe)


def _width_checks(section: str, model: Model | Towers) -> Iterator[Problem]:
    """Check that a model's width is a multiple of its heads."""
    if model.width % model.heads:
        found = f"{section}.width: {model.width} with {section}.heads: {model.heads}"
        fix = f"set {section}.width to {model.heads * max(1, model.width // model.heads)}"
        yield Problem(found, "a width that the heads divide", fix)


def _policy_checks(recipe: Recipe) -> Iterator[Problem]:
    """Check that the keys of a policy's recipe go together.

    A key that would have no effect is refused, since a user who sets it expects one. Only keys in
    `changed` count as set.
    """
    if recipe.task not in TASKS and "colors" in changed(recipe.rollout):
        found = f"rollout.colors: {', '.join(recipe.rollout.colors)} with task: {recipe.task}"
        yield Problem(found, _NO_COLORS, "delete rollout.colors")
    yield from _train_checks(recipe.train)
    yield from _extension_checks(recipe)
    yield from _source_checks(recipe)
    yield from _method_checks(recipe)
    if recipe.probe.gate != MEAN and recipe.probe.max_drop is None:
        found = f"probe.gate: {recipe.probe.gate} without probe.max_drop"
        yield Problem(found, "a limit that the drop is held to", "set probe.max_drop")
    if not recipe.task.startswith(SUITE) and recipe.demos.drop_below is not None:
        found = f"demos.drop_below: {recipe.demos.drop_below:g} with task: {recipe.task}"
        yield Problem(
            found,
            "a suite task, whose episodes have a return",
            "delete demos.drop_below: failures are dropped",
        )


def _method_checks(recipe: Recipe) -> Iterator[Problem]:
    """Check that a method's options have the other options that they need."""
    kfac, train = recipe.kfac, recipe.train
    for name in ("growth", "every"):
        if kfac.step == "gradient" and name in changed(kfac):
            found = f"kfac.{name}: {getattr(kfac, name):g} with kfac.step: gradient"
            yield Problem(found, "kfac.step: proximal, which it belongs to", f"delete kfac.{name}")
    fix = "delete kfac.growth"
    if train.schedule == CONSTANT and kfac.growth != 0:
        found = f"kfac.growth: {kfac.growth:g} with train.schedule: {CONSTANT}"
        yield Problem(found, "learning rates that fall", fix)
    elif train.final_lr_share == 1 and kfac.growth != 0:
        found = f"kfac.growth: {kfac.growth:g} with train.final_lr_share: 1"
        yield Problem(found, "learning rates that fall", fix)


def _train_checks(train: Train) -> Iterator[Problem]:
    """Check that keys of the training have the other keys that they need."""
    if train.optimizer != "sgd" and "momentum" in changed(train):
        found = f"train.momentum: {train.momentum:g} with train.optimizer: adamw"
        yield Problem(found, "train.optimizer: sgd", "set it, or delete train.momentum")
    yield from _schedule_checks(train)
    yield from _relative_checks(train)
    yield from _augment_checks(train)


def _schedule_checks(train: Train | StreamTrain | RobotTrain) -> Iterator[Problem]:
    # A final_lr_share of 1 means a constant rate as well.
    if train.schedule == CONSTANT and changed(train).get("final_lr_share", 1) != 1:
        found = f"train.final_lr_share: {train.final_lr_share:g} with train.schedule: {CONSTANT}"
        fix = "delete train.final_lr_share, or set it to 1"
        yield Problem(found, "train.schedule: cosine or linear, which fall to it", fix)


def _relative_checks(train: Train | RobotTrain) -> Iterator[Problem]:
    if train.relative_exclude is not None and not train.relative_actions:
        found = f"train.relative_exclude: {', '.join(train.relative_exclude)}"
        fix = "set it, or delete train.relative_exclude"
        yield Problem(found, "train.relative_actions: true beside it", fix)


def _augment_checks(train: Train | RobotTrain) -> Iterator[Problem]:
    if train.augment is None and "augment_count" in changed(train):
        found = f"train.augment_count: {train.augment_count} without train.augment"
        fix = "e.g. train.augment: [brightness, contrast], or delete train.augment_count"
        yield Problem(found, "transformations to draw from", fix)


def _extension_checks(recipe: Recipe) -> Iterator[Problem]:
    """Check that a run can have been extended as the recipe says."""
    earlier, plans = recipe.train.extended_from, recipe.train.plans  # `steps` is the last plan
    if list(plans) != sorted(set(plans)):
        named = ", ".join(map(str, plans[:-1]))
        found = f"train.extended_from: {named} with train.steps: {recipe.train.steps}"
        fix = "raise train.steps, which cannot fall again, or delete train.extended_from"
        yield Problem(found, "rising numbers below train.steps", fix)
    if earlier and recipe.train.backbone_until < 1:  # a share of which plan's steps?
        found = f"train.extended_from with train.backbone_until: {recipe.train.backbone_until:g}"
        yield Problem(found, "one of the two", "delete train.extended_from")


def _source_checks(recipe: Recipe) -> Iterator[Problem]:
    """Check that robot frames suffice for the parts of the anchor."""
    if recipe.anchor.source == "demos" and recipe.anchor.parts != ("moments",):
        yield Problem(
            f"anchor.parts: {', '.join(recipe.anchor.parts)} with anchor.source: demos",
            "only moments: the other parts need answers, which frames do not have",
            "set anchor.parts to [moments]",
        )


def _robot_checks(recipe: RobotStreamRecipe) -> Iterator[Problem]:
    yield from _demos_checks(recipe.demos, len(recipe.tasks), recipe.simulated)
    yield from _task_checks(recipe)
    train = recipe.train
    yield from _schedule_checks(train)
    yield from _relative_checks(train)
    yield from _augment_checks(train)
    if train.weights != "float32" and train.method == "sequential":
        yield Problem(
            f"train.weights: {train.weights} with train.method: sequential, which trains all "
            "weights",
            "weights that keep small steps",
            "set train.weights to float32, or train.method to igsp or isolated-lora",
        )
    if train.batch_size < train.accumulate:
        yield Problem(
            f"train.batch_size: {train.batch_size} with train.accumulate: {train.accumulate}",
            "at least one frame in each pass of a step",
            f"set train.accumulate to at most {train.batch_size}",
        )
    plain = [task for task in recipe.tasks if task not in TASKS]
    if recipe.expert.start is not None:
        found = f"expert.start: {recipe.expert.start} with a stream"
        yield Problem(found, "a new expert, which learns all tasks", "delete expert.start")
    if recipe.probe.max_drop is not None:
        found = f"probe.max_drop: {recipe.probe.max_drop:g} with a stream"
        yield Problem(
            found, "no gate: a stream has a figure after each task", "delete probe.max_drop"
        )
    if recipe.probe.gate != MEAN:
        found = f"probe.gate: {recipe.probe.gate} with a stream"
        yield Problem(found, "no gate: a stream has a figure after each task", "delete probe.gate")
    if recipe.probe.while_training is not None:
        found = f"probe.while_training: {recipe.probe.while_training} with a stream"
        yield Problem(
            found,
            "no such key: a stream asks its questions after each task",
            "delete probe.while_training",
        )
    if not isinstance(recipe.probe.vqa, str):
        found = f"probe.vqa: {', '.join(recipe.probe.vqa)} with a stream"
        yield Problem(found, "one set of questions", f"set probe.vqa to {recipe.probe.vqa[0]}")
    if recipe.simulated and plain and "colors" in changed(recipe.rollout):
        found = f"rollout.colors: {recipe.rollout.colors} with task {plain[0]}"
        yield Problem(found, _NO_COLORS, "delete rollout.colors")


def _task_checks(recipe: RobotStreamRecipe) -> Iterator[Problem]:
    """Check that all tasks are simulated or none is, and that the rollout keys apply to them."""
    own = [task for task in recipe.tasks if not TASK.accepts(task)]
    simulated = [task for task in recipe.tasks if task not in own]
    near = did_you_mean(own[0], TASKS) if own else None
    fix = "correct tasks, or" if near is None else f"did you mean '{near}'? Or"
    if own and recipe.demos.paths is None:
        yield Problem(
            f"tasks: '{own[0]}', which is not simulated, without demos.paths",
            TASK.expected,
            f"{fix} give the demonstrations of each task in demos.paths, if no simulator has it",
        )
        return
    if own and simulated:
        yield Problem(
            f"tasks: '{own[0]}', which is not simulated, beside '{simulated[0]}', which is",
            f"all tasks simulated ({TASK.expected}), or none: a stream is measured in one way",
            f"{fix} give '{simulated[0]}' another name, if no simulator has it",
        )
        return
    # Keys that are not read are refused, since a user who sets them expects an effect.
    read = (
        {"ensemble", "frames", "replan"}
        if own
        else {f.name for f in fields(RobotRollout)} - {"frames"}
    )
    for name in sorted(changed(recipe.rollout).keys() - read):
        found = f"rollout.{name}: {getattr(recipe.rollout, name)} with task {recipe.tasks[0]}"
        expected = (
            "only rollout.ensemble, frames and replan: no simulator has this task"
            if own
            else "no such key: a simulated task is rolled out, without recorded frames"
        )
        yield Problem(found, expected, f"delete rollout.{name}")


def _demos_checks(demos: RobotDemos, tasks: int, simulated: bool) -> Iterator[Problem]:
    """Check that lists have one item per task, and that there are demonstrations to choose from."""
    if isinstance(demos.paths, tuple) and len(demos.paths) != tasks:
        yield Problem(
            f"demos.paths: {len(demos.paths)} with {tasks} tasks",
            "one per task, in their order, or a text: a single one for all",
            "correct demos.paths" + ", or delete it to have them recorded" * simulated,
        )
    if demos.only is not None and len(demos.only) != tasks:
        yield Problem(
            f"demos.only: {len(demos.only)} with {tasks} tasks",
            "one per task, in their order",
            "correct demos.only, or delete it",
        )
    for name in ("only", "rename"):
        if getattr(demos, name) is not None and demos.paths is None:
            fix = f"set demos.paths to them, or delete demos.{name}"
            yield Problem(f"demos.{name} without demos.paths", "demonstrations that are given", fix)


def anchor_checks(recipe: Recipe, methods: Sequence[str]) -> Iterator[Problem]:
    """Check that the anchor that `aegis run` measures has the parts that these methods read."""
    measured = recipe.anchor
    for method in methods:
        missing = [part for part in NEEDS.get(method, ()) if part not in measured.parts]
        if missing:
            fix = f"set anchor.parts to [{', '.join((*measured.parts, *missing))}]"
            found = f"anchor.parts: {', '.join(measured.parts)} with method {method}"
            yield Problem(found, f"anchor.parts with {' and '.join(missing)}", fix)
    share = recipe.nullspace.energy  # the anchor stores directions only up to its own share
    if "nullspace" in methods and share is not None and share > measured.energy:
        found = f"nullspace.energy: {share:g} with anchor.energy: {measured.energy:g}"
        yield Problem(
            found, "an anchor that keeps at least that share", f"set anchor.energy to {share:g}"
        )


def merge_checks(recipe: Recipe, methods: Sequence[str]) -> Iterator[Problem]:
    """Check that policies of these methods can be merged as the recipe says, if it does."""
    merge, measured = recipe.merge, recipe.anchor.parts
    if merge.method is None:
        for name in changed(merge):
            found = f"merge.{name}: {getattr(merge, name)} without merge.method"
            yield Problem(found, "a method that merges", f"set merge.method, or delete {name}")
        return
    for name in MERGE_UNREAD.get(merge.method, ()):
        if name in changed(merge):
            found = f"merge.{name}: {getattr(merge, name)} with merge.method: {merge.method}"
            yield Problem(found, "a method that reads it", f"delete merge.{name}")
    if merge.method == "linear" and merge.strength > 1:
        found = f"merge.strength: {merge.strength:g} with merge.method: linear"
        yield Problem(found, "the share of the way back, from 0 to 1", "set merge.strength: 0.4")
    if "stop-gradient" in methods:
        found = f"merge.method: {merge.method} with method stop-gradient"
        yield Problem(found, "methods that move the backbone", "delete merge, or stop-gradient")
    part = MERGE_NEEDS.get(merge.method)
    if part is not None and part not in measured:
        fix = f"set anchor.parts to [{', '.join((*measured, part))}]"
        found = f"anchor.parts: {', '.join(measured)} with merge.method: {merge.method}"
        yield Problem(found, f"anchor.parts with {part}", fix)


def check_run(recipe: Recipe) -> None:
    """Raise AegisError if a recipe's anchor or merge does not fit its methods."""
    checks = (anchor_checks, merge_checks)
    problems = [problem for check in checks for problem in check(recipe, recipe.methods)]
    refuse(problems, f"recipe {recipe.name}")
