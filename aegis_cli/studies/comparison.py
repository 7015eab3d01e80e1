"""The results of a study: its figures, declared once per kind of study, and who passes the bar.

Figures are means over seeds with 95 % intervals. A seed's figure is its mean over tasks or streams.
The recipe names these; they are not random draws, so an interval says nothing about other tasks or
other orders of a stream. It covers other questions and episodes only if the cells have stored the
units that they were measured on.
"""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter, sub
from typing import Annotated, Any

from aegis_cli.evaluation.bootstrap import Units
from aegis_cli.recipes import Pairs, PolicyVariant, StudyRecipe, Variant
from aegis_cli.recipes.study_cells import HALF, ISOLATED, NAIVE, ZERO_SHOT
from aegis_cli.studies.figures import (
    Divergence,
    Figures,
    Outcome,
    PolicyFigures,
    RobotStreamFigures,
    StreamFigures,
)
from aegis_cli.studies.metrics import (
    Bar,
    Column,
    Contrast,
    Demand,
    Limit,
    Mean,
    Metric,
    Sample,
    Setting,
    above,
    at_least,
    at_most,
    bar,
    below,
    lowest,
    measure,
    over_seeds,
    ratio,
    unless_alike,
)
from aegis_cli.studies.tuning import PolicyPoint, RobotStreamPoint, StreamPoint


def _gain(
    header: str,
    of: str,
    against: str,
    decimals: int,
    units: Callable[[Any], Units | None] | None = None,
) -> Contrast:
    """A difference to another variant in percentage points."""
    of_cell = attrgetter(of)
    return Contrast(header, decimals, signed=True, of=of_cell, against=against, units=units)


@dataclass(frozen=True)
class Cost:
    """Ratios to naive's training step.

    Attributes:
        machine: the machine that they were measured on; they hold only there.
        code: version and digest of the package that measured them. Both are None in entries that an
            earlier version stored.
    """

    step_time: float
    peak_memory: float
    machine: str | None = None
    code: str | None = None


@dataclass(frozen=True)
class Findings:
    """The results of a study so far.

    Attributes:
        points: the values of knobs that have been tried.
        chosen: variant -> the knob's value in the comparison.
        cells: variant -> task or stream and seed -> the cell's result, in the recipe's order.
        costs: variant -> ratios to naive's training step.
    """

    points: list[Any] = field(default_factory=list)
    chosen: Mapping[str, Any] = field(default_factory=dict)
    cells: Mapping[str, Mapping[Setting, Outcome]] = field(default_factory=dict)
    costs: Mapping[str, Cost] = field(default_factory=dict)

    def at(self, place: str) -> dict[str, dict[int, Outcome]]:
        """The cells of one task or stream by variant and seed, without variants that have none."""
        found: dict[str, dict[int, Outcome]] = {}
        for variant, own in self.cells.items():
            for (where, seed), cell in own.items():
                if where == place:
                    found.setdefault(variant, {})[seed] = cell
        return found


def measured(found: Outcome) -> bool:
    """Whether a cell has figures, that is, did not diverge."""
    return not isinstance(found, Divergence)


def _no_units(figures: Figures) -> None:
    """Units of figures whose units are not stored; Student's t is then the only interval.

    It also marks a figure at which seeds may be equal by chance.
    """


# --- policies -------------------------------------------------------------------------------------


def _lost_by_image(figures: PolicyFigures) -> Units | None:
    """The accuracy lost in training, in points; a unit is the questions of one image."""
    # Cells of an earlier version store neither.
    if figures.lost_per_image is None or figures.questions_per_image is None:
        return None
    import numpy as np

    lost = np.array(figures.lost_per_image, np.float64)
    questions = np.array(figures.questions_per_image, np.float64)
    sure = _stands_still(figures)
    return Units(100 * lost, questions, figures.probe_seed, sure=sure, names=figures.images)


def _stands_still(figures: PolicyFigures) -> bool:
    """Whether the backbone is unchanged: any change would show in the digits of cross-entropy."""
    return figures.cross_entropy == figures.baseline_cross_entropy


def _seen_episodes(figures: PolicyFigures) -> Units | None:
    return _episodes(figures.outcomes_seen, figures.rollout_seed)


