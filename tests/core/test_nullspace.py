"""Null-space projection of an update: what it removes and what it leaves."""

from __future__ import annotations

import pytest
import torch
from samples.nullspace import (
    CASES,
    SITE,
    Case,
    assert_same,
    dense_rows,
    draw,
    protected_share,
    protection_of,
    random_update,
    rows_of,
    size,
    with_one,
)
from torch import Tensor, nn

from aegis_cli.common.errors import AegisError
from aegis_cli.core import nullspace
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.nullspace import Protection, Strength, allowed, protect
from aegis_cli.core.pairs import Pair, copied, copied_small, minus
from aegis_cli.core.spectrum import (
    Spectrum,
    channel_moment,
    decompose,
    lone_row,
    second_moment,
    with_rest,
)

pytestmark = pytest.mark.usefixtures("fixed_draws")

ENERGIES = [0.3, 0.7, 0.9, 0.999, 1.0]
SOFT = [1e-3, 0.1, 1.0]
DENSE = [name for name in CASES if name.startswith(("linear", "conv"))]


def falling(width: int) -> Spectrum:
    """All eigenvectors, each with half the energy of the previous one."""
    return Spectrum(
        2.0 ** -torch.arange(width, dtype=torch.float64), torch.linalg.qr(draw(width, width)).Q
    )


def share_of(spectrum: Spectrum, count: int) -> float:
    """The share of energy that `count` directions hold."""
    return max(0.0, (spectrum.values[:count].sum() / spectrum.values.sum()).item() - 1e-9)


def joined(update: Pair) -> Tensor:
    """Weight and bias as one matrix [out, d]."""
    weight, bias = update
    return weight.flatten(1) if bias is None else torch.cat([weight.flatten(1), bias[:, None]], 1)


# --- hard -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("energy", ENERGIES)
@pytest.mark.parametrize("inputs", ["vqa", "any"])
def test_projecting_twice_is_once_and_nothing_is_lost(
    case: Case, inputs: str, energy: float
) -> None:
    protection, update = protection_of(case, getattr(case, inputs)(), energy), random_update(case)
    removed, left = protection.removed(*update), allowed(protection, update)
    assert_same(allowed(protection, left), left)
    assert_same(protection.removed(*removed), removed)
    assert_same(minus(minus(update, removed), left), minus(update, update))
    assert size(left) + size(removed) == pytest.approx(size(update), rel=1e-9)  # orthogonal


@pytest.mark.parametrize("count", range(8))
@pytest.mark.parametrize("bias", [True, False])
def test_what_is_removed_lies_along_the_leading_eigenvectors(bias: bool, count: int) -> None:
    spectrum = falling(7)
    update = draw(5, 6 if bias else 7), draw(5) if bias else None
    removed = protect(spectrum, Strength(share_of(spectrum, count)), update[0]).removed(*update)
    leading = spectrum.vectors[:, :count]
    torch.testing.assert_close(joined(removed), joined(update) @ leading @ leading.T)


def test_equal_channels_share_their_fate() -> None:
    spectrum = decompose(torch.eye(2, dtype=torch.float64).expand(6, 2, 2).contiguous())
    update = draw(6), draw(6)
    assert size(allowed(protect(spectrum, Strength(0.01), update[0]), update)) < 1e-20


@pytest.mark.parametrize("strength", [Strength(0.3), Strength(1.0), Strength(0.9, soft=0.1)])
@pytest.mark.parametrize("shape", [(), (1,), (6,), (1, 1, 6), (6, 1)])
def test_a_lone_row_keeps_nothing_of_its_update(shape: tuple[int, ...], strength: Strength) -> None:
    """Like the rows of a table that are read: questions use every direction of it."""
    update = torch.randn(shape, dtype=torch.float64), None
    left = allowed(protect(lone_row(), strength, update[0]), update)[0]
    assert left.shape == shape and not left.any()


# --- soft -----------------------------------------------------------------------------------------


def shrunk(moment: Tensor, update: Tensor, soft: float, trace: Tensor) -> Tensor:
    """D s (C + s)^-1 by a dense solve, with C as shares of `trace`: update [out, d] -> the same."""
    identity = torch.eye(len(moment), dtype=moment.dtype)
    return soft * torch.linalg.solve(moment / trace + soft * identity, update.T).T


