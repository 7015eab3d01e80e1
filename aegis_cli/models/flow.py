"""Flow matching over action chunks in openpi's convention: t = 1 is noise, t = 0 is the action.

The equations are those of pi0 (arXiv 2410.24164) as openpi and LeRobot implement them; in the paper
itself time runs the other way.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

EULER_STEPS = 10  # pi0's number of integration steps
_BETA_A, _BETA_B = 1.5, 1.0  # pi0 (arXiv 2410.24164), appendix B: more weight on noisy times


def draw_times(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    """Flow times in [0.001, 1], float32 on the CPU: t = Beta(1.5, 1) * 0.999 + 0.001.

    Beta(a, 1) has the closed quantile function u^(1/a). It is used because
    `torch.distributions.Beta` takes no generator.
    """
    uniform = torch.rand(shape, generator=generator, dtype=torch.float64)
    beta = uniform ** (1 / _BETA_A)
    return (beta * 0.999 + 0.001).float()


def draw_noise(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    """Standard normal noise, float32 on the CPU, whatever the default dtype is."""
    return torch.randn(shape, generator=generator, dtype=torch.float32)


def interpolate(actions: Tensor, noise: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
    """Noisy chunks x_t = t eps + (1 - t) a and their target velocity dx/dt = eps - a.

    Args:
        actions: a [..., H, A], broadcastable against `noise`.
        noise: eps [..., H, A], standard normal.
        times: t [...].
    """
    t = times[..., None, None]
    # The path is a straight line, so its velocity is the same at every t.
    return t * noise + (1 - t) * actions, noise - actions


def masked_mse(
    velocity: Tensor, target: Tensor, is_pad: Tensor, shown: int | None = None
) -> Tensor:
    """Mean squared error over valid action entries only, so that padding never dilutes it.

    Args:
        velocity, target: [B, K, H, A].
        is_pad: [B, H] bool; True where the chunk runs past its episode's end.
        shown: number of valid steps of the larger batch that this one is a share of; the result is
            then the share's contribution to that batch's mean.
    """
    valid = (~is_pad)[:, None, :, None].expand_as(target)  # [B, 1, H, 1] -> [B, K, H, A]
    squares = (velocity - target).square() * valid
    # A mean over all entries, and so each frame's gradient, would shrink with the padding.
    entries = valid.sum() if shown is None else shown * target.shape[1] * target.shape[3]
    return squares.sum() / entries


@torch.no_grad()
def integrate(
    velocity: Callable[[Tensor, Tensor], Tensor], noise: Tensor, steps: int = EULER_STEPS
) -> Tensor:
    """Euler integration of dx/dt = v(x, t) from t = 1 (noise [B, H, A]) to t = 0 (actions)."""
    x = noise
    # Time decreases from noise to action, so a step goes against the velocity.
    for i in range(steps):
        t = torch.full((len(x),), 1 - i / steps, dtype=x.dtype, device=x.device)
        x = x - velocity(x, t) / steps
    return x