def _held_out_episodes(figures: PolicyFigures) -> Units | None:
    return _episodes(figures.outcomes_held_out, figures.rollout_seed)


def _seen_share(figures: PolicyFigures) -> Units | None:
    return _episodes(figures.outcomes_seen, figures.rollout_seed, 1.0)


def _held_out_share(figures: PolicyFigures) -> Units | None:
    return _episodes(figures.outcomes_held_out, figures.rollout_seed, 1.0)


def _error_by_episode(figures: PolicyFigures) -> Units | None:
    """The open-loop error, one unit per held-out episode."""
    return _evaluated(figures, figures.error_per_episode)


def _error_over_still(figures: PolicyFigures) -> float | None:
    """The open-loop error minus the error without a policy (holding, or the mean action)."""
    if figures.open_loop_error is None:
        return None
    return figures.open_loop_error - _without_policy(figures)


def _over_still_by_episode(figures: PolicyFigures) -> Units | None:
    found = _evaluated(figures, figures.error_per_episode)
    if found is None:
        return None
    if figures.hold_error != _without_policy(figures):  # the mean action has error 1 everywhere
        return dataclasses.replace(found, values=found.values - found.counts)
    held = _evaluated(figures, figures.hold_per_episode)
    return None if held is None else found.minus(held)


def _without_policy(figures: PolicyFigures) -> float:
    """The smaller of the errors of holding the position and of the mean action, which is 1."""
    return 1.0 if figures.hold_error is None else min(1.0, figures.hold_error)


def _evaluated(figures: PolicyFigures, errors: Sequence[float] | None) -> Units | None:
    """Errors in held-out episodes; different seeds may have held out the same ones."""
    names, weights = figures.evaluated_episodes, figures.weight_per_episode
    if errors is None or names is None or weights is None:  # measured by an earlier version
        return None
    import numpy as np

    counts = np.array(weights, np.float64)
    return Units(counts * np.array(errors, np.float64), counts, reach=None, names=names)


def _episodes(outcomes: str | None, seed: int, whole: float = 100.0) -> Units | None:
    """Successes, one unit per episode, from one character per episode.

    Args:
        whole: the value of a success: 100 points, or a share of 1.
    """
    if outcomes is None:  # no rollouts, or measured by an earlier version
        return None
    import numpy as np

    successes = np.array([whole * int(one) for one in outcomes])
    return Units(successes, np.ones(len(outcomes)), seed, whole)


