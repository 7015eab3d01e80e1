"""What a study found: its figures, declared once for each kind of study, and who passes the bar.

Figures are means over seeds with 95 % intervals. A seed's figure is its mean over tasks or streams,
which the recipe names and which are not draws of anything: an interval says nothing of other tasks,
or other orders of a stream. Of other questions and episodes it speaks where the cells have kept
what they were measured on.
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
        machine: what they were measured on, since they hold there; so does `code`, the version and
            digest of the package. None in what an earlier version kept.
    """

    step_time: float
    peak_memory: float
    machine: str | None = None
    code: str | None = None


@dataclass(frozen=True)
class Findings:
    """What a study knows so far.

    Attributes:
        points: the values of knobs that have been tried.
        chosen: variant -> the value that it is compared with.
        cells: variant -> task or stream and seed -> what the cell led to, in the recipe's order.
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
    """Whether a cell led to figures."""
    return not isinstance(found, Divergence)


def _no_units(figures: Figures) -> None:
    """What the figures are means of is not kept, so that there is one interval: Student's t.

    A figure that has it is known to be one at which seeds may come out alike by chance.
    """


# --- policies -------------------------------------------------------------------------------------


def _lost_by_image(figures: PolicyFigures) -> Units | None:
    """The accuracy that a training cost, in points, with an image's questions as a unit."""
    # Cells that an earlier version measured have kept neither.
    if figures.lost_per_image is None or figures.questions_per_image is None:
        return None
    import numpy as np

    lost = np.array(figures.lost_per_image, np.float64)
    questions = np.array(figures.questions_per_image, np.float64)
    sure = _stands_still(figures)
    return Units(100 * lost, questions, figures.probe_seed, sure=sure, names=figures.images)


def _stands_still(figures: PolicyFigures) -> bool:
    """Whether the backbone has not moved: else no answer is as sure as before to the last digit."""
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
    """The open-loop error less that which needs no policy: of holding, or of the mean action."""
    if figures.open_loop_error is None:
        return None
    return figures.open_loop_error - _without_policy(figures)


def _over_still_by_episode(figures: PolicyFigures) -> Units | None:
    found = _evaluated(figures, figures.error_per_episode)
    if found is None:
        return None
    if figures.hold_error != _without_policy(figures):  # the mean action's, 1 in any episode
        return dataclasses.replace(found, values=found.values - found.counts)
    held = _evaluated(figures, figures.hold_per_episode)
    return None if held is None else found.minus(held)


def _without_policy(figures: PolicyFigures) -> float:
    """The lesser error of holding the position and of always the mean action, which has 1."""
    return 1.0 if figures.hold_error is None else min(1.0, figures.hold_error)


def _evaluated(figures: PolicyFigures, errors: Sequence[float] | None) -> Units | None:
    """Errors in held-out episodes; another seed may have held out some of the same ones."""
    names, weights = figures.evaluated_episodes, figures.weight_per_episode
    if errors is None or names is None or weights is None:  # an earlier version measured the cell
        return None
    import numpy as np

    counts = np.array(weights, np.float64)
    return Units(counts * np.array(errors, np.float64), counts, reach=None, names=names)


def _episodes(outcomes: str | None, seed: int, whole: float = 100.0) -> Units | None:
    """Successes, one unit per episode, from one character per episode.

    Args:
        whole: what a success counts: 100 points, or a share of 1.
    """
    if outcomes is None:  # nothing was played, or an earlier version played it
        return None
    import numpy as np

    successes = np.array([whole * int(one) for one in outcomes])
    return Units(successes, np.ones(len(outcomes)), seed, whole)


