"""Statistics against their definitions, over rows of every scale."""

from __future__ import annotations

import numpy as np
import pytest

from aegis_cli.data.lerobot import statistics
from aegis_cli.data.lerobot.statistics import QUANTILES


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e9])
@pytest.mark.parametrize("length", [2, 3, 40, 1000])
def test_figures_of_vectors(length: int, scale: float) -> None:
    rows = np.random.default_rng(length).normal(3, 1, (length, 4)) * scale
    found = statistics.of_vectors(rows)
    np.testing.assert_array_equal([found["min"], found["max"]], [rows.min(0), rows.max(0)])
    np.testing.assert_allclose(found["mean"], rows.mean(0), rtol=1e-12)
    np.testing.assert_allclose(found["std"], rows.std(0), rtol=1e-9)
    assert found["count"].tolist() == [length]


@pytest.mark.parametrize("length", [2, 7, 100, 5000])
def test_a_quantile_is_the_value_that_its_share_lies_below_within_a_bin(length: int) -> None:
    rows = np.random.default_rng(length).normal(size=(length, 3))
    found, ordered = statistics.of_vectors(rows), np.sort(rows, axis=0)
    bin_width = (ordered[-1] - ordered[0]) / 5000 + 1e-9
    for name, share in QUANTILES.items():
        if length * share < 1 and share < 0.5:  # less than the first value: the left edge
            assert (found[name] <= ordered[0] + bin_width).all()
            continue
        value = ordered[int(np.ceil(share * length - 1e-9)) - 1]
        assert (np.abs(found[name] - value) <= bin_width).all(), name


def test_mean_and_deviation_do_not_cancel() -> None:
    """In float32, E[x^2] - E[x]^2, which LeRobot computes, gives 0 or nonsense here."""
    rows = (1000 + 0.1 * np.random.default_rng(0).normal(size=(500, 1))).astype(np.float32)
    np.testing.assert_allclose(
        statistics.of_vectors(rows)["std"], rows.astype(np.float64).std(0), rtol=1e-9
    )


def test_a_single_row_and_a_constant() -> None:
    for rows in (np.full((1, 2), 7.0), np.full((9, 2), 7.0)):
        for name, value in statistics.of_vectors(rows).items():
            expected = {"count": [len(rows)], "std": [0.0, 0.0]}.get(name, [7.0, 7.0])
            np.testing.assert_allclose(value, expected, atol=1e-9)


def test_pictures_are_vectors_of_their_pixels() -> None:
    frames = np.random.default_rng(0).integers(0, 256, (6, 10, 12, 3), dtype=np.uint8)
    found, pixels = statistics.of_images(frames), statistics.of_vectors(frames.reshape(-1, 3) / 255)
    for name in found.keys() - {"count"}:
        assert found[name].shape == (3, 1, 1)
        np.testing.assert_allclose(found[name].ravel(), pixels[name], atol=1 / 255 / 100)
    assert found["count"].tolist() == [6]


@pytest.mark.parametrize(
    ("length", "looked_at"), [(1, 1), (99, 99), (100, 100), (500, 105), (2000, 299)]
)
def test_of_many_pictures_some_are_looked_at(length: int, looked_at: int) -> None:
    """LeRobot's rule: length ** 0.75, at least 100; the first and the last are among them."""
    frames = np.zeros((length, 2, 2, 3), np.uint8)
    frames[[0, -1]] = [[[[10]]], [[[200]]]] if length > 1 else 10
    found = statistics.of_images(frames)
    assert found["count"].tolist() == [looked_at]
    assert found["max"].max() == pytest.approx((200 if length > 1 else 10) / 255)


def test_large_pictures_are_thinned_out() -> None:
    frames = np.zeros((2, 320, 480, 3), np.uint8)
    frames[:, ::3, ::3] = 255  # 480 / 150 = 3.2
    assert statistics.of_images(frames)["mean"].min() == 1


@pytest.mark.parametrize("seed", range(4))
def test_merged_figures_are_those_of_all_rows_together(seed: int) -> None:
    rng = np.random.default_rng(seed)
    parts = [rng.normal(rng.normal() * 5, 1, (rng.integers(1, 30), 3)) for _ in range(6)]
    separate, together = (
        [statistics.of_vectors(part) for part in parts],
        statistics.of_vectors(np.concatenate(parts)),
    )
    merged = statistics.merge(separate)
    in_steps = separate[0]
    for one in separate[1:]:
        in_steps = statistics.merge([in_steps, one])
    for name in ("min", "max", "mean", "std", "count"):
        np.testing.assert_allclose(merged[name], together[name], rtol=1e-9)
    for name in merged:
        np.testing.assert_allclose(in_steps[name], merged[name], rtol=1e-9)
    for name, share in QUANTILES.items():  # an envelope, as in LeRobot
        pick = np.min if share <= 0.5 else np.max
        np.testing.assert_array_equal(merged[name], pick([one[name] for one in separate], axis=0))
