"""The policy: normalizers, flow samples that share a backbone pass, chunks in raw units."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from samples.training import CHUNK, INSTRUCTIONS, adapt, gradients, images, make_policy, robot_batch
from torch import Tensor

from aegis_cli.data.batch import Normalizer, deviations
from aegis_cli.methods import METHODS
from aegis_cli.models import flow
from aegis_cli.models.policy import Policy


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


# --- scales ---------------------------------------------------------------------------------------


def test_normalized_rows_have_mean_zero_and_deviation_one() -> None:
    rows = torch.randn(500, 2, generator=generator()) * torch.tensor([3.0, 0.01]) + torch.tensor(
        [1.0, -2.0]
    )
    scaled = Normalizer.fit(rows)(rows).double()
    torch.testing.assert_close(scaled.mean(0), torch.zeros(2).double(), rtol=0, atol=1e-4)
    torch.testing.assert_close(
        scaled.std(0, correction=0), torch.ones(2).double(), rtol=1e-4, atol=0
    )


def test_a_large_mean_costs_no_digits() -> None:
    """In float32, E[x^2] - E[x]^2 gives anything from 0 to 0.66 here."""
    rows = 1000 + 0.25 * torch.randn(2000, 1, generator=generator())
    expected = rows.double().std(0, correction=0).float()
    torch.testing.assert_close(Normalizer.fit(rows).std, expected, rtol=1e-6, atol=0)


@pytest.mark.parametrize("level", [0.0, 1.0, -500.0])
@pytest.mark.parametrize("fit", [Normalizer.fit, Normalizer.fit_quantiles])
def test_a_dimension_that_never_varied_is_only_centred_and_keeps_its_value(
    fit: Callable[[Tensor], Normalizer], level: float
) -> None:
    noise = torch.randn(200, 1, generator=generator())
    still = level + (1e-6 * abs(level) if level else 1e-7) * noise
    rows = torch.cat([still, noise], dim=1)
    scale = fit(rows)
    # Whatever is predicted for it, the robot receives the value that it always had.
    predicted = scale.invert(torch.randn(50, 2, generator=generator(1)))
    assert (predicted[:, 0] == scale.mean[0]).all() and predicted[:, 1].std() > 0.1
    # sensor noise a thousand times larger than any seen before is still a small input
    assert scale(rows + 1e-3)[:, 0].abs().max() < 0.01


@pytest.mark.parametrize("fit", [Normalizer.fit, Normalizer.fit_quantiles])
def test_rows_without_dimensions_have_scales_without_any(
    fit: Callable[[Tensor], Normalizer],
) -> None:
    rows = torch.zeros(20, 0)
    scale = fit(rows)
    assert scale.mean.shape == scale.std.shape == deviations(rows).shape == (0,)
    assert scale(rows).shape == scale.invert(rows).shape == (20, 0)


@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e-5])
@pytest.mark.parametrize("fit", [Normalizer.fit, Normalizer.fit_quantiles])
def test_small_units_are_scaled_as_large_ones(
    fit: Callable[[Tensor], Normalizer], unit: float
) -> None:
    """For example motions in metres per frame, which are a hundredth of a millimetre."""
    rows = torch.randn(300, 2, generator=generator()) + torch.tensor([0.0, 2.0])
    one, other = fit(rows), fit(rows * unit)
    torch.testing.assert_close(other(rows * unit), one(rows), rtol=1e-4, atol=1e-4)
    predicted = torch.randn(20, 2, generator=generator(1))
    torch.testing.assert_close(other.invert(predicted), one.invert(predicted) * unit)


def test_a_dimension_that_varies_in_few_frames_is_predicted() -> None:
    rows = torch.zeros(400, 1)
    rows[:2] = 1.0  # a gripper that closes twice: both quantiles are 0
    scale = Normalizer.fit_quantiles(rows)
    assert scale.std[0] == 1
    torch.testing.assert_close(scale.invert(scale(rows)), rows)


def test_invert_undoes_forward() -> None:
    rows = torch.randn(50, 3, generator=generator()) * 4 + 2
    rows[:, 2] = 7.0
    scale = Normalizer.fit(rows)
    torch.testing.assert_close(scale.invert(scale(rows)), rows)


# --- the loss -------------------------------------------------------------------------------------


def velocity(policy: Policy, samples: slice) -> Tensor:
    """[B, K, H, A] for fixed noise at fixed times, for some of K = 3 flow samples."""
    batch = robot_batch()
    encoding = policy.encode(batch.images, batch.instructions)
    noisy = torch.randn(5, 3, CHUNK, 2, generator=generator(1))
    times = flow.draw_times((5, 3), generator(2))
    return policy.expert(
        noisy[:, samples],
        times[:, samples],
        policy.proprio_scale(batch.proprio),
        encoding.keys_values,
        encoding.mask,
    )


@torch.no_grad()
def test_flow_samples_of_a_frame_do_not_see_each_other() -> None:
    policy = make_policy()
    together = velocity(policy, slice(None))
    apart = torch.cat([velocity(policy, slice(k, k + 1)) for k in range(3)], dim=1)
    torch.testing.assert_close(together, apart, rtol=1e-5, atol=1e-6)
    assert (together[:, 0] - together[:, 1]).abs().max() > 1e-3


@torch.no_grad()
def test_the_loss_is_that_of_the_velocity_on_the_path() -> None:
    """Written out with the same draws: times first, then the noise."""
    policy, batch = make_policy(), robot_batch()
    encoding = policy.encode(batch.images, batch.instructions)
    got = policy.flow_loss(batch, encoding, 3, generator(4))
    draw = generator(4)
    t = flow.draw_times((5, 3), draw)
    noise = torch.randn(5, 3, CHUNK, 2, generator=draw)
    actions = (batch.actions - policy.action_scale.mean) / policy.action_scale.std
    x = torch.stack(
        [t[:, k, None, None] * noise[:, k] + (1 - t[:, k, None, None]) * actions for k in range(3)],
        dim=1,
    )
    proprio = (batch.proprio - policy.proprio_scale.mean) / policy.proprio_scale.std
    v = policy.expert(x, t, proprio, encoding.keys_values, encoding.mask)
    errors = (v - (noise - actions[:, None])).square().mean(-1)
    valid = [
        errors[b, k, h]
        for b in range(5)
        for k in range(3)
        for h in range(CHUNK)
        if not batch.is_pad[b, h]
    ]
    torch.testing.assert_close(got, torch.stack(valid).mean())


def test_detaching_keeps_the_value() -> None:
    naive, stopped = (
        gradients(adapt(METHODS[name], make_policy()), METHODS[name]).loss
        for name in ("naive", "stop-gradient")
    )
    assert torch.equal(naive, stopped)


def test_detaching_ends_the_gradient_at_the_keys_and_values() -> None:
    policy, batch = make_policy(), robot_batch()
    for detach in (False, True):
        policy.zero_grad()
        encoding = policy.encode(batch.images, batch.instructions)
        policy.flow_loss(batch, encoding, 2, generator(), detach=detach).backward()
        assert all(p.grad is not None for p in policy.expert.parameters())
        assert all(p.grad is None for p in policy.backbone.parameters()) == detach


@torch.no_grad()
def test_the_expert_reads_image_text_and_proprioception() -> None:
    policy, batch = make_policy(), robot_batch()

    def act(frames: Tensor, texts: list[str], proprio: Tensor) -> Tensor:
        return policy.act(frames, texts, proprio, generator())

    texts = list(batch.instructions)
    base = act(batch.images, texts, batch.proprio)
    assert not torch.equal(base, act(images(5, seed=1), texts, batch.proprio))
    assert not torch.equal(base, act(batch.images, [INSTRUCTIONS[0]] * 5, batch.proprio))
    assert not torch.equal(base, act(batch.images, texts, batch.proprio + 1))


# --- acting ---------------------------------------------------------------------------------------


def test_chunks_come_in_raw_units() -> None:
    """An expert whose field is the noise itself ends at the normalised action 0, the raw mean."""
    policy = make_policy()
    policy.expert.forward = lambda x, t, *_: (
        x / t[..., None, None]
    )  # the field that leads every x to 0
    got = policy.act(images(2), list(INSTRUCTIONS[:2]), torch.zeros(2, 3), generator())
    assert got.shape == (2, CHUNK, 2)
    torch.testing.assert_close(got, policy.action_scale.mean.expand_as(got), rtol=0, atol=1e-6)


def test_acting_is_a_function_of_its_generator() -> None:
    policy = make_policy()
    first, again, other = (
        policy.act(images(2), list(INSTRUCTIONS[:2]), torch.zeros(2, 3), generator(seed))
        for seed in (0, 0, 1)
    )
    assert torch.equal(first, again) and not torch.equal(first, other)


def test_a_frame_is_acted_on_alike_alone_and_in_company() -> None:
    """Longer texts in the batch only add padding, which the expert must not read."""
    policy, batch = make_policy(), robot_batch()
    with torch.no_grad():
        encodings = [policy.encode(batch.images[:n], batch.instructions[:n]) for n in (2, 3)]
        assert encodings[0].mask.shape[1] < encodings[1].mask.shape[1]
        noisy, times = torch.randn(3, 1, CHUNK, 2, generator=generator()), torch.full((3, 1), 0.5)
        state = policy.proprio_scale(batch.proprio[:3])
        two, three = (
            policy.expert(noisy[:n], times[:n], state[:n], encoding.keys_values, encoding.mask)
            for n, encoding in zip((2, 3), encodings, strict=True)
        )
    torch.testing.assert_close(two, three[:2], rtol=1e-5, atol=1e-6)