@pytest.mark.parametrize("soft", SOFT)
@pytest.mark.parametrize("name", DENSE)
def test_soft_equals_a_dense_solve(name: str, soft: float) -> None:
    module, inputs = CASES[name].model().map, CASES[name].any()
    moment = second_moment(dense_rows(module, inputs[0]))
    update = random_update(CASES[name])
    protection = protect(
        decompose(moment), Strength(0.3, soft), update[0]
    )  # the energy does not include them
    expected = shrunk(moment, joined(update), soft, moment.trace())
    torch.testing.assert_close(joined(allowed(protection, update)), expected)


@pytest.mark.parametrize("soft", SOFT)
@pytest.mark.parametrize("name", DENSE)
def test_soft_leaves_what_is_nearest_to_the_update_and_least_seen(name: str, soft: float) -> None:
    """X = argmin |X - D|^2 + E|X x|^2 / soft over VQA's inputs x, whose mean energy is 1.

    So the soft threshold is a proximal step for an update's own effect, as `kfac`'s is.
    """
    module, x = CASES[name].model().map, CASES[name].any()[0]
    moment = second_moment(dense_rows(module, x))
    update = random_update(CASES[name])
    left = joined(allowed(protect(decompose(moment), Strength(soft=soft), update[0]), update))
    left = left.requires_grad_()
    seen = (left @ (moment / moment.trace()) @ left.T).trace()
    objective = (left - joined(update)).square().sum() + seen / soft
    (gradient,) = torch.autograd.grad(objective, left)
    torch.testing.assert_close(gradient, torch.zeros_like(gradient), rtol=0, atol=1e-6)


@pytest.mark.parametrize("soft", SOFT)
@pytest.mark.parametrize("name", ["norm", "norm without shift"])
def test_soft_equals_a_solve_in_each_channel(name: str, soft: float) -> None:
    module, inputs = CASES[name].model().map, CASES[name].vqa()
    moment = channel_moment(rows_of(module, inputs[0]), module.bias is not None)
    weight, bias = random_update(CASES[name])
    both = weight[:, None] if bias is None else torch.stack([weight, bias], 1)
    trace = moment.diagonal(dim1=-2, dim2=-1).sum()
    expected = torch.cat(
        [shrunk(m, d[None], soft, trace) for m, d in zip(moment, both, strict=True)]
    )
    protection = protect(decompose(moment), Strength(1.0, soft), weight)
    assert_same(
        allowed(protection, (weight, bias)),
        (expected[:, 0], None if bias is None else expected[:, 1]),
    )


def test_soft_leads_from_hard_to_nothing(case: Case) -> None:
    inputs, update = case.any(), random_update(case)
    if isinstance(case.make(), nn.Embedding):
        inputs = (case.vqa()[0], *inputs[1:])  # rows that are read stay, however soft
    thresholds = (1e-13, 1e-6, 1e-3, 0.1, 1.0, 1e3, 1e13)
    left = [allowed(protection_of(case, inputs, 1.0, soft), update) for soft in thresholds]
    assert_same(left[0], allowed(protection_of(case, inputs, 1.0), update), 1e-8)
    no_threshold = (
        allowed(protection_of(case, inputs[:1], 1.0), update)
        if inputs[0].dtype == torch.int64
        else update
    )
    assert_same(left[-1], no_threshold, 1e-8)
    sizes, lost = [size(x) for x in left], [size(minus(update, x)) for x in left]
    assert sizes == sorted(sizes) and lost == sorted(lost, reverse=True)


def test_soft_takes_what_is_stored() -> None:
    moment = second_moment(draw(50, 5) * torch.tensor([9.0, 3, 1, 0.3, 0.1]))
    spectrum, update = decompose(moment, energy=0.99), draw(4, 5)
    stored = spectrum.vectors
    assert 0 < stored.shape[1] < 5
    left, _ = allowed(protect(spectrum, Strength(1.0, 0.1), update), (update, None))
    rest = torch.eye(5, dtype=torch.float64) - stored @ stored.T
    torch.testing.assert_close(left @ rest, update @ rest)  # what is not stored is free
    torch.testing.assert_close(left @ stored, shrunk(moment, update, 0.1, moment.trace()) @ stored)


