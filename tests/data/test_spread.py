"""Rows that are spread evenly over many."""

from __future__ import annotations

from hypothesis import example, given
from hypothesis import strategies as st

from aegis_cli.data import spread


@given(st.integers(1, 2**40), st.integers(1, 300))
@example(16_777_220, 100)  # which float32 rounds to a row that does not exist
@example(27_000_004, 1_000)
def test_they_go_from_the_first_row_to_the_last(size: int, most: int) -> None:
    rows = spread.rows(size, most)
    count = min(size, most)
    assert len(rows) == count == len(rows.unique())
    assert rows[0] == 0 and rows.max() < size
    if count > 1:
        assert size - 1 - rows[-1] <= 1
        steps = rows.diff()
        assert steps.max() - steps.min() <= 1 + size // 2**22
