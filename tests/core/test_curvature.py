"""The proximal step along VQA's curvature, compared with its penalty."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from aegis_cli.common.errors import AegisError
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.curvature import Curvature, curvatures, taken
from aegis_cli.core.pairs import Pair, minus
from aegis_cli.core.spectrum import Spectrum, decompose, with_rest

SITE = "map"
OUT, IN = 4, 5
STRENGTHS = (0.01, 0.3, 20.0)


@pytest.fixture(autouse=True)
def fixed_draws() -> Iterator[None]:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


def draw(*shape: int) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64)


def moment(size: int, rank: int | None = None) -> Tensor:
    """A second moment with very different directions."""
    rows = draw(50, rank or size) @ (
        draw(rank or size, size) * torch.logspace(0, 2, size, dtype=torch.float64)
    )
    return rows.T @ rows


def of(
    inputs: Tensor, outputs: Tensor, weight: Tensor, energy: float = 1.0, damping: float = 0.0
) -> Curvature:
    sides = {"inputs": inputs, "outputs": outputs}
    anchor = Anchor(
        curvature={f"{SITE}.{side}": decompose(moment, energy) for side, moment in sides.items()}
    )
    return curvatures(anchor, {SITE: weight}, damping)[SITE]


def drawn_back(curvature: Curvature, displacement: Pair, strength: float) -> Pair:
    """The displacement after the proximal step."""
    return minus(displacement, curvature.excess(*displacement, strength))


def relative(moment: Tensor) -> Tensor:
    """Eigenvalues whose mean is 1."""
    return moment * len(moment) / moment.trace()


def joined(pair: Pair) -> Tensor:
    """[out, in + 1], the bias last."""
    weight, bias = pair
    return weight.flatten(1) if bias is None else torch.cat([weight.flatten(1), bias[:, None]], 1)


@pytest.mark.parametrize("strength", STRENGTHS)
@pytest.mark.parametrize("shape", [(OUT, IN), (40, IN), (OUT, 2, 3, 3)])
@pytest.mark.parametrize("biased", [True, False])
@pytest.mark.parametrize(("damping", "rank"), [(0.0, None), (0.3, None), (0.3, 2)])
def test_the_step_minimises_distance_and_penalty(
    shape: tuple[int, ...], biased: bool, strength: float, damping: float, rank: int | None
) -> None:
    """The gradient vanishes at X = argmin |X - D|^2 / 2 + (w / 2) tr((G + damping) X C X^T).

    It is (X - D) + w (G + damping) X C.

    This also holds if the anchor has only the `rank` output directions that matter to answers.
    """
    displacement = draw(*shape), draw(shape[0]) if biased else None
    c, g = moment(displacement[0][0].numel() + biased), moment(shape[0], rank)
    found = of(c, g, displacement[0], damping=damping)
    assert rank is None or found.outputs.shape[1] == rank
    kept = joined(drawn_back(found, displacement, strength))
    minded = relative(g) + damping * torch.eye(len(g), dtype=torch.float64)
    gradient = kept - joined(displacement) + strength * minded @ kept @ relative(c)
    assert (
        gradient.abs().max() < 1e-5 * strength * joined(displacement).abs().max()
    )  # eigenvectors are kept in the map's dtype
    assert kept.norm() < joined(displacement).norm()


@pytest.mark.parametrize("strength", STRENGTHS)
@pytest.mark.parametrize("biased", [True, False])
def test_the_gradient_is_the_penaltys(strength: float, biased: bool) -> None:
    """(w / 2) tr((G + damping) D C D^T), by autograd."""
    displacement = draw(OUT, IN), draw(OUT) if biased else None
    c, g = moment(IN + biased), moment(OUT)
    found = joined(of(c, g, displacement[0], damping=0.3).gradient(*displacement, strength))
    minded = relative(g) + 0.3 * torch.eye(OUT, dtype=torch.float64)
    moved = joined(displacement).requires_grad_()
    penalty = strength / 2 * (minded @ moved @ relative(c) @ moved.T).trace()
    (wanted,) = torch.autograd.grad(penalty, moved)
    torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-5)


def test_a_displacement_in_half_precision_has_a_gradient_in_the_factors_own() -> None:
    displacement = draw(OUT, IN).bfloat16(), draw(OUT).bfloat16()
    found = of(moment(IN + 1), moment(OUT), displacement[0]).gradient(*displacement, 0.3)
    assert found[0].dtype == found[1].dtype == torch.float32


def test_neither_moments_scale_matters() -> None:
    displacement, c, g = (draw(OUT, IN), draw(OUT)), moment(IN + 1), moment(OUT)
    kept = [
        drawn_back(of(a * c, b * g, displacement[0]), displacement, 0.3)
        for a, b in ((1, 1), (1e6, 1e-9))
    ]
    torch.testing.assert_close(joined(kept[0]), joined(kept[1]))


def test_what_vqa_does_not_read_or_does_not_mind_is_free() -> None:
    """A displacement outside either factor's span stays; one inside both is almost undone.

    This holds whatever the strength.
    """
    c, g = moment(IN, rank=2), moment(OUT, rank=2)
    found = of(c, g, draw(OUT, IN))
    away_in = torch.eye(IN, dtype=torch.float64) - torch.linalg.pinv(c, rtol=1e-9) @ c
    away_out = torch.eye(OUT, dtype=torch.float64) - torch.linalg.pinv(g, rtol=1e-9) @ g
    for free in (draw(OUT, IN) @ away_in, away_out @ draw(OUT, IN)):
        torch.testing.assert_close(drawn_back(found, (free, None), 1e9)[0], free, rtol=0, atol=1e-6)
    inside = g @ draw(OUT, IN) @ c
    assert drawn_back(found, (inside, None), 1e9)[0].norm() < 1e-3 * inside.norm()


def test_no_strength_takes_nothing_and_more_takes_more() -> None:
    displacement = draw(OUT, IN), draw(OUT)
    found = of(moment(IN + 1), moment(OUT), displacement[0])
    sizes = [
        joined(drawn_back(found, displacement, strength)).norm().item()
        for strength in (0.0, *STRENGTHS)
    ]
    assert sizes[0] == pytest.approx(joined(displacement).norm().item(), rel=1e-12)
    assert sizes == sorted(sizes, reverse=True) and len(set(sizes)) == len(sizes)


@pytest.mark.parametrize("strength", [1e38, 1e39, 1e300])
@pytest.mark.parametrize("read", [True, False])
def test_a_weight_beyond_float32_takes_what_has_a_curvature_and_leaves_numbers(
    strength: float, read: bool
) -> None:
    c, g = moment(IN, rank=2), moment(OUT, rank=2)
    displacement = draw(OUT, IN).float(), None
    found = of(c, g, displacement[0])
    given = strength if read else torch.tensor(strength, dtype=torch.float64)
    kept = minus(displacement, found.excess(*displacement, given))[0]
    torch.testing.assert_close(kept, drawn_back(found, displacement, 1e30)[0])
    assert kept.isfinite().all() and kept.norm() < displacement[0].norm()


def test_all_is_taken_of_a_direction_whose_curvature_is_beyond_float32() -> None:
    steep = torch.tensor([0.0, 1.0, torch.inf])
    assert taken(steep).tolist() == [0.0, 0.5, 1.0]


def test_damping_holds_outputs_that_answers_do_not_mind_and_frees_no_other_input() -> None:
    c, g = moment(IN, rank=2), moment(OUT, rank=2)
    found = of(c, g, draw(OUT, IN), damping=0.1)
    away_in = torch.eye(IN, dtype=torch.float64) - torch.linalg.pinv(c, rtol=1e-9) @ c
    away_out = torch.eye(OUT, dtype=torch.float64) - torch.linalg.pinv(g, rtol=1e-9) @ g
    free, held = draw(OUT, IN) @ away_in, away_out @ draw(OUT, IN) @ c
    torch.testing.assert_close(drawn_back(found, (free, None), 1e9)[0], free, rtol=0, atol=1e-6)
    assert drawn_back(found, (held, None), 1e9)[0].norm() < 1e-3 * held.norm()


def test_input_directions_that_the_anchor_left_out_are_free() -> None:
    displacement, c, g = (draw(OUT, IN), None), moment(IN), moment(OUT)
    found = of(c, g, displacement[0], energy=0.9)
    outside = decompose(c).vectors[:, -1:]
    torch.testing.assert_close(
        drawn_back(found, displacement, 5.0)[0] @ outside, displacement[0] @ outside
    )


@pytest.mark.parametrize("strength", STRENGTHS)
@pytest.mark.parametrize(("read", "written"), [(2, OUT), (IN + 1, 1), (3, 2), (0, 0)])
def test_directions_that_were_never_resolved_have_one_curvature(
    read: int, written: int, strength: float
) -> None:
    """The step is that of the moments which such spectra represent."""
    displacement = draw(OUT, IN), draw(OUT)
    spectra, stand_for = {}, []
    for side, size, count in (("inputs", IN + 1, read), ("outputs", OUT, written)):
        whole = decompose(moment(size))
        u, rest = whole.vectors[:, :count], whole.values[count:].mean().nan_to_num()
        spectra[f"{SITE}.{side}"] = with_rest(whole.values[:count], u, rest)
        flat = (u * (whole.values[:count] - rest)) @ u.T
        stand_for.append(flat + rest * torch.eye(size, dtype=u.dtype))
    rounded = curvatures(Anchor(curvature=spectra), {SITE: displacement[0]}, 0.3)[SITE]
    found = replace(
        rounded,
        inputs=spectra[f"{SITE}.inputs"].vectors,
        outputs=spectra[f"{SITE}.outputs"].vectors,
    )
    wanted = of(*stand_for, displacement[0], damping=0.3)
    for apply in ("excess", "gradient"):
        got, expected = (getattr(c, apply)(*displacement, strength) for c in (found, wanted))
        torch.testing.assert_close(joined(got), joined(expected))
    assert rounded.inputs.dtype == rounded.outputs.dtype == torch.float16
    taken, exact = (joined(c.excess(*displacement, strength)) for c in (rounded, found))
    assert (taken - exact).norm() <= 2e-3 * exact.norm()


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32])
def test_narrow_weights_are_drawn_back_in_float32(dtype: torch.dtype) -> None:
    displacement = draw(OUT, IN).to(dtype), draw(OUT).to(dtype)
    found = of(moment(IN + 1), moment(OUT), displacement[0])
    weight, bias = drawn_back(found, (displacement[0].float(), displacement[1].float()), 0.3)
    assert weight.dtype == torch.float32 and bias is not None and bias.dtype == torch.float32


@pytest.mark.parametrize("held", [{}, {f"{SITE}.inputs": decompose(torch.eye(IN))}])
def test_what_the_anchor_lacks_is_named(held: dict[str, Spectrum]) -> None:
    with pytest.raises(AegisError) as caught:
        curvatures(Anchor(curvature=held), {SITE: draw(OUT, IN)}, 0.0)
    assert SITE in caught.value.found and "--parts" in caught.value.fix
