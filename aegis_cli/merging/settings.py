"""How `aegis merge` moves a backbone back, and what it measures for that."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from aegis_cli.common.errors import AegisError
from aegis_cli.data.selection import Paths

DAMPING = 0.01
# Strengths of a sweep in which none are named: each method's from little to nearly all of the way.
GRIDS = {
    "linear": (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8),
    "kfac-shrink": (0.003, 0.01, 0.03, 0.1, 0.3, 1.0),
    "inputs": (0.1, 0.3, 1.0, 3.0, 10.0),
    "factors": (1.0, 3.0, 10.0, 30.0, 100.0, 300.0),
}


@dataclass(frozen=True)
class MergeSettings:
    """All but the strength.

    Attributes:
        method: one of `MERGES`.
        damping: added to each eigenvalue of every factor, whose mean is 1.
        base: the pre-trained model; None: the one that the run's recipe names.
        demos: of the run, one set or all of several; None: those that its recipe names, or that lie
            beside it.
        anchor: of the base; None: it is measured on `samples` questions of `vqa`.
        vqa: the questions whose answers are to be kept.
        ask: what a question becomes before a model reads it, with {} for it.
        task_vqa: the task as questions, for a model without a run.
        samples: questions that the anchor is measured on where none is given.
        temperature: what their answers' scores are divided by before the curvature's words are
            drawn from them.
        frames: of demonstrations that the task's factors are measured on.
        questions: for validation, of each set.
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
    """Raise AegisError for a strength that the method does not take."""
    if method == "linear" and strength > 1:
        raise AegisError(
            f"strength {strength:g} of a linear merge",
            "the share of the way back, from 0 to 1",
            "e.g. --strength 0.4, which keeps 0.6 of the displacement",
        )
