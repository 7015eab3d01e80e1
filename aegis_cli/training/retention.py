"""Which checkpoints of a run stay where `train.keep_checkpoints` bounds their number."""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection
from pathlib import Path

from aegis_cli.recipes import Recipe
from aegis_cli.training import checkpoint, folder, validation_vqa


def prune(out: Path, step: int, count: int, recipe: Recipe) -> None:
    """Remove the checkpoints before `step` but for the last ones and the best one.

    Later ones stay, for a user who went back to an earlier checkpoint. What is half removed
    when the process is killed bears a name that the next checkpoint clears away.

    Args:
        step: of the checkpoint that has just been written, which is the newest.
        count: how many of the last ones stay, that one included.
        recipe: of the run, whose gate the best one is to pass.

    Raises:
        AegisError: the log is damaged, or the disk refuses.
    """
    there = {int(path.name): path for path in checkpoint.whole(out)}
    behind = sorted(number for number in there if number <= step)
    for number in {*behind[:-count]} - {best(out, behind, recipe)}:
        # A rename is one step: a checkpoint is there whole, or not at all.
        aside = there[number].with_name(f".{there[number].name}.tmp")
        with checkpoint.writing(out):
            os.rename(there[number], aside)
            shutil.rmtree(aside)


def best(out: Path, steps: Collection[int], recipe: Recipe) -> int | None:
    """The one of these steps with the least validation loss; None where none has a loss.

    Where the recipe limits the drop, it is the best of those of which answers have shown that they
    keep to the limit, if there are any. Where losses are equal, it is the earliest step.
    """
    losses: dict[int, float] = {}
    keeping: set[int] = set()
    for line in folder.read_metrics(out, "step"):
        if line["step"] in steps and line.get("validation_loss") is not None:
            losses[line["step"]] = line["validation_loss"]
            asked = validation_vqa.of_line(recipe, line)
            if asked and not validation_vqa.past_limit(recipe, asked):
                keeping.add(line["step"])
    limited = keeping if recipe.probe.max_drop is not None else set()
    return min(limited or losses, key=lambda step: (losses[step], step), default=None)


def most_at_once(planned: int, there: int, count: int | None) -> int:
    """How many checkpoints a run adds to its disk at most at one time.

    That is the last ones and the best one, and the one that is written before another goes.

    Args:
        planned: checkpoints that are still to be written.
        there: how many lie there already.
        count: as `train.keep_checkpoints` says; None: all stay.
    """
    return planned if count is None else min(planned, max(1, count + 2 - there))
