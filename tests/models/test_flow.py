"""Flow matching: the distribution of times, the path, the solver and the masked loss."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from aegis_cli.models import flow


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


# --- times ----------------------------------------------------------------------------------------


def test_times_are_beta_distributed() -> None:
    """Beta(1.5, 1) * 0.999 + 0.001 has mean 0.6 and quantile p^(2/3).

    The tolerance is 5 standard errors of 200,000 draws.
    """
    times = flow.draw_times((200_000,), generator()).double()
    beta = (times - 0.001) / 0.999
    assert abs(beta.mean() - 0.6) < 5 * 0.2619 / 200_000**0.5
    for p in (0.1, 0.25, 0.5, 0.75, 0.9):
        assert abs((beta <= p ** (2 / 3)).double().mean() - p) < 5 * (p * (1 - p) / 200_000) ** 0.5


def test_times_stay_in_range_and_follow_their_generator() -> None:
    times = flow.draw_times((1000, 7), generator(3))
    assert times.shape == (1000, 7) and times.dtype == torch.float32
    assert times.min() >= 0.001 and times.max() <= 1
    assert torch.equal(times, flow.draw_times((1000, 7), generator(3)))
    assert not torch.equal(times, flow.draw_times((1000, 7), generator(4)))


def test_times_leave_the_global_random_state_alone() -> None:
    before = torch.random.get_rng_state()
    flow.draw_times((10,), generator())
    assert torch.equal(before, torch.random.get_rng_state())


# --- the path -------------------------------------------------------------------------------------


@pytest.fixture
def ends() -> tuple[Tensor, Tensor]:
    """Actions [B, 1, H, A] and noise [B, K, H, A]."""
    return torch.randn(3, 1, 4, 2, generator=generator(1)), torch.randn(
        3, 5, 4, 2, generator=generator(2)
    )


def test_time_one_is_noise_and_time_zero_the_action(ends: tuple[Tensor, Tensor]) -> None:
    actions, noise = ends
    assert torch.equal(flow.interpolate(actions, noise, torch.ones(3, 5))[0], noise)
    assert torch.equal(
        flow.interpolate(actions, noise, torch.zeros(3, 5))[0], actions.expand_as(noise)
    )


def test_the_target_is_the_derivative_of_the_path(ends: tuple[Tensor, Tensor]) -> None:
    actions, noise = (x.double() for x in ends)
    times = flow.draw_times((3, 5), generator()).double()
    x, target = flow.interpolate(actions, noise, times)
    later, _ = flow.interpolate(actions, noise, times + 1e-6)
    torch.testing.assert_close((later - x) / 1e-6, target, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(x - times[..., None, None] * target, actions.expand_as(x))


# --- the solver -----------------------------------------------------------------------------------


def test_a_straight_field_is_integrated_exactly() -> None:
    """The conditional field eps - a is constant in time, so any number of steps is exact."""
    actions, noise = (
        torch.randn(3, 4, 2, generator=generator(s), dtype=torch.float64) for s in (1, 2)
    )
    for steps in (1, 7, flow.EULER_STEPS):
        got = flow.integrate(lambda x, t: noise - actions, noise, steps)
        torch.testing.assert_close(got, actions, rtol=0, atol=1e-14)


def test_a_field_that_knows_the_action_is_followed_from_any_noise() -> None:
    """v(x, t) = (x - a) / t is the marginal field of a single action."""
    actions = torch.randn(3, 4, 2, generator=generator(1), dtype=torch.float64)
    noise = torch.randn(3, 4, 2, generator=generator(2), dtype=torch.float64)
    got = flow.integrate(lambda x, t: (x - actions) / t[:, None, None], noise)
    torch.testing.assert_close(got, actions, rtol=0, atol=1e-6)  # times are float32


def test_the_solver_runs_from_time_one_in_ten_steps_and_never_evaluates_zero() -> None:
    seen: list[Tensor] = []

    def velocity(x: Tensor, t: Tensor) -> Tensor:
        seen.append(t)
        return torch.zeros_like(x)

    noise = torch.randn(3, 4, 2, generator=generator())
    assert torch.equal(flow.integrate(velocity, noise), noise)
    assert all(t.shape == (3,) for t in seen)
    torch.testing.assert_close(torch.stack(seen)[:, 0], torch.linspace(1, 0.1, 10))


# --- the loss -------------------------------------------------------------------------------------


@pytest.fixture
def judged() -> tuple[Tensor, Tensor, Tensor]:
    """Velocity and target [B, K, H, A], is_pad [B, H]; the second chunk has one valid action."""
    velocity, target = (torch.randn(2, 3, 4, 2, generator=generator(s)) for s in (1, 2))
    return velocity, target, torch.tensor([[False, False, False, False], [False, True, True, True]])


def test_the_loss_is_the_mean_over_valid_entries(judged: tuple[Tensor, Tensor, Tensor]) -> None:
    velocity, target, is_pad = judged
    errors = (velocity - target).square()
    expected = torch.cat([errors[0].flatten(), errors[1, :, 0].flatten()]).mean()
    torch.testing.assert_close(flow.masked_mse(velocity, target, is_pad), expected)


def test_padding_neither_counts_nor_dilutes(judged: tuple[Tensor, Tensor, Tensor]) -> None:
    velocity, target, is_pad = judged
    loss = flow.masked_mse(velocity, target, is_pad)
    other = velocity.clone()
    other[1, :, 1:] = 1e6
    assert flow.masked_mse(other, target, is_pad) == loss
    # an error of one everywhere is a loss of one, however much is padding
    assert flow.masked_mse(target + 1, target, is_pad) == pytest.approx(1.0)


def test_padded_entries_get_no_gradient(judged: tuple[Tensor, Tensor, Tensor]) -> None:
    velocity, target, is_pad = judged
    velocity.requires_grad_(True)
    flow.masked_mse(velocity, target, is_pad).backward()
    padded = is_pad[:, None, :, None].expand_as(velocity)
    assert (velocity.grad[padded] == 0).all() and (velocity.grad[~padded] != 0).all()
