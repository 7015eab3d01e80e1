"""Temporal ensembling is the weighted mean of all predictions of a step."""

from __future__ import annotations

import math

import pytest
import torch

from aegis_cli.common.errors import AegisError
from aegis_cli.core.ensemble import TemporalEnsemble

CHUNK, STEPS = 5, 13


def chunks(*shape: int, seed: int = 0) -> list[torch.Tensor]:
    """A chunk of actions for every step of an episode."""
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(*shape, CHUNK, 3, generator=generator) for _ in range(STEPS)]


def naive(predicted: list[torch.Tensor], step: int, decay: float) -> torch.Tensor:
    """Algorithm 2 of ACT from a table of all predictions of a step."""
    own = [(step - at, chunk) for at, chunk in enumerate(predicted)]
    told = [chunk[..., age, :] for age, chunk in own if age < CHUNK]
    weights = [math.exp(-decay * i) for i in range(len(told))]
    return sum(w * a for w, a in zip(weights, told, strict=True)) / sum(weights)


@pytest.mark.parametrize("decay", [0.0, 0.01, 0.5, -0.3, 3.0])
@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_it_is_the_mean_of_a_naive_table(decay: float, shape: tuple[int, ...]) -> None:
    ensemble, predicted = TemporalEnsemble(decay), chunks(*shape)
    for step, chunk in enumerate(predicted):
        found = ensemble.next(chunk)
        assert found.dtype == chunk.dtype
        torch.testing.assert_close(found, naive(predicted[: step + 1], step, decay))


@pytest.mark.parametrize("decay", [0.0, 0.01, -2.0])
def test_predictions_that_agree_are_what_they_predict(decay: float) -> None:
    path = torch.randn(STEPS + CHUNK, 3, generator=torch.Generator().manual_seed(1))
    ensemble = TemporalEnsemble(decay)
    for step in range(STEPS):
        torch.testing.assert_close(ensemble.next(path[step : step + CHUNK]), path[step])


def test_it_lies_between_the_predictions() -> None:
    ensemble, predicted = TemporalEnsemble(0.1), chunks()
    for step, chunk in enumerate(predicted):
        found = ensemble.next(chunk)
        told = [predicted[step - age][age] for age in range(min(CHUNK, step + 1))]
        assert (found >= torch.stack(told).amin(0) - 1e-6).all()
        assert (found <= torch.stack(told).amax(0) + 1e-6).all()


@pytest.mark.parametrize(("decay", "age"), [(1e6, CHUNK - 1), (-1e6, 0)])
def test_of_a_large_decay_one_prediction_is_left(decay: float, age: int) -> None:
    """The oldest for a positive decay, as in ACT, the newest for a negative one; all are finite."""
    ensemble, predicted = TemporalEnsemble(decay), chunks()
    for step, chunk in enumerate(predicted):
        found = ensemble.next(chunk)
        left = min(age, step)
        torch.testing.assert_close(found, predicted[step - left][left])


def test_an_episode_begins_without_what_was_before() -> None:
    ensemble, predicted = TemporalEnsemble(0.01), chunks()
    first = [ensemble.next(chunk) for chunk in predicted]
    ensemble.reset()
    again = [ensemble.next(chunk) for chunk in predicted]
    assert all(torch.equal(one, other) for one, other in zip(first, again, strict=True))
    assert torch.equal(first[0], predicted[0][0])


def test_a_chunk_of_one_is_itself() -> None:
    ensemble = TemporalEnsemble(0.01)
    for chunk in chunks():
        assert torch.equal(ensemble.next(chunk[:1]), chunk[0])


@pytest.mark.parametrize("decay", [math.nan, math.inf, -math.inf])
def test_a_decay_that_is_not_finite_is_refused(decay: float) -> None:
    with pytest.raises(AegisError, match="a temporal ensemble with decay"):
        TemporalEnsemble(decay)