@dataclass(frozen=True)
class PolicyResult:
    """One variant on one task.

    Shares are in [0, 1], `_points` in percentage points, cross-entropy in nats. On a task measured
    by its return, `return_share` (1 is the highest return) takes the place of successes and
    `return_gain_points` that of their gains. If nothing can be rolled out, there is an
    `open_loop_error` instead (1 is the error of always predicting the mean action), and
    `open_loop_difference` is its excess over naive's.

    Attributes:
        hold_error: the error of a robot that holds its position, if actions are positions.
        open_loop_over_still: the error minus the error without a policy, which is the smaller of
            `hold_error` and 1.
        diverged: the seeds whose training diverged; no mean counts them, and the bar fails.
        step_time: ratio to the training step of naive, or of `against`; likewise `peak_memory`.
        bar: None for naive and for methods that train on VQA data.
        against: the variant that differences are measured against; None means naive.
    """

    variant: str
    method: str
    knob: str | None
    value: Any
    diverged: list[int]
    accuracy: Annotated[
        Mean,
        Metric(
            "VQA %",
            1,
            percent=True,
            units=_no_units,
            more_is_better=True,
            sure=_stands_still,
        ),
    ]
    drop_points: Annotated[
        Mean,
        Metric(
            "Drop (points)",
            2,
            axis="VQA accuracy lost (points)",
            units=_lost_by_image,
            more_is_better=False,
            sure=_stands_still,
        ),
    ]
    cross_entropy: Annotated[Mean, Metric("Cross-entropy (nats)", 3, more_is_better=False)]
    success_seen: Annotated[
        Mean,
        Metric(
            "Success seen %",
            1,
            percent=True,
            axis="success on seen colours (%)",
            units=_seen_share,
            more_is_better=True,
        ),
    ]
    success_held_out: Annotated[
        Mean,
        Metric("Success held-out %", 1, percent=True, units=_held_out_share, more_is_better=True),
    ]
    wrong_target: Annotated[
        Mean, Metric("Wrong target %", 1, percent=True, units=_no_units, more_is_better=False)
    ]
    return_share: Annotated[
        Mean,
        Metric(
            "Return % of highest",
            1,
            percent=True,
            axis="return (% of the highest)",
            more_is_better=True,
        ),
    ]
    validation_loss: Annotated[Mean, Metric("Validation loss", 4, more_is_better=False)]
    w2: Annotated[Mean, Metric("W2²", significant=3, more_is_better=False)]
    energy_shed: Annotated[Mean, Metric("Energy shed %", 2, percent=True)]
    seen_gain_points: Annotated[
        Mean, _gain("Seen - naive (points)", "success_seen", NAIVE, 1, _seen_episodes)
    ]
    held_out_gain_points: Annotated[
        Mean, _gain("Held-out - naive (points)", "success_held_out", NAIVE, 1, _held_out_episodes)
    ]
    return_gain_points: Annotated[Mean, _gain("Return - naive (points)", "return_share", NAIVE, 1)]
    step_time: Annotated[float | None, Column("Step x naive", 2, more_is_better=False)]
    peak_memory: Annotated[float | None, Column("Memory x naive", 2, more_is_better=False)]
    bar: Bar | None
    against: str | None = None
    drop_difference_points: Annotated[
        Mean,
        Contrast(
            "Drop - reference's (points)",
            2,
            signed=True,
            of=attrgetter("drop_points"),
            against=NAIVE,
            compare=sub,
            units=_lost_by_image,
            sure=_stands_still,
        ),
    ] = None
    open_loop_error: Annotated[
        Mean,
        Metric(
            "Open-loop error",
            3,
            axis="open-loop error on held-out episodes",
            units=_error_by_episode,
            more_is_better=False,
        ),
    ] = None
    hold_error: Annotated[Mean, Metric("Holding's error", 3)] = None
    open_loop_difference: Annotated[
        Mean,
        Contrast(
            "Error - naive's",
            3,
            signed=True,
            of=attrgetter("open_loop_error"),
            against=NAIVE,
            compare=sub,
            units=_error_by_episode,
        ),
    ] = None
    open_loop_over_still: Annotated[
        Mean,
        Metric(
            "Error - no policy's",
            3,
            signed=True,
            of=_error_over_still,
            units=_over_still_by_episode,
        ),
    ] = None

    @property
    def questions(self) -> float:
        """VQA questions in training: 0, since only methods without them have a bar."""
        return 0.0


# A method that trains on no VQA data is preferred to naive if it keeps VQA, learns as well,
# generalises better and costs no more, each judged by the worse end of its interval. A task that is
# measured by its return has no colours to generalise to, so its bar stays open unless a demand
# fails.
_KEEPS = Demand("VQA drop", "drop_points", at_most(0.1, "points"))
_COSTS_NO_MORE = (
    Demand("step time", "step_time", at_most(1.02, "x naive")),
    Demand("VQA questions in training", "questions", Limit("none", lambda count: count == 0)),
)
POLICY_BAR = (
    _KEEPS,
    Demand("success seen - naive", "seen_gain_points", at_least(-1, "point")),
    Demand("success held-out - naive", "held_out_gain_points", above(0, "points")),
    *_COSTS_NO_MORE,
)


def open_loop_bar(most: float) -> tuple[Demand, ...]:
    """The bar if nothing can be rolled out, so that no success is known.

    The open-loop error must be at most `most` above naive's, by the upper end of its interval. It
    must also be below the error without a policy, since any method would match a naive that has
    learned nothing. This bar says nothing about other colours.
    """
    return (
        _KEEPS,
        Demand("open-loop error - naive's", "open_loop_difference", at_most(most, "of variance")),
        Demand("open-loop error - no policy's", "open_loop_over_still", below(0, "of variance")),
        *_COSTS_NO_MORE,
    )


