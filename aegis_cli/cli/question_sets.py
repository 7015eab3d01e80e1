"""Which questions a command asks of a model where none are named."""

from __future__ import annotations

from pathlib import Path

from aegis_cli.cli import render
from aegis_cli.common import launch

SCENES = "scenes"


def chosen(model: str, named: str | None, skip_bad: bool) -> tuple[str, bool]:
    """A question set, and whether its bad questions are left out.

    Args:
        model: a run, one of its checkpoints, or a backbone.
        named: the set of the command line; None: the run's own, that of its recipe's `probe.vqa`,
            and drawn scenes of a model without a run.
        skip_bad: as on the command line; the recipe of a run may ask for it too, of its own set.
    """
    if named is not None:
        return named, skip_bad
    from aegis_cli.evaluation import results

    run = results.run_of(Path(model))
    if run is None:
        return SCENES, skip_bad
    first, *others = results.recipe_of(run).probe.of_each_set()
    if others and launch.rank() == 0:
        left = ", ".join(f"--vqa {other.vqa}" for other in others)
        render.note(f"asked are the questions of {first.vqa}; the run's recipe also names {left}")
    return first.vqa, skip_bad or first.skip_bad
