"""Declarations of the figures of a comparison: each once, for measuring, JSON and tables.

A result class declares a figure as an annotated field, `w2: Annotated[Mean, Metric("W2²")]`.
`measure` computes the fields of a variant from its cells, `dataclasses.asdict` turns them into
JSON, and a table takes a column's header and digits from the same declaration. A bar is a tuple of
demands on such a result.
"""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cache
from typing import Any, get_type_hints

from aegis_cli.common.estimates import Estimate, estimate
from aegis_cli.common.limits import ROUNDING
from aegis_cli.evaluation.bootstrap import Units, crossed_interval

Mean = Estimate | None  # over seeds; None if no cell has a value
Setting = tuple[str, int]  # the task or stream of a cell, and its seed
Values = Mapping[Setting, float]


@dataclass(frozen=True)
class Sample:
    """A variant's cells that did not diverge.

    Attributes:
        figures: the figures of each cell, in the recipe's order.
        seeded: whether the seeds differ. They do not if nothing is learned.
    """

    figures: Mapping[Setting, Any]
    seeded: bool = True


# --- summaries of a metric's values ---------------------------------------------------------------


def over_seeds(values: Values) -> Mean:
    """The estimate from each seed's mean over its tasks or streams; None without values."""
    # First over a seed's tasks, which are not random draws: the interval's n counts seeds.
    seeds: dict[int, list[float]] = {}
    for (_, seed), value in values.items():
        seeds.setdefault(seed, []).append(value)
    return estimate([statistics.fmean(own) for own in seeds.values()]) if seeds else None


def lowest(values: Values) -> float | None:
    """The value of the worst cell."""
    return min(values.values(), default=None)


def points(own: float, other: float) -> float:
    """The difference of two shares, in percentage points."""
    return 100 * (own - other)


def ratio(own: float, other: float) -> float | None:
    """`own / other`; None if `other` is zero."""
    return own / other if other else None


# --- declarations ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Column:
    """How a figure is shown.

    Attributes:
        header: the column's header, with the unit.
        decimals: digits after the point; None for `significant` digits.
        percent: whether it is a share, shown in percent.
        signed: whether a positive value is shown with its sign.
        axis: its label on a plot's axis, with the unit; None for a figure that no plot shows.
        more_is_better: whether larger values are better; None if neither direction is.
    """

    header: str
    decimals: int | None = None
    _: KW_ONLY
    significant: int = 4
    percent: bool = False
    signed: bool = False
    axis: str | None = None
    more_is_better: bool | None = None

    def shown(self, value: float) -> float:
        """The value in the unit of the header and the axis."""
        return 100 * value if self.percent else value


@dataclass(frozen=True)
class Metric(Column):
    """A figure that is measured.

    Attributes:
        of: computes it for one cell; by default the cell's figure with the field's name.
        summary: summarizes the values of all cells.
        units: the units that a cell was measured on, if it stored them, for the crossed bootstrap.
        sure: whether a cell's figure could not have been different; None means it always could.
    """

    _: KW_ONLY
    of: Callable[[Any], float | None] | None = None
    summary: Callable[[Values], Any] = over_seeds
    units: Callable[[Any], Units | None] | None = None
    sure: Callable[[Any], bool] | None = None


@dataclass(frozen=True)
class Contrast(Metric):
    """A figure compared with another variant's in the same setting.

    Cells of the same task or stream and seed start equally and see the same batches, so a paired
    difference varies less than either of its parts.

    Attributes:
        against: the name of the other variant.
        compare: computes the comparison from the two figures.
    """

    _: KW_ONLY
    against: str
    compare: Callable[[float, float], float | None] = points


@cache
def columns(kind: type) -> dict[str, Column]:
    """The declared figures of a result class, by the names of their fields."""
    found: dict[str, Column] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        for note in getattr(hint, "__metadata__", ()):
            if isinstance(note, Column):
                found[name] = note
    return found


