"""Signs that two recordings of one robot have different units, such as degrees and radians."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

# Degrees and radians differ by 57, millimetres and metres by 1,000. Motions of one robot rarely
# differ by this much in most of its joints.
_APART = 10.0


def said(what: str, own: Sequence[float], known: Sequence[float], of_known: str) -> str | None:
    """A sentence that two recordings may have other units; None if nothing suggests that.

    Args:
        what: the values of one recording, as the sentence's subject.
        own, known: standard deviations [A] of both recordings' values, dimension by dimension.
        of_known: the other recording's values, after "as much as".
    """
    ratios = [one / other for one, other in zip(own, known, strict=True) if one > 0 and other > 0]
    if not ratios:
        return None
    # The median, since a single joint may well move more or hardly at all.
    ratio = statistics.median(ratios)
    if 1 / _APART < ratio < _APART:
        return None
    return (
        f"{what} vary {ratio:.3g} times as much as {of_known}, by the median over their "
        "dimensions: they may be in other units, such as radians beside degrees"
    )
