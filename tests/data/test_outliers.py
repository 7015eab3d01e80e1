"""Values far from all others are found per joint, and a training warns of them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from aegis_cli.common.events import Event, Warned
from aegis_cli.data import demonstrations
from aegis_cli.data.outliers import outliers
from aegis_cli.recipes import RobotTrain, Train
from aegis_cli.training import loading


def rows(count: int = 2000) -> torch.Tensor:
    """Four joints: one moves, one rests, one is a gripper that seldom closes, one drifts."""
    made = torch.randn(count, 4, generator=torch.Generator().manual_seed(0))
    made[:, 1] = 12.5
    made[:, 2] = 0.0
    made[7, 2] = 95.0
    made[:, 3] = made[:, 3].cumsum(0)
    return made


def test_joints_that_move_rest_or_seldom_switch_are_no_outliers() -> None:
    assert list(outliers(rows())) == []


@pytest.mark.parametrize("value", [400.0, -400.0])
def test_a_glitch_is_found_in_its_joint_and_row(value: float) -> None:
    made = rows()
    made[1234, 0] = value
    (found,) = outliers(made)
    assert (found.dimension, found.row, found.value) == (0, 1234, value)
    assert found.std == pytest.approx(400 / 2000**0.5, rel=0.02)
    assert found.others == pytest.approx(1.0, abs=0.05)


def test_of_few_rows_none_is_called_an_outlier() -> None:
    made = rows(99)
    made[50, 0] = 400.0
    assert list(outliers(made)) == []


def test_a_training_warns_of_the_joint_and_the_episode(demos_file: Path) -> None:
    loaded = demonstrations.load(demos_file, 0.3, 0)
    found = dataclasses.replace(loaded, train=loaded.read)
    assert len(found.train) >= 100  # as many as a finding requires
    told = list[Event]()
    loading.warn_of_outliers(demos_file, found, Train(), told.append)
    assert told == []
    found.tensors["actions"] = found.tensors["actions"].clone()
    found.tensors["actions"][found.train[5], 1] = 1e4
    for settings in (Train(normalization="quantiles"), Train(relative_actions=True)):
        loading.warn_of_outliers(demos_file, found, settings, told.append)
        assert told == []  # no value shifts these by much; those that do have their own scale
    loading.warn_of_outliers(demos_file, found, RobotTrain(), told.append)
    (warned,) = told
    assert isinstance(warned, Warned)
    episode = int(found.episode_of[found.train[5]])
    for part in (f"action {found.action_names[1]} (10000 in episode {episode};", "demos.only"):
        assert part in warned.text