@dataclass(frozen=True)
class TaskResults:
    """One task's table.

    The baseline is the backbone before training, as a mean over the question sets that the seeds
    were asked. It is unknown if every training diverged.

    Attributes:
        vqa: the question set, if a study asks several; each has its own table and bar.
        compared: number of comparisons between cells of two variants with the same seed.
        across_versions: how many of these pair cells that different code versions have measured.
    """

    task: str
    baseline_accuracy: float | None
    baseline_cross_entropy: float | None
    majority_accuracy: float | None
    results: list[PolicyResult]
    vqa: str | None = None
    compared: int = 0
    across_versions: int = 0


@dataclass(frozen=True)
class StudyReport:
    """A study so far, also written to `table.json`.

    `finished` of `cells` trainings are measured.

    Attributes:
        costs_on: the machines that step times and peak memories were measured on.
    """

    name: str
    finished: int
    cells: int
    seeds: list[int]
    tasks: list[TaskResults]
    tuning_task: str | None
    within: float | None
    tuning: list[PolicyPoint]
    out: str
    costs_on: list[str] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def _cost(name: str, against: str | None, costs: Mapping[str, Cost]) -> Cost | None:
    """A variant's costs relative to the variant that it is compared with."""
    own = costs.get(name)
    if own is None or against is None:
        return own
    reference = costs.get(against)
    if reference is None:
        return None
    # Both are relative to naive, which cancels in their ratio.
    return dataclasses.replace(
        own,
        step_time=own.step_time / reference.step_time,
        peak_memory=own.peak_memory / reference.peak_memory,
    )


def task_results(
    task: str,
    found: Mapping[str, Mapping[int, Outcome]],
    variants: Mapping[str, PolicyVariant],
    values: Mapping[str, Any],
    costs: Mapping[str, Cost],
    ceilings: Collection[str],
    max_error_rise: float = StudyRecipe.max_error_rise,
) -> TaskResults:
    """One task's table.

    Args:
        found: variant -> seed -> the result of its training; at least one seed per variant.
        values: variant -> the value of its knob.
        costs: variant -> ratios to naive; empty if there is no naive.
        ceilings: variants that train on VQA data.
        max_error_rise: how far an open-loop error may be above naive's.
    """
    samples: dict[str, Sample] = {}
    for name, own in found.items():
        figures = {(task, seed): row for seed, row in own.items() if measured(row)}
        samples[name] = Sample(figures)
    rows = [row for sample in samples.values() for row in sample.figures.values()]
    demands = open_loop_bar(max_error_rise) if _only_evaluated(rows) else POLICY_BAR
    results, pairs = [], list[tuple[PolicyFigures, PolicyFigures]]()
    for name, own in found.items():
        variant = variants[name]
        # Contrasts are declared against naive, but a variant may name another reference with
        # `against`. Naive itself is not compared unless it names one.
        against = variant.against or (None if name == NAIVE else NAIVE)
        references = {NAIVE: samples[against]} if against in samples else {}
        for other in references.values():
            pairs += _pairs(samples[name], other)
        cost = _cost(name, variant.against, costs)
        diverged = sorted(seed for seed, row in own.items() if not measured(row))
        made = PolicyResult(
            variant=name,
            method=variant.method,
            knob=variant.knob,
            value=values.get(name),
            diverged=diverged,
            **measure(PolicyResult, samples[name], references),
            step_time=None if cost is None else cost.step_time,
            peak_memory=None if cost is None else cost.peak_memory,
            bar=None,
            against=variant.against,
        )
        if not variant.is_plain(NAIVE) and name not in ceilings:
            made = dataclasses.replace(made, bar=bar(demands, made))
        results.append(made)
    asked = _each_probed(samples.values())
    return TaskResults(
        task=task,
        baseline_accuracy=_mean([row.baseline_accuracy for row in asked]),
        baseline_cross_entropy=_mean([row.baseline_cross_entropy for row in asked]),
        majority_accuracy=_mean([row.majority_accuracy for row in asked]),
        results=results,
        compared=len(pairs),
        across_versions=sum(one.code != other.code for one, other in pairs),
    )


def _only_evaluated(rows: Sequence[PolicyFigures]) -> bool:
    """Whether policies have only an open-loop error, and no success or return."""
    acted = any(row.success_seen is not None or row.return_share is not None for row in rows)
    return not acted and any(row.open_loop_error is not None for row in rows)


