"""The settings of `aegis merge`: how it moves a backbone back, and what it measures for that."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from aegis_cli.common.errors import AegisError
from aegis_cli.data.selection import Paths

DAMPING = 0.01
# Default strengths of a sweep for each method, from little to nearly all of the way back.
GRIDS = {
    "linear": (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8),
    "kfac-shrink": (0.003, 0.01, 0.03, 0.1, 0.3, 1.0),
    "inputs": (0.1, 0.3, 1.0, 3.0, 10.0),
    "factors": (1.0, 3.0, 10.0, 30.0, 100.0, 300.0),
}


@dataclass(frozen=True)
class MergeSettings:
    """All settings but the strength.

    Attributes:
        method: one of `MERGES`.
        damping: added to each eigenvalue of every factor; a factor's mean eigenvalue is 1.
        base: the pre-trained model; None: the one that the run's recipe names.
        demos: the run's demonstrations, one set or all of several; None: those that its recipe
            names, or that are beside it.
        anchor: the base's anchor; None: it is measured on `samples` questions of `vqa`.
        vqa: the questions whose answers should be kept.
        ask: template of the prompt, with {} for the question.
        task_vqa: the task as questions, for a model without a run.
        samples: number of questions that the anchor is measured on if none is given.
        temperature: what their answers' scores are divided by before the curvature's words are
            drawn from them.
        frames: number of demonstration frames that the task's factors are measured on.
        questions: number of validation questions of each set.
        batch_size: questions per forward pass.
    """

    method: str = "factors"
    damping: float = DAMPING
    base: str | None = None
    demos: Paths | None = None
    anchor: Path | None = None
    vqa: str = "scenes"
    skip_bad: bool = False
    ask: str = "{}"
    task_vqa: str | None = None
    samples: int = 1000
    temperature: float = 1.0
    frames: int = 1000
    questions: int = 2100
    batch_size: int = 64


def check_strength(method: str, strength: float) -> None:
    """Raise AegisError for a strength that the method does not accept."""
    if method == "linear" and strength > 1:
        raise AegisError(
            f"strength {strength:g} of a linear merge",
            "the share of the way back, from 0 to 1",
            "e.g. --strength 0.4, which keeps 0.6 of the displacement",
        )
