"""Second moments and eigenvectors: exact sums, orthonormal directions, a rank that never falls."""

from __future__ import annotations

import pytest
import torch
from samples.nullspace import with_one
from torch import Tensor

from aegis_cli.core.spectrum import Spectrum, channel_moment, decompose, rank, second_moment

SCALES = [1e-6, 1.0, 1e6]
ENERGIES = [0.0, 1e-6, 0.1, 0.3, 0.5, 0.9, 0.99, 0.999, 0.9999, 0.999999, 1 - 1e-12, 1.0]


def rows(
    seed: int,
    count: int = 50,
    width: int = 7,
    scale: float = 1.0,
    dtype: torch.dtype = torch.float64,
) -> Tensor:
    """Columns of very different sizes, none of them centred."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(count, width, generator=generator, dtype=torch.float64) + 2
    return (scale * x * 10 ** torch.linspace(0, -2, width, dtype=torch.float64)).to(dtype)


def random_moment(seed: int, width: int = 7) -> Tensor:
    return second_moment(rows(seed, width=width))


def spectra() -> list[Tensor]:
    """Eigenvalues of many kinds.

    They are even, or fall slowly or fast; one dwarfs all others, or many lie just above or below
    rounding.
    """
    like = {"dtype": torch.float64}
    dwarfed = [
        torch.cat([torch.ones(1, **like), torch.full((2000,), share, **like)])
        for share in (1e-5, 1e-7, 1e-8, 1e-30)
    ]
    falling = [base ** -torch.arange(40, **like) for base in (1.0, 1.1, 2.0, 10.0)]
    return [
        *dwarfed,
        *falling,
        *(torch.rand(30, generator=torch.Generator().manual_seed(i), **like) for i in range(3)),
    ]


# --- moments --------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", SCALES)
def test_second_moment_is_the_product_of_the_rows(scale: float) -> None:
    x = rows(0, scale=scale)
    moment = second_moment(x)
    torch.testing.assert_close(moment, x.T @ x, rtol=1e-12, atol=0)
    assert torch.equal(moment, moment.T)


def test_second_moment_adds_over_splits() -> None:
    x = rows(1, count=60)
    for size in (1, 7, 60):
        total = sum(second_moment(part) for part in x.split(size))
        torch.testing.assert_close(total, second_moment(x), rtol=1e-12, atol=0)


def test_second_moment_of_many_float32_rows_loses_nothing_to_their_number() -> None:
    x = rows(2, count=20_000, dtype=torch.float32)
    moment = second_moment(x)
    assert moment.dtype == torch.float64
    torch.testing.assert_close(moment, x.double().T @ x.double(), rtol=2e-6, atol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_second_moment_keeps_its_precision_inside_of_autocast(dtype: torch.dtype) -> None:
    x = rows(3, dtype=dtype)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        moment = second_moment(x)
    torch.testing.assert_close(moment, second_moment(x.double()), rtol=1e-6, atol=0)


@pytest.mark.parametrize("bias", [True, False])
def test_channel_moment_is_each_channels_second_moment(bias: bool) -> None:
    x = rows(3)
    moment = channel_moment(x, bias)
    assert moment.shape == ((7, 2, 2) if bias else (7, 1, 1))
    channels = [with_one(column) if bias else column for column in x.split(1, dim=1)]
    each = torch.stack([second_moment(channel) for channel in channels])
    torch.testing.assert_close(moment, each, rtol=1e-12, atol=0)
    torch.testing.assert_close(
        sum(channel_moment(part, bias) for part in x.split(9)), moment, rtol=1e-12, atol=0
    )


# --- eigenvectors ---------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_decompose_gives_falling_values_and_orthonormal_vectors_of_the_moment(seed: int) -> None:
    moment = random_moment(seed)
    spectrum = decompose(moment)
    assert (
        spectrum.kind == "dense"
        and spectrum.vectors is not None
        and spectrum.vectors.shape == (7, 7)
    )
    assert (spectrum.values.diff() <= 0).all() and (spectrum.values >= 0).all()
    largest, vectors = spectrum.values[0], spectrum.vectors
    torch.testing.assert_close(
        vectors.T @ vectors, torch.eye(7, dtype=torch.float64), rtol=0, atol=1e-12
    )
    torch.testing.assert_close(
        moment @ vectors, vectors * spectrum.values, rtol=0, atol=1e-12 * largest
    )
    direct = torch.linalg.eigvals(moment).real.sort(descending=True).values
    torch.testing.assert_close(spectrum.values, direct, rtol=0, atol=1e-12 * largest)


@pytest.mark.parametrize("energy", [e for e in ENERGIES if e > 0])
def test_decompose_keeps_the_fewest_vectors_that_hold_the_energy(energy: float) -> None:
    moment = random_moment(4)
    spectrum, whole = decompose(moment, energy), decompose(moment)
    kept = spectrum.vectors.shape[1]
    assert torch.equal(spectrum.values, whole.values) and torch.equal(
        spectrum.vectors, whole.vectors[:, :kept]
    )
    held = (
        torch.einsum("dk,de,ek->k", spectrum.vectors, moment, spectrum.vectors).cumsum(0)
        / moment.trace()
    )
    assert held[-1] >= energy - 1e-6
    assert kept == 1 or held[-2] < energy


@pytest.mark.parametrize("bias", [True, False])
def test_decompose_of_channels_is_each_channels_own(bias: bool) -> None:
    moment = channel_moment(rows(5), bias)
    spectrum = decompose(moment, energy=0.5)  # channels are stored whole, whatever the energy
    assert spectrum.kind == "elementwise" and spectrum.vectors.shape == moment.shape
    for c, own in enumerate(moment):
        alone = decompose(own)
        torch.testing.assert_close(spectrum.values[c], alone.values, rtol=1e-9, atol=1e-12)
        rebuilt = spectrum.vectors[c] * spectrum.values[c] @ spectrum.vectors[c].T
        torch.testing.assert_close(rebuilt, own, rtol=1e-9, atol=1e-12)


def test_inputs_that_span_little_leave_the_rest_out() -> None:
    generator = torch.Generator().manual_seed(0)
    for spanned in range(1, 7):
        x = torch.randn(200, spanned, generator=generator) @ torch.randn(
            spanned, 7, generator=generator
        )
        spectrum = decompose(second_moment(x))  # float32, whose rounding fills the other directions
        assert spectrum.vectors.shape[1] == spanned


def test_a_table_has_no_vectors() -> None:
    assert Spectrum(torch.ones(5), None).kind == "rows"


# --- rank -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("values", spectra(), ids=lambda values: f"{len(values)} values")
@pytest.mark.parametrize("scale", SCALES)
def test_rank_never_falls_with_the_energy(values: Tensor, scale: float) -> None:
    ranks = [rank(scale * values, energy) for energy in ENERGIES]
    assert ranks == sorted(ranks)
    assert ranks[0] == 0 and ranks[1] >= 1 and ranks[-1] <= len(values)


def test_rank_holds_the_energy_and_no_less_would() -> None:
    for values in spectra()[4:]:
        shares = values.sort(descending=True).values / values.sum()
        for energy in (0.1, 0.5, 0.9, 0.99):
            count = rank(values, energy)
            assert shares[:count].sum() >= energy - 1e-12 and shares[: count - 1].sum() < energy


def test_rank_of_all_energy_is_all_that_was_resolved() -> None:
    full = torch.linspace(1, 2, 9, dtype=torch.float64)
    noise = torch.full((4,), 1e-9, dtype=torch.float64)
    assert rank(full, 1.0) == 9
    assert rank(torch.cat([full, noise]), 1.0) == 9
    assert rank(torch.cat([full, torch.zeros(4)]), 1.0) == 9


def test_rank_takes_values_in_any_order_and_shape() -> None:
    values = 2.0 ** -torch.arange(8, dtype=torch.float64)
    mixed = values[torch.randperm(8, generator=torch.Generator().manual_seed(0))]
    for energy in ENERGIES:
        assert rank(mixed, energy) == rank(mixed.view(4, 2), energy) == rank(values, energy)


def test_rank_of_nothing_is_nothing() -> None:
    assert [rank(torch.zeros(5), energy) for energy in ENERGIES] == [0] * len(ENERGIES)
    assert decompose(torch.zeros(3, 3)).vectors.shape == (3, 0)
