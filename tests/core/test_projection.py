"""The projection: orthogonal where it acts, bit for bit absent where it does not, at any scale."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from aegis_cli.core import projection

SHAPES = [(8, 5), (5,), (3, 4, 2), ()]
SCALES = [1e-10, 1e-5, 1.0, 1e5, 1e10]


def gradients(seed: int, scale: float = 1.0) -> list[Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(shape, generator=generator) * scale for shape in SHAPES]


def pair(
    seed: int, conflict: bool, g_scale: float = 1.0, a_scale: float = 1.0
) -> tuple[list[Tensor], list[Tensor]]:
    """A task and an anchor gradient whose inner product has the requested sign."""
    gs, as_ = gradients(seed, g_scale), gradients(seed + 1000, a_scale)
    gs[1].fill_(-0.0)  # adding 0 * a would make some of it +0.0
    sign = -1.0 if (projection.inner(gs, as_)[1] < 0) != conflict else 1.0
    return gs, [a * sign for a in as_]


def project(gs: list[Tensor | None], as_: list[Tensor | None]) -> list[Tensor | None]:
    """AEGIS' projection of a copy of `gs`."""
    wg, wa = projection.aegis(*projection.inner(gs, as_))
    return projection.apply(
        [None if g is None else g.clone() for g in gs], as_, float(wg), float(wa)
    )


def cosine(gs: list[Tensor], as_: list[Tensor]) -> Tensor:
    tt, ta, aa = projection.inner(gs, as_)
    return ta / (tt * aa).sqrt()


def same_bits(xs: list[Tensor], ys: list[Tensor]) -> bool:
    return all(
        torch.equal(x.view(torch.int32), y.view(torch.int32)) for x, y in zip(xs, ys, strict=True)
    )


@pytest.mark.parametrize("g_scale", SCALES)
@pytest.mark.parametrize("a_scale", SCALES)
@pytest.mark.parametrize("seed", range(3))
def test_projected_gradient_is_orthogonal(seed: int, g_scale: float, a_scale: float) -> None:
    gs, as_ = pair(seed, conflict=True, g_scale=g_scale, a_scale=a_scale)
    before = cosine(gs, as_)
    projected = project(gs, as_)
    assert before < -1e-3 and cosine(projected, as_).abs() < 1e-6
    removed = [g.double() - p.double() for g, p in zip(gs, projected, strict=True)]
    assert cosine(removed, as_) < -1 + 1e-6  # only a part along the anchor gradient was removed


@pytest.mark.parametrize("g_scale", SCALES)
@pytest.mark.parametrize("a_scale", SCALES)
@pytest.mark.parametrize("seed", range(3))
def test_without_conflict_nothing_changes_bit_for_bit(
    seed: int, g_scale: float, a_scale: float
) -> None:
    gs, as_ = pair(seed, conflict=False, g_scale=g_scale, a_scale=a_scale)
    assert same_bits(project(gs, as_), gs)


@pytest.mark.parametrize("conflict", [True, False])
@pytest.mark.parametrize("scale", SCALES)
def test_energy_shed_is_relu_of_minus_cosine_squared(conflict: bool, scale: float) -> None:
    for seed in range(5):
        gs, as_ = pair(seed, conflict, g_scale=scale)
        tt, ta, aa = projection.inner(gs, as_)
        identity = torch.relu(-cosine(gs, as_)).square()
        torch.testing.assert_close(projection.energy_shed(tt, ta, aa), identity, rtol=1e-12, atol=0)
        left = projection.inner(project(gs, as_), as_)[0]
        torch.testing.assert_close((tt - left) / tt, identity, rtol=1e-4, atol=1e-7)
        torch.testing.assert_close(
            projection.removed_energy(ta, aa) / tt, identity, rtol=1e-12, atol=0
        )


def test_opposite_gradients_shed_everything() -> None:
    gs = gradients(0)
    projected = project(gs, [-3 * g for g in gs])
    assert projection.inner(projected, gs)[0] < 1e-12


