"""How a variant's knob is chosen: one rule for all variants of a study, on validation parts only.

Among a variant's values whose ability is close to the best, the one with the most merit is chosen.
Each kind of study declares what ability and merit are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from aegis_cli.common.limits import ROUNDING


@dataclass(frozen=True)
class PolicyPoint:
    """One value of a variant's knob (None: it has none), and its figures on the validation split.

    They are shares in [0, 1]. `success` is on seen colours or, on a task measured by its return,
    its share of the highest return. For policies that cannot be rolled out, `open_loop_error` takes
    its place, on episodes that no compared cell is evaluated on. Both are None if the training
    diverged.
    """

    variant: str
    method: str
    value: Any
    accuracy: float | None
    baseline_accuracy: float | None
    success: float | None
    chosen: bool = False
    open_loop_error: float | None = None


@dataclass(frozen=True)
class StreamPoint:
    """One value of a variant's knob (None: it has none) and its result.

    `last` is a share in [0, 1], on validation parts with the task told; None if the training
    diverged.
    """

    variant: str
    method: str
    value: Any
    last: float | None
    parameters: int | None
    chosen: bool = False


@dataclass(frozen=True)
class RobotStreamPoint:
    """One value of a variant's knob (None: it has none) and its result after the last task.

    Shares in [0, 1], on validation episodes and questions; None if the training diverged.
    """

    variant: str
    method: str
    value: Any
    last: float | None
    accuracy: float | None
    chosen: bool = False


Point = PolicyPoint | StreamPoint | RobotStreamPoint


@dataclass(frozen=True)
class Rule:
    """Ability first, within a margin, then merit.

    Attributes:
        ability: a share, higher is better; None for a value that diverged.
        merit: decides among able values; the highest is chosen.
        reference: the method whose best value sets the margin for all variants; without one, each
            variant's own best value does.
        sentence: the rule in words, with {place} and {within} to be filled in.
    """

    ability: Callable[[Any], float | None]
    merit: Callable[[Any], float]
    sentence: str
    reference: str | None = None

    def explain(self, place: str, within: float) -> str:
        """The rule in words, for the task or stream and the margin of one study."""
        return self.sentence.format(place=place, within=within)


def _acts(point: PolicyPoint) -> float | None:
    if point.success is not None:
        return point.success
    return None if point.open_loop_error is None else -point.open_loop_error


POLICY_RULE: Rule = Rule(
    ability=_acts,
    merit=lambda point: point.accuracy or 0.0,
    sentence="by validation scenes and episodes of {place}: of a variant's values within "
    "{within:g} points of naive's best success, the one with the highest VQA accuracy; if none is "
    "within, the one with the highest success",
    reference="naive",
)
# The same rule, worded for policies that cannot be rolled out.
OPEN_LOOP_RULE = replace(
    POLICY_RULE,
    sentence="by validation questions, and episodes of {place} that judge no compared policy: of a "
    "variant's values within {within:g} hundredths of naive's least open-loop error, the one with "
    "the highest VQA accuracy; if none is within, the one with the least error",
)
STREAM_RULE: Rule = Rule(
    ability=lambda point: point.last,
    merit=lambda point: -(point.parameters or 0),  # fewer is better
    sentence="on validation parts of {place}: of a variant's values within {within:g} points of "
    "its best Last, the one with the fewest final parameters; ties by Last",
)
ROBOT_STREAM_RULE: Rule = Rule(
    ability=lambda point: point.last,
    merit=lambda point: point.accuracy or 0.0,
    sentence="on validation episodes and questions of {place}: of a variant's values within "
    "{within:g} points of its best success on all tasks, the one with the highest VQA accuracy "
    "after the last task; ties by success",
)


def choose(rule: Rule, points: Mapping[str, Sequence[Point]], within: float) -> dict[str, int]:
    """The index of the chosen point for each variant.

    A value is able if its ability is within `within` percentage points of the best one: the best of
    the rule's reference method, of all variants if none has that method, or of the variant itself
    if the rule has no reference. Among the able values, the one with the most merit is chosen; ties
    are broken by ability, then by order. If none is able, the one with the most ability is chosen;
    ties are broken by merit, then by order. A value that diverged is chosen only if all diverged.
    """
    everyone = [point for own in points.values() for point in own]
    measures = [point for point in everyone if point.method == rule.reference] or everyone
    chosen = {}
    for variant, own in points.items():
        compared = measures if rule.reference else own
        # One margin for all, so that a method cannot trade ability for accuracy.
        best = max(_ability(rule, point) for point in compared)
        chosen[variant] = _best(rule, own, best - within / 100 - ROUNDING)
    return chosen


def _best(rule: Rule, own: Sequence[Point], least: float) -> int:
    """The index of a variant's chosen point; among equal points, `max` takes the first."""
    abilities = [_ability(rule, point) for point in own]
    merits = [rule.merit(point) for point in own]
    numbers = range(len(own))
    # A value that diverged is never able, even if all values of the reference diverged.
    able = [i for i in numbers if -math.inf < abilities[i] >= least]
    if able:  # otherwise the value with the most ability is chosen
        return max(able, key=lambda i: (merits[i], abilities[i]))
    return max(numbers, key=lambda i: (abilities[i], merits[i]))


def _ability(rule: Rule, point: Point) -> float:
    """The ability of a value, or minus infinity if it diverged."""
    ability = rule.ability(point)
    return -math.inf if ability is None else ability
