"""Trackers that show a training while it runs: TensorBoard, Trackio and Weights & Biases.

Each gets the lines of metrics.jsonl, under their names there. A tracker's package is imported when
a recipe names it. Nothing leaves the machine unless the user says so to the tracker itself, as by
its environment variables.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from aegis_cli import recipes
from aegis_cli.common.errors import AegisError
from aegis_cli.recipes import Recipe

PROJECT = "aegis"
Log = Callable[[Mapping[str, float]], None]  # one line of metrics.jsonl, its step included


def check(recipe: Recipe) -> None:
    """Refuse a tracker that is not installed, before any work.

    Raises:
        AegisError: one that the recipe names is not.
    """
    missing = [name for name in recipe.train.track or () if find_spec(name) is None]
    if missing:
        raise AegisError(
            f"train.track: {', '.join(missing)}, which is not installed",
            "the packages of the trackers that the recipe names",
            f"pip install {' '.join(missing)}, or all of them: pip install 'aegis-vla[track]'",
        )


@contextmanager
def following(recipe: Recipe, out: Path, done: int, speaks: bool = True) -> Iterator[Log]:
    """Trackers of a run, opened and in the end closed; without any, nothing is logged.

    Args:
        out: the run's folder, where those that write files write them.
        done: steps behind a run that goes on.
        speaks: whether this process is the one that writes.
    """
    with ExitStack() as stack:
        names = (recipe.train.track or ()) if speaks else ()
        logs = [stack.enter_context(_TRACKERS[name](recipe, out, done)) for name in names]

        def log(line: Mapping[str, float]) -> None:
            for each in logs:
                each(line)

        yield log


def _figures(line: Mapping[str, float]) -> dict[str, float]:
    return {name: value for name, value in line.items() if name != "step"}


@contextmanager
def _tensorboard(recipe: Recipe, out: Path, done: int) -> Iterator[Log]:
    """Event files in the run's folder: tensorboard --logdir runs."""
    from torch.utils.tensorboard import SummaryWriter

    # What was logged after the checkpoint that a run goes on from is repeated.
    writer = SummaryWriter(str(out / "tensorboard"), purge_step=done + 1 if done else None)

    def log(line: Mapping[str, float]) -> None:
        for name, value in _figures(line).items():
            writer.add_scalar(name, value, int(line["step"]))
        writer.flush()

    try:
        yield log
    finally:
        writer.close()


@contextmanager
def _trackio(recipe: Recipe, out: Path, done: int) -> Iterator[Log]:
    """Trackio's own local database: trackio show --project aegis."""
    import trackio

    trackio.init(project=PROJECT, name=_name(out), config=_config(recipe), resume="allow")
    try:
        yield lambda line: trackio.log(_figures(line), step=int(line["step"]))
    finally:
        trackio.finish()


@contextmanager
def _wandb(recipe: Recipe, out: Path, done: int) -> Iterator[Log]:
    """Files in the run's folder; `wandb sync` or WANDB_MODE=online send them."""
    import wandb

    run = wandb.init(
        project=PROJECT,
        name=_name(out),
        config=_config(recipe),
        dir=str(out),
        mode=os.environ.get("WANDB_MODE", "offline"),
    )
    try:
        yield lambda line: run.log(_figures(line), step=int(line["step"]))
    finally:
        run.finish()


def _name(out: Path) -> str:
    """A name that tells the run from others: its folder's last two parts."""
    return "-".join(out.resolve().parts[-2:])


def _config(recipe: Recipe) -> dict[str, Any]:
    """What a tracker shows beside the curves: what shapes the training."""
    return {"recipe": recipe.name, **recipes.training_part(recipe)}


_TRACKERS = {"tensorboard": _tensorboard, "trackio": _trackio, "wandb": _wandb}
