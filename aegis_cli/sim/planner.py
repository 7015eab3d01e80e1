"""Sampling-based predictive control: draw plans about the last one, simulate them, keep what the
best have in common.

Predictive sampling as in MuJoCo MPC (arXiv 2212.00541), with noise of several sizes at once and a
weighted mean of the best few. A plan is [K, A]: K knots of A actions in [-1, 1], straight lines
between them. Knows no task.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from aegis_cli.common import gl

gl.choose_backend()

import mujoco  # noqa: E402  (the backend is chosen when MuJoCo is imported)
from mujoco.rollout import Rollout  # noqa: E402

_LEAST_NOISE, _MOST_NOISE = (
    0.05,
    1.0,
)  # standard deviations, 1 = half of an action's range; log-uniform, one a plan
_ELITES = 4

Score = Callable[[np.ndarray], np.ndarray]  # plans [N, K, A] -> what each is worth [N]


@dataclass(frozen=True)
class Search:
    """How far ahead and how densely to look; a plan is scored every `score_s` and made anew every
    `replan_s`.
    """

    horizon_s: float = 1.0
    knots: int = 8
    samples: int = 32
    score_s: float = 0.04
    replan_s: float = 0.04


def follow(plan: np.ndarray, steps: int) -> np.ndarray:
    """The actions [steps, A] of a plan whose last knot is the last of `steps` steps."""
    return _read(plan, np.linspace(0, len(plan) - 1, steps))


def shift(plan: np.ndarray, share: float) -> np.ndarray:
    """The plan as seen after `share` of its horizon has passed; it ends by holding its
    last knot.
    """
    last = len(plan) - 1
    return _read(plan, np.minimum(np.arange(len(plan)) + share * last, last))


def _read(plan: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The plan's actions [len(at), A] at knot numbers, whole or between."""
    low = np.minimum(at.astype(int), len(plan) - 2)
    part = (at - low)[:, None]
    return (1 - part) * plan[low] + part * plan[low + 1]


def improve(plan: np.ndarray, score: Score, samples: int, rng: np.random.Generator) -> np.ndarray:
    """The best plan [K, A] of: this one, `samples` - 1 draws about it, and what the best few of
    them have in common.

    That last one smooths, where to and fro are worth the same; where the best few go different ways
    about it, it is worth little, and a single one is taken.
    """
    noise = np.exp(rng.uniform(np.log(_LEAST_NOISE), np.log(_MOST_NOISE), size=(samples, 1, 1)))
    drawn = np.clip(plan + noise * rng.standard_normal((samples, *plan.shape)), -1, 1)
    drawn[0] = plan
    worth = score(drawn)
    best = np.argsort(-worth, kind="stable")[:_ELITES]
    first, spread = best[0], worth.std()
    if spread == 0:
        return plan
    weights = np.exp((worth[best] - worth[first]) / spread)
    common = np.clip(
        np.tensordot(weights / weights.sum(), drawn[best], axes=1), -1, 1
    )  # rounding may leave the bounds
    return common if score(common[None])[0] > worth[first] else drawn[first]


class Simulator:
    """Many futures of one model at once, shared out among threads; which thread does what changes
    nothing.

    Args:
        substeps: physics steps of a control step, all with the same control.
        threads: 1: the caller's own.
    """

    def __init__(self, model: mujoco.MjModel, substeps: int, threads: int = 1) -> None:
        self._model, self._substeps = model, substeps
        self._scratch = [mujoco.MjData(model) for _ in range(threads)]
        self._rollout = Rollout(nthread=threads if threads > 1 else 0)

    def states(self, start: np.ndarray, controls: np.ndarray) -> np.ndarray:
        """Full physics states [N, T, S] after each of T control steps from `start` [S] under
        `controls` [N, T, U].
        """
        fine = np.repeat(controls, self._substeps, axis=1)
        found, _ = self._rollout.rollout(self._model, self._scratch, start, fine)
        return found[:, self._substeps - 1 :: self._substeps]
