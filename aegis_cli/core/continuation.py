"""Real-time chunking: predict an action chunk that continues the one still being executed.

Black, Galliker, Levine: Real-Time Execution of Action Chunking Flow Policies (arXiv 2506.07339).
While the policy predicts a chunk, the robot keeps executing the previous one, so it has moved when
the new chunk arrives. If the new chunk planned another path, the robot would jerk. So each flow
step is pulled towards the rest of the old chunk: fully for the actions that will have been executed
by then, with decreasing weight for later ones, and not at all beyond its end.

With t = 1 at the noise and t = 0 at the action, as in `models.flow`, a velocity v(x, t) expects the
action a(x) = x - t v(x, t). Guidance by pseudo-inverse (the paper's equations 2 to 5, whose time
runs the other way) replaces the velocity by

    v - g(t) J^T W (y - a(x)),    g(t) = min(b, (t^2 + (1 - t)^2) / (t (1 - t))),

where y is the old chunk, W has a weight for each of its steps, J is the derivative of a(x), and
b = 5 bounds the pull when x is almost pure noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

STRONGEST = 5.0  # the paper's bound b

Velocity = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Continued:
    """The old chunk that a new one continues.

    Attributes:
        actions: the rest of the old chunk [B, n, A] at the time of the observation, n <= H.
        delay: how many of them are executed before the new chunk arrives, at most n.
    """

    actions: Tensor
    delay: int


def weights(left: int, delay: int, horizon: int) -> Tensor:
    """How strongly each step of a new chunk is held to the old one [horizon] float32, in [0, 1].

    Args:
        left: n, the remaining steps of the old chunk.
        delay: d <= n; the steps that are executed before the new chunk arrives.
        horizon: H >= n.
    """
    step = torch.arange(horizon, dtype=torch.float64, device="cpu")
    # The paper's soft mask: c (e^c - 1) / (e - 1), where c falls linearly from 1 at the last
    # executed step to 0 at the first step past the end of the old chunk. For earlier executed steps
    # the quotient is above 1, so their weight is clamped to 1.
    share = ((left - step) / (left - delay + 1)).clamp(0, 1)
    return (share * torch.expm1(share) / (math.e - 1)).float()


def strength(time: Tensor) -> Tensor:
    """g(t) at flow times [B] in (0, 1]."""
    rest = 1 - time
    exact = (time.square() + rest.square()) / (time * rest)  # infinite at t = 1
    return exact.clamp(max=STRONGEST)


def guided(velocity: Velocity, continued: Continued, horizon: int) -> Velocity:
    """The velocity that leads to a chunk [B, H, A] which continues the old one.

    Args:
        velocity: v(x, t) for chunks [B, H, A] and times [B]; it is differentiated by autograd.
        continued: the old chunk, in the units of the flow.
    """
    left = continued.actions.shape[1]
    each_step = weights(left, continued.delay, horizon)
    held = each_step.to(continued.actions.device)[:, None]  # W as a column [H, 1]
    # Steps past the end of the old chunk have weight 0, so the padding value does not matter.
    target = torch.nn.functional.pad(continued.actions, (0, 0, 0, horizon - left))

    def pulled(x: Tensor, time: Tensor) -> Tensor:
        # Actions are sampled without gradients, so enable them for this derivative only.
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            moves = velocity(x, time)
            expected = x - time[:, None, None] * moves
            missing = held * (target - expected.detach())  # W (y - a(x)), [B, H, A]
            # J^T W (y - a(x)) as a vector-Jacobian product, without forming J.
            (pull,) = torch.autograd.grad(expected, x, missing.to(expected.dtype))
        return moves.detach() - strength(time)[:, None, None] * pull

    return pulled
