"""Which task an image is of: planted clusters, thresholds, and features that never vary."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.distributions import Normal

from aegis_cli.core.gaussians import NONE, Gaussian, fit, infer

SEEDS = range(3)


def cluster(seed: int, centre: float, count: int = 200) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    return centre + torch.rand(6, generator=g) * torch.randn(count, 6, generator=g) + torch.randn(6, generator=g)


@pytest.mark.parametrize("seed", SEEDS)
def test_density_is_that_of_independent_normals(seed: int) -> None:
    features = cluster(seed, 0.0).double()
    found = fit(features, shrinkage=0.0, quantile=0.1)
    expected = Normal(features.mean(0), features.std(0, correction=0)).log_prob(features).sum(-1)
    torch.testing.assert_close(found.log_density(features), expected)
    assert found.count() == 13


@pytest.mark.parametrize("quantile", [0.0, 0.02, 0.25])
def test_the_threshold_leaves_out_its_share_of_the_task_itself(quantile: float) -> None:
    features = cluster(0, 0.0)
    outside = (infer(features, [fit(features, 0.1, quantile)]) == NONE).double().mean()
    assert float(outside) == pytest.approx(quantile, abs=0.006)


@pytest.mark.parametrize("seed", SEEDS)
def test_images_go_to_their_task_and_strangers_to_none(seed: int) -> None:
    tasks = [fit(cluster(10 * seed + i, 20.0 * i), 0.1, 0.02) for i in range(3)]
    for i in range(3):
        again = infer(cluster(10 * seed + i, 20.0 * i), tasks)
        assert set(again.tolist()) <= {i, NONE} and (again == i).double().mean() > 0.95
    assert (infer(cluster(99, -50.0), tasks) == NONE).all()
    assert (infer(cluster(99, 0.0), []) == NONE).all()


def test_each_task_has_a_threshold_of_its_own() -> None:
    """What would do for a wide task is a stranger to a narrow one."""
    g = torch.Generator().manual_seed(0)
    narrow, wide = 0.01 * torch.randn(200, 6, generator=g), 20 + torch.randn(200, 6, generator=g)
    tasks = [fit(narrow, 0.0, 0.02), fit(wide, 0.0, 0.02)]
    odd = torch.full((1, 6), 0.03)
    assert tasks[1].threshold < tasks[0].log_density(odd) < tasks[0].threshold
    assert infer(odd, tasks).tolist() == [NONE] and infer(odd / 6, tasks).tolist() == [0]


def test_shrinkage_draws_variances_to_their_mean() -> None:
    features = cluster(0, 0.0)
    none, some, all_ = (fit(features, share, 0.1).variance for share in (0.0, 0.3, 1.0))
    torch.testing.assert_close(some, 0.7 * none + 0.3 * none.mean())
    torch.testing.assert_close(all_, none.mean().expand(6))


def test_a_feature_that_never_varies_is_no_infinity() -> None:
    features = cluster(0, 0.0)
    features[:, 2] = 0.5
    found = fit(features, 0.0, 0.05)
    assert isinstance(found, Gaussian) and found.log_density(features).isfinite().all()
    assert fit(torch.ones(4, 3), 0.0, 0.5).log_density(torch.ones(4, 3)).isfinite().all()
