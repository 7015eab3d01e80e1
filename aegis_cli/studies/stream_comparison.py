"""What a study of streams found: means over streams, with 95 % intervals over seeds, reuse on the
pairs, and the bar.

The streams are the orders that the recipe names, not draws of anything: a seed's figure is the mean
over them, and the interval is of the seeds' figures. So it says nothing of other orders, or of
other test images.
"""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from aegis_cli.continual import learners
from aegis_cli.evaluation.estimates import ROUNDING, Estimate, estimate
from aegis_cli.recipes import Pairs, StreamVariant
from aegis_cli.recipes.stream_study_cells import HALF, ISOLATED, ZERO_SHOT
from aegis_cli.studies.row import Divergence
from aegis_cli.studies.stream_row import StreamRow
from aegis_cli.studies.stream_tuning import StreamPoint
from aegis_cli.studies.verdict import Bar, Check, check, verdict

MOST_PARAMETERS = 0.5  # times the isolated LoRA's
MOST_ADDED = 0.1  # by the second task of pair A, times what its first task added
LEAST_TRANSFER = -0.5  # points, against zero-shot
Run = tuple[str, int]  # stream and seed
Found = Mapping[Run, StreamRow | Divergence]
Rows = Mapping[Run, StreamRow]


@dataclass(frozen=True)
class Accuracies:
    """Estimates of shares in [0, 1]; None where a stream has one task."""

    transfer: Estimate | None
    average: Estimate | None
    last: Estimate | None
    forgetting: Estimate | None


@dataclass(frozen=True)
class PairResult:
    """What the second of two tasks did, over seeds.

    Attributes:
        added: numbers stored for it, as a share of what the first task added, which had nothing to
            share.
        new_experts: the same of experts alone, without routers, scales and what tells the task;
            None without experts.
        second_gain_points: the second task's accuracy, told, against the variant isolated-lora's in
            the same run.
        first_change_points: of the first task's accuracy, told, after it; `worst_change_points` in
            the worst run.
    """

    added: Estimate | None
    new_experts: Estimate | None
    second_gain_points: Estimate | None
    first_change_points: Estimate | None
    worst_change_points: float | None


@dataclass(frozen=True)
class StreamResult:
    """One variant, over streams and seeds; differences (`_gain_points`) and ratios are of the same
    stream and seed.

    Of a learner that learns nothing a stream has one run, since its seeds are the same, and no
    interval; differences to it are of each seed.

    Attributes:
        diverged: runs, pairs too, which no estimate counts and which cost a variant the bar.
        told, inferred: with the task told, and inferred from the image.
        parameters: stored at the end beside the bare encoder, of which `inference_parameters` tell
            the task. trained_phase1, trained, trained_mean: parameters that learn, mean over tasks:
            in phase 1 (None without one), in
            the last or only phase, and over all steps.
        reuse: routing mass on experts of earlier tasks.
        last_gain_points, average_gain_points, parameters_ratio: against the variant isolated-lora.
        half_gain_points: of Last against the variant isolated-lora-half, if there is one.
        transfer_gain_points, inferred_transfer_gain_points: against the variant zero-shot.
        bar: None for these two.
    """

    variant: str
    method: str
    knob: str | None
    value: Any
    diverged: list[str]
    told: Accuracies
    inferred: Accuracies
    parameters: Estimate | None
    inference_parameters: Estimate | None
    trained_phase1: Estimate | None
    trained: Estimate | None
    trained_mean: Estimate | None
    reuse: Estimate | None
    minutes: Estimate | None
    last_gain_points: Estimate | None
    average_gain_points: Estimate | None
    parameters_ratio: Estimate | None
    half_gain_points: Estimate | None
    transfer_gain_points: Estimate | None
    inferred_transfer_gain_points: Estimate | None
    pair_a: PairResult | None
    pair_b: PairResult | None
    bar: Bar | None


