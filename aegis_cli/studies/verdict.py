"""A bar: demands on a variant's figures, each passed, failed, or not measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from aegis_cli.evaluation.estimates import Estimate


@dataclass(frozen=True)
class Check:
    """One demand of the bar: its number, if it could be measured, and whether that is
    good enough.
    """

    name: str
    demand: str
    value: float | None
    interval: tuple[float, float] | None
    passed: bool | None


@dataclass(frozen=True)
class Bar:
    """What a variant has to be to be preferred; None: not measured.

    All checks can be passed and the bar not: by a variant that diverged with some seed.
    """

    checks: list[Check]
    passed: bool | None


def check(name: str, demand: str, found: Estimate | None, passed: bool | None) -> Check:
    """A demand on a mean."""
    return Check(
        name,
        demand,
        None if found is None else found.mean,
        None if found is None else found.interval,
        passed,
    )


def verdict(checks: Sequence[Check], diverged: bool = False) -> Bar:
    """One failed check, or a training that diverged, fails the bar; else one that was not measured
    leaves it open.
    """
    passed = [check.passed for check in checks]
    return Bar(
        list(checks), False if diverged or False in passed else None if None in passed else True
    )
