"""Settings of individual suite tasks: their instructions, and how the planner solves them.

All other suite tasks use defaults.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from aegis_cli.sim.contract import SUITE
from aegis_cli.sim.planner import Search

Guide = Callable[[Any], float]  # takes the domain's Physics


@dataclass(frozen=True)
class Known:
    """The settings of one task.

    Args:
        text: the instruction; None: derived from the names.
        search: how the planner searches.
        guide: a term that the planner adds to a reward that is uninformative until the task is
            done. Reported returns never include it.
    """

    text: str | None = None
    search: Search = Search()
    guide: Guide | None = None


def _pole_up(physics: Any) -> float:
    """Height of the pendulum: 0 hanging, 1 upright."""
    return (1 + physics.pole_vertical()) / 2


def _poles_up(physics: Any) -> float:
    """Mean height of the cart's poles: 0 hanging, 1 upright."""
    return float(1 + np.mean(physics.pole_angle_cosine())) / 2


def _ball_over_cup(physics: Any) -> float:
    """The ball's height over the target, up to 10 cm, minus its distance, in metres.

    The height term keeps the ball from being pulled against the bottom of the cup from below.
    """
    gap = physics.ball_to_target()
    return float(min(-gap[1], 0.1) - np.linalg.norm(gap))


def _tip_near_target(physics: Any) -> float:
    """Minus the metres from tip to target."""
    return -float(physics.dist_to_target())


def _finger_near_target(physics: Any) -> float:
    """Minus the metres from finger to target."""
    return -float(physics.finger_to_target_dist())


def _mass_near_target(physics: Any) -> float:
    """Minus the metres from mass to target."""
    return -float(physics.mass_to_target_dist())


def _spinning(physics: Any) -> float:
    """Fraction of the rewarded speed, which is 15 rad/s, in [-1, 1]."""
    return float(np.clip(-physics.hinge_velocity() / 15, -1, 1))


# The instructions use words that the embedded VLM knows, so that it can be trained on these tasks:
# the cart is the object, and a pole is the arm.
_POLE_OVER_CART = "slide the object to put the arm over it"
_TURN = "push the tip of the object to the target"
_CART = Search(horizon_s=1.2, knots=6, score_s=0.08)
_FINGER = Search(samples=24, score_s=0.08)
KNOWN: dict[str, Known] = {
    "ball_in_cup-catch": Known(
        "bring the ball into the target",
        Search(horizon_s=0.7, knots=6, samples=24, score_s=0.08),
        _ball_over_cup,
    ),
    "cartpole-balance": Known(_POLE_OVER_CART, _CART),
    "cartpole-balance_sparse": Known(_POLE_OVER_CART, _CART, _poles_up),
    "cartpole-swingup": Known(_POLE_OVER_CART, _CART),
    "cartpole-swingup_sparse": Known(_POLE_OVER_CART, _CART, _poles_up),
    "finger-spin": Known("push the object over", guide=_spinning),
    "finger-turn_easy": Known(_TURN, _FINGER, _tip_near_target),
    "finger-turn_hard": Known(_TURN, _FINGER, _tip_near_target),
    "pendulum-swingup": Known(
        "bring the mass over the arm",
        Search(horizon_s=2.0, samples=24, score_s=0.06, replan_s=0.06),
        _pole_up,
    ),
    "point_mass-easy": Known("move the mass to the target", guide=_mass_near_target),
    "point_mass-hard": Known("move the mass to the target", guide=_mass_near_target),
    "reacher-easy": Known("move the finger to the target", guide=_finger_near_target),
    "reacher-hard": Known("move the finger to the target", guide=_finger_near_target),
}


def sentence(name: str) -> str:
    """The instruction of `suite/<domain>-<task>`."""
    domain, _, task = name.removeprefix(SUITE).partition("-")
    known = KNOWN.get(f"{domain}-{task}", Known()).text
    return known or f"make the {domain} {task}".replace("_", " ").lower()
