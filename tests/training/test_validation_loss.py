"""The validation loss: it depends on the weights and the held-out frames, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from samples.tiny import make_tiny
from samples.training_runs import SETTINGS, STEPS, Start, small_policy
from torch import nn

from aegis_cli.common.events import Event, Progress
from aegis_cli.data import demonstrations
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.models.policy import Policy
from aegis_cli.training import train

NOISE = train.validation_noise(3)


@pytest.fixture
def demos(demos_file: Path) -> Demonstrations:
    return demonstrations.load(demos_file, 0.5, 0)


@pytest.fixture
def policy(demos: Demonstrations) -> Policy:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return small_policy(make_tiny(), demos)


@pytest.mark.fast
def test_it_does_not_depend_on_how_many_frames_pass_at_once(
    demos: Demonstrations, policy: Policy
) -> None:
    count = len(demos.validation)
    assert demos.size(demos.validation, SETTINGS.chunk)[1] < count * SETTINGS.chunk  # some padding
    cuts = [(count, 1), (count, 3), (5, 1), (5, 2), (1, 1)]
    losses = [
        train.validation_loss(
            policy, demos, replace(SETTINGS, batch_size=size, accumulate=passes), NOISE
        )
        for size, passes in cuts
    ]
    assert losses == pytest.approx([losses[0]] * len(cuts), rel=1e-5)


@pytest.mark.fast
def test_a_frame_has_the_same_noise_whatever_else_is_held_out(
    demos: Demonstrations, policy: Policy
) -> None:
    halves = [replace(demos, validation=half) for half in demos.validation.split(7)]
    weights = [demos.size(half.validation, SETTINGS.chunk)[1] for half in halves]
    losses = [train.validation_loss(policy, half, SETTINGS, NOISE) for half in halves]
    mean = sum(w * loss for w, loss in zip(weights, losses, strict=True)) / sum(weights)
    assert train.validation_loss(policy, demos, SETTINGS, NOISE) == pytest.approx(mean, rel=1e-5)
    other = train.validation_noise(4)
    assert train.validation_loss(policy, demos, SETTINGS, other) != pytest.approx(mean, rel=1e-5)


@pytest.mark.fast
def test_it_writes_nothing_to_the_policy(demos: Demonstrations, policy: Policy) -> None:
    stem = policy.backbone.stem
    stem.norm = nn.BatchNorm2d(3)
    stem.register_forward_pre_hook(lambda stem, given: stem.norm(*given))
    policy.train()
    before = {name: t.clone() for name, t in policy.state_dict().items()}
    train.validation_loss(policy, demos, SETTINGS, NOISE)
    assert all(torch.equal(t, before[name]) for name, t in policy.state_dict().items())
    assert policy.training and stem.norm.training


@pytest.mark.parametrize("long_s", [0.0, 3600.0])
def test_a_long_validation_has_progress_of_its_own(
    long_s: float, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a large model it takes minutes; a short one would only add two lines each to a log."""
    monkeypatch.setattr(train, "_LONG_S", long_s)
    events: list[Event] = []
    start("naive", tmp_path / "run", anchor=None, on_event=events.append)
    told = [e.done for e in events if isinstance(e, Progress) and e.stage == "validation"]
    validations = STEPS // SETTINGS.validate_every
    assert told.count(0) == (validations if long_s == 0 else 0)
    if told:
        (total,) = {e.total for e in events if getattr(e, "stage", "") == "validation"}
        assert told.count(total) == validations
