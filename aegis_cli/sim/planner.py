"""Sampling-based predictive control: sample plans around the last one, simulate, take the best.

This is predictive sampling as in MuJoCo MPC (arXiv 2212.00541), with noise of several scales at
once and a weighted mean of the best few. A plan is [K, A]: K knots of A actions in [-1, 1],
linearly interpolated. The module knows no task.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from aegis_cli.common import gl

gl.choose_backend()

import mujoco  # noqa: E402  (the backend is chosen when MuJoCo is imported)
from mujoco.rollout import Rollout  # noqa: E402

# Bounds of the noise's standard deviation, where 1 is half the range of an action. It is drawn
# log-uniformly for each plan.
_LEAST_NOISE, _MOST_NOISE = 0.05, 1.0
_ELITES = 4  # plans in the weighted mean

Score = Callable[[np.ndarray], np.ndarray]  # plans [N, K, A] -> their scores [N], higher is better


@dataclass(frozen=True)
class Search:
    """How far ahead the planner looks, and how densely.

    Attributes:
        horizon_s: seconds that a plan covers.
        knots: K.
        samples: plans per search.
        score_s: seconds between two rewards that count towards a plan's score.
        replan_s: seconds after which a new plan is made.
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
    """The rest of a plan after a fraction `share` of its horizon; its end holds the last knot."""
    last = len(plan) - 1
    return _read(plan, np.minimum(np.arange(len(plan)) + share * last, last))


def _read(plan: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The plan's actions [len(at), A] at knot indices, which may be fractional."""
    low = np.minimum(at.astype(int), len(plan) - 2)
    part = (at - low)[:, None]
    return (1 - part) * plan[low] + part * plan[low + 1]


def improve(plan: np.ndarray, score: Score, samples: int, rng: np.random.Generator) -> np.ndarray:
    """The best plan [K, A] among this one, `samples` - 1 samples around it, and a mean of the best.

    The mean smooths plans that differ only in noise. If the best few take different ways, their
    mean scores low, and the best single plan is taken.
    """
    noise = np.exp(rng.uniform(np.log(_LEAST_NOISE), np.log(_MOST_NOISE), size=(samples, 1, 1)))
    drawn = np.clip(plan + noise * rng.standard_normal((samples, *plan.shape)), -1, 1)
    drawn[0] = plan
    scores = score(drawn)
    best = np.argsort(-scores, kind="stable")[:_ELITES]
    first, spread = best[0], scores.std()
    if spread == 0:
        return plan
    weights = np.exp((scores[best] - scores[first]) / spread)
    mean = np.tensordot(weights / weights.sum(), drawn[best], axes=1)
    mean = np.clip(mean, -1, 1)  # rounding may exceed the bounds
    return mean if score(mean[None])[0] > scores[first] else drawn[first]


class Simulator:
    """Simulates many futures of one model at once.

    Args:
        substeps: physics steps in a control step, all with the same control.
        threads: number of threads that share the work, which does not change the result; 1 is the
            calling thread.
    """

    def __init__(self, model: mujoco.MjModel, substeps: int, threads: int = 1) -> None:
        self._model, self._substeps = model, substeps
        self._scratch = [mujoco.MjData(model) for _ in range(threads)]
        self._rollout = Rollout(nthread=threads if threads > 1 else 0)

    def states(self, start: np.ndarray, controls: np.ndarray) -> np.ndarray:
        """Full physics states [N, T, S] after each of T control steps.

        Args:
            start: the initial state [S] of all futures.
            controls: [N, T, U].
        """
        fine = np.repeat(controls, self._substeps, axis=1)
        found, _ = self._rollout.rollout(self._model, self._scratch, start, fine)
        return found[:, self._substeps - 1 :: self._substeps]
