"""Which checkpoints of a run are kept if `train.keep_checkpoints` limits their number."""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

from aegis_cli.recipes import Recipe
from aegis_cli.training import checkpoint, folder, validation_vqa


class Best(NamedTuple):
    """The best of some checkpoints.

    Attributes:
        step: None if none has a validation loss.
        passes: whether it is known to pass the recipe's gate; None if the recipe has no gate, or
            no checkpoint was asked anything.
    """

    step: int | None
    passes: bool | None


def prune(out: Path, step: int, count: int, recipe: Recipe) -> None:
    """Remove the checkpoints before `step`, except the last ones and the best one.

    Later ones stay, for a user who went back to an earlier checkpoint. If the process is killed
    during removal, the rest has a temporary name, which the next checkpoint cleans up.

    Args:
        step: step of the checkpoint that has just been written, which is the newest.
        count: how many of the last ones stay, including that one.
        recipe: recipe of the run, whose gate the best checkpoint should pass.

    Raises:
        AegisError: the log is damaged, or the disk cannot be written.
    """
    there = {int(path.name): path for path in checkpoint.whole(out)}
    behind = sorted(number for number in there if number <= step)
    for number in {*behind[:-count]} - {best(out, behind, recipe).step}:
        # A rename is one step: a checkpoint is there whole, or not at all.
        aside = there[number].with_name(f".{there[number].name}.tmp")
        with checkpoint.writing(out):
            os.rename(there[number], aside)
            shutil.rmtree(aside)


def best(out: Path, steps: Collection[int], recipe: Recipe) -> Best:
    """The step with the lowest validation loss.

    If the recipe limits the drop in accuracy, it is the best of the steps whose measured drop is
    within the limit, if there are any. Among equal losses it is the earliest step.
    """
    losses: dict[int, float] = {}
    keeping, any_asked = set[int](), False
    for line in folder.read_metrics(out, "step"):
        if line["step"] in steps and line.get("validation_loss") is not None:
            losses[line["step"]] = line["validation_loss"]
            asked = validation_vqa.of_line(recipe, line)
            any_asked |= bool(asked)
            if asked and not validation_vqa.past_limit(recipe, asked):
                keeping.add(line["step"])
    limited = keeping if recipe.probe.max_drop is not None else set()
    step = min(limited or losses, key=lambda step: (losses[step], step), default=None)
    has_gate = recipe.probe.max_drop is not None and any_asked
    return Best(step, bool(limited) if has_gate else None)


def most_at_once(planned: int, there: int, count: int | None) -> int:
    """The most checkpoints that a run adds to the disk at any one time.

    These are the last ones, the best one, and the one that is written before another is removed.

    Args:
        planned: checkpoints that are still to be written.
        there: how many exist already.
        count: as in `train.keep_checkpoints`; None: all are kept.
    """
    return planned if count is None else min(planned, max(1, count + 2 - there))