def _pairs(sample: Sample, reference: Sample) -> list[tuple[PolicyFigures, PolicyFigures]]:
    """Pairs of cells of the same task and seed."""
    # Samples hold no diverged cells, so their settings have no pair.
    settings = sample.figures.keys() & reference.figures.keys()
    return [(sample.figures[setting], reference.figures[setting]) for setting in settings]


def _each_probed(samples: Iterable[Sample]) -> list[PolicyFigures]:
    """One cell for each question set that was asked, since seeds may have different sets."""
    asked: dict[int, PolicyFigures] = {}
    for sample in samples:
        for row in sample.figures.values():
            # Any cell will do, because all methods start from the same backbone.
            asked.setdefault(row.probe_seed, row)
    return list(asked.values())


def _mean(values: Sequence[float]) -> float | None:
    return statistics.fmean(values) if values else None


# --- streams --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Accuracies:
    """Means of shares in [0, 1]; None if a stream has one task."""

    transfer: Annotated[Mean, Metric("Transfer %", 1, percent=True, more_is_better=True)]
    average: Annotated[Mean, Metric("Average %", 1, percent=True, more_is_better=True)]
    last: Annotated[Mean, Metric("Last %", 1, percent=True, more_is_better=True)]
    forgetting: Annotated[
        Mean, Metric("Forgetting (points)", 2, percent=True, more_is_better=False)
    ]


def _stored_share(figures: StreamFigures) -> float | None:
    return ratio(figures.added[1], figures.added[0])


def _experts_share(figures: StreamFigures) -> float | None:
    return ratio(figures.new_experts[1], figures.new_experts[0])


def _second_accuracy(figures: StreamFigures) -> float:
    return figures.own[1]


def _first_change_points(figures: StreamFigures) -> float:
    return 100 * figures.first_change


@dataclass(frozen=True)
class PairResult:
    """Effects of the second of two tasks.

    Attributes:
        added: numbers stored for it, as a share of those of the first task, which had nothing to
            reuse.
        new_experts: the same for experts only, without routers, scales and the numbers that infer
            the task; None without experts.
        reuse: routing mass of the second task on experts of the first.
        second_gain_points: the second task's accuracy with the task told, against the variant
            isolated-lora in the same setting.
        first_change_points: change of the first task's accuracy, with the task told, caused by the
            second task; `worst_change_points` is that of the worst run.
    """

    added: Annotated[Mean, Metric("Stored, % of a fresh task's", 1, percent=True, of=_stored_share)]
    new_experts: Annotated[
        Mean, Metric("Experts, % of a fresh task's", 1, percent=True, of=_experts_share)
    ]
    second_gain_points: Annotated[
        Mean,
        Contrast(
            "Second task - isolated LoRA's (points)",
            2,
            signed=True,
            of=_second_accuracy,
            against=ISOLATED,
        ),
    ]
    first_change_points: Annotated[
        Mean,
        Metric(
            "First task afterwards (points)",
            2,
            signed=True,
            of=_first_change_points,
        ),
    ]
    worst_change_points: Annotated[
        float | None,
        Metric(
            "First task afterwards, worst run (points)",
            2,
            signed=True,
            of=_first_change_points,
            summary=lowest,
        ),
    ]
    # Tables of earlier versions do not have it.
    reuse: Annotated[Mean, Metric("Mass shared %", 1, percent=True)] = None