@dataclass(frozen=True)
class PolicyResult:
    """One variant on one task.

    Shares are in [0, 1], `_points` in percentage points, cross-entropy in nats. On a task measured
    by its return, `return_share` (1: the highest there is) takes the place of successes and
    `return_gain_points` of their gains. Where nothing can be rolled out there is an
    `open_loop_error` instead, of which 1 is that of always the mean action, and
    `open_loop_difference` is how much more it is than naive's.

    Attributes:
        hold_error: the error of a robot that holds its position, where actions are positions.
        open_loop_over_still: the error less that which needs no policy: the lesser of `hold_error`
            and 1.
        diverged: the seeds whose training did, which no mean counts and which cost the bar.
        step_time: ratio to naive's training step, or to that of `against`; so is `peak_memory`.
        bar: None for naive and for methods that train on VQA data.
        against: the variant that gains and the difference of the drops are to; None for naive.
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
        """VQA questions in training: a method that is trained on some has no bar."""
        return 0.0


# A method that trains on no VQA data is one to prefer to naive if it surely keeps VQA, learns as
# well, generalises better, and costs no more: each by the worse end of its interval. A task that is
# measured by its return has no colours to generalise to, and so no verdict but by a demand that
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
    """The bar where nothing can be rolled out, so that no success is known.

    The open-loop error may surely be no more than `most` above naive's. A naive that has learned
    nothing would be matched by anything, so that the error has to be below what needs no policy,
    too. It tells nothing of other colours.
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

    The baseline is the backbone before training, a mean over the sets of questions that the seeds
    were asked; it is unknown as long as every training diverged.

    Attributes:
        vqa: the set of questions, where a study asks several; each has a table and a bar.
        compared: how many cells are compared with another variant's of the same seed.
        across_versions: how many of these another version of the code has measured.
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
    """What a variant costs over the one that it is held against."""
    own = costs.get(name)
    if own is None or against is None:
        return own
    reference = costs.get(against)
    if reference is None:
        return None
    # Both are over naive, which goes out of their ratio.
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
        found: variant -> seed -> what its training led to; at least one seed per variant.
        values: variant -> what its knob is set to.
        costs: variant -> ratios to naive; empty where there is no naive.
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
        # Contrasts are declared against naive, whose place a variant may give to another: its
        # `against`. Naive itself is compared with nobody.
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
    """Whether an open-loop error is all that is known of how policies act."""
    acted = any(row.success_seen is not None or row.return_share is not None for row in rows)
    return not acted and any(row.open_loop_error is not None for row in rows)


def _pairs(sample: Sample, reference: Sample) -> list[tuple[PolicyFigures, PolicyFigures]]:
    """Cells of the same task and seed."""
    # A cell that diverged is in no sample, and its setting then in no pair.
    settings = sample.figures.keys() & reference.figures.keys()
    return [(sample.figures[setting], reference.figures[setting]) for setting in settings]


def _each_probed(samples: Iterable[Sample]) -> list[PolicyFigures]:
    """One cell of each set of questions that was asked, since seeds may have sets of their own."""
    asked: dict[int, PolicyFigures] = {}
    for sample in samples:
        for row in sample.figures.values():
            # Any will do, because all methods begin with the same backbone.
            asked.setdefault(row.probe_seed, row)
    return list(asked.values())


def _mean(values: Sequence[float]) -> float | None:
    return statistics.fmean(values) if values else None


# --- streams --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Accuracies:
    """Means of shares in [0, 1]; None where a stream has one task."""

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
    """What the second of two tasks did.

    Attributes:
        added: numbers stored for it, as a share of what the first task added, which had nothing to
            share.
        new_experts: the same for experts alone, without routers, scales and what tells the task;
            None without experts.
        reuse: routing mass of the second task on experts of the first.
        second_gain_points: the second task's accuracy, told, against the variant isolated-lora's in
            the same setting.
        first_change_points: change of the first task's accuracy, told, after it;
            `worst_change_points` in the worst run.
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
    # Tables of before it was reported have none.
    reuse: Annotated[Mean, Metric("Mass shared %", 1, percent=True)] = None


@dataclass(frozen=True)
class StreamResult:
    """One variant, over streams and seeds.

    Differences (`_gain_points`) and ratios are between runs of the same stream and seed. A learner
    that learns nothing has one run per stream, since its seeds are the same, and no interval;
    differences to it are of each seed.

    Attributes:
        diverged: runs, pairs too, which no mean counts and which cost a variant the bar.
        told, inferred: accuracies with the task told, and inferred from the image.
        parameters: numbers stored at the end beside the bare encoder, of which
            `inference_parameters` tell the task.
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
        """Forgetting with the task told, which is never under 0, in points."""
        return None if self.told.forgetting is None else 100 * self.told.forgetting.mean