@dataclass(frozen=True)
class StreamStudyReport:
    """A study so far, also written to `table.json`: `finished` of `cells` runs have
    been measured.
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


def results(
    found: Mapping[str, Found],
    variants: Mapping[str, StreamVariant],
    values: Mapping[str, Any],
    pairs: Pairs | None,
) -> list[StreamResult]:
    """The table's rows.

    Args:
        found: variant -> stream and seed -> what that run led to, those of the pairs too.
        values: variant -> what its knob is set to.
    """
    names = () if pairs is None else (pairs.a, pairs.b)
    main = {name: _rows(own, lambda stream: stream not in names) for name, own in found.items()}
    made = []
    for name, own in found.items():
        both = [
            _pair(_of(own, pair), _of(found.get(ISOLATED, {}), pair), variants[name].method)
            for pair in names
        ]
        diverged = sorted(
            f"{stream} {seed}" for (stream, seed), row in own.items() if isinstance(row, Divergence)
        )
        made.append(_result(name, variants[name], values.get(name), diverged, main, both))
    return made


def _of(found: Found, pair: str) -> Rows:
    return _rows(found, lambda stream: stream == pair)


def _rows(found: Found, wanted: Callable[[str], bool]) -> Rows:
    return {run: row for run, row in found.items() if isinstance(row, StreamRow) and wanted(run[0])}


def _distinct(rows: Rows, method: str) -> Rows:
    """Of a learner that learns nothing one run a stream: with other seeds it is the same run."""
    if learners.get(method).trains != "nothing":
        return rows
    first: dict[str, Run] = {}
    for run in rows:
        first.setdefault(run[0], run)
    return {run: rows[run] for run in first.values()}


def _result(
    name: str,
    variant: StreamVariant,
    value: Any,
    diverged: list[str],
    main: Mapping[str, Rows],
    pairs: Sequence[PairResult],
) -> StreamResult:
    rows, isolated, half, zero = (main.get(of, {}) for of in (name, ISOLATED, HALF, ZERO_SHOT))
    own = _distinct(rows, variant.method)
    plain = (
        "parameters",
        "inference_parameters",
        "trained_phase1",
        "trained",
        "trained_mean",
        "reuse",
        "minutes",
    )
    made = StreamResult(
        variant=name,
        method=variant.method,
        knob=variant.knob,
        value=value,
        diverged=diverged,
        told=_accuracies(own, ""),
        inferred=_accuracies(own, "inferred_"),
        **{
            field: _estimate({run: getattr(row, field) for run, row in own.items()})
            for field in plain
        },
        last_gain_points=_gain(rows, isolated, "last"),
        average_gain_points=_gain(rows, isolated, "average"),
        parameters_ratio=_paired(rows, isolated, "parameters", _share),
        half_gain_points=_gain(rows, half, "last"),
        transfer_gain_points=_gain(own, zero, "transfer"),
        inferred_transfer_gain_points=_gain(own, zero, "inferred_transfer"),
        pair_a=pairs[0] if pairs else None,
        pair_b=pairs[1] if pairs else None,
        bar=None,
    )
    return made if name in (ISOLATED, ZERO_SHOT) else dataclasses.replace(made, bar=bar(made))


def _accuracies(rows: Rows, prefix: str) -> Accuracies:
    names = [f.name for f in dataclasses.fields(Accuracies)]
    return Accuracies(
        **{
            name: _estimate({run: getattr(row, prefix + name) for run, row in rows.items()})
            for name in names
        }
    )


def _pair(rows: Rows, isolated: Rows, method: str) -> PairResult:
    own = _distinct(rows, method)
    return PairResult(
        _estimate({run: _share(row.added[1], row.added[0]) for run, row in own.items()}),
        _estimate(
            {run: _share(row.new_experts[1], row.new_experts[0]) for run, row in own.items()}
        ),
        _estimate(
            {
                run: 100 * (rows[run].own[1] - isolated[run].own[1])
                for run in rows
                if run in isolated
            }
        ),
        _estimate({run: 100 * row.first_change for run, row in own.items()}),
        min((100 * row.first_change for row in own.values()), default=None),
    )


def _estimate(values: Mapping[Run, float | None]) -> Estimate | None:
    """Of the means over each seed's streams that have a value; None where none has."""
    seeds: dict[int, list[float]] = {}
    for (_, seed), value in values.items():
        if value is not None:
            seeds.setdefault(seed, []).append(value)
    return estimate([statistics.fmean(own) for own in seeds.values()]) if seeds else None


