"""Task inference: planted clusters and directions, thresholds, and features that never vary."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from aegis_cli.core.gaussians import NONE, Gaussian, fit, infer

SEEDS = range(3)


def cluster(seed: int, centre: float, count: int = 200) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    return (
        centre
        + torch.rand(6, generator=g) * torch.randn(count, 6, generator=g)
        + torch.randn(6, generator=g)
    )


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("rank", [0, 2, 5])
def test_density_is_that_of_a_normal_with_the_leading_directions_and_one_noise(
    seed: int, rank: int
) -> None:
    features = cluster(seed, 0.0).double()
    found = fit(features, rank, shrinkage=0.0, quantile=0.1)
    covariance = (features - features.mean(0)).T @ (features - features.mean(0)) / len(features)
    values, vectors = torch.linalg.eigh(covariance)
    values[: 6 - rank] = values[: 6 - rank].mean()
    expected = MultivariateNormal(features.mean(0), vectors @ values.diag() @ vectors.T).log_prob(
        features
    )
    torch.testing.assert_close(found.log_density(features), expected)
    assert found.count() == 6 + 6 * rank + rank + 2


@pytest.mark.parametrize("seed", SEEDS)
def test_all_directions_are_the_whole_covariance(seed: int) -> None:
    """With five of six directions kept, the noise is the sixth."""
    features = (
        cluster(seed, 1.0).double()
        @ torch.randn(6, 6, generator=torch.Generator().manual_seed(seed)).double()
    )
    found = fit(features, 99, shrinkage=0.0, quantile=0.1)
    expected = MultivariateNormal(features.mean(0), torch.cov(features.T, correction=0)).log_prob(
        features
    )
    torch.testing.assert_close(found.log_density(features), expected)


@pytest.mark.parametrize("seed", SEEDS)
def test_directions_tell_what_single_entries_do_not(seed: int) -> None:
    """Two tasks with equal means and variances, but opposite correlation."""
    g = torch.Generator().manual_seed(seed)
    base, mirror = torch.randn(300, 1, generator=g), torch.tensor([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])
    first, second = (
        base + 0.1 * torch.randn(300, 6, generator=g),
        base * mirror + 0.1 * torch.randn(300, 6, generator=g),
    )
    told = infer(torch.cat([first, second]), [fit(x, 1, 0.0, 0.0) for x in (first, second)])
    assert (told == torch.tensor([0] * 300 + [1] * 300)).double().mean() > 0.9


@pytest.mark.parametrize("quantile", [0.0, 0.02, 0.25])
def test_the_threshold_leaves_out_its_share_of_the_task_itself(quantile: float) -> None:
    features = cluster(0, 0.0)
    outside = (infer(features, [fit(features, 3, 0.1, quantile)]) == NONE).double().mean()
    assert float(outside) == pytest.approx(quantile, abs=0.006)


@pytest.mark.parametrize("seed", SEEDS)
def test_images_go_to_their_task_and_strangers_to_none(seed: int) -> None:
    tasks = [fit(cluster(10 * seed + i, 20.0 * i), 3, 0.1, 0.02) for i in range(3)]
    for i in range(3):
        again = infer(cluster(10 * seed + i, 20.0 * i), tasks)
        assert set(again.tolist()) <= {i, NONE} and (again == i).double().mean() > 0.95
    assert (infer(cluster(99, -50.0), tasks) == NONE).all()
    assert (infer(cluster(99, 0.0), []) == NONE).all()


def test_each_task_has_a_threshold_of_its_own() -> None:
    """A distance that is normal for a wide task is a stranger to a narrow one."""
    g = torch.Generator().manual_seed(0)
    narrow, wide = 0.01 * torch.randn(200, 6, generator=g), 20 + torch.randn(200, 6, generator=g)
    tasks = [fit(narrow, 0, 0.0, 0.02), fit(wide, 0, 0.0, 0.02)]
    odd = torch.full((1, 6), 0.03)
    assert tasks[1].threshold < tasks[0].log_density(odd) < tasks[0].threshold
    assert infer(odd, tasks).tolist() == [NONE] and infer(odd / 6, tasks).tolist() == [0]


def test_shrinkage_draws_variances_to_their_mean() -> None:
    features = cluster(0, 0.0)
    none, some, all_ = (fit(features, 3, share, 0.1) for share in (0.0, 0.3, 1.0))
    mean = (none.variances.sum() + 3 * none.noise) / 6
    torch.testing.assert_close(some.variances, 0.7 * none.variances + 0.3 * mean)
    torch.testing.assert_close(some.noise, 0.7 * none.noise + 0.3 * mean)
    torch.testing.assert_close(all_.variances, mean.expand(3))


def test_a_feature_that_never_varies_is_no_infinity() -> None:
    features = cluster(0, 0.0)
    features[:, 2] = 0.5
    found = fit(features, 3, 0.0, 0.05)
    assert isinstance(found, Gaussian) and found.log_density(features).isfinite().all()
    assert fit(torch.ones(4, 3), 16, 0.0, 0.5).log_density(torch.ones(4, 3)).isfinite().all()