def resolved(moment: Tensor, count: int) -> Spectrum:
    """The spectrum of which only the leading directions and the energy of the rest are known."""
    whole = decompose(moment)
    assert whole.vectors is not None
    rest = whole.values[count:].mean()
    return with_rest(whole.values[:count], whole.vectors[:, :count], rest)


@pytest.mark.parametrize("soft", SOFT)
@pytest.mark.parametrize("bias", [True, False])
def test_what_was_never_resolved_is_taken_as_one_scalar(bias: bool, soft: float) -> None:
    rows = draw(50, 5)
    moment = second_moment(with_one(rows) if bias else rows)
    spectrum, weight = resolved(moment, 2), draw(4, 5)
    update = (weight, draw(4) if bias else None)
    u = spectrum.vectors
    leading, eye = spectrum.values[:2] - spectrum.rest, torch.eye(len(u), dtype=u.dtype)
    stands_for = (u * leading) @ u.T + spectrum.rest * eye
    left = allowed(protect(spectrum, Strength(1.0, soft), weight), update)
    torch.testing.assert_close(
        joined(left), shrunk(stands_for, joined(update), soft, moment.trace())
    )


def test_all_that_was_resolved_serves_any_share() -> None:
    moment, update = second_moment(draw(50, 5)), draw(4, 5)
    spectrum = resolved(moment, 2)
    left, _ = allowed(protect(spectrum, Strength(1.0), update), (update, None))
    torch.testing.assert_close(left, update - update @ spectrum.vectors @ spectrum.vectors.T)


def test_no_protection_copies_the_anchors_directions() -> None:
    spectrum = decompose(second_moment(draw(50, 5)))
    for strength in (Strength(0.9), Strength(1.0, 0.1)):
        found = protect(spectrum, strength, draw(4, 5))
        assert found.basis.data_ptr() == spectrum.vectors.data_ptr()


# --- what is known of the weights before ----------------------------------------------------------


