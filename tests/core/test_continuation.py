"""A chunk that continues another one: the paper's weights and guidance, and their effect."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from aegis_cli.core import continuation
from aegis_cli.core.continuation import Continued, Velocity
from aegis_cli.models import flow


@pytest.mark.parametrize("seed", range(20))
def test_weights_fall_from_what_is_executed_to_what_is_free(seed: int) -> None:
    rng = np.random.default_rng(seed)
    horizon = int(rng.integers(1, 51))
    left = int(rng.integers(0, horizon + 1))
    delay = int(rng.integers(0, left + 1))
    found = continuation.weights(left, delay, horizon)
    assert found.shape == (horizon,) and found.dtype == torch.float32
    assert (found[:delay] == 1).all() and (found[left:] == 0).all()
    between = found[delay:left]
    assert ((between > 0) & (between < 1)).all() and (between.diff() < 0).all()


def test_weights_between_are_those_of_the_paper() -> None:
    """Equation 5, for H = 8 of which 3 were executed, and a delay of 2."""
    shares = np.array([3, 2, 1]) / 4  # (H - s - i) / (H - s - d + 1) for i = 2, 3, 4
    expected = [1, 1, *(shares * (np.exp(shares) - 1) / (np.e - 1)), 0, 0, 0]
    np.testing.assert_allclose(continuation.weights(5, 2, 8), expected, rtol=1e-6)


def test_the_strength_is_the_papers() -> None:
    """Equations 2 and 4, where time runs from the noise at 0 to the action at 1."""
    times = torch.linspace(0.01, 1, 50, dtype=torch.float64)
    toward = 1 - times
    spread = (1 - toward).square() / (toward.square() + (1 - toward).square())
    expected = ((1 - toward) / (toward * spread)).clamp(max=5)
    torch.testing.assert_close(continuation.strength(times), expected)
    assert continuation.strength(torch.ones(1)).item() == 5


def of_a_gaussian(covariance: Tensor) -> Velocity:
    """The exact velocity for chunks [B, H, 1] drawn from N(0, covariance [H, H])."""
    eye = torch.eye(len(covariance), dtype=covariance.dtype)

    def velocity(x: Tensor, time: Tensor) -> Tensor:
        t = float(time[0])
        seen = torch.linalg.inv((1 - t) ** 2 * covariance + t**2 * eye)
        # E[eps | x] - E[a | x] for x = t eps + (1 - t) a
        return torch.einsum("ij,bja->bia", (t * eye - (1 - t) * covariance) @ seen, x)

    return velocity


def smooth(horizon: int, length: float) -> Tensor:
    """The covariance [H, H] of chunks whose neighbouring steps are similar."""
    step = torch.arange(horizon, dtype=torch.float64)
    return torch.exp(-((step[:, None] - step) ** 2) / (2 * length**2)) + 1e-3 * torch.eye(horizon)


@pytest.mark.parametrize("seed", range(5))
def test_the_pull_is_that_of_the_derivative(seed: int) -> None:
    """The derivative of a linear velocity is known: (I - t M)^T."""
    generator = torch.Generator().manual_seed(seed)
    horizon, left, delay, t = 6, 4, 2, 0.4
    matrix = torch.randn(horizon, horizon, generator=generator, dtype=torch.float64)
    x = torch.randn(2, horizon, 3, generator=generator, dtype=torch.float64)
    old = torch.randn(2, left, 3, generator=generator, dtype=torch.float64)

    def velocity(at: Tensor, _: Tensor) -> Tensor:
        return torch.einsum("ij,bja->bia", matrix, at)

    times = torch.full((2,), t, dtype=torch.float64)
    found = continuation.guided(velocity, Continued(old, delay), horizon)(x, times)
    to_action = torch.eye(horizon, dtype=torch.float64) - t * matrix
    missing = torch.zeros_like(x)
    missing[:, :left] = old - torch.einsum("ij,bja->bia", to_action, x)[:, :left]
    missing *= continuation.weights(left, delay, horizon)[:, None]
    pull = torch.einsum("ji,bja->bia", to_action, missing)
    torch.testing.assert_close(found, velocity(x, times) - continuation.strength(times)[0] * pull)


def test_where_nothing_is_left_nothing_changes() -> None:
    velocity = of_a_gaussian(smooth(5, 2))
    noise = torch.randn(3, 5, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    nothing = Continued(torch.zeros(3, 0, 1, dtype=torch.float64), 0)
    guided = continuation.guided(velocity, nothing, 5)
    assert torch.equal(flow.integrate(guided, noise), flow.integrate(velocity, noise))


@pytest.mark.parametrize("length", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("delay", [1, 2, 4])
def test_what_is_free_follows_what_is_held_as_its_conditional_mean_does(
    length: float, delay: int
) -> None:
    """From the mean of the noise; guidance by pseudo-inverse comes near it, but no nearer."""
    horizon, draws = 8, torch.Generator().manual_seed(0)
    covariance = smooth(horizon, length)
    held = covariance[:delay, :delay]
    standard = torch.randn(delay, 1000, generator=draws, dtype=torch.float64)
    old = (torch.linalg.cholesky(held) @ standard).T
    expected = old @ torch.linalg.solve(held, covariance[:delay, delay])
    velocity = of_a_gaussian(covariance)
    noise = torch.zeros(1000, horizon, 1, dtype=torch.float64)
    guided = continuation.guided(velocity, Continued(old[:, :, None], delay), horizon)
    found = flow.integrate(guided, noise)[:, delay, 0]
    assert (found - expected).square().mean() < expected.square().mean() / 4


def test_the_new_chunk_begins_as_the_old_one_goes_on_and_stays_smooth() -> None:
    """For smooth chunks; without guidance the transition to the new one is a jump."""
    horizon, left, delay = 16, 12, 4
    velocity = of_a_gaussian(smooth(horizon, 4))
    draws = torch.Generator().manual_seed(1)
    noise, other = (
        torch.randn(64, horizon, 1, generator=draws, dtype=torch.float64) for _ in range(2)
    )
    old = flow.integrate(velocity, other, 50)[:, horizon - left :]
    free = flow.integrate(velocity, noise, 50)
    held = flow.integrate(continuation.guided(velocity, Continued(old, delay), horizon), noise, 50)
    jump_of = {
        name: (chunk[:, delay] - old[:, delay - 1]).abs().mean()
        for name, chunk in {"old": old, "free": free, "held": held}.items()
    }
    assert jump_of["held"] < 1.5 * jump_of["old"] < 0.5 * jump_of["free"]
    off = (held - torch.nn.functional.pad(old, (0, 0, 0, horizon - left))).abs().mean((0, 2))
    assert off[:delay].max() < 0.1 < off[left - 1]  # held where it is executed, then released
    roughness = held.diff(dim=1).diff(dim=1).square().mean()
    assert roughness < 2 * free.diff(dim=1).diff(dim=1).square().mean()


def test_parameters_get_no_gradient() -> None:
    layer = torch.nn.Linear(3, 3)
    guided = continuation.guided(
        lambda x, _: layer(x), Continued(torch.zeros(1, 2, 3), 1), horizon=4
    )
    found = flow.integrate(guided, torch.randn(1, 4, 3))
    assert not found.requires_grad and layer.weight.grad is None
