"""Transfer, Average, Last and forgetting against hand-computed matrices, and their bounds."""

from __future__ import annotations

import random

import pytest

from aegis_cli.core.accuracy_matrix import reuse_rate, scores


def test_a_matrix_worked_by_hand() -> None:
    rows = [[0.9, 0.4, 0.2], [0.7, 0.8, 0.3], [0.8, 0.6, 0.9]]
    found = scores(rows)
    assert found.transfer == pytest.approx((0.4 + (0.2 + 0.3) / 2) / 2)
    assert found.average == pytest.approx((0.9 + 0.4 + 0.2 + 0.7 + 0.8 + 0.3 + 0.8 + 0.6 + 0.9) / 9)
    assert found.last == pytest.approx((0.8 + 0.6 + 0.9) / 3)
    assert found.forgetting == pytest.approx(((0.9 - 0.8) + (0.8 - 0.6)) / 2)


def test_the_best_counts_from_the_tasks_own_learning_on() -> None:
    """Accuracy from before a task was learned does not count as remembered."""
    assert scores([[0.5, 0.9], [0.5, 0.6]]).forgetting == 0
    assert scores([[0.5, 0.1], [0.7, 0.6]]).forgetting == 0  # later tasks may help
    assert scores([[0.5, 0.0, 0.0], [0.9, 0.0, 0.0], [0.6, 0.0, 0.0]]).forgetting == pytest.approx(
        0.3 / 2
    )


def test_one_task_has_no_transfer_and_no_forgetting() -> None:
    found = scores([[0.7]])
    assert (found.transfer, found.average, found.last, found.forgetting) == (None, 0.7, 0.7, None)


@pytest.mark.parametrize("seed", range(5))
def test_where_nothing_is_learned_all_figures_agree(seed: int) -> None:
    draw = random.Random(seed)
    count = draw.randint(2, 7)
    row = [draw.random() for _ in range(count)]
    found = scores([row] * count)
    assert found.average == pytest.approx(sum(row) / count) == pytest.approx(found.last)
    assert found.transfer == pytest.approx(sum(row[1:]) / (count - 1)) and found.forgetting == 0


@pytest.mark.parametrize("seed", range(5))
def test_frozen_tasks_are_never_forgotten(seed: int) -> None:
    draw = random.Random(seed)
    own = [draw.random() for _ in range(5)]
    rows = [[own[i] if i <= t else draw.random() for i in range(5)] for t in range(5)]
    assert scores(rows).forgetting == 0 and scores(rows).last == pytest.approx(sum(own) / 5)


def test_reuse_is_the_mean_mass_on_history_after_the_first_task() -> None:
    assert reuse_rate([[0.0, 0.0], [0.5, 0.1], [1.0, 0.8]]) == pytest.approx(0.6)
    assert reuse_rate([[0.0, 0.0]]) is None and reuse_rate([[], []]) is None