def measure(
    kind: type, sample: Sample, references: Mapping[str, Sample], prefix: str = ""
) -> dict[str, Any]:
    """The measured fields of a result class.

    Args:
        references: variant -> its cells, for contrasts.
        prefix: prefix of the field names in the cells' figures, such as `inferred_`.
    """
    measured: dict[str, Any] = {}
    for name, column in columns(kind).items():
        if not isinstance(column, Metric):
            continue
        values = _values(column, prefix + name, sample)
        seeded, other = sample.seeded, None
        if isinstance(column, Contrast):
            other = references.get(column.against, Sample({}))
            values = _compared(column, values, _values(column, prefix + name, other))
            seeded = sample.seeded or other.seeded
        known = {setting: value for setting, value in values.items() if value is not None}
        # Counting one run once per seed would look like several runs that agree.
        made = column.summary(known if seeded else _once(known))
        if isinstance(made, Estimate) and column.units is not None:
            crossed = _crossed(column.units, known, sample, other)
            sure = crossed is not None or _surely(column, known, sample, other)
            made = dataclasses.replace(unless_alike(made, sure), crossed=crossed)
        measured[name] = made
    return measured


def unless_alike(found: Estimate, sure: bool) -> Estimate:
    """Drop the interval if seeds are equal by chance, since they do not show how seeds vary.

    Args:
        sure: whether they are not equal by chance, or the variation is known from elsewhere.
    """
    alike = found.interval is not None and found.interval[1] - found.interval[0] <= ROUNDING
    return dataclasses.replace(found, interval=None) if alike and not sure else found


def _surely(column: Metric, known: Values, sample: Sample, other: Sample | None) -> bool:
    """Whether the figures of these cells, and of the cells compared with them, could not differ.

    This also holds for a variant that is compared with itself.
    """
    if other is sample:
        return True
    if column.sure is None:
        return False
    figures = []
    for each in [sample] if other is None else [sample, other]:
        figures += [each.figures[setting] for setting in known]
    return all(map(column.sure, figures))


def _crossed(
    units_of: Callable[[Any], Units | None], known: Values, sample: Sample, other: Sample | None
) -> tuple[float, float] | None:
    """The crossed bootstrap's interval of these cells, or of differences to another variant's.

    It is None unless every cell stored its units and all cells are of one task, since tasks are
    not random draws.
    """
    seeds = []
    for setting in known:
        units = units_of(sample.figures[setting])
        if units is not None and other is not None:
            reference = units_of(other.figures[setting])
            units = None if reference is None else units.minus(reference)
        if units is None:
            return None
        seeds.append(units)
    if len({task for task, _ in known}) != 1:
        return None
    return crossed_interval(seeds)


def _values(metric: Metric, name: str, sample: Sample) -> dict[Setting, float | None]:
    of = metric.of or (lambda figures: getattr(figures, name))
    return {setting: of(figures) for setting, figures in sample.figures.items()}


def _compared(
    contrast: Contrast,
    own: Mapping[Setting, float | None],
    other: Mapping[Setting, float | None],
) -> dict[Setting, float | None]:
    made: dict[Setting, float | None] = {}
    for setting, value in own.items():  # settings that only one variant has are left out
        against = other.get(setting)
        if value is not None and against is not None:
            made[setting] = contrast.compare(value, against)
    return made


def _once(values: Values) -> dict[Setting, float]:
    """One value per task or stream: with other seeds it is the same cell."""
    first: dict[str, Setting] = {}
    for setting in values:
        first.setdefault(setting[0], setting)
    return {setting: values[setting] for setting in first.values()}


# --- bars -----------------------------------------------------------------------------------------


_SIGNS: dict[str, Callable[[float, float], bool]] = {
    "<=": lambda value, limit: value <= limit + ROUNDING,
    ">=": lambda value, limit: value >= limit - ROUNDING,
    ">": lambda value, limit: value > limit + ROUNDING,
    "<": lambda value, limit: value < limit - ROUNDING,
}
_ALL_DECIMALS = 9  # values that differ by less than ROUNDING count as equal


@dataclass(frozen=True)
class Check:
    """A demand's figure, if it could be measured, and whether it is good enough.

    `by_design` means that a variant of this kind could not have failed.
    """

    name: str
    demand: str
    value: float | None
    interval: tuple[float, float] | None
    passed: bool | None
    by_design: bool = False


