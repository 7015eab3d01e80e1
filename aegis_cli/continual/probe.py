"""`aegis probe` on the run of a stream: the accuracy matrix, measured again from the
run's files.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aegis_cli import recipes
from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.continual import files, train
from aegis_cli.continual.stream_evaluate import Evaluator
from aegis_cli.core.accuracy_matrix import StreamScores, scores
from aegis_cli.recipes import StreamRecipe


@dataclass(frozen=True)
class StreamProbeReport:
    """The matrix R [T, T] as in a stream's report, of the same parts.

    Attributes:
        measured: how many rows were measured, the last ones: all where what serves a learned task
            never changes, and else the one of the end, since the weights of the other rows are
            gone; those are as the training measured them.
        largest_difference: between the measured rows and the training's.
    """

    method: str
    tasks: tuple[str, ...]
    split: str
    oracle: tuple[tuple[float, ...], ...]
    inferred: tuple[tuple[float, ...], ...]
    scores: StreamScores
    inferred_scores: StreamScores
    measured: int
    largest_difference: float
    out: str

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def run(path: Path, on_event: OnEvent = ignore) -> StreamProbeReport:
    """Load a finished run's experts or encoder, evaluate every row that they can give, and write
    the matrix.

    Raises:
        AegisError: the run is not done, its files are damaged, or images, words or encoder are no
            longer the same.
    """
    path = Path(path)
    before = files.report(path)
    recipe = recipes.load(path / "recipe.yaml", kind=StreamRecipe)
    built = train.build(files.encoder_of(recipe, path), path, on_event)
    files.check_inputs(built, before)
    if built.learner.trains == "experts":
        files.attach(built)
    evaluator, count = (
        Evaluator(built.encoder, built.sites, built.tasks, built.learner),
        len(built.tasks),
    )
    oracle, inferred = list(before.oracle), list(before.inferred)
    rows = range(count) if built.learner.frozen else [count - 1]
    for done, t in enumerate(rows, 1):
        told, guessed = evaluator.row(t, built.gaussians[: t + 1])
        oracle[t], inferred[t] = tuple(told), tuple(guessed)
        on_event(Progress("probe", done, len(rows), "rows"))
    old, new = (*before.oracle, *before.inferred), (*oracle, *inferred)
    found = dataclasses.replace(
        before,
        oracle=tuple(oracle),
        inferred=tuple(inferred),
        scores=scores(oracle),
        inferred_scores=scores(inferred),
    )
    files.write_matrix(path, found)
    return StreamProbeReport(
        found.method,
        found.tasks,
        found.split,
        found.oracle,
        found.inferred,
        found.scores,
        found.inferred_scores,
        len(rows),
        max(abs(x - y) for a, b in zip(old, new, strict=True) for x, y in zip(a, b, strict=True)),
        str(path),
    )