def test_projecting_twice_is_projecting_once() -> None:
    for seed in range(5):
        gs, as_ = pair(seed, conflict=True)
        once = project(gs, as_)
        for x, y in zip(project(once, as_), once, strict=True):
            torch.testing.assert_close(x, y, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("absent", ["zero", "none", "empty group"])
def test_no_anchor_gradient_changes_nothing(absent: str) -> None:
    gs = [] if absent == "empty group" else gradients(0)
    as_ = [None if absent == "none" else torch.zeros_like(g) for g in gs]
    tt, ta, aa = projection.inner(gs, as_)
    assert ta == aa == 0 and (tt > 0 or not gs)
    assert same_bits(project(gs, as_), gs)
    assert projection.energy_shed(tt, ta, aa) == 0


def test_denominator_has_no_epsilon() -> None:
    tt, ta, aa = (torch.tensor([x], dtype=torch.float64) for x in (1.0, -1e-30, 1e-40))
    assert projection.aegis(tt, ta, aa)[1].item() == pytest.approx(1e10, rel=1e-12)


def test_tiny_gradients_do_not_underflow() -> None:
    gs, as_ = pair(0, conflict=True, g_scale=1e-25, a_scale=1e-25)
    assert cosine(gs, as_) < 0 and cosine(project(gs, as_), as_).abs() < 1e-6


@pytest.mark.parametrize(
    ("dtype", "size"), [(torch.float16, 1e-4), (torch.bfloat16, 1e-37), (torch.float32, 1e-37)]
)
def test_weights_beyond_the_gradients_type_are_applied(dtype: torch.dtype, size: float) -> None:
    """A small anchor gradient has a large weight, as in half-precision passes with a scaler."""
    g = torch.tensor([300.0, 20.0], dtype=dtype)
    a = torch.tensor([-size, 0.0], dtype=dtype)
    weight = float(projection.aegis(*projection.inner([g], [a]))[1])
    assert weight > torch.finfo(dtype).max
    (projected,) = projection.apply([g], [a], 1.0, weight)
    assert projected is g and g.tolist() == pytest.approx([0.0, 20.0], abs=1e-9)
    (alone,) = projection.apply([None], [a], 1.0, weight)
    assert alone.dtype == dtype and float(alone[0]) == pytest.approx(-300.0)


@pytest.mark.parametrize("missing", [True, False])
def test_weights_that_are_not_read_may_lie_beyond_half_precision(missing: bool) -> None:
    """For a float16 gradient on a GPU, a weight of 3e6 would become infinite and give NaN."""
    g = torch.tensor([300.0, 20.0], dtype=torch.float16)
    a = torch.tensor([-1e-4, 0.0], dtype=torch.float16)
    weight = projection.aegis(*projection.inner([g], [a]))[1]
    assert weight > torch.finfo(torch.float16).max
    one = torch.ones_like(weight)
    (found,) = projection.apply([None if missing else g], [a], one, weight)
    assert found.dtype == torch.float16
    expected = [-300.0, 0.0] if missing else [0.0, 20.0]
    assert found.tolist() == pytest.approx(expected, abs=1e-9)


def test_missing_gradients_count_as_zero() -> None:
    (g1, g2, *_), (a1, a2, *_) = pair(1, conflict=True)
    sparse = projection.inner([g1, g2, None, None], [a1, None, a2, None])
    dense = projection.inner([g1, g2, torch.zeros_like(a2)], [a1, torch.zeros_like(g2), a2])
    assert [float(x) for x in sparse] == [float(x) for x in dense]


def test_a_parameter_without_task_gradient_takes_part() -> None:
    g, a, b = torch.tensor([1.0, 0.0]), torch.tensor([-1.0, 0.0]), torch.tensor([2.0])
    moved, created = project([g, None], [a, b])
    assert projection.inner([moved, created], [a, b])[1].abs() < 1e-6
    torch.testing.assert_close(created, torch.tensor([0.4]))


def test_nan_is_not_swallowed() -> None:
    gs, as_ = pair(0, conflict=True)
    as_[0][0, 0] = float("nan")
    assert projection.aegis(*projection.inner(gs, as_))[1].isnan()


def test_inner_products_add_over_parameters_and_equal_the_flat_ones() -> None:
    gs, as_ = gradients(0), gradients(1)
    g, a = (torch.cat([x.flatten() for x in xs]).double() for xs in (gs, as_))
    expected = torch.stack([g @ g, g @ a, a @ a])
    torch.testing.assert_close(torch.stack(projection.inner(gs, as_)), expected, rtol=1e-14, atol=0)
    halves = [
        torch.stack(projection.inner(gs[part], as_[part])) for part in (slice(2), slice(2, None))
    ]
    torch.testing.assert_close(halves[0] + halves[1], expected, rtol=1e-14, atol=0)


@pytest.mark.parametrize("block", [1, 7, 40])
def test_blocks_add_up_to_the_whole(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    gs, as_ = gradients(0), gradients(1)
    monkeypatch.setattr(projection, "_BLOCK", block)
    for other in (as_, [None] * len(gs)):
        expected = [
            sum(
                (0 if x is None or y is None else (x.double() * y.double()).sum())
                for x, y in zip(*both, strict=True)
            )
            for both in ((gs, gs), (gs, other), (other, other))
        ]
        assert [float(x) for x in projection.inner(gs, other)] == pytest.approx(
            [float(x) for x in expected], rel=1e-12
        )
    assert float(projection.dot(gs[0], as_[0])) == pytest.approx(
        float((gs[0].double() * as_[0].double()).sum()), rel=1e-12
    )


@pytest.mark.parametrize("block", [1, 7, 40, 10**6])
@pytest.mark.parametrize("scale", SCALES)
def test_few_kernels_find_the_same(
    block: int, scale: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a GPU computes, computed on the CPU: small tensors are concatenated."""
    monkeypatch.setattr(projection, "_BLOCK", block)
    monkeypatch.setattr(projection, "_GPU_BLOCK", block)
    whole: tuple[list[Tensor | None], ...] = (gradients(0, scale), gradients(1))
    partly = [None, *whole[0][1:]], [*whole[1][:2], None, whole[1][3]]
    nothing = [None, None], [None, None]
    for gs, as_ in (whole, partly, nothing):
        expected = [float(x) for x in projection.inner(gs, as_)]
        found = projection._inner_by_few_kernels(gs, as_, torch.device("cpu"))
        assert [float(x) for x in found] == pytest.approx(expected, rel=1e-12)
        assert all(x.dtype == torch.float64 and x.shape == () for x in found)


@pytest.mark.parametrize("weights", [(2.0, -0.5), (1.0, 0.25), (1.0, 0.0), (0.5, 0.0)])
def test_weights_that_are_tensors_are_the_same_weights(weights: tuple[float, float]) -> None:
    gs, as_ = [None, *gradients(0)], [gradients(2)[0], *gradients(1)]
    as_[-1] = None
    expected = projection.apply([g if g is None else g.clone() for g in gs], as_, *weights)
    of_tensors = [torch.tensor(w, dtype=torch.float64) for w in weights]
    found = projection.apply(gs, as_, *of_tensors)
    assert (expected[0] is None) == (weights[1] == 0)
    torch.testing.assert_close(found[1:], expected[1:])


def test_gram_stacks_the_groups() -> None:
    groups = [(gradients(i), gradients(i + 10)) for i in range(3)]
    for i, column in enumerate(zip(*projection.gram(groups), strict=True)):
        assert [float(x) for x in column] == [float(x) for x in projection.inner(*groups[i])]


def test_weights_of_the_other_combinations() -> None:
    tt, ta, aa = (
        torch.tensor(x, dtype=torch.float64) for x in ([1.0, 2.0], [-1.0, 1.0], [4.0, 4.0])
    )
    assert [w.tolist() for w in projection.naive(tt, ta, aa)] == [[1, 1], [0, 0]]
    assert [w.tolist() for w in projection.aegis(tt, ta, aa)] == [[1, 1], [0.25, 0]]
    assert projection.conflict(ta).tolist() == [True, False]
    assert not projection.conflict(torch.tensor(0.0))


def test_apply_mixes_in_place() -> None:
    gs, as_ = gradients(0), gradients(1)
    expected = [2 * g - 0.5 * a for g, a in zip(gs, as_, strict=True)]
    mixed = projection.apply(gs, as_, 2.0, -0.5)
    assert all(m is g for m, g in zip(mixed, gs, strict=True))
    torch.testing.assert_close(mixed, expected)
