"""The questions that a command asks, and how, if the command line does not say."""

from __future__ import annotations

import dataclasses
import shlex
from pathlib import Path

from aegis_cli.cli import render, resuming
from aegis_cli.common import launch
from aegis_cli.common.errors import AegisError
from aegis_cli.recipes import Probe


def chosen(
    model: str,
    vqa: str | None,
    ask: str | None,
    skip_bad: bool,
    batch_size: int | None,
    questions: int | None = None,
    seed: int | None = None,
) -> Probe:
    """The questions and how they are asked; a run's own recipe replaces arguments that are None.

    Args:
        model: a run, one of its checkpoints, or a backbone.
        vqa: the question set; the default is the recipe's first set. The recipe's limit on the drop
            applies only to its own sets.
        skip_bad: the recipe's setting also applies, but only to its own set.
    """
    named = _of_run(model, asks=vqa is None)
    own = named[0]
    of_recipe = vqa is None or vqa in [each.vqa for each in named]
    return dataclasses.replace(
        own,
        # The recipe sets no limit on the drop for other questions.
        max_drop=own.max_drop if of_recipe else None,
        vqa=own.vqa if vqa is None else vqa,
        ask=own.ask if ask is None else ask,
        skip_bad=skip_bad or (vqa is None and own.skip_bad),
        batch_size=own.batch_size if batch_size is None else batch_size,
        questions=own.questions if questions is None else questions,
        seed=own.seed if seed is None else seed,
    )


def baseline(model: str, anchor: Path | None = None, needed: bool = True) -> str | None:
    """The default baseline for the drop of a run.

    It is the pre-trained VLM from which the run started, possibly through other runs, or the one
    among these models that the anchor was measured on. None for a model without a run.

    Args:
        needed: whether the drop has to be measured; otherwise None if the baseline is not on this
            machine, with a note.
    """
    from aegis_cli.common import artifacts
    from aegis_cli.evaluation import results

    run = results.run_of(Path(model))
    if run is None:
        return None
    origins = results.origins(run)
    if anchor is not None:
        measured = artifacts.read_header(anchor, "anchor").fingerprint
        known = [number for number, origin in enumerate(origins) if origin.digest == measured]
        # The drift is measured from the anchor's model, so the drop is too.
        origins = origins[: known[0] + 1] if known else origins
    *between, began_from = [origin.name for origin in origins]  # nearest first
    if not needed and (lacking := _lacking(run, began_from)) is not None:
        if launch.rank() == 0:
            render.note(f"only the accuracy is measured, and no drop: {lacking}")
        return None
    resuming.check_seen(run, [began_from], "probe")
    if launch.rank() == 0:
        by_way = f" by way of {', '.join(between)}" if between else ""
        render.note(f"the baseline is '{began_from}', the model that the run began from{by_way}")
    return began_from


def _lacking(run: Path, began_from: str) -> str | None:
    """Why a run cannot be compared with the model that it began from; None if it can."""
    from aegis_cli.models import backbones

    try:
        resuming.check_seen(run, [began_from], "probe")
    except AegisError as error:
        return error.found
    if backbones.is_here(began_from):
        return None
    return (
        f"'{began_from}', the model that the run began from, is not on this machine (--baseline "
        "says where)"
    )


def _of_run(model: str, asks: bool) -> tuple[Probe, ...]:
    """The `probe` of a run's recipe for each set; the defaults for a model without a run.

    Args:
        asks: whether the first of these is used.
    """
    from aegis_cli.evaluation import results

    run = results.run_of(Path(model))
    if run is None:
        return (Probe(),)
    first, *others = named = results.recipe_of(run).probe.of_each_set()
    if asks:
        resuming.check_seen(run, [str(first.vqa)], "probe")
    if asks and others and launch.rank() == 0:
        left = ", ".join(f"--vqa {shlex.quote(str(other.vqa))}" for other in others)
        render.note(f"asking the questions of '{first.vqa}'; the run's recipe also names {left}")
    return named
