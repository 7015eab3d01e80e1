"""`aegis merge`: move a fine-tuned backbone back towards the pre-trained one.

It gives up what the robot task does not need; the action expert is unchanged.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aegis_cli.common import circumstances, files, kept_lines, locks
from aegis_cli.common.errors import check_finite
from aegis_cli.common.events import OnEvent, Progress, Warned, ignore
from aegis_cli.common.kept_lines import KeptLines
from aegis_cli.common.ranks import ALONE
from aegis_cli.data.vqa import sets
from aegis_cli.data.vqa.gate import MEAN, passes
from aegis_cli.evaluation import kept_answers, probe
from aegis_cli.merging import rules, sources
from aegis_cli.merging.displacement import Displacement
from aegis_cli.merging.settings import GRIDS, MergeSettings, check_strength


@dataclass(frozen=True)
class MergePoint:
    """One strength, judged on validation data.

    Attributes:
        kept: the maps' mean kept share of the displacement, in [0, 1].
        accuracy: on validation questions, in [0, 1]; the drop from the pre-trained model's is in
            percentage points, with its 95 % interval over images.
        validation_loss: the policy's on held-out episodes; None without a policy.
        task_accuracy: on validation questions of the task; None if the task has none.
    """

    strength: float
    kept: float
    accuracy: float
    drop_points: float
    drop_interval: tuple[float, float]
    validation_loss: float | None = None
    task_accuracy: float | None = None


@dataclass(frozen=True)
class MergeReport:
    """What was merged, and how.

    Attributes:
        strength: strength of the merge that was written; None if nothing was.
        kept: the mean kept share of its maps' displacement.
        validation_loss: the merged policy's on held-out episodes; None if it was not evaluated.
        baseline_accuracy: the pre-trained model's on the validation questions; None without a
            sweep, when `questions` is 0 and `points` is empty.
        points: the sweep, weakest first, starting with 0, the fine-tuned model.
        passed: whether some strength stays within `max_drop`; None without that limit.
        gate: what that limit applies to, MEAN or UPPER; None without it.
        vqa, ask: the questions of a sweep and their prompt; None without one.
    """

    method: str
    damping: float
    target: str
    base: str
    strength: float | None
    kept: float | None
    max_drop: float | None
    passed: bool | None
    out: str | None
    questions: int
    baseline_accuracy: float | None
    points: tuple[MergePoint, ...] = ()
    validation_loss: float | None = None
    gate: str | None = None
    vqa: str | None = None
    ask: str | None = None

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def run(
    target: str,
    settings: MergeSettings,
    out: Path | None,
    strength: float | None = None,
    sweep: Sequence[float] = (),
    max_drop: float | None = None,
    on_event: OnEvent = ignore,
    judged: bool = False,
    gate: str = MEAN,
) -> MergeReport:
    """Write the merge of one strength, or try several.

    Args:
        target: the folder of a run, a checkpoint or a model.
        out: the folder to write, with the same layout as the target; None: nothing is written.
        strength: the strength to write; None: the strengths of `sweep` are tried.
        sweep: empty: the method's own grid.
        max_drop: a sweep writes the weakest merge that loses at most this many percentage points of
            accuracy on validation questions.
        judged: whether a single strength is evaluated on the task's validation data, like a sweep.
        gate: what `max_drop` limits, MEAN or UPPER.

    Raises:
        AegisError: nothing that can be merged, a method that cannot merge it, or another process
            that is writing to `out`.
        Diverged: weights or a loss that are not finite.
    """
    if out is not None:
        sources.check_out(out)
    with contextlib.nullcontext() if out is None else locks.alone(out):
        return _merge(target, settings, out, strength, sweep, max_drop, on_event, judged, gate)


def _merge(
    target: str,
    settings: MergeSettings,
    out: Path | None,
    strength: float | None,
    sweep: Sequence[float],
    max_drop: float | None,
    on_event: OnEvent,
    judged: bool,
    gate: str,
) -> MergeReport:
    strengths = (strength,) if strength is not None else tuple(sweep) or GRIDS[settings.method]
    for each in strengths:  # a bad one is refused before any model is loaded
        check_strength(settings.method, each)
    source = sources.find(target, settings, on_event)
    sources.check_moved(source)
    probe.check_preparation(
        target, source.base_name, source.backbone, source.base, max_drop, "merge", on_event
    )
    # Before any weight is changed, since the task's factors belong to the fine-tuned weights.
    keep = rules.keep(source, settings, on_event)
    displacement = Displacement(source.backbone, source.base, keep)
    tried, chosen = _Sweep(), strength
    if strength is None:
        tried = _try(displacement, source, settings, strengths, max_drop, on_event)
        chosen = _chosen(tried, target, max_drop, gate, on_event)
    kept = loss = None
    if chosen is not None and out is not None:
        kept = displacement.keep(chosen)  # a sweep leaves the weights of its last strength
        loss = tried.loss_at(chosen)
        if judged:
            loss = _performance(source, chosen).get("validation_loss")
        source.write(out, _made(source, settings, chosen, kept, loss))
    return MergeReport(
        method=settings.method,
        damping=settings.damping,
        target=target,
        base=source.base_name,
        strength=None if kept is None else chosen,
        kept=kept,
        max_drop=max_drop,
        passed=None if max_drop is None else chosen is not None,
        out=None if kept is None else str(out),
        questions=tried.questions,
        baseline_accuracy=tried.baseline_accuracy,
        points=tried.points,
        validation_loss=loss,
        gate=None if max_drop is None else gate,
        vqa=settings.vqa if tried.points else None,
        ask=settings.ask if tried.points else None,
    )


@dataclass(frozen=True)
class _Sweep:
    """The strengths that were tried, as in `MergeReport`; empty if a single one was given."""

    points: tuple[MergePoint, ...] = ()
    baseline_accuracy: float | None = None
    questions: int = 0

    def loss_at(self, strength: float) -> float | None:
        """The policy's loss at one of the strengths; None for another one, or without a policy."""
        return {point.strength: point.validation_loss for point in self.points}.get(strength)


