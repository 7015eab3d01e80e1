"""Positions far from those of the training are noticed, and those that merely differ are not."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from aegis_cli.data.batch import Normalizer
from aegis_cli.data.far_positions import FarPositions, reach

NAMES = ("pan.pos", "lift.pos")


def turned(count: int = 1000) -> torch.Tensor:
    """Positions [count, 2] of two joints in degrees."""
    return 30 * torch.randn(count, 2, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    ("kind", "known"),
    [
        ("mean_std", "training mean 0.1, standard deviation 30"),
        ("quantiles", "98 % of the training's between -60 and 70"),
    ],
)
def test_a_joint_in_other_units_is_named_once_with_what_the_training_had(
    kind: str, known: str
) -> None:
    first = (0.1, 30.0) if kind == "mean_std" else (5.0, 65.0)
    middle, scale = torch.tensor([first, (0.0, 30.0)]).unbind(1)
    watched = FarPositions(Normalizer(middle, scale), NAMES, kind)
    assert watched.notice(np.array([[90.0, -90.0], [-180.0, 10.0]])) is None
    told = watched.notice(np.array([[0.0, 0.0], [-2000.0, 0.0]]))
    assert told is not None and f"'pan.pos' is -2000 ({known})." in told
    assert "degrees, radians" in told and "lift" not in told
    both = np.array([-2000.0, 1e6])
    then = watched.notice(both)
    assert then is not None and "'lift.pos' is 1e+06" in then and "pan" not in then
    assert watched.notice(both) is None
    anew = watched.anew().notice(both)
    assert anew is not None and "pan" in anew and "lift" in anew
    assert watched.notice(both) is None


def test_a_joint_that_hardly_varied_may_be_a_little_elsewhere() -> None:
    """Its deviation of 1e-6 is no scale: an encoder's noise would be far from its mean."""
    rows = torch.tensor([[2048.0, 0.0], [2048.0 + 1e-3, 0.0]]).repeat(500, 1)
    watched = FarPositions(Normalizer.fit(rows))
    assert watched.notice(np.array([2070.0, 0.5])) is None
    told = watched.notice(np.array([-9000.0, 0.0]))
    assert told is not None and "positions[0] is -9000 (in training about 2048)" in told


@pytest.mark.parametrize("kind", ["mean_std", "quantiles"])
def test_a_gripper_that_hardly_ever_closed_may_close(kind: str) -> None:
    rows = turned()
    rows[:, 1] = 0.0
    rows[7:11, 1] = 100.0
    fit = Normalizer.fit if kind == "mean_std" else Normalizer.fit_quantiles
    scale = fit(rows)
    farthest = reach(rows, scale, kind)
    assert farthest is not None
    closed = np.array([0.0, 100.0])
    assert FarPositions(scale, NAMES, kind).notice(closed) is not None
    watched = FarPositions(scale, NAMES, kind, farthest)
    assert watched.notice(closed) is None
    assert watched.notice(np.array([0.0, 4096.0])) is not None


@pytest.mark.parametrize("kind", ["mean_std", "quantiles"])
def test_of_usual_joints_no_reach_is_kept(kind: str) -> None:
    fit = Normalizer.fit if kind == "mean_std" else Normalizer.fit_quantiles
    assert reach(turned(), fit(turned()), kind) is None
    none = torch.zeros(3, 0)
    assert reach(none, Normalizer.fit(none), kind) is None
