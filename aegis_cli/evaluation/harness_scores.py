"""`aegis scores`: what two models scored on the same benchmarks, question by question.

lmms-eval, lm-evaluation-harness and VLMEvalKit record a model's score for each question. A model
before and after fine-tuning is asked the same questions, so the differences are paired, which gives
a far narrower interval than two separate averages.
"""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aegis_cli.common.errors import AegisError, few
from aegis_cli.common.events import OnEvent, Warned, ignore
from aegis_cli.data.vqa.gate import MEAN, passes
from aegis_cli.data.vqa.metrics import mean_loss_interval
from aegis_cli.evaluation import harness_samples, probe, vlmevalkit_tables
from aegis_cli.evaluation.question_log import Harness, QuestionLog, Tasks, tally_of

_HARNESSES = (harness_samples.HARNESS, vlmevalkit_tables.HARNESS)
_WRITTEN = f"{harness_samples.WRITTEN}, or {vlmevalkit_tables.WRITTEN}"
_NOT_NOTED = "no per-question scores were written"


@dataclass(frozen=True)
class ScoreDrop:
    """One metric of one benchmark.

    Attributes:
        task, metric: as the harness names them.
        questions: number of questions that have the metric, in both models' files.
        before, after: means over these questions, in [0, 1].
        drop_points: before minus after, percentage points; drop_interval: its 95 % interval.
        passed: whether the gate lets the drop pass; None without a gate.
    """

    task: str
    metric: str
    questions: int
    before: float
    after: float
    drop_points: float
    drop_interval: tuple[float, float]
    passed: bool | None


@dataclass(frozen=True)
class ScoresReport:
    """What was lost on every benchmark on which both models were evaluated.

    Attributes:
        before, after: where the scores were read.
        scores: one for each metric of each task, in the tasks' alphabetical order.
        left_out: tasks for which nothing was compared.
        why_left_out: the reason by task: only one of the two models was evaluated on it, or none of
            its metrics is a share for each question.
        max_drop: points; None without a gate. gate: what of a drop it limits.
        passed: whether every score passes; None without a gate.
    """

    before: str
    after: str
    scores: list[ScoreDrop]
    left_out: list[str]
    why_left_out: dict[str, str]
    max_drop: float | None
    gate: str
    passed: bool | None

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def run(
    before: Path,
    after: Path,
    max_drop: float | None = None,
    gate: str = MEAN,
    on_event: OnEvent = ignore,
) -> ScoresReport:
    """Compare the scores of two models on the same questions.

    Args:
        before, after: folders that the harness wrote, or single files of samples or tables. If a
            folder has several evaluations of a task, the newest counts, and a warning says so.
        max_drop: the largest drop allowed for any score, in points.
        gate: what the limit applies to: MEAN, the drop as measured, or UPPER, the upper end of its
            interval.

    Raises:
        AegisError: no scores, scores of two harnesses, no task or score in common, or questions
            that differ; with a gate also a task for which only the first model has scores, or
            which was judged differently.
    """
    if before.exists() and after.exists() and before.samefile(after):
        found = f"'{before}' before and after"
        raise AegisError(found, "the scores of two models", "give the other one's folder")
    harness = _harness(before, after)
    first, second = harness.find(before, on_event), harness.find(after, on_event)
    why = _lone(first, second, before, after)
    if max_drop is not None:
        _refuse_unjudged(first, second, before, after)
    _warn_of_lone(why, max_drop, on_event)
    scores: list[ScoreDrop] = []
    tasks = sorted((first.keys() & second.keys()) - why.keys())
    both = [path for task in tasks for own in (first, second) for path in own[task].values()]
    tally = tally_of(both, on_event)
    for task in tasks:
        logs = (
            harness.read(task, first[task], tally),
            harness.read(task, second[task], tally),
        )
        _warn_of_doubts(task, logs, on_event)
        metrics, unfit = _comparable(task, logs, max_drop, on_event)
        if not metrics:
            why[task] = unfit
            _warn_of_nothing(task, unfit, max_drop, on_event)
        scores += [_drop(task, metric, logs, max_drop, gate, on_event) for metric in metrics]
    if not scores:
        raise _nothing_in_common(before, after, why)
    passed = None if max_drop is None else all(score.passed for score in scores)
    why = dict(sorted(why.items()))
    return ScoresReport(str(before), str(after), scores, list(why), why, max_drop, gate, passed)


def _harness(before: Path, after: Path) -> Harness:
    """The harness that evaluated both models.

    Raises:
        AegisError: no known harness, or two.
    """
    first, second = _harness_of(before), _harness_of(after)
    if first is not second:
        raise AegisError(
            f"output of {first.name} in '{before}', and of {second.name} in '{after}'",
            "the output of one harness for both models",
            "evaluate both models with the same one, since each asks and judges in its own way",
        )
    return first


