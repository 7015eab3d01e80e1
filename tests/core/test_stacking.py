"""Maps of one shape, treated together: each gets the same result as alone."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from aegis_cli.core import curvature, nullspace, stacking
from aegis_cli.core.curvature import Curvature
from aegis_cli.core.nullspace import Dense, Elementwise, Protection, TableRows
from aegis_cli.core.pairs import Pair, copied

pytestmark = pytest.mark.usefixtures("fixed_draws")

OUT = 4
SHAPES = [(OUT, 5), (OUT, 2, 3, 3)]
# The number of directions of each map, without those that were never resolved.
RANKS = [(3,), (2, 5), (5, 1, 3)]


def draw(*shape: int) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64)


def pairs(count: int, shape: Sequence[int], biased: bool) -> list[Pair]:
    return [(draw(*shape), draw(shape[0]) if biased else None) for _ in range(count)]


def width(shape: Sequence[int], biased: bool) -> int:
    return torch.Size(shape[1:]).numel() + biased


def columns(size: int, count: int) -> Tensor:
    return torch.linalg.qr(draw(size, size)).Q[:, :count]


def curved(size: int, rank: int, rest: float) -> Curvature:
    outputs = min(rank, OUT)
    return Curvature(
        inputs=columns(size, rank),
        outputs=columns(OUT, outputs),
        c=draw(rank).abs(),
        g=draw(outputs).abs(),
        damping=0.3,
        c_rest=rest,
        g_rest=rest,
    )


def assert_same(found: Sequence[Pair], expected: Sequence[Pair]) -> None:
    for ours, theirs in zip(found, expected, strict=True):
        for x, y in zip(ours, theirs, strict=True):
            assert (x is None) == (y is None)
            if x is not None and y is not None:
                torch.testing.assert_close(x, y, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("biased", [True, False])
def test_stacked_curvatures_take_what_each_takes(shape: tuple[int, ...], biased: bool) -> None:
    """Whether none, one or all of them have directions that were never resolved."""
    size = width(shape, biased)
    for ranks, rests in itertools.product(RANKS, ([0.0] * 3, [0.0, 0.2, 0.0], [0.1, 0.2, 0.3])):
        each = [curved(size, rank, rest) for rank, rest in zip(ranks, rests, strict=False)]
        moved = pairs(len(ranks), shape, biased)
        together = curvature.stacked(each)
        for name in ("excess", "gradient"):
            found = getattr(together, name)(*stacking.stacked(moved), 0.7)
            alone = [getattr(one, name)(*pair, 0.7) for one, pair in zip(each, moved, strict=True)]
            assert_same(stacking.apart(found, moved), alone)


def dense(size: int, rank: int, rest: float) -> Protection:
    return Dense(columns(size, rank), torch.rand(rank, dtype=torch.float64), rest)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("biased", [True, False])
def test_stacked_maps_are_protected_as_each_is(shape: tuple[int, ...], biased: bool) -> None:
    size = width(shape, biased)
    for ranks, rest in itertools.product(RANKS, (0.0, 0.2)):
        each = [dense(size, rank, rest * number) for number, rank in enumerate(ranks)]
        check_protection(each, pairs(len(ranks), shape, biased), pairs(len(ranks), shape, biased))


@pytest.mark.parametrize("biased", [True, False])
@pytest.mark.parametrize("count", [1, 3])
def test_stacked_normalisations_are_protected_as_each_is(count: int, biased: bool) -> None:
    parts = 1 + biased
    each = [Elementwise(draw(OUT, parts, parts)) for _ in range(count)]
    check_protection(each, pairs(count, (OUT,), biased), pairs(count, (OUT,), biased))


def check_protection(
    each: Sequence[Protection], now: Sequence[Pair], before: Sequence[Pair]
) -> None:
    together = nullspace.stacked(each)
    removed = together.removed(*stacking.stacked(now))
    alone = [one.removed(*pair) for one, pair in zip(each, now, strict=True)]
    assert_same(stacking.apart(removed, now), alone)

    held = []
    for one, pair, old in zip(each, now, before, strict=True):
        held.append(copied(pair))
        one.hold(*held[-1], one.remember(*old))
    assert isinstance(together, Dense | Elementwise)
    remembered = together.remember(*stacking.stacked(before))
    stacking.subtract(now, together.changed(*stacking.stacked(now), remembered))
    assert_same(now, held)


def test_tables_are_not_stacked() -> None:
    with pytest.raises(TypeError, match="not tables"):
        nullspace.stacked([TableRows(torch.ones(2, dtype=torch.bool))] * 2)


def test_maps_on_two_devices_are_of_two_kinds() -> None:
    here, there = (torch.zeros(OUT, 5, device=device) for device in ("cpu", "meta"))
    assert stacking.kind_of((here, None)) == stacking.kind_of((here.clone(), None))
    assert stacking.kind_of((here, None)) != stacking.kind_of((there, None))


def test_a_lone_map_is_left_as_it_is() -> None:
    one, pair = curved(5, 2, 0.1), (draw(OUT, 5), None)
    assert curvature.stacked([one]) is one and stacking.stacked([pair]) is pair


@given(
    sizes=st.dictionaries(
        st.text(min_size=1), st.tuples(st.integers(1, 50), st.integers(0, 9)), max_size=20
    ),
    kinds=st.integers(1, 4),
    most=st.integers(1, 120),
)
def test_groups_have_each_site_once_and_one_kind_and_no_more_than_they_may(
    sizes: dict[str, tuple[int, int]], kinds: int, most: int
) -> None:
    def kind(site: str) -> int:
        return len(site) % kinds

    found = stacking.groups(sizes, kind, sizes.__getitem__, most)
    assert sorted(site for group in found for site in group) == sorted(sizes)
    for group in found:
        assert len({kind(site) for site in group}) == 1
        assert len(group) == 1 or sum(sizes[site][0] for site in group) <= most
    for a, b in zip(found, found[1:], strict=False):
        # No stack begins before the last one of its kind is full.
        if kind(a[0]) == kind(b[0]):
            assert sum(sizes[site][0] for site in (*a, b[0])) > most
