"""Sums of second moments: exact if kept whole; how close sketches come otherwise."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from aegis_cli.core import moment_sums
from aegis_cli.core.moment_sums import FullSum, MomentSum, Sketch, make, merged, size
from aegis_cli.core.spectrum import Spectrum, orthonormal, second_moment

CPU = torch.device("cpu")
WIDE = 1200  # sketched by 384 columns
DECAYS = {"slow": -0.5, "middling": -0.8, "fast": -1.5}


def rows(count: int, width: int, decay: float, seed: int = 0) -> Tensor:
    """Rows [n, d] float32 with a nonzero mean, whose deviations fall as a power law."""
    generator = torch.Generator().manual_seed(seed)
    sizes = torch.arange(1, width + 1) ** decay
    turn = torch.linalg.qr(torch.randn(width, width, generator=generator))[0]
    mean = torch.randn(width, generator=generator)
    noise = torch.randn(count, width, generator=generator)
    return (noise * sizes) @ turn.T + mean * (3 * sizes.norm() / mean.norm())


def summed(total: MomentSum, *parts: Tensor) -> MomentSum:
    for part in parts:
        total.add(part)
    return total


def moment(spectrum: Spectrum) -> Tensor:
    """The second moment [d, d] that a spectrum represents."""
    assert spectrum.vectors is not None
    vectors = spectrum.vectors.double()
    excess = spectrum.values[: vectors.shape[1]] - spectrum.rest
    return (vectors * excess) @ vectors.T + spectrum.rest * torch.eye(len(vectors)).double()


# --- whole ----------------------------------------------------------------------------------------


def test_a_narrow_sum_is_that_of_its_parts_moments_bit_by_bit() -> None:
    parts = rows(90, 40, -0.5).split(30)
    wanted = second_moment(parts[0]) + second_moment(parts[1])
    total = summed(make(40, CPU), *parts[:2])
    assert isinstance(total, FullSum) and torch.equal(total.matrix(), wanted)


def test_a_float32_sum_of_many_passes_is_off_by_millionths_of_its_largest_entry() -> None:
    width, passes = 600, 400
    parts = [rows(20, width, -0.5, seed) for seed in range(4)]
    total = summed(make(width, CPU), *(parts * (passes // 4)))
    wanted = sum(part.double().T @ part.double() for part in parts) * (passes // 4)
    assert isinstance(total, FullSum) and width > moment_sums.EXACT_SUM
    assert (total.matrix() - wanted).abs().max() < 3e-6 * wanted.abs().max()
    assert torch.equal(total.matrix(), total.matrix().T)


def test_the_widths_decide() -> None:
    assert isinstance(make(moment_sums.WHOLE, CPU), FullSum)
    assert isinstance(make(moment_sums.WHOLE + 1, CPU), Sketch)
    assert isinstance(make(moment_sums.WHOLE + 1, CPU, convolution=True), FullSum)
    assert isinstance(make(moment_sums.SKETCHED + 1, CPU), moment_sums.TraceOnly)


def test_a_trace_stays_on_the_device_of_its_rows() -> None:
    """Processes sum their traces there, and NCCL cannot handle CPU tensors."""
    width, elsewhere = moment_sums.SKETCHED + 1, torch.device("meta")
    added = make(width, elsewhere)
    added.add(torch.empty(3, width, device=elsewhere))
    for one in (added, added.plus(added)):
        assert [part.device for part in one.parts()] == [elsewhere]


@pytest.mark.parametrize("width", [40, 600, WIDE])
def test_sums_add_up(width: int) -> None:
    x = rows(90, width, -0.5)
    together = summed(make(width, CPU), x).spectrum(90, 0.99)
    split = [summed(make(width, CPU), part) for part in x.split(31)]
    apart = merged(split).spectrum(90, 0.99)
    torch.testing.assert_close(apart.values, together.values, rtol=1e-3, atol=1e-6)
    scale = moment(together).abs().max()
    assert (moment(apart) - moment(together)).abs().max() < 1e-4 * scale


def test_the_size_is_told_before_anything_is_summed() -> None:
    for width in (40, 600, WIDE):
        total = summed(make(width, CPU), torch.ones(1, width))
        held = total._sums if isinstance(total, FullSum) else [total._seen]
        assert size(width) == sum(t.nbytes for t in held)


# --- sketches -------------------------------------------------------------------------------------


@pytest.mark.parametrize("decay", DECAYS.values(), ids=DECAYS)
def test_a_sketch_loses_little_more_energy_than_the_best_directions(decay: float) -> None:
    x = rows(3000, WIDE, decay)
    found = summed(make(WIDE, CPU), x).spectrum(len(x), 1.0)
    exact = second_moment(x) / len(x)
    values = torch.linalg.eigvalsh(exact).flip(0)
    assert found.vectors is not None and not found.whole
    stored = found.vectors.shape[1]
    for kept, allowed in ((stored // 2, 1.1), (stored, 1.45)):
        u = found.vectors[:, :kept].double()
        lost = exact.trace() - ((u.T @ exact) * u.T).sum()
        assert lost <= allowed * values[kept:].sum()


def test_the_leading_directions_of_a_sketch_are_the_exact_ones() -> None:
    x = rows(3000, WIDE, DECAYS["middling"])
    found = summed(make(WIDE, CPU), x).spectrum(len(x), 1.0)
    exact = torch.linalg.eigh(second_moment(x))[1].flip(1)
    assert found.vectors is not None
    # Cosines of the principal angles between the spans.
    cosines = torch.linalg.svdvals(exact[:, :10].T @ found.vectors[:, :20].double())
    assert cosines.min() > 0.999


@pytest.mark.parametrize("energy", [0.5, 0.99, 1.0])
def test_what_a_sketch_leaves_out_is_one_scalar_with_the_energy_that_is_left(energy: float) -> None:
    x = rows(500, WIDE, DECAYS["middling"])
    found = summed(make(WIDE, CPU), x).spectrum(len(x), energy)
    trace = x.double().square().sum() / len(x)
    assert found.vectors is not None and len(found.values) == WIDE
    stored = found.vectors.shape[1]
    torch.testing.assert_close(found.values.sum(), trace, rtol=1e-6, atol=0.0)
    assert (found.values[stored:] == found.rest).all() and found.rest > 0
    if energy < 0.9:
        assert found.values[: stored - 1].sum() < energy * trace <= found.values[:stored].sum()
    gram = found.vectors.T @ found.vectors
    torch.testing.assert_close(gram, torch.eye(stored), rtol=0, atol=1e-4)


def test_few_rows_are_found_exactly() -> None:
    x = rows(30, WIDE, DECAYS["slow"])
    found = summed(make(WIDE, CPU), x).spectrum(len(x), 1.0)
    assert found.vectors is not None and found.vectors.shape[1] == 30
    wanted = second_moment(x) / len(x)
    assert (moment(found) - wanted).abs().max() < 1e-5 * wanted.abs().max()


def test_a_map_as_narrow_as_a_sketch_is_summed_whole() -> None:
    assert isinstance(make(384, CPU, whole=8), FullSum)
    assert isinstance(make(385, CPU, whole=8), Sketch)
    assert size(384, whole=8) == size(384)


@pytest.mark.parametrize("rank", [20, 100])
def test_a_sketch_with_nearly_as_many_columns_as_rows_is_close_to_the_moment(rank: int) -> None:
    """Such a random matrix hardly sees some directions, in which only rounding is left."""
    width = 386
    x = rows(600, rank, DECAYS["slow"]) @ rows(rank, width, 0.0, seed=1)
    found = summed(make(width, CPU, whole=8), *x.split(6)).spectrum(len(x), 1.0)
    wanted = second_moment(x) / len(x)
    assert found.vectors is not None
    assert (moment(found) - wanted).abs().max() < 1e-3 * wanted.abs().max()


def test_rows_of_zeros_have_no_direction() -> None:
    found = summed(make(WIDE, CPU), torch.zeros(5, WIDE)).spectrum(5, 0.99)
    assert found.vectors is not None and found.vectors.shape == (WIDE, 0)
    assert not found.values.any()


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16], ids=str)
def test_a_programs_default_type_changes_no_sketch(dtype: torch.dtype) -> None:
    """A program that loads models in bfloat16 may have made that the default."""
    drawn = rows(500, WIDE, DECAYS["middling"])
    wanted = summed(make(WIDE, CPU), drawn).spectrum(500, 1.0)
    moment_sums._probe.cache_clear()
    torch.set_default_dtype(dtype)
    try:
        found = summed(make(WIDE, CPU), drawn).spectrum(500, 1.0)
    finally:
        torch.set_default_dtype(torch.float32)
        moment_sums._probe.cache_clear()
    assert wanted.vectors is not None and found.vectors is not None
    assert torch.equal(found.values, wanted.values) and torch.equal(found.vectors, wanted.vectors)


def test_rows_in_float64_are_sketched_as_their_rounded_ones() -> None:
    drawn = rows(500, WIDE, DECAYS["middling"])
    wanted = summed(make(WIDE, CPU), drawn).spectrum(500, 1.0)
    found = summed(make(WIDE, CPU), drawn.double()).spectrum(500, 1.0)
    assert torch.equal(found.values, wanted.values)


def test_the_widest_have_their_trace() -> None:
    width = moment_sums.SKETCHED + 1
    found = summed(make(width, CPU), 2 * torch.ones(3, width)).spectrum(3, 0.99)
    assert found.vectors is not None and found.vectors.shape == (width, 0)
    torch.testing.assert_close(found.values, torch.full_like(found.values, 4), rtol=1e-6, atol=0)
    assert found.rest == found.values[0]


def test_rounded_columns_are_made_orthonormal() -> None:
    exact = torch.linalg.qr(torch.randn(300, 40, generator=torch.Generator().manual_seed(0)))[0]
    rounded = exact.half().float()
    eye = torch.eye(40)
    before = (rounded.T @ rounded - eye).abs().max()
    found = orthonormal(rounded)
    assert (found.T @ found - eye).abs().max() < min(2e-6, before / 5)
    assert (found - exact).abs().max() < 1e-3