def _harness_of(place: Path) -> Harness:
    if not place.exists():
        raise AegisError(f"no '{place}'", f"a folder with {_WRITTEN}", "check the path")
    held = [harness for harness in _HARNESSES if harness.holds(place)]
    if len(held) > 1:
        names = " and ".join(harness.name for harness in held)
        fix = "give a folder with the output of one of them"
        raise AegisError(f"output of {names} in '{place}'", "the output of one harness", fix)
    if not held:
        raise _nothing_known(place)
    return held[0]


def _nothing_known(place: Path) -> AegisError:
    if place.is_file():
        return AegisError(
            f"'{place}', which is not named as a harness names samples or tables",
            "e.g. 20260131_120000_samples_TASK.jsonl, samples_TASK_2026-01-31T12-00-00.jsonl, or "
            "MODEL_BENCHMARK_exact_matching_result.xlsx in a folder MODEL",
            "give it back the name that it was written under, which tells the task",
        )
    table = vlmevalkit_tables.unnamed(place)
    if table is not None:
        fix = "give the folder back the name that VLMEvalKit gave it, which is the model's"
        found = f"'{table}', whose name does not begin with that of its model's folder"
        return AegisError(found, vlmevalkit_tables.WRITTEN, fix)
    fix = "evaluate again, by lmms-eval with --log_samples, and give the folder of its output"
    return AegisError(f"no file of samples or verdicts in '{place}'", _WRITTEN, fix)


def _lone(first: Tasks, second: Tasks, before: Path, after: Path) -> dict[str, str]:
    """Tasks for which only one of the models has scores -> the reason."""
    why: dict[str, str] = {}
    for task in sorted(first.keys() | second.keys()):
        have = [place for own, place in ((first, before), (second, after)) if own.get(task)]
        if not have:
            why[task] = _NOT_NOTED
        elif len(have) == 1:
            why[task] = f"only '{have[0]}' has scores"
    return why


def _refuse_unjudged(first: Tasks, second: Tasks, before: Path, after: Path) -> None:
    """Raise AegisError for tasks that only the first model has scores for: a gate would pass."""
    tasks = sorted(task for task, own in first.items() if own and not second.get(task))
    if tasks:
        raise AegisError(
            f"no scores in '{after}' of {', '.join(tasks)}, which '{before}' has",
            "scores of both models for every task, so that --max-drop can judge them",
            "evaluate the second model on these tasks, or remove them from the first folder",
        )


def _warn_of_lone(why: Mapping[str, str], max_drop: float | None, on_event: OnEvent) -> None:
    for reason in sorted(set(why.values()) - {_NOT_NOTED}):
        names = ", ".join(task for task in why if why[task] == reason)
        on_event(Warned("scores", f"left out: {names}: {reason}"))
    for task in [task for task in why if why[task] == _NOT_NOTED]:
        _warn_of_nothing(task, _NOT_NOTED, max_drop, on_event)


def _warn_of_nothing(task: str, reason: str, max_drop: float | None, on_event: OnEvent) -> None:
    judged = "" if max_drop is None else ", and --max-drop does not judge it"
    on_event(Warned("scores", f"{task}: not compared{judged}: {reason}"))


def _warn_of_doubts(task: str, logs: tuple[QuestionLog, QuestionLog], on_event: OnEvent) -> None:
    for log in logs:
        for doubt, questions in log.doubts.items():
            text = f"{task}: of {len(log.asked)} questions {len(questions)} {doubt}"
            on_event(Warned("scores", f"{text}, in '{log.path}'"))


def _nothing_in_common(before: Path, after: Path, why: Mapping[str, str]) -> AegisError:
    reasons = few([f"{task}: {reason}" for task, reason in sorted(why.items())])
    return AegisError(
        f"no question with a score in both '{before}' and '{after}' ({reasons})",
        "the scores that one harness wrote for each question, of the same tasks",
        "evaluate both models on the same tasks, in the same way",
    )


def _comparable(
    task: str,
    logs: tuple[QuestionLog, QuestionLog],
    max_drop: float | None,
    on_event: OnEvent,
) -> tuple[list[str], str]:
    """The metrics that both files have and that are a share for every question.

    Other metrics cannot be averaged, or have no points that a gate could limit; a warning says why
    each is left out. Metrics that are equal for every question count once, under the first name.

    Returns:
        The metrics, and why the others are left out.

    Raises:
        AegisError: there is a gate, and no metric that both files have.
    """
    before, after = logs
    shared = [name for name in before.values if name in after.values]
    if not shared:
        return [], _judged_otherwise(task, logs, max_drop)
    for log in logs:
        for metric in [name for name in log.values if name not in shared]:
            on_event(Warned("scores", f"{task}: {metric} is left out: only '{log.path}' has it"))
    shares: list[str] = []
    unfit: list[str] = []
    for metric in shared:
        why = _unfit(metric, logs)
        if why is not None:
            unfit.append(f"{metric} is left out: {why}")
            on_event(Warned("scores", f"{task}: {unfit[-1]}"))
        elif not any(_are_one(metric, other, logs) for other in shares):
            shares.append(metric)
    return shares, "; ".join(unfit)


