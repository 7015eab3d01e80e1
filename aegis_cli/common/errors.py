"""The one error a user sees: what was found, what was expected, what to do next."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence

_NAMED = 4  # names that an error lists


class AegisError(Exception):
    """A problem the user can act on; the command line prints it and exits with code 2."""

    def __init__(self, found: str, expected: str, fix: str) -> None:
        super().__init__(found, expected, fix)
        self.found = found
        self.expected = expected
        self.fix = fix

    def __str__(self) -> str:
        return f"found: {self.found}\nexpected: {self.expected}\nfix: {self.fix}"


class PeerLost(AegisError):
    """Another of several processes has ended; it reports the reason itself."""


class Diverged(AegisError):
    """Training met a number that is not finite; earlier checkpoints are intact."""

    def __init__(self, found: str, expected: str, fix: str, good_steps: int) -> None:
        super().__init__(found, expected, fix)
        self.good_steps = good_steps

    def __reduce__(self) -> tuple[type[Diverged], tuple[str, str, str, int]]:
        """Support pickling: an exception is recreated from its `args`, which lack the steps."""
        return Diverged, (self.found, self.expected, self.fix, self.good_steps)


def check_finite(figures: Mapping[str, float], where: str, fix: str, good_steps: int) -> None:
    """Raise Diverged unless every figure is a finite number."""
    if not all(math.isfinite(value) for value in figures.values()):
        found = ", ".join(f"{name} {value:g}" for name, value in figures.items())
        raise Diverged(f"{found} {where}", "finite numbers", fix, good_steps)


def few(names: Sequence[str]) -> str:
    """The first few names, and the total count if there are more."""
    shown = ", ".join(names[:_NAMED])
    return shown if len(names) <= _NAMED else f"{shown}, ... {len(names)} in all"


def in_short(error: Exception) -> str:
    """The beginning of an error's message, on one line."""
    said = " ".join(str(error).split())
    return textwrap.shorten(said, 200, placeholder=" ...") or type(error).__name__
