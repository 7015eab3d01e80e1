"""What probes and rollouts have measured of a run, kept in its folder.

`aegis run` writes probe.json and rollout-*.json beside the checkpoints, and knows by their digests
what is up to date. What `aegis probe` and `aegis rollout` measure lies apart, in `results`.
"""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from aegis_cli import recipes
from aegis_cli.common import files, locks
from aegis_cli.evaluation import kept_figures
from aegis_cli.evaluation.estimates import ROUNDING
from aegis_cli.evaluation.kept_figures import ProbeFigures, RolloutFigures
from aegis_cli.training import checkpoint, track

FOLDER = "results"


def keep(
    target: Path, name: str, figures: Mapping[str, Any], settings: Mapping[str, Any]
) -> Path | None:
    """Write a measurement of a run, or of one of its checkpoints, into the run's folder.

    A later one of the same name replaces it.

    Args:
        name: `probe-scenes`, or `rollout-seen`.
        figures: what was measured, as `--json` shows it.
        settings: what was asked for, written beside the figures.

    Returns:
        The file; None where `target` is no run of one policy, or may not be written to.

    Raises:
        AegisError: another process writes there, or the disk is full.
    """
    found = _run_and_step(target)
    if found is None or not os.access(found[0], os.W_OK):
        return None
    run, step = found
    # A file's name or a question set's path may hold anything.
    plain = re.sub(r"[^\w.-]+", "_", name).strip("_.")
    path = run / FOLDER / (f"{plain}.json" if step is None else f"{plain}-{step:06d}.json")
    with locks.alone(path.parent):
        files.save_json(path, {**figures, "settings": dict(settings), "step": step})
    recipe = recipe_of(run)
    if recipe.train.track:
        at = checkpoint.step_of(checkpoint.last(run)) if step is None else step
        track.tell(recipe, run, plain, figures, at)
    return path


def run_of(target: Path) -> Path | None:
    """The run of one policy that a folder is, or has as a checkpoint; None of others."""
    found = _run_and_step(target)
    return None if found is None else found[0]


def recipe_of(run: Path) -> recipes.Recipe:
    """The recipe that a run of one policy was trained by."""
    return recipes.load(run / "recipe.yaml")


def _run_and_step(target: Path) -> tuple[Path, int | None] | None:
    """The run that a path belongs to, and its step if it is a checkpoint's; None of others."""
    if (target / "recipe.yaml").is_file():
        return None if recipes.is_stream_run(target) else (target, None)
    if checkpoint.is_one(target) and (run := checkpoint.run_of(target)) is not None:
        return run, checkpoint.step_of(target)
    return None


@dataclasses.dataclass(frozen=True)
class Result:
    """One measurement of a run.

    Attributes:
        name: of its file, without the ending.
        figures: as `--json` shows them.
        settings: what was asked for; empty where `aegis run` did, by the run's recipe.
    """

    name: str
    figures: dict[str, Any]
    settings: dict[str, Any]


def probes(run: Path) -> list[Result]:
    """The probes of a run's last checkpoint; that of `aegis run` comes first."""
    return _read(run, "probe", ProbeFigures)


def rollouts(run: Path) -> list[Result]:
    """The rollouts of a run's last checkpoint; those of `aegis run` come first.

    Held-out colours come after those of training.
    """
    return sorted(_read(run, "rollout", RolloutFigures), key=lambda found: "held-out" in found.name)


def _read(run: Path, kind: str, figures: type[ProbeFigures | RolloutFigures]) -> list[Result]:
    by_recipe = sorted(run.glob(f"{kind}.json")) + sorted(run.glob(f"{kind}-*.json"))
    found = []
    for path in [*by_recipe, *sorted((run / FOLDER).glob(f"{kind}-*.json"))]:
        # What a study measures on validation data chooses its knobs, and is no result.
        if "validation" in path.stem:
            continue
        raw = kept_figures.read(path, figures)
        settings, step = raw.pop("settings", None) or {}, raw.pop("step", None)
        if step is None:
            found.append(Result(path.stem, raw, settings))
    return found


def gate(probed: Sequence[Result], max_drop: float | None) -> bool | None:
    """Whether every probe passes its gate; None where there is none.

    Args:
        max_drop: that of the run's recipe, to which the probes of `aegis run` are held.
    """
    verdicts = []
    for result in probed:
        passed, drop = result.figures.get("passed"), result.figures.get("drop_points")
        if passed is None and max_drop is not None and not result.settings and drop is not None:
            passed = within(drop, max_drop)
        if passed is not None:
            verdicts.append(passed)
    return all(verdicts) if verdicts else None


def within(drop_points: float, max_drop: float) -> bool:
    """Whether a gate lets a drop pass; one exactly on the border does."""
    return drop_points <= max_drop + ROUNDING