def _judged_otherwise(
    task: str, logs: tuple[QuestionLog, QuestionLog], max_drop: float | None
) -> str:
    """Why two files without a metric in common cannot be compared."""
    names = [" and ".join(f"'{name}'" for name in log.values) or "no metric" for log in logs]
    reason = f"{names[0]} before, {names[1]} after"
    if max_drop is not None:
        raise AegisError(
            f"{task}: {reason}, in '{logs[0].path}' and '{logs[1].path}'",
            "a metric of both models, so that --max-drop can judge it",
            "evaluate both with the same judge, version of the harness and settings",
        )
    return reason


def _are_one(metric: str, other: str, logs: tuple[QuestionLog, QuestionLog]) -> bool:
    """Whether two metrics are equal for every question, before and after."""
    return all(log.values[metric] == log.values[other] for log in logs)


def _unfit(metric: str, logs: tuple[QuestionLog, QuestionLog]) -> str | None:
    """Why a metric is not a share in [0, 1] for which higher is better; None if it is one."""
    values = [value for log in logs for value in log.values[metric].values()]
    numbers = [value for value in values if value is not None]
    if len(numbers) < len(values):
        return "not one number per question"
    if any(metric.split(",")[0] in log.falling for log in logs):
        return "less of it is better"
    if min(numbers) < 0 or max(numbers) > 1:
        return f"from {min(numbers):g} to {max(numbers):g}, which are not shares"
    return None


def _drop(
    task: str,
    metric: str,
    logs: tuple[QuestionLog, QuestionLog],
    max_drop: float | None,
    gate: str,
    on_event: OnEvent,
) -> ScoreDrop:
    """What was lost of one metric."""
    _check_same(task, metric, logs)
    before, after = (log.values[metric] for log in logs)
    # Sorted, so that the order of a file's rows does not change the sums.
    questions = sorted(before)
    values = np.array([[before[name], after[name]] for name in questions])  # [N, 2]
    # Paired: a question's own difficulty affects both scores and cancels in the difference.
    losses = values[:, 0] - values[:, 1]
    low, high = mean_loss_interval(losses, _clusters(questions, logs[0].alike))
    drop, interval = 100 * float(losses.mean()), (100 * low, 100 * high)
    passed = None
    if max_drop is not None:
        passed = passes(drop, interval, max_drop, gate)
        ask = "Ask more of the task's questions, without a limit"
        stage = f"scores of {task}"
        probe.warn_of_few_questions(len(losses), interval, max_drop, stage, on_event, ask)
    return ScoreDrop(
        task=task,
        metric=metric,
        questions=len(losses),
        before=float(values[:, 0].mean()),
        after=float(values[:, 1].mean()),
        drop_points=drop,
        drop_interval=interval,
        passed=passed,
    )


def _clusters(questions: Sequence[str], alike: Mapping[str, str]) -> list[int]:
    """A cluster number for each question; questions that are not independent share one."""
    numbers: dict[tuple[str, str], int] = {}
    # A question that shares nothing gets its own number, whatever names the others share.
    names = [("shared", alike[q]) if q in alike else ("own", q) for q in questions]
    return [numbers.setdefault(name, len(numbers)) for name in names]


def _check_same(task: str, metric: str, logs: tuple[QuestionLog, QuestionLog]) -> None:
    """Raise AegisError unless both models were asked the same questions in the same words."""
    before, after = logs
    counts = [len(log.values[metric]) for log in logs]
    apart = before.values[metric].keys() ^ after.values[metric].keys()
    if apart:
        found = f"{task}: {counts[0]} and {counts[1]} questions, {len(apart)} of them in one file"
        fix = "evaluate both with the same limit, or with none"
        raise AegisError(found, "the same questions in both", fix)
    for question in before.values[metric]:
        then, now = before.asked[question], after.asked[question]
        if then != now:
            raise AegisError(
                f"{task}: question {question} is {_short(then)} in '{before.path}' and "
                f"{_short(now)} in '{after.path}'",
                "the same questions and references, in the same words",
                "evaluate both with the same --model, version of the harness and settings",
            )


def _short(asked: Sequence[Any]) -> str:
    prompt, target = (textwrap.shorten(str(part), 60, placeholder=" ...") for part in asked)
    return f"'{prompt}' (reference '{target}')"
