"""`aegis probe` on the run of a stream of robot tasks: success and knowledge, measured again from
the run's files.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress, ignore
from aegis_cli.continual import robot_files
from aegis_cli.continual.robot_evaluate import Evaluator, questions
from aegis_cli.continual.robot_report import Knowledge, knowledge
from aegis_cli.core.accuracy_matrix import SeenScores, seen_scores


@dataclass(frozen=True)
class RobotProbeReport:
    """The matrix S and the backbone's knowledge as in a stream's report.

    Attributes:
        measured: how many rows of both were measured, the last ones: all where what serves a
            learned task never changes, and else the one of the end; what came before the first task
            is as the training measured it.
        largest_difference: between what was measured and the training's, in success and accuracy.
    """

    method: str
    tasks: tuple[str, ...]
    success: tuple[tuple[float, ...], ...]
    scores: SeenScores
    vqa: tuple[Knowledge, ...]
    measured: int
    largest_difference: float
    out: str

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def run(path: Path, on_event: OnEvent = ignore) -> RobotProbeReport:
    """Load a finished run, measure every row that it can still give, and write the matrix.

    Of frozen experts a task is tried once: its column has the same policy in every row.

    Raises:
        AegisError: the run is not done, or its files are damaged or of another backbone.
    """
    path = Path(path)
    before, built = robot_files.report(path), robot_files.load(path)
    source = questions(built.recipe, on_event)
    if any(before.inputs.get(name) != digest for name, digest in source.sha256.items()):
        found = (
            f"other questions than the run in '{path}' was measured with: "
            f"{', '.join(source.sha256)}"
        )
        raise AegisError(
            found, "the same files", "bring them back, or train the stream again in another --out"
        )
    evaluator, count = Evaluator(built, source, on_event), len(built.names)
    now = []
    for task in range(count):
        now.append(evaluator.success(task))
        on_event(Progress("probe", task + 1, count, "tasks"))
    known = evaluator.vqa()
    first = 0 if built.learner.frozen else count - 1
    success = (*before.success[:first], *(tuple(now[: t + 1]) for t in range(first, count)))
    told = [(k.accuracy, k.cross_entropy) for k in before.vqa]
    vqa = knowledge([*told[: first + 1], *[known] * (count - first)])
    found = dataclasses.replace(before, success=success, scores=seen_scores(success), vqa=vqa)
    robot_files.write_matrix(path, found)
    old, new = (
        (*(v for row in r.success for v in row), *(k.accuracy for k in r.vqa))
        for r in (before, found)
    )
    return RobotProbeReport(
        found.method,
        found.tasks,
        found.success,
        found.scores,
        found.vqa,
        count - first,
        max(abs(x - y) for x, y in zip(old, new, strict=True)),
        str(path),
    )