@dataclass(frozen=True)
class StreamResult:
    """One variant, over streams and seeds.

    Differences (`_gain_points`) and ratios are between runs of the same stream and seed. A learner
    that learns nothing has one run per stream, since all its seeds are equal, and no interval.
    Differences to it are taken for each seed.

    Attributes:
        diverged: diverged runs, including pairs; no mean counts them, and the variant fails the
            bar.
        told, inferred: accuracies with the task told, and inferred from the image.
        parameters: numbers stored at the end beside the bare encoder, of which
            `inference_parameters` are used to infer the task.
        trained_phase1, trained, trained_mean: parameters that learn, mean over tasks: in phase 1
            (None without one), in the last or only phase, and over all steps.
        reuse: routing mass on experts of earlier tasks.
        last_gain_points, average_gain_points, parameters_ratio: against the variant isolated-lora.
        half_gain_points: of Last against the variant isolated-lora-half, if there is one.
        transfer_gain_points, inferred_transfer_gain_points: against the variant zero-shot.
        bar: None for isolated-lora and zero-shot.
    """

    variant: str
    method: str
    knob: str | None
    value: Any
    diverged: list[str]
    told: Accuracies
    inferred: Accuracies
    parameters: Annotated[Mean, Metric("Final parameters")]
    inference_parameters: Annotated[Mean, Metric("To tell tasks")]
    trained_phase1: Annotated[Mean, Metric("In phase 1")]
    trained: Annotated[Mean, Metric("In phase 2, or the only one")]
    trained_mean: Annotated[Mean, Metric("Mean of steps")]
    reuse: Annotated[Mean, Metric("Mass on history %", 1, percent=True)]
    minutes: Annotated[Mean, Metric("Minutes", 2)]
    last_gain_points: Annotated[Mean, _gain("Last - isolated LoRA's", "last", ISOLATED, 2)]
    average_gain_points: Annotated[Mean, _gain("Average - isolated LoRA's", "average", ISOLATED, 2)]
    parameters_ratio: Annotated[
        Mean,
        Contrast(
            "x isolated LoRA's", 2, of=attrgetter("parameters"), against=ISOLATED, compare=ratio
        ),
    ]
    half_gain_points: Annotated[Mean, _gain("Last - half rank's", "last", HALF, 2)]
    transfer_gain_points: Annotated[
        Mean, _gain("Transfer - zero-shot's, told", "transfer", ZERO_SHOT, 2)
    ]
    inferred_transfer_gain_points: Annotated[
        Mean, _gain("Transfer - zero-shot's, inferred", "inferred_transfer", ZERO_SHOT, 2)
    ]
    pair_a: PairResult | None
    pair_b: PairResult | None
    bar: Bar | None

    @property
    def forgetting_points(self) -> float | None:
        """Forgetting with the task told, in points; it is never negative."""
        return None if self.told.forgetting is None else 100 * self.told.forgetting.mean


# A learner is preferred to a LoRA per task if it is as accurate (at most half a point below),
# smaller, and loses nothing, each judged by the worse end of its interval. The second task of each
# pair must be as accurate too, since a learner that learns nothing loses nothing. Forgetting and
# the loss on pair B must be 0 in every run. Transfer is also judged with inferred tasks: with the
# task told, most learners use the bare encoder for tasks that have not come yet, and could lose
# nothing.
_NOT_LESS = at_least(-0.5, "points")
_NOTHING_LOST = Limit("0 points", lambda lost: lost == 0)
_NO_LOSS = Limit(">= 0 points in every run", lambda points: points >= 0)
STREAM_BAR = (
    Demand("Last - isolated LoRA's", "last_gain_points", _NOT_LESS),
    Demand("Average - isolated LoRA's", "average_gain_points", _NOT_LESS),
    Demand("final parameters", "parameters_ratio", at_most(0.5, "x isolated LoRA's")),
    Demand("forgetting, task told", "forgetting_points", _NOTHING_LOST, sure_if_frozen=True),
    Demand("pair A adds", "pair_a.added", at_most(0.1, "x a fresh task's")),
    Demand("pair A, second - isolated LoRA's", "pair_a.second_gain_points", _NOT_LESS),
    Demand("pair B, second - isolated LoRA's", "pair_b.second_gain_points", _NOT_LESS),
    Demand("pair B, first task", "pair_b.worst_change_points", _NO_LOSS, sure_if_frozen=True),
    Demand("Transfer - zero-shot's, told", "transfer_gain_points", _NOT_LESS, sure_if_frozen=True),
    Demand("Transfer - zero-shot's, inferred", "inferred_transfer_gain_points", _NOT_LESS),
)