# A learner is one to prefer to a LoRA per task if it is as accurate, smaller, and loses nothing:
# each by the end of the interval, and as accurate is less than half a point below.
# The second task of each pair has to be as accurate too, since a learner that learns nothing loses
# nothing. Forgetting and the loss on pair B are 0 only where they are in every run. Transfer is
# asked for inferred tasks too: with the task told, one that has not come is the bare encoder's work
# for most learners, and nothing could be lost.
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
        found: variant -> stream and seed -> what that run led to, those of the pairs too.
        values: variant -> what its knob is set to.
        unseeded: methods whose seeds are all the same run, since they learn nothing.
        frozen: methods that never change what serves a learned task, nor one that has not come.
    """
    paired = dataclasses.astuple(pairs) if pairs else ()  # the names of streams a and b
    samples = {stream: _samples(found, variants, (stream,), unseeded) for stream in paired}
    # The pairs answer questions of their own, and no mean over streams counts them.
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
        # Without `bar` at first: it is judged by the figures of the whole result.
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
    """The cells of some streams, by variant."""
    samples = {}
    for name, own in found.items():
        figures = {run: row for run, row in own.items() if run[0] in streams and measured(row)}
        samples[name] = Sample(figures, variants[name].method not in unseeded)
    return samples


# --- robot streams --------------------------------------------------------------------------------


def _right_after_learning(figures: RobotStreamFigures) -> float:
    # The last entry of a row is the task that has just been learned.
    return statistics.fmean(row[-1] for row in figures.success)


def _vqa_at_the_end(figures: RobotStreamFigures) -> float:
    return figures.vqa[-1]


def _forgotten_points(figures: RobotStreamFigures) -> float | None:
    return None if figures.forgetting is None else 100 * figures.forgetting


def _lost_at_the_end(figures: RobotStreamFigures) -> float:
    return 100 * (figures.vqa[0] - figures.vqa[-1])


def _knows_the_same(figures: RobotStreamFigures) -> bool:
    """Whether the backbone has not moved: else no answer is as sure as before to the last digit."""
    return len({*figures.cross_entropy}) == 1


def _is_frozen(figures: RobotStreamFigures) -> bool:
    """Whether nothing changes what serves a learned task."""
    from aegis_cli.continual import learners  # loads torch, which tables do without

    return learners.get(figures.method).frozen


def _reached(header: str, of: Callable[[RobotStreamFigures], float] | None = None) -> Metric:
    """A share of successes, or of correct answers, at which seeds may come out alike by chance."""
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
        diverged: the seeds whose training did, which no mean counts.
        last, average: success on all tasks after the last one, and over the whole triangle.
        learned: success on each task right after it was learned, mean over tasks.
        forgetting: of success; None for a single task.
        accuracy, drop_points: VQA after the last task, and what of it was lost since before the
            first.
        parameters: numbers stored at the end beside the bare backbone.
        trained_mean: parameters that learn, mean over steps and tasks.
        reuse: routing mass on experts of earlier tasks.
        last_gain_points, parameters_ratio: against the variant isolated-lora of the same seed.
        after: the matrix of success, and VQA beside it, task by task.
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
        found: variant -> place and seed -> what that run led to.
        values: variant -> what its knob is set to.
        tasks: of the stream, in their order.
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
        for i in range(t + 1):  # the matrix is a triangle: later tasks have not come yet
            acted = over_seeds({run: figures.success[t][i] for run, figures in cells})
            success.append(acted and unless_alike(acted, sure=False))
        # `vqa` begins before the first task, so that after task t it is at t + 1.
        lost = over_seeds({r: 100 * (found.vqa[0] - found.vqa[t + 1]) for r, found in cells})
        rows.append(AfterTask(task, success, lost and unless_alike(lost, still)))
    return rows


Report = StudyReport | StreamStudyReport | RobotStreamStudyReport