@pytest.mark.parametrize("strength", [Strength(0.9), Strength(1.0), Strength(1.0, soft=0.1)])
def test_held_by_its_coordinates_a_map_is_where_the_projection_leaves_it(
    case: Case, strength: Strength
) -> None:
    protection = protection_of(case, case.vqa(), strength.energy, strength.soft)
    module = case.model().map
    now = module.weight.data, None if getattr(module, "bias", None) is None else module.bias.data
    before, update = copied(now), random_update(case)
    known = protection.remember(*now)
    for tensor, moved in zip(now, update, strict=True):
        if tensor is not None:
            tensor.add_(moved)
    protection.hold(*now, known)
    for tensor, old, left in zip(now, before, allowed(protection, update), strict=True):
        if tensor is not None:
            torch.testing.assert_close(tensor, old + left, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("shape", [(), (1,), (6,), (1, 1, 6)])
@pytest.mark.parametrize("read", [True, False])
def test_a_lone_row_that_is_read_goes_back(shape: tuple[int, ...], read: bool) -> None:
    protection = nullspace.TableRows(torch.tensor([read]))
    weight = torch.randn(shape, dtype=torch.float64)
    before = weight.clone()
    known = protection.remember(weight, None)
    protection.hold(weight.add_(1), None, known)
    torch.testing.assert_close(weight, before if read else before + 1)


def test_coordinates_are_fewer_numbers_than_weights() -> None:
    moment = second_moment(draw(3, 64))
    protection = protect(decompose(moment), Strength(1.0), draw(8, 64))
    (known,) = protection.remember(draw(8, 64), None)
    assert known is not None and known.shape == (8, 3)


@pytest.mark.parametrize("exact", [True, False])
def test_a_small_copy_holds_the_same_numbers(exact: bool) -> None:
    weight = torch.randn(5, 6)
    weight = weight.bfloat16().float() if exact else weight
    small, bias = copied_small((weight, None))
    assert bias is None and small.data_ptr() != weight.data_ptr()
    assert small.dtype == (torch.bfloat16 if exact else torch.float32)
    update = torch.randn(5, 6)
    found, _ = minus((weight + update, None), (small, None))
    assert torch.equal(found, weight + update - weight)


# --- all maps together ----------------------------------------------------------------------------


def all_protections(energy: float, soft: float = 0.0) -> dict[str, Protection]:
    return {name: protection_of(case, case.vqa(), energy, soft) for name, case in CASES.items()}


@pytest.mark.parametrize("energy", ENERGIES)
def test_what_is_left_has_no_protected_share_and_what_is_removed_no_other(
    energy: float,
) -> None:
    protections = all_protections(energy)
    updates = {name: random_update(case) for name, case in CASES.items()}
    left = {name: allowed(p, updates[name]) for name, p in protections.items()}
    removed = {name: minus(updates[name], left[name]) for name in updates}
    assert 0 <= protected_share(protections, left.items()) < 1e-12
    assert protected_share(protections, removed.items()) == pytest.approx(1, abs=1e-12)
    expected = sum(map(size, removed.values())) / sum(map(size, updates.values()))
    assert 0.01 < expected < 0.99
    assert protected_share(protections, updates.items()) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_what_is_removed_is_all_that_is_protected_in_float32(scale: float) -> None:
    for seed in range(20):
        torch.manual_seed(seed)
        vectors = torch.linalg.qr(torch.randn(40, 40)).Q
        spectrum = Spectrum(
            torch.rand(40, dtype=torch.float64).sort(descending=True).values, vectors
        )
        for energy in ENERGIES:
            weight = scale * torch.randn(30, 40)
            protections = {SITE: protect(spectrum, Strength(energy), weight)}
            removed, _ = protections[SITE].removed(weight, None)
            updates = (removed, weight, weight - removed)
            whole, some, none = (
                protected_share(protections, [(SITE, (update, None))]) for update in updates
            )
            assert 0 <= some <= 1 + 1e-5 and whole == pytest.approx(1, abs=1e-5)
            assert (
                energy > 0.9 or 0 <= none < 1e-5
            )  # if every direction is protected, only rounding is left


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize("width", [7, 9, 10])
@pytest.mark.parametrize("scale", [0.1, 0.3, 1.0])
@pytest.mark.parametrize("base", [1.0, 0.5], ids=["even", "falling"])
def test_a_spectrum_kept_up_to_a_share_serves_that_share_and_none_above(
    base: float, scale: float, width: int
) -> None:
    """This includes a share that ends exactly on a direction, where rounding could decide."""
    moment, like = (
        scale * torch.diag(base ** torch.arange(width, dtype=torch.float64)),
        torch.zeros(3, width),
    )
    for energy in (*(i / width for i in range(1, width + 1)), *(i / 100 for i in range(1, 101))):
        spectrum = decompose(moment, energy)
        protect(spectrum, Strength(energy), like)
        if spectrum.vectors.shape[1] < width:
            with pytest.raises(AegisError) as caught:
                protect(spectrum, Strength(1.0), like)
            assert (
                f"{spectrum.vectors.shape[1]} eigenvectors" in caught.value.found
                and f"needs {width}" in caught.value.found
            )
            assert "anchor.energy=1" in caught.value.fix


def test_sites_that_the_anchor_lacks_are_named() -> None:
    weights = {"known": draw(3, 3), "layers.0.up": draw(3, 3), "layers.0.norm1": draw(3)}
    nullspace.protections(
        Anchor(inputs={site: falling(3) for site in weights}), weights, Strength(1.0)
    )
    with pytest.raises(AegisError) as caught:
        nullspace.protections(
            Anchor(inputs={"known": falling(3), "known.scores": falling(3)}), weights, Strength(1.0)
        )
    assert caught.value.found == "an anchor without the inputs of layers.0.norm1, layers.0.up"


def test_inputs_that_were_never_but_zero_protect_nothing() -> None:
    update = draw(4, 3)
    for soft in (0.0, 0.1):
        left, _ = allowed(
            protect(decompose(torch.zeros(3, 3)), Strength(1.0, soft), update), (update, None)
        )
        torch.testing.assert_close(left, update)
        channels = protect(decompose(torch.zeros(4, 1, 1)), Strength(1.0, soft), update[:, 0])
        torch.testing.assert_close(allowed(channels, (update[:, 0], None))[0], update[:, 0])