@dataclass(frozen=True)
class StreamStudyReport:
    """A study of streams so far, also written to `table.json`.

    `finished` of `cells` runs are measured.
    """

    name: str
    finished: int
    cells: int
    streams: list[str]
    seeds: list[int]
    pairs: Pairs | None
    results: list[StreamResult]
    tuning_stream: str | None
    within: float | None
    tuning: list[StreamPoint]
    out: str

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def stream_results(
    found: Mapping[str, Mapping[Setting, Outcome]],
    variants: Mapping[str, Variant],
    values: Mapping[str, Any],
    pairs: Pairs | None,
    unseeded: Collection[str],
    frozen: Collection[str],
) -> list[StreamResult]:
    """One result per variant.

    Args:
        found: variant -> stream and seed -> the run's result, including the pairs.
        values: variant -> the value of its knob.
        unseeded: methods whose seeds are all the same run, since they learn nothing.
        frozen: methods that never change the weights that serve learned tasks or future tasks.
    """
    paired = dataclasses.astuple(pairs) if pairs else ()  # the names of streams a and b
    samples = {stream: _samples(found, variants, (stream,), unseeded) for stream in paired}
    # The pairs are judged separately, and means over streams do not count them.
    streams = {stream for own in found.values() for stream, _ in own} - {*paired}
    main = _samples(found, variants, streams, unseeded)
    results = []
    for name, own in found.items():
        variant = variants[name]
        both = []
        for stream in paired:
            measured_pair = measure(PairResult, samples[stream][name], samples[stream])
            both.append(PairResult(**measured_pair))
        diverged = [f"{s} {seed}" for (s, seed), row in own.items() if not measured(row)]
        # `bar` follows below, since it is computed from the figures of the whole result.
        made = StreamResult(
            variant=name,
            method=variant.method,
            knob=variant.knob,
            value=values.get(name),
            diverged=sorted(diverged),
            told=Accuracies(**measure(Accuracies, main[name], main)),
            inferred=Accuracies(**measure(Accuracies, main[name], main, "inferred_")),
            **measure(StreamResult, main[name], main),
            pair_a=both[0] if both else None,
            pair_b=both[1] if both else None,
            bar=None,
        )
        if name not in (ISOLATED, ZERO_SHOT):
            made = dataclasses.replace(made, bar=bar(STREAM_BAR, made, variant.method in frozen))
        results.append(made)
    return results


def _samples(
    found: Mapping[str, Mapping[Setting, Outcome]],
    variants: Mapping[str, Variant],
    streams: Collection[str],
    unseeded: Collection[str],
) -> dict[str, Sample]:
    """The cells of the given streams, by variant."""
    samples = {}
    for name, own in found.items():
        figures = {run: row for run, row in own.items() if run[0] in streams and measured(row)}
        samples[name] = Sample(figures, variants[name].method not in unseeded)
    return samples


# --- robot streams --------------------------------------------------------------------------------


def _right_after_learning(figures: RobotStreamFigures) -> float:
    # The last entry of a row belongs to the task that has just been learned.
    return statistics.fmean(row[-1] for row in figures.success)


def _vqa_at_the_end(figures: RobotStreamFigures) -> float:
    return figures.vqa[-1]


def _forgotten_points(figures: RobotStreamFigures) -> float | None:
    return None if figures.forgetting is None else 100 * figures.forgetting


def _lost_at_the_end(figures: RobotStreamFigures) -> float:
    return 100 * (figures.vqa[0] - figures.vqa[-1])


def _knows_the_same(figures: RobotStreamFigures) -> bool:
    """Whether the backbone is unchanged: any change would show in the digits of cross-entropy."""
    return len({*figures.cross_entropy}) == 1


def _is_frozen(figures: RobotStreamFigures) -> bool:
    """Whether the weights that serve a learned task never change."""
    from aegis_cli.continual import learners  # loads torch, which tables do not need

    return learners.get(figures.method).frozen


def _reached(header: str, of: Callable[[RobotStreamFigures], float] | None = None) -> Metric:
    """A share of successes or correct answers, at which seeds may be equal by chance."""
    return Metric(header, 1, percent=True, of=of, units=_no_units, more_is_better=True)


@dataclass(frozen=True)
class AfterTask:
    """A variant after one more task of the stream: means over seeds.

    Attributes:
        task: the task that has just been learned.
        success: a share in [0, 1] for each task so far, this one included.
        drop_points: VQA accuracy lost since before the first task, in percentage points.
    """

    task: str
    success: list[Mean]
    drop_points: Mean


