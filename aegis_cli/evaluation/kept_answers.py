"""Save a model's answers, so that an interrupted probe can resume.

A probe with more questions reuses them too, and a baseline is asked only once. An answer is found
by the model, the question and its image, and the code, libraries and device that computed it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

from aegis_cli.common import circumstances, files, kept_digests
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, OnEvent, Progress
from aegis_cli.common.kept_lines import KeptLines
from aegis_cli.common.ranks import Ranks
from aegis_cli.data.batch import Share
from aegis_cli.data.vqa import digests
from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.data.vqa.metrics import Graded, grade, graded_answer
from aegis_cli.models import backbones
from aegis_cli.models.backbones.base import Backbone

Said = tuple[str, float]  # an answer and its cross-entropy


class Loaded(NamedTuple):
    """A model, and a digest of everything in it that its answers depend on.

    The digest is None for random weights, and if the files changed while they were read, since it
    is then unknown which weights were loaded.
    """

    model: Backbone
    digest: str | None


def load(name: str) -> Loaded:
    """Load a backbone, as `backbones.load` does, and find the digest of its answers."""
    before = _places(name)
    model = backbones.load(name)
    if not before:
        return Loaded(model, None)
    home = next(iter(before)).parent
    weights = kept_digests.of_files(before, home)
    if _places(name) != before:  # a running training also makes `last` point to another folder
        return Loaded(model, None)
    content = [weights[path] for path in sorted(weights)]
    return Loaded(model, files.sha256_value({"weights": content, "settings": model.settings()}))


def about(model: Backbone) -> dict[str, Any]:
    """Everything in a model that its answers depend on, as JSON; its weights are read for this."""
    return {"weights": model.fingerprint(), "settings": model.settings()}


def of_now(model: Backbone) -> Loaded:
    """A model as it is now, possibly with weights that are in no file."""
    return Loaded(model, files.sha256_value(about(model)))


def _places(name: str) -> dict[Path, object]:
    """The resolved paths of a model's files with their state; empty if it cannot be loaded."""
    try:
        paths = [Path(os.path.realpath(path)) for path in backbones.model_files(name)]
        return {path: kept_digests.stamp(path) for path in paths if path.is_file()}
    except (AegisError, OSError):  # loading it gives the better error
        return {}


def ask(
    loaded: Loaded,
    asked: VQASet,
    batch_size: int,
    ranks: Ranks,
    on_event: OnEvent,
) -> list[Graded]:
    """Every question's graded answer; `models.asking.ask` is called for those without one.

    The batches are those of an uninterrupted run, so an answer is the same bit for bit whether the
    work was interrupted or not. Answers are saved at once.

    Args:
        ranks: the processes, each of which asks a share of the questions.
    """
    model = loaded.model
    own = asked.part(Share(ranks.rank, ranks.count).rows(len(asked.questions)))
    own = own.sized(model.image_size)
    with torch.no_grad():
        if loaded.digest is None:
            graded = grade(model.answers, own, batch_size, on_event)
        else:
            by = {"model": loaded.digest, **circumstances.of_answers()}
            kept = KeptLines("answers", by, on_event)
            graded = _asked(model, own, batch_size, kept, on_event)
    return [one for part in ranks.gathered(graded) for one in part]


def _asked(
    model: Backbone, own: VQASet, batch_size: int, kept: KeptLines, on_event: OnEvent
) -> list[Graded]:
    keys = digests.of_questions(own)
    known = {line["question"]: _said(line) for line in kept.read() if _is_answer(line)}
    rows: list[int] = []  # of the batches that are not fully answered
    for first in range(0, len(keys), batch_size):
        batch = range(len(keys))[first : first + batch_size]
        if not all(keys[row] in known for row in batch):
            rows += batch
    if rows:
        names = iter([keys[row] for row in rows])

        def keep(graded: Sequence[Graded]) -> None:
            given = {next(names): (one.said, one.cross_entropy) for one in graded}
            known.update(given)
            kept.add(_line(key, *said) for key, said in given.items())

        told = _going_on(len(keys) - len(rows), len(keys), on_event)
        grade(model.answers, own.part(rows), batch_size, told, keep)
    else:
        on_event(Progress("probe", len(keys), len(keys), "questions"))
    numbers = own.image_of.tolist()
    return [
        graded_answer(question, *known[key], number)
        for question, key, number in zip(own.questions, keys, numbers, strict=True)
    ]


def _going_on(done: int, total: int, on_event: OnEvent) -> OnEvent:
    """A listener for the remaining questions, which adds the `done` answered ones to progress."""

    def told(event: Event) -> None:
        if isinstance(event, Progress):
            event = replace(event, done=event.done + done, total=total)
        on_event(event)

    return told


# --- lines ----------------------------------------------------------------------------------------


def _line(question: str, said: str, cross_entropy: float) -> dict[str, object]:
    return {"question": question, "said": said, "cross_entropy": cross_entropy}


def _is_answer(line: Mapping[str, object]) -> bool:
    """Whether a line is complete; other answers are computed again."""
    kinds = {"question": str, "said": str, "cross_entropy": float}
    return all(isinstance(line.get(name), kind) for name, kind in kinds.items())


def _said(line: Mapping[str, object]) -> Said:
    said, cross_entropy = line["said"], line["cross_entropy"]
    assert isinstance(said, str) and isinstance(cross_entropy, float)
    return said, cross_entropy
