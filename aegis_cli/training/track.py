"""Trackers that show a run while it trains: TensorBoard, Trackio and Weights & Biases.

Each gets the lines of metrics.jsonl, under the same names, and later what probes, rollouts and
open-loop evaluations measure of the run. A tracker's package is imported only if a recipe names it.
Nothing leaves the machine unless the user configures the tracker to send it, for example by its
environment variables.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from aegis_cli import recipes
from aegis_cli.common import media
from aegis_cli.common.errors import AegisError
from aegis_cli.recipes import Recipe
from aegis_cli.training import folder

PROJECT = "aegis"
Log = Callable[[Mapping[str, float]], None]  # one line of metrics.jsonl, its step included
# The tables of a probe, of a rollout over a set of tasks, and of one with colours.
_TABLES = ("families", "tasks", "target_colors")


@dataclass(frozen=True)
class Measured:
    """What a probe, a rollout or an open-loop evaluation measured of a run.

    Attributes:
        name: of its file, such as `probe-scenes`.
        step: the run's last one.
        header, rows: its table, with one row per family of questions or per task; empty if there is
            none.
        video: of some episodes.
    """

    name: str
    step: int
    figures: Mapping[str, float]
    header: Sequence[str] = ()
    rows: Sequence[Sequence[str | float]] = ()
    video: Path | None = None


class Tracker(NamedTuple):
    """An open tracker: a function for lines of the log, and one for measurements."""

    log: Log
    show: Callable[[Measured], None]


def check(recipe: Recipe) -> None:
    """Refuse a tracker that is not installed, before any work.

    Raises:
        AegisError: a tracker that the recipe names is not installed.
    """
    missing = [name for name in recipe.train.track or () if find_spec(name) is None]
    if missing:
        raise AegisError(
            f"train.track: {', '.join(missing)}, which is not installed",
            "the packages of the trackers that the recipe names",
            f"pip install {' '.join(missing)}, or all of them: pip install 'aegis-vla[track]'",
        )


@contextmanager
def following(recipe: Recipe, out: Path, done: int, speaks: bool = True) -> Generator[Log]:
    """Open a run's trackers and close them at the end; without any, nothing is logged.

    Args:
        out: the run's folder, for trackers that write files.
        done: steps already taken by a resumed run.
        speaks: whether this process is the one that logs.
    """
    with ExitStack() as stack:
        names = (recipe.train.track or ()) if speaks else ()
        opened = [stack.enter_context(_TRACKERS[name](recipe, out, done)) for name in names]

        def log(line: Mapping[str, float]) -> None:
            for each in opened:
                each.log(line)

        yield log


def tell(recipe: Recipe, out: Path, name: str, report: Mapping[str, Any], step: int) -> None:
    """Send what was measured of a run to its trackers.

    Trackers that are not installed are skipped: a run may be measured on another machine than it
    was trained on.

    Args:
        name: of the measurement's file.
        report: the measurement, as `--json` shows it.
        step: the last one of the run.
    """
    names = [name for name in recipe.train.track or () if find_spec(name) is not None]
    if not names:
        return
    found = _measured(name, report, step)
    for tracker in names:
        with _TRACKERS[tracker](recipe, out, None, "measuring") as opened:
            opened.show(found)


def _measured(name: str, report: Mapping[str, Any], step: int) -> Measured:
    """The scalar figures of a report, and its table if it has one."""
    table = next((report[key] for key in _TABLES if report.get(key)), {})
    # The first row's figures are the columns: all rows of a measurement have the same ones.
    columns = list(_numbers(next(iter(table.values()), {})))
    rows = []
    for line, figures in table.items():
        rows.append([line, *(figures[column] for column in columns)])
    video = report.get("video")
    return Measured(
        name,
        step,
        _numbers(report),
        ["", *columns] if rows else (),
        rows,
        None if video is None else Path(video),
    )


def _numbers(values: Mapping[str, Any]) -> dict[str, float]:
    plain = {name: value for name, value in values.items() if isinstance(value, int | float)}
    # In Python a bool is an int, but it makes no curve.
    return {name: value for name, value in plain.items() if not isinstance(value, bool)}


def _figures(line: Mapping[str, float]) -> dict[str, float]:
    return {name: value for name, value in line.items() if name != "step"}


# --- TensorBoard ----------------------------------------------------------------------------------


@contextmanager
def _tensorboard(recipe: Recipe, out: Path, done: int | None, job: str = "") -> Generator[Tracker]:
    """Event files in the run's folder: tensorboard --logdir runs.

    Args:
        done: steps already taken; None for a measurement, which keeps all steps.
    """
    from torch.utils.tensorboard import SummaryWriter

    # Steps logged after the checkpoint that a run is resumed from are repeated; all steps are, if
    # it was killed before its first checkpoint.
    writer = SummaryWriter(str(out / "tensorboard"), purge_step=None if done is None else done + 1)

    def log(line: Mapping[str, float]) -> None:
        for name, value in _figures(line).items():
            writer.add_scalar(name, value, int(line["step"]))
        writer.flush()  # otherwise it flushes every two minutes, and a killed run would lose lines

    def show(found: Measured) -> None:
        for name, value in found.figures.items():
            writer.add_scalar(f"{found.name}/{name}", value, found.step)
        if found.rows:
            writer.add_text(f"{found.name}/table", _markdown(found), found.step)
        if found.video is not None:
            assert writer.file_writer is not None
            writer.file_writer.add_summary(_moving(f"{found.name}/video", found.video), found.step)

    try:
        yield Tracker(log, show)
    finally:
        writer.close()


def _markdown(found: Measured) -> str:
    """The table in Markdown, for TensorBoard's text plugin."""
    shown = [[f"{x:.4g}" if isinstance(x, float) else f"{x}" for x in row] for row in found.rows]
    lines = [found.header, ["---"] * len(found.header), *shown]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _moving(name: str, video: Path) -> Any:
    """A video as a GIF, the only kind that TensorBoard shows; its own encoder needs moviepy."""
    from tensorboard.compat.proto.summary_pb2 import Summary

    gif, width, height = media.as_gif(video)
    image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=gif)
    return Summary(value=[Summary.Value(tag=name, image=image)])


