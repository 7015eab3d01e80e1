"""What a merge keeps of a displacement: the minimum of the two losses, and its limits."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from aegis_cli.common.errors import AegisError
from aegis_cli.core.merging import TwoSided, basis, damped
from aegis_cli.core.pairs import from_matrix, matrix
from aegis_cli.core.spectrum import decompose

OUT, IN = 5, 7
STRENGTHS = (0.01, 1.0, 30.0, 1e4)
SEEDS = range(4)


def draw(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def moment(seed: int, size: int, decades: float = 2, rank: int | None = None) -> Tensor:
    """A second moment whose directions differ by several powers of ten; positive definite."""
    rows = draw(seed, 50, rank or size) @ draw(seed + 100, rank or size, size)
    scale = torch.logspace(0, decades, size, dtype=torch.float64)
    rows = rows * scale[torch.randperm(size, generator=torch.Generator().manual_seed(seed))]
    small = 1e-6 * rows.square().mean()
    return rows.T @ rows / len(rows) + small * torch.eye(size, dtype=torch.float64)


def problem(seed: int, decades: float = 2) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """D [o, d], then C_r, C_v [d, d] and G_r, G_v [o, o]."""
    inputs = [moment(seed + i, IN, decades) for i in (10, 20)]
    outputs = [moment(seed + i, OUT, decades) for i in (30, 40)]
    return draw(seed, OUT, IN), *inputs, *outputs


def merged(d: Tensor, c_r: Tensor, c_v: Tensor, g_r: Tensor, g_v: Tensor, s: float) -> Tensor:
    return TwoSided(basis(c_r, c_v), basis(g_r, g_v)).kept_matrix(d, s)


def objective(
    x: Tensor, d: Tensor, c_r: Tensor, c_v: Tensor, g_r: Tensor, g_v: Tensor, s: float
) -> Tensor:
    """tr(G_r (X - D) C_r (X - D)^T) + s tr(G_v X C_v X^T)."""
    task = (g_r @ (x - d) @ c_r @ (x - d).T).trace()
    return task + s * (g_v @ x @ c_v @ x.T).trace()


# --- the bases ------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
def test_both_matrices_are_diagonal_in_the_basis(seed: int) -> None:
    task, questions = moment(seed, IN), moment(seed + 50, IN)
    found = basis(task, questions)
    t, one = found.vectors, torch.eye(IN, dtype=torch.float64)
    torch.testing.assert_close(t.T @ task @ t, torch.diag(found.share), rtol=0, atol=1e-9)
    torch.testing.assert_close(t.T @ questions @ t, torch.diag(1 - found.share), rtol=0, atol=1e-9)
    torch.testing.assert_close(t @ found.inverse, one, rtol=0, atol=1e-8)
    assert (found.share >= 0).all() and (found.share <= 1).all()


def test_moments_that_are_damped_by_less_than_rounding_are_refused() -> None:
    few = draw(1, 3, 60)  # three rows in 60 dimensions: most directions are never read
    spectrum = decompose(few.T @ few)
    for damping in (1e-2, 1e-9):
        assert basis(damped(spectrum, damping), damped(spectrum, damping)).share.isfinite().all()
    with pytest.raises(AegisError, match="less than rounding") as caught:
        basis(damped(spectrum, 1e-18), damped(spectrum, 1e-18))
    assert "1e-6 or more: --damping" in caught.value.fix


# --- the minimum ----------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("strength", STRENGTHS)
def test_the_gradient_of_the_objective_is_zero_at_what_is_kept(seed: int, strength: float) -> None:
    d, c_r, c_v, g_r, g_v = problem(seed)
    x = merged(d, c_r, c_v, g_r, g_v, strength)
    task, questions = g_r @ (x - d) @ c_r, strength * (g_v @ x @ c_v)
    size = task.norm() + questions.norm()
    assert (task + questions).norm() <= 1e-8 * size
    x.requires_grad_(True)  # the same by automatic differentiation
    objective(x, d, c_r, c_v, g_r, g_v, strength).backward()
    assert x.grad.norm() <= 1e-7 * size


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("strength", STRENGTHS)
def test_it_is_the_solution_of_the_whole_linear_system(seed: int, strength: float) -> None:
    d, c_r, c_v, g_r, g_v = problem(seed)
    # vec of G X C by rows is (G kron C) vec(X) for symmetric C
    task, questions = torch.kron(g_r, c_r), torch.kron(g_v, c_v)
    direct = torch.linalg.solve(task + strength * questions, task @ d.flatten())
    found = merged(d, c_r, c_v, g_r, g_v, strength)
    torch.testing.assert_close(found.flatten(), direct, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("seed", SEEDS)
def test_no_other_point_is_lower(seed: int) -> None:
    d, *factors = problem(seed)
    x = merged(d, *factors, 3.0)
    least = objective(x, d, *factors, 3.0)
    for step in range(20):
        near = x + 0.1 * draw(1000 + step, OUT, IN)
        assert objective(near, d, *factors, 3.0) > least


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("strength", STRENGTHS)
def test_inputs_alone_follow_their_own_formula(seed: int, strength: float) -> None:
    d, c_r, c_v, *_ = problem(seed)
    found = TwoSided(basis(c_r, c_v)).kept_matrix(d, strength)
    direct = torch.linalg.solve(c_r + strength * c_v, (d @ c_r).T).T
    torch.testing.assert_close(found, direct, rtol=1e-6, atol=1e-8)
    one = torch.eye(OUT, dtype=torch.float64)
    torch.testing.assert_close(
        merged(d, c_r, c_v, one, one, strength), direct, rtol=1e-6, atol=1e-8
    )


# --- limits ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
def test_strength_0_keeps_the_displacement(seed: int) -> None:
    d, *factors = problem(seed)
    torch.testing.assert_close(merged(d, *factors, 0.0), d, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_huge_strength_keeps_nothing_that_questions_read(seed: int) -> None:
    d, *factors = problem(seed)
    assert merged(d, *factors, 1e30).norm() <= 1e-8 * d.norm()


@pytest.mark.parametrize("seed", SEEDS)
def test_what_questions_do_not_read_is_kept_at_any_strength(seed: int) -> None:
    """C_v does not see the first inputs, except through damping."""
    d, c_r, c_v, g_r, g_v = problem(seed, decades=0.5)
    c_v[:3], c_v[:, :3] = 0, 0
    c_r[:3, 3:], c_r[3:, :3] = 0, 0
    kept = merged(d, c_r, c_v, g_r, g_v, 1e8)
    torch.testing.assert_close(kept[:, :3], d[:, :3], rtol=1e-3, atol=1e-3)
    assert kept[:, 3:].norm() <= 1e-3 * d.norm()


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("strength", STRENGTHS)
def test_equal_factors_are_a_straight_line(seed: int, strength: float) -> None:
    d, c, _, g, _ = problem(seed)
    found = merged(d, c, c, g, g, strength)
    torch.testing.assert_close(found, d / (1 + strength), rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_greater_strength_costs_the_task_more_and_the_questions_less(seed: int) -> None:
    d, c_r, c_v, g_r, g_v = problem(seed)
    found = [merged(d, c_r, c_v, g_r, g_v, s) for s in (0, *STRENGTHS)]
    task = [float((g_r @ (x - d) @ c_r @ (x - d).T).trace()) for x in found]
    questions = [float((g_v @ x @ c_v @ x.T).trace()) for x in found]
    assert task == sorted(task) and questions == sorted(questions, reverse=True)


# --- damping and stored spectra -------------------------------------------------------------------


@pytest.mark.parametrize("damping", [1e-3, 0.1, 1.0])
def test_damping_is_added_to_a_mean_eigenvalue_of_1(damping: float) -> None:
    whole = moment(0, IN)
    found = damped(decompose(whole), damping)
    one = torch.eye(IN, dtype=torch.float64)
    wanted = whole * IN / whole.trace() + damping * one
    torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-9)
    scaled = damped(decompose(1e6 * whole), damping)
    torch.testing.assert_close(scaled, found, rtol=1e-9, atol=1e-9)


def test_directions_that_were_not_stored_share_what_energy_is_left() -> None:
    whole = moment(1, IN)
    part, all_of_it = decompose(whole, 0.9), decompose(whole)
    assert part.vectors.shape[1] < IN
    found = torch.linalg.eigvalsh(damped(part, 0.1)).flip(0) - 0.1
    relative = all_of_it.values / all_of_it.values.mean()
    kept = part.vectors.shape[1]
    torch.testing.assert_close(found[:kept], relative[:kept], rtol=1e-9, atol=1e-9)
    rest = relative[kept:].mean().expand(IN - kept)
    torch.testing.assert_close(found[kept:], rest, rtol=1e-9, atol=1e-9)


def test_a_map_that_nothing_reads_still_has_a_basis() -> None:
    nothing = decompose(torch.zeros(IN, IN, dtype=torch.float64))
    something = decompose(moment(2, IN))
    found = basis(damped(nothing, 0.1), damped(something, 0.1))
    assert found.share.isfinite().all() and float(found.share.max()) <= 0.5 + 1e-9


def test_singular_moments_of_float32_spectra_are_safe_with_damping() -> None:
    """A file's eigenvectors are float32, and a frame's moment has few directions."""
    few, many = moment(3, 40, rank=2), moment(4, 40)
    task, questions = (decompose(m.float().double(), 0.9999) for m in (few, many))
    found = basis(damped(task, 1e-3), damped(questions, 1e-3))
    assert found.share.isfinite().all()
    assert math.isclose(float((found.vectors @ found.inverse).trace()), 40, rel_tol=1e-9)


# --- maps as matrices -----------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(4, 6), (4, 3, 2, 2)])
@pytest.mark.parametrize("bias", [True, False])
def test_a_map_is_a_matrix_and_back(shape: tuple[int, ...], bias: bool) -> None:
    pair = draw(0, *shape).float(), draw(1, 4).float() if bias else None
    flat = matrix(pair)
    assert flat.shape == (4, math.prod(shape[1:]) + bias)
    weight, shift = from_matrix(flat.double(), pair)
    assert torch.equal(weight, pair[0]) and weight.dtype == torch.float32
    assert shift is None if pair[1] is None else torch.equal(shift, pair[1])


def test_a_convolution_with_a_bias_keeps_what_its_matrix_keeps() -> None:
    pair = draw(0, 4, 3, 2, 2), draw(1, 4)
    two_sided = TwoSided(basis(moment(5, 13), moment(6, 13)), basis(moment(7, 4), moment(8, 4)))
    weight, bias = two_sided.kept(pair, 2.0)
    wanted = two_sided.kept_matrix(matrix(pair), 2.0)
    torch.testing.assert_close(weight.flatten(1), wanted[:, :12], rtol=0, atol=0)
    torch.testing.assert_close(bias, wanted[:, 12], rtol=0, atol=0)