def deciding_decimals(value: float, demand: str, decimals: int) -> int:
    """Number of digits, `decimals` or more, with which a rounded value is on the right side.

    For example, 1.0204 is above a limit of 1.02, but 1.02 is not.

    Args:
        demand: the demand in words, as in `Check.demand`.
    """
    sign, _, rest = demand.partition(" ")
    if sign not in _SIGNS:
        return decimals
    # The words of a limit begin with its number: `<= 1.02 x naive`.
    holds, limit = _SIGNS[sign], float(rest.partition(" ")[0])
    while decimals < _ALL_DECIMALS and holds(round(value, decimals), limit) != holds(value, limit):
        decimals += 1
    return decimals


@dataclass(frozen=True)
class Bar:
    """Whether a variant is to be preferred; None if that was not measured.

    A variant that diverged with some seed can pass all checks but not the bar.
    """

    checks: list[Check]
    passed: bool | None


def unmeasured(bars: Sequence[Mapping[str, float | None]]) -> str:
    """The demands for which no variant has a figure, in words: no variant can pass such a bar.

    Args:
        bars: for each variant, demand -> its figure; all have the same demands.
    """
    names = bars[0] if bars else ()
    return ", ".join(name for name in names if all(bar[name] is None for bar in bars))


@dataclass(frozen=True)
class Limit:
    """A limit in words, and as a test of a measured figure.

    The test returns None if the figure cannot decide, as for a single run without an interval.
    """

    words: str
    holds: Callable[[Any], bool | None]


@dataclass(frozen=True)
class Demand:
    """A requirement on a result.

    Attributes:
        of: path of the figure in the result, such as `pair_a.added`.
        sure_if_frozen: whether a learner that never changes the weights of learned tasks always
            meets it.
    """

    name: str
    of: str
    limit: Limit
    sure_if_frozen: bool = False

    def check(self, result: Any, frozen: bool = False) -> Check:
        """Check a result against the demand."""
        found = result
        for name in self.of.split("."):  # a study without pairs has None for `pair_a`
            found = None if found is None else getattr(found, name)
        passed = None if found is None else self.limit.holds(found)
        value, interval = found, None
        if isinstance(found, Estimate):
            value, interval = found.mean, found.ends
        sure = frozen and self.sure_if_frozen
        return Check(self.name, self.limit.words, value, interval, passed, sure)


def bar(demands: Sequence[Demand], result: Any, frozen: bool = False) -> Bar:
    """The verdict on a result.

    One failed check, or a training in `diverged`, fails the bar. Otherwise a check that was not
    measured leaves it open.
    """
    checks = [demand.check(result, frozen) for demand in demands]
    passed = [check.passed for check in checks]
    # A mean over only the seeds that did not diverge is not a mean over seeds.
    if result.diverged or False in passed:
        return Bar(checks, False)
    return Bar(checks, None if None in passed else True)


# An estimate is judged by the end of its interval that is nearer to failure: a mean on the good
# side may be there by chance, and an interval that merely reaches the good side rewards noise.


def at_most(limit: float, unit: str) -> Limit:
    """A figure that is surely not above `limit`: the upper end of its interval is not."""
    return Limit(f"<= {limit:g} {unit}", lambda found: _reaches(found, 1, limit + ROUNDING))


def at_least(limit: float, unit: str) -> Limit:
    """A figure that is surely not below `limit`: the lower end of its interval is not."""
    return Limit(f">= {limit:g} {unit}", lambda found: _reaches(found, -1, limit - ROUNDING))


def above(limit: float, unit: str) -> Limit:
    """A figure that is surely above `limit`: the lower end of its interval is."""
    return Limit(f"> {limit:g} {unit}", lambda found: _reaches(found, -1, limit + ROUNDING))


def below(limit: float, unit: str) -> Limit:
    """A figure that is surely below `limit`: the upper end of its interval is."""
    return Limit(f"< {limit:g} {unit}", lambda found: _reaches(found, 1, limit - ROUNDING))


def _reaches(found: Estimate | float, side: int, limit: float) -> bool | None:
    """Whether the upper end (`side` 1) is at most `limit`, or the lower end (-1) at least `limit`.

    A plain number is its own upper and lower end. Several equal runs without an interval fail if
    their value is on the bad side; otherwise they leave it open.
    """
    # Multiplying by -1 reverses an inequality: -x <= -limit is x >= limit.
    if not isinstance(found, Estimate):
        return side * found <= side * limit
    if found.ends is None:
        is_bad = found.runs > 1 and side * found.mean > side * limit
        return False if is_bad else None
    low, high = found.ends
    return high <= limit if side == 1 else low >= limit