# --- Trackio, and Weights & Biases, which it takes after ------------------------------------------


@contextmanager
def _trackio(recipe: Recipe, out: Path, done: int | None, job: str = "") -> Generator[Tracker]:
    """Trackio's own local database: trackio show --project aegis."""
    import trackio

    trackio.init(project=PROJECT, name=_name(out), config=_config(recipe), resume="allow")
    try:
        yield _tracker(trackio, trackio.log)
    finally:
        trackio.finish()


@contextmanager
def _wandb(
    recipe: Recipe, out: Path, done: int | None, job: str = "training"
) -> Generator[Tracker]:
    """Files in the run's folder; `wandb sync` or WANDB_MODE=online send them.

    A run that was finished offline cannot be opened again: later measurements become a new run in
    the same group.
    """
    import wandb

    run = wandb.init(
        project=PROJECT,
        name=_name(out),
        group=_name(out),
        job_type=job,
        config=_config(recipe),
        dir=str(out),
        mode=os.environ.get("WANDB_MODE", "offline"),
    )
    try:
        yield _tracker(wandb, run.log)
    finally:
        run.finish()


def _tracker(module: Any, send: Callable[..., None]) -> Tracker:
    """A tracker whose module has `Table` and `Video`, and whose `send` takes figures by name."""

    def log(line: Mapping[str, float]) -> None:
        send(_figures(line), step=int(line["step"]))

    def show(found: Measured) -> None:
        shown: dict[str, Any] = dict(found.figures)
        if found.rows:
            rows = [list(row) for row in found.rows]
            shown["table"] = module.Table(columns=list(found.header), data=rows)
        if found.video is not None:
            shown["video"] = module.Video(str(found.video))
        send({f"{found.name}/{name}": value for name, value in shown.items()}, step=found.step)

    return Tracker(log, show)


def _name(out: Path) -> str:
    """A name for the run: the last two parts of its folder, or three for a merged run."""
    out = out.resolve()
    return "-".join(out.parts[-2 if folder.trained_in(out) == out else -3 :])


def _config(recipe: Recipe) -> dict[str, Any]:
    """The settings that affect the training, which a tracker shows beside the curves."""
    return {"recipe": recipe.name, **recipes.without_retired(recipes.training_part(recipe))}


_TRACKERS = {"tensorboard": _tensorboard, "trackio": _trackio, "wandb": _wandb}