@dataclass(frozen=True)
class RobotStreamResult:
    """One variant on a stream of robot tasks, over seeds.

    Attributes:
        diverged: the seeds whose training diverged, which no mean counts.
        last, average: success on all tasks after the last one, and over the whole triangular
            matrix.
        learned: success on each task right after it was learned, mean over tasks.
        forgetting: of success; None for a single task.
        accuracy, drop_points: VQA after the last task, and the accuracy lost since before the
            first task.
        parameters: numbers stored at the end beside the bare backbone.
        trained_mean: parameters that learn, mean over steps and tasks.
        reuse: routing mass on experts of earlier tasks.
        last_gain_points, parameters_ratio: against the variant isolated-lora of the same seed.
        after: the matrix of success with VQA, one entry per task.
    """

    variant: str
    method: str
    knob: str | None
    value: Any
    diverged: list[int]
    last: Annotated[Mean, _reached("Success at the end %")]
    learned: Annotated[Mean, _reached("Right after learning %", _right_after_learning)]
    average: Annotated[Mean, _reached("Average %")]
    forgetting: Annotated[
        Mean,
        Metric(
            "Forgetting (points)",
            1,
            of=_forgotten_points,
            units=_no_units,
            sure=_is_frozen,
            more_is_better=False,
        ),
    ]
    accuracy: Annotated[Mean, _reached("VQA %", _vqa_at_the_end)]
    drop_points: Annotated[
        Mean,
        Metric(
            "VQA lost (points)",
            2,
            of=_lost_at_the_end,
            units=_no_units,
            sure=_knows_the_same,
            more_is_better=False,
        ),
    ]
    parameters: Annotated[Mean, Metric("Final parameters")]
    parameters_ratio: Annotated[
        Mean,
        Contrast(
            "x isolated LoRA's", 2, of=attrgetter("parameters"), against=ISOLATED, compare=ratio
        ),
    ]
    trained_mean: Annotated[Mean, Metric("Trained, mean of steps")]
    reuse: Annotated[Mean, Metric("Mass on history %", 1, percent=True)]
    minutes: Annotated[Mean, Metric("Minutes", 1)]
    last_gain_points: Annotated[
        Mean, _gain("At the end - isolated LoRA's (points)", "last", ISOLATED, 1, _no_units)
    ]
    after: list[AfterTask]


@dataclass(frozen=True)
class RobotStreamStudyReport:
    """A study of a stream of robot tasks so far, also written to `table.json`.

    `finished` of `cells` runs are measured.
    """

    name: str
    finished: int
    cells: int
    tasks: list[str]
    seeds: list[int]
    results: list[RobotStreamResult]
    within: float | None
    tuning: list[RobotStreamPoint]
    out: str

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def robot_stream_results(
    found: Mapping[str, Mapping[Setting, Outcome]],
    variants: Mapping[str, Variant],
    values: Mapping[str, Any],
    tasks: Sequence[str],
) -> list[RobotStreamResult]:
    """One result per variant.

    Args:
        found: variant -> place and seed -> the run's result.
        values: variant -> the value of its knob.
        tasks: the stream's tasks in their order.
    """
    samples = {}
    for name, own in found.items():
        samples[name] = Sample({run: row for run, row in own.items() if measured(row)})
    results = []
    for name, own in found.items():
        diverged = [seed for (_, seed), row in own.items() if not measured(row)]
        made = RobotStreamResult(
            variant=name,
            method=variants[name].method,
            knob=variants[name].knob,
            value=values.get(name),
            diverged=sorted(diverged),
            **measure(RobotStreamResult, samples[name], samples),
            after=_task_by_task(samples[name], tasks),
        )
        results.append(made)
    return results


def _task_by_task(sample: Sample, tasks: Sequence[str]) -> list[AfterTask]:
    """The variant's means after each task."""
    cells = sample.figures.items()
    rows = []
    still = all(_knows_the_same(figures) for _, figures in cells)
    for t, task in enumerate(tasks):
        success = []
        for i in range(t + 1):  # the matrix is triangular: later tasks have not come yet
            acted = over_seeds({run: figures.success[t][i] for run, figures in cells})
            success.append(acted and unless_alike(acted, sure=False))
        # `vqa` starts before the first task, so its entry after task t is at t + 1.
        lost = over_seeds({r: 100 * (found.vqa[0] - found.vqa[t + 1]) for r, found in cells})
        rows.append(AfterTask(task, success, lost and unless_alike(lost, still)))
    return rows


Report = StudyReport | StreamStudyReport | RobotStreamStudyReport