def _made(
    source: sources.Source,
    settings: MergeSettings,
    strength: float,
    kept: float,
    loss: float | None,
) -> dict[str, Any]:
    """What the files of the merged weights say about how they were made."""
    return {
        "method": settings.method,
        "strength": strength,
        "damping": settings.damping,
        "base": source.base_name,
        "kept": kept,
        "validation_loss": loss,
        **_measured_on(source, settings),
    }


def _performance(source: sources.Source, strength: float) -> dict[str, float]:
    """How well the task is done with the backbone's current weights.

    Raises:
        Diverged: a figure that is not finite.
    """
    found = source.performance()
    check_finite(found, f"at strength {strength:g}", "leave that strength out", 0)
    return found


def _measured_on(source: sources.Source, settings: MergeSettings) -> dict[str, Any]:
    """What the method measured the task and the questions on, so that a merge can be repeated."""
    if settings.method == "linear":
        return {}
    found: dict[str, Any] = {}
    if settings.method != "kfac-shrink" and isinstance(source, sources.PolicyRun):
        found["frames"] = settings.frames
    if settings.anchor is not None:
        return found | {"anchor": files.sha256_file(settings.anchor)}
    for name in ("vqa", "ask", "samples", "temperature"):
        found[name] = getattr(settings, name)
    if settings.skip_bad:
        found["skip_bad"] = True
    return found