def _share(part: float, whole: float) -> float | None:
    return part / whole if whole else None


def _gain(rows: Rows, others: Rows, field: str) -> Estimate | None:
    return _paired(rows, others, field, lambda a, b: 100 * (a - b))


def _paired(
    rows: Rows, others: Rows, field: str, compare: Callable[[float, float], float | None]
) -> Estimate | None:
    """Of runs of the same stream and seed."""
    pairs = {
        run: (getattr(rows[run], field), getattr(others[run], field))
        for run in rows
        if run in others
    }
    return _estimate(
        {run: None if a is None or b is None else compare(a, b) for run, (a, b) in pairs.items()}
    )


def bar(found: StreamResult) -> Bar:
    """Whether a learner is one to prefer to a LoRA a task.

    At least equal within the interval: the mean difference is not under 0, or its interval reaches
    0; so of the second task of each pair, which costs nothing where nothing is learned. The others
    are demands on means; forgetting and loss are 0 only where they are in every run. Transfer is
    asked for inferred tasks too: with the task told, one that has not come is the bare encoder's
    work for most learners, and nothing could be lost.
    """
    last, average, ratio = found.last_gain_points, found.average_gain_points, found.parameters_ratio
    told, inferred = found.transfer_gain_points, found.inferred_transfer_gain_points
    forgotten = (
        found.told.forgetting and 100 * found.told.forgetting.mean
    )  # points; none is under 0
    a, b = found.pair_a and found.pair_a.added, found.pair_b and found.pair_b.worst_change_points
    learned = [pair and pair.second_gain_points for pair in (found.pair_a, found.pair_b)]
    equal = ">= 0 points, or the interval reaches 0"
    share, least = f"<= {MOST_ADDED:g} x a fresh task's", f">= {LEAST_TRANSFER:g} points"
    checks = [
        check("Last - isolated LoRA's", equal, last, _equal(last)),
        check("Average - isolated LoRA's", equal, average, _equal(average)),
        check(
            "final parameters",
            f"<= {MOST_PARAMETERS:g} x isolated LoRA's",
            ratio,
            _most(ratio, MOST_PARAMETERS),
        ),
        Check(
            "forgetting, task told",
            "0 points",
            forgotten,
            None,
            None if forgotten is None else forgotten == 0,
        ),
        check("pair A adds", share, a, _most(a, MOST_ADDED)),
        *(
            check(f"pair {letter}, second - isolated LoRA's", equal, gain, _equal(gain))
            for letter, gain in zip("AB", learned, strict=True)
        ),
        Check(
            "pair B, first task", ">= 0 points in every run", b, None, None if b is None else b >= 0
        ),
        check(
            "Transfer - zero-shot's, told",
            least,
            told,
            told and told.mean >= LEAST_TRANSFER - ROUNDING,
        ),
        check(
            "Transfer - zero-shot's, inferred",
            least,
            inferred,
            inferred and inferred.mean >= LEAST_TRANSFER - ROUNDING,
        ),
    ]
    return verdict(checks, bool(found.diverged))


def _equal(difference: Estimate | None) -> bool | None:
    if difference is None:
        return None
    reaches = difference.interval is not None and difference.interval[1] >= 0
    return difference.mean >= -ROUNDING or reaches


def _most(found: Estimate | None, most: float) -> bool | None:
    return None if found is None else found.mean <= most + ROUNDING
