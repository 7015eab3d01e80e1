"""The ledger: rows are read as written, a resumed ledger continues, sums are as defined."""

from __future__ import annotations

import time

import pytest
import torch
from torch import Tensor

from aegis_cli.core import ledger as ledgers
from aegis_cli.core.ledger import Ledger

GROUPS, LAYERS = ("embed", "layer 0", "layer 1"), ("0", "1")


def row(seed: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """tt, ta, aa of random gradient pairs (so Cauchy-Schwarz holds) and a W2."""
    generator = torch.Generator().manual_seed(seed)
    g, a = torch.randn(2, len(GROUPS), 4, dtype=torch.float64, generator=generator)
    w2 = torch.rand(len(LAYERS), dtype=torch.float64, generator=generator)
    return (g * g).sum(1), (g * a).sum(1), (a * a).sum(1), w2


def filled(steps: range) -> Ledger:
    ledger = Ledger(GROUPS, LAYERS)
    for step in steps:
        ledger.append(step, *row(step))
    return ledger


def assert_equal(a: Ledger, b: Ledger) -> None:
    assert a.tensors().keys() == b.tensors().keys()
    for name, values in a.tensors().items():
        assert torch.equal(values, b.tensors()[name]), name


def test_tensors_hold_the_rows() -> None:
    tensors = filled(range(1, 5)).tensors()
    assert tensors["step"].tolist() == [1, 2, 3, 4] and tensors["step"].dtype == torch.int64
    assert {name: tuple(x.shape) for name, x in tensors.items() if name != "step"} == {
        "tt": (4, 3),
        "ta": (4, 3),
        "aa": (4, 3),
        "w2": (4, 2),
    }
    for name, value in zip(("tt", "ta", "aa", "w2"), row(3), strict=True):
        assert torch.equal(tensors[name][2], value) and tensors[name].dtype == torch.float64


def test_resumed_equals_uninterrupted() -> None:
    stopped = filled(range(1, 8))
    resumed = Ledger.from_tensors(GROUPS, LAYERS, stopped.tensors())
    resumed.truncate(5)  # the checkpoint is older than the ledger
    assert len(resumed) == 5
    for step in range(6, 11):
        resumed.append(step, *row(step))
    assert_equal(resumed, filled(range(1, 11)))


def test_rows_are_copies() -> None:
    ledger, buffer = Ledger(GROUPS, LAYERS), [x.clone() for x in row(0)]
    ledger.append(1, *buffer)
    for x in buffer:
        x.zero_()
    assert torch.equal(ledger.tensors()["tt"][0], row(0)[0])


def test_tensors_are_copies() -> None:
    ledger = filled(range(1, 4))
    before = ledger.tensors()
    ledger.truncate(1)
    ledger.append(2, *row(99))
    assert torch.equal(before["tt"][1], row(2)[0])


def test_rows_after_a_step() -> None:
    """Steps without a row take the row after them."""
    ledger = Ledger(GROUPS, LAYERS)
    for step in (1, 2, 5):
        ledger.append(step, *row(step))
    wanted = {0: [1, 2, 5], 1: [2, 5], 2: [5], 4: [5], 5: [], 9: []}
    assert {after: ledger.tensors(after)["step"].tolist() for after in wanted} == wanted
    assert torch.equal(ledger.tensors(after=2)["w2"], row(5)[3][None])


def test_many_rows_take_little_more_memory_than_their_numbers() -> None:
    """A tensor per row took ten times that, and a resumed run needed 15 seconds to make them."""
    count = 100_000
    columns = {name: torch.rand(count, 3, dtype=torch.float64) for name in ("tt", "ta", "aa")}
    saved = columns | {"w2": torch.rand(count, 2), "step": torch.arange(1, count + 1)}
    started = time.process_time()
    ledger = Ledger.from_tensors(GROUPS, LAYERS, saved)
    ledger.truncate(count - 1)
    ledger.append(count, *row(0))
    assert time.process_time() - started < 1
    assert sum(x.nbytes for x in ledger.tensors().values()) == count * (3 * 3 + 2 + 1) * 8


def test_empty_ledger_has_its_shapes_and_zero_summaries() -> None:
    tensors = Ledger(GROUPS, LAYERS).tensors()
    assert (
        tensors["tt"].shape == (0, 3)
        and tensors["w2"].shape == (0, 2)
        and tensors["step"].shape == (0,)
    )
    assert ledgers.energy_shed_mean(tensors) == ledgers.conflict_share(tensors) == 0
    assert [s.energy_shed_max for s in ledgers.summarize_groups(GROUPS, tensors)] == [0, 0, 0]


def test_steps_must_increase_and_sizes_must_fit() -> None:
    ledger = filled(range(1, 3))
    with pytest.raises(ValueError, match="step 2 after step 2"):
        ledger.append(2, *row(2))
    tt, ta, aa, w2 = row(3)
    with pytest.raises(ValueError, match="'w2' has shape"):
        ledger.append(3, tt, ta, aa, w2[:1])
    assert len(ledger) == 2 and len(ledger.tensors()["tt"]) == 2


def test_energy_shed_of_a_step_is_removed_over_total_energy() -> None:
    g = torch.tensor([[3.0, 0.0], [0.0, 2.0], [1.0, 1.0]], dtype=torch.float64)
    a = torch.tensor(
        [[-1.0, 1.0], [0.0, 5.0], [0.0, -2.0]], dtype=torch.float64
    )  # conflict, none, conflict
    ledger = Ledger(GROUPS, LAYERS)
    ledger.append(1, (g * g).sum(1), (g * a).sum(1), (a * a).sum(1), torch.zeros(2))
    tensors = ledger.tensors()
    # by hand: the first group loses 9/2 of 9, the second 0 of 4, the third 1 of 2
    assert ledgers.step_energy_shed(tensors).tolist() == pytest.approx([5.5 / 15])
    assert ledgers.energy_shed_mean(tensors) == pytest.approx(5.5 / 15)
    assert ledgers.conflict_share(tensors) == pytest.approx(2 / 3)
    summaries = ledgers.summarize_groups(GROUPS, tensors)
    assert [s.energy_shed_mean for s in summaries] == pytest.approx([0.5, 0, 0.5])
    assert [s.conflict for s in summaries] == [1, 0, 1]


def test_summaries_are_means_and_maxima_over_steps() -> None:
    tensors = filled(range(1, 20)).tensors()
    cos = tensors["ta"] / (tensors["tt"] * tensors["aa"]).sqrt()
    shed = torch.relu(-cos).square()
    for i, summary in enumerate(ledgers.summarize_groups(GROUPS, tensors)):
        assert summary.name == GROUPS[i]
        assert summary.energy_shed_mean == pytest.approx(float(shed[:, i].mean()))
        assert summary.energy_shed_max == pytest.approx(float(shed[:, i].max()))
        assert summary.conflict == pytest.approx(float((cos[:, i] < 0).double().mean()))
    assert 0 < ledgers.conflict_share(tensors) < 1


def test_a_step_without_gradients_sheds_nothing() -> None:
    ledger = Ledger(GROUPS, LAYERS)
    ledger.append(1, *(torch.zeros(3),) * 3, torch.zeros(2))
    assert ledgers.energy_shed_mean(ledger.tensors()) == 0