class _Judge:
    """Asks the merged model validation questions, and evaluates its task on validation data.

    Answers and figures are saved by the weights that gave them, so an interrupted sweep can resume.
    """

    def __init__(self, source: sources.Source, settings: MergeSettings, on_event: OnEvent) -> None:
        self._source, self._size = source, settings.batch_size
        checks = [source.base.check_text, source.backbone.check_text]
        read = sets.read(settings.vqa, settings.skip_bad, on_event, settings.ask)
        self._asked = read.choose(
            "validation", settings.questions, probe.PROBE_SEED, checks, on_event
        )
        base = kept_answers.of_now(source.base)
        self._before = kept_answers.ask(base, self._asked, self._size, ALONE, on_event)
        self._figures = KeptLines("merges", circumstances.of_answers(), on_event)
        lines = filter(None, map(kept_lines.unsealed, self._figures.read()))
        self._known = {line["judged_by"]: line["figures"] for line in lines}

    @property
    def questions(self) -> int:
        return len(self._asked.questions)

    @property
    def baseline(self) -> probe.ProbeReport:
        """What the pre-trained model answers."""
        return probe.compare(self._before, None, [], None)

    def point(self, strength: float, kept: float) -> MergePoint:
        """Evaluate the backbone's current weights."""
        merged = kept_answers.of_now(self._source.backbone)
        after = kept_answers.ask(merged, self._asked, self._size, ALONE, ignore)
        report = probe.compare(after, self._before, [], None)
        performance = self._performance(strength)
        assert report.drop_points is not None and report.drop_interval is not None
        return MergePoint(
            strength, kept, report.accuracy, report.drop_points, report.drop_interval, **performance
        )

    def _performance(self, strength: float) -> dict[str, float]:
        """How well the task is done, from saved figures or measured now."""
        by = files.sha256_value(self._source.judged_by())
        if by not in self._known:
            self._known[by] = _performance(self._source, strength)
            line = {"judged_by": by, "figures": self._known[by]}
            self._figures.add([kept_lines.sealed(line)])
        return self._known[by]


def _try(
    displacement: Displacement,
    source: sources.Source,
    settings: MergeSettings,
    strengths: Sequence[float],
    max_drop: float | None,
    on_event: OnEvent,
) -> _Sweep:
    """Judge the fine-tuned model, then each of the strengths, the weakest first."""
    judge = _Judge(source, settings, on_event)
    if max_drop is not None:
        probe.warn_of_little_knowledge(
            judge.baseline, source.base_name, settings.ask, "merge", on_event
        )
    rising = sorted({0.0, *strengths})  # 0 is the fine-tuned model itself
    points: list[MergePoint] = []
    on_event(Progress("merge", 0, len(rising), "strengths"))
    for number, strength in enumerate(rising, 1):
        points.append(judge.point(strength, displacement.keep(strength)))
        shown = {"accuracy": points[-1].accuracy}
        on_event(Progress("merge", number, len(rising), "strengths", shown))
    return _Sweep(tuple(points), judge.baseline.accuracy, judge.questions)


def _chosen(
    tried: _Sweep, target: str, max_drop: float | None, gate: str, on_event: OnEvent
) -> float | None:
    """The strength of a sweep to write, if any; warns if the figures decide little."""
    chosen = _weakest(tried.points, max_drop, gate)
    # The one that passes, or else the strongest, which comes closest to passing.
    judged_by = tried.points[-1]
    for point in tried.points:
        if point.strength == chosen:
            judged_by = point
    probe.warn_of_few_questions(
        tried.questions, judged_by.drop_interval, max_drop, "merge", on_event
    )
    if chosen == 0:
        said = f"'{target}' itself loses no more than {max_drop:g} points: nothing is moved"
        on_event(Warned("merge", said))
    return chosen


def _weakest(points: Sequence[MergePoint], max_drop: float | None, gate: str) -> float | None:
    """The smallest strength that passes: it changes the policy least while keeping the answers."""
    if max_drop is None:
        return None
    passing = []
    for point in points:
        if passes(point.drop_points, point.drop_interval, max_drop, gate):
            passing.append(point.strength)
    return min(passing, default=None)
