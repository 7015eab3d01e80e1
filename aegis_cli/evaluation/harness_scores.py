"""`aegis scores`: what two models scored on the same benchmarks, question by question.

lmms-eval and lm-evaluation-harness write a line of JSON for every question where they are given
`--log_samples --output_path FOLDER`. Two such folders, of a model before and after fine-tuning,
have the same questions. So their difference is one of pairs, which is known far more closely than
two averages apart.
"""

from __future__ import annotations

import dataclasses
import re
import sys
import textwrap
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress, Warned, ignore
from aegis_cli.data.vqa.gate import MEAN, passes
from aegis_cli.data.vqa.metrics import mean_loss_interval
from aegis_cli.evaluation import probe

# How the two harnesses name their files.
_SAMPLES = (
    re.compile(r"(?P<date>\d{8}_\d{6})_samples_(?P<task>.+)\.jsonl"),
    re.compile(r"samples_(?P<task>.+)_(?P<date>\d{4}-\d\d-\d\dT[\d.:-]+)\.jsonl"),
)
_RESULTS = ("{date}_results.json", "results_{date}.json")
# Keys of a line that are no metric.
_NO_METRIC = frozenset(
    "doc_id doc target arguments input input_media resps filtered_resps filter metrics "
    "token_counts doc_hash prompt_hash target_hash".split()
)
# Where a metric is an object, its key that says how the question was answered.
_NOTED = ("score", "is_correct", "correct")
_TOLD_BYTES = 1_000_000  # between two tellings of how much is read
_WRITTEN = "what lmms-eval or lm-evaluation-harness writes with --log_samples --output_path FOLDER"


@dataclass(frozen=True)
class ScoreDrop:
    """One metric of one benchmark.

    Attributes:
        task, metric: as the harness names them.
        questions: that have the metric, in both models' files.
        before, after: means over these questions, in [0, 1].
        drop_points: before less after, percentage points; drop_interval: its 95 % interval.
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
    """What was lost on every benchmark that both models were asked.

    Attributes:
        before, after: where the scores were read.
        scores: one for each metric of each task, in the tasks' alphabetical order.
        left_out: tasks of which nothing was compared: only one of the two was asked, or none of
            their metrics is a share for each question.
        max_drop: points; None without a gate. gate: what of a drop it limits.
        passed: whether every score passes; None without a gate.
    """

    before: str
    after: str
    scores: list[ScoreDrop]
    left_out: list[str]
    max_drop: float | None
    gate: str
    passed: bool | None

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


@dataclass
class _Log:
    """One task's lines.

    Attributes:
        asked: by the question's number, what was asked, and the reference answer.
        values: by metric and question, the number that the harness gave; None where it is none.
        lines: by the question's number, how many lines without a filter's name it has.
        falling: metrics of which less is better.
    """

    path: Path
    asked: dict[str, tuple[Any, Any]] = field(default_factory=dict)
    lines: Counter[str] = field(default_factory=Counter)
    values: dict[str, dict[str, float | None]] = field(default_factory=lambda: defaultdict(dict))
    falling: frozenset[str] = frozenset()


def run(
    before: Path,
    after: Path,
    max_drop: float | None = None,
    gate: str = MEAN,
    on_event: OnEvent = ignore,
) -> ScoresReport:
    """Compare the scores of two models on the same questions.

    Args:
        before, after: folders that the harness wrote, or single files of samples. Of several
            evaluations of a task in one folder the newest counts, and a warning says so.
        max_drop: points that no score may drop by.
        gate: what of a drop it limits: MEAN, the drop as measured, or UPPER, the upper end of its
            interval.

    Raises:
        AegisError: no samples, no task or score in common, or questions that differ; under a gate
            also a task of which only the first model has samples.
    """
    if before.exists() and after.exists() and before.samefile(after):
        found = f"'{before}' before and after"
        raise AegisError(found, "the scores of two models", "give the other one's folder")
    first, second = _tasks(before, on_event), _tasks(after, on_event)
    lone = sorted(first.keys() ^ second.keys())
    if max_drop is not None:
        _refuse_unjudged(first.keys() - second.keys(), before, after)
    _warn_of_lone(lone, before, after, on_event)
    scores: list[ScoreDrop] = []
    tasks = sorted(first.keys() & second.keys())
    reading = _Reading([path for task in tasks for path in (first[task], second[task])], on_event)
    for task in tasks:
        logs = _read(first[task], reading), _read(second[task], reading)
        metrics = _comparable(task, logs, on_event)
        if not metrics:
            lone.append(task)
            _warn_of_nothing(task, max_drop, on_event)
        scores += [_drop(task, metric, logs, max_drop, gate, on_event) for metric in metrics]
    if not scores:
        raise AegisError(
            f"no score of one question in common between '{before}' and '{after}'",
            f"{_WRITTEN}, of the same tasks",
            "ask both models the same --tasks",
        )
    passed = None if max_drop is None else all(score.passed for score in scores)
    return ScoresReport(str(before), str(after), scores, sorted(lone), max_drop, gate, passed)


def _tasks(place: Path, on_event: OnEvent) -> dict[str, Path]:
    """Each task's newest file of samples."""
    if not place.exists():
        raise AegisError(f"no '{place}'", f"a folder with {_WRITTEN}", "check the path")
    found: dict[str, list[tuple[str, Path]]] = {}
    for path in [place] if place.is_file() else sorted(place.rglob("*.jsonl")):
        if (named := _named(path)) is not None:
            task, date = named
            found.setdefault(task, []).append((date, path))
    if not found and place.is_file():
        raise AegisError(
            f"'{place}', whose name is none that a harness gives to samples",
            "e.g. 20260131_120000_samples_TASK.jsonl, or samples_TASK_2026-01-31T12-00-00.jsonl",
            "give it the name again that it was written under: it tells the task",
        )
    if not found:
        raise _no_samples(place)
    newest = {task: max(own) for task, own in found.items()}  # dates that sort as texts do
    for task, own in found.items():
        if len({path.parent for _, path in own}) > 1:
            folders = sorted({str(path.parent) for _, path in own})
            raise AegisError(
                f"scores of {task} in {len(folders)} folders below '{place}'",
                "those of one model",
                f"give one of them, such as '{folders[0]}'",
            )
        if len(own) > 1:
            text = f"{len(own)} evaluations of {task} in '{place}': the newest is read"
            on_event(Warned("scores", f"{text}, '{newest[task][1].name}'"))
    return {task: path for task, (_, path) in newest.items()}


def _no_samples(folder: Path) -> AegisError:
    fix = "evaluate again with --log_samples, and give the folder of --output_path"
    found = f"no file of samples in '{folder}'"
    # VLMEvalKit keeps what each question got in tables, and not for every benchmark.
    if next(folder.rglob("*.xlsx"), None) is not None:
        found += ", but tables as VLMEvalKit writes them, which are not read"
        fix = "ask both models the same benchmarks by lmms-eval with --log_samples --output_path"
    return AegisError(found, _WRITTEN, fix)


def _named(path: Path) -> tuple[str, str] | None:
    """The task and the date that a file of samples is named after."""
    for shape in _SAMPLES:
        if (match := shape.fullmatch(path.name)) is not None:
            return match["task"], match["date"]
    return None


def _refuse_unjudged(tasks: Set[str], before: Path, after: Path) -> None:
    """A gate would pass by an evaluation that had ended before it came to these tasks."""
    if tasks:
        names = ", ".join(sorted(tasks))
        raise AegisError(
            f"no samples in '{after}' of {names}, of which '{before}' has some",
            "samples of every task of both models, where --max-drop is to judge",
            "ask the second model the same --tasks, or take these files out of the first folder",
        )


def _warn_of_lone(tasks: Sequence[str], before: Path, after: Path, on_event: OnEvent) -> None:
    if tasks:
        names = ", ".join(tasks)
        on_event(Warned("scores", f"not in both '{before}' and '{after}', and left out: {names}"))


def _warn_of_nothing(task: str, max_drop: float | None, on_event: OnEvent) -> None:
    judged = "" if max_drop is None else ", and --max-drop does not judge it"
    on_event(Warned("scores", f"{task}: nothing of it is compared{judged}"))


class _Reading:
    """Tells how much of all files is read; those of a benchmark may have gigabytes."""

    def __init__(self, paths: Sequence[Path], on_event: OnEvent) -> None:
        self._total = sum(path.stat().st_size for path in paths)
        self._done, self._told, self._on_event = 0, 0, on_event

    def read(self, size: int) -> None:
        """So many bytes more."""
        self._done += size
        if self._done - self._told >= _TOLD_BYTES or self._done == self._total:
            self._told = self._done
            self._on_event(Progress("scores", self._done, self._total, "bytes"))


def _read(path: Path, reading: _Reading) -> _Log:
    """A task's lines.

    Raises:
        AegisError: no line, a line that is no question's, or one question twice.
    """
    log = _Log(path, falling=_falling(path))
    with files.reading(path, "check the path"), open(path, "rb") as file:
        for number, line in enumerate(file, start=1):
            if line.strip():
                _add(log, number, line)
            reading.read(len(line))
    if not log.asked:
        fix = "evaluate again: the harness has written the file and no line of it"
        raise AegisError(f"no question in '{path}'", _WRITTEN, fix)
    _check_lines(log)
    return log


def _check_lines(log: _Log) -> None:
    """Raise AegisError unless each question has as many lines, one for each filter of the task."""
    if len(set(log.lines.values())) > 1:
        (most, count), (least, fewer) = log.lines.most_common()[0], log.lines.most_common()[-1]
        raise AegisError(
            f"question {most} on {count} lines of '{log.path}', and question {least} on {fewer}",
            "one line for each question, or one for each of the task's filters",
            "evaluate again, once",
        )


def _add(log: _Log, number: int, line: bytes) -> None:
    where = f"line {number} of '{log.path}'"
    try:
        row = files.parse_json(line)
    except ValueError as error:
        raise AegisError(f"{where}: not JSON ({error})", _WRITTEN, "evaluate again") from error
    if not isinstance(row, dict) or "doc_id" not in row:
        raise AegisError(f"{where}: no question's doc_id", _WRITTEN, "evaluate again")
    question = str(row["doc_id"])
    if "filter" not in row:
        log.lines[question] += 1
    # lm-evaluation-harness has no text of the prompt, but its digest.
    prompt = row.get("input", row.get("prompt_hash"))
    log.asked[question] = (prompt, row.get("target"))
    for name, value in _metrics(row, log.lines[question]):
        if question in log.values[name]:
            found = f"{where}: question {question} a second time"
            raise AegisError(found, "one line for each question", "evaluate again, once")
        log.values[name][question] = value


def _metrics(row: Mapping[str, Any], line: int) -> Iterator[tuple[str, float | None]]:
    """The names of a line's metrics, with the filter that an answer went through, and values.

    Args:
        line: which of the question's lines it is, from 1. lmms-eval names no filter, and writes a
            line for each in the order that the task lists them in.
    """
    named = row.get("metrics")
    names = named if isinstance(named, list) else [key for key in row if key not in _NO_METRIC]
    chosen = row.get("filter")
    if "filter" not in row and line > 1:
        chosen = f"filter {line}"
    suffix = "" if chosen in (None, "none") else f", {chosen}"
    for name in names:
        yield f"{name}{suffix}", _number(row.get(str(name)))


def _number(value: Any) -> float | None:
    """A metric's value for one question, or what a task that sums up by itself has noted of it."""
    if isinstance(value, dict):
        value = next((value[name] for name in _NOTED if name in value), None)
    # A whole number may be too large for a float, and is no share then. NaN fails every comparison.
    if not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
        return None
    return float(value)


def _falling(path: Path) -> frozenset[str]:
    """The metrics of a task of which less is better, as the file of results beside it says."""
    named = _named(path)
    assert named is not None  # no other file is read
    task, date = named
    for shape in _RESULTS:
        beside = path.with_name(shape.format(date=date))
        if beside.is_file():
            found = files.load_json(beside)
            # {"higher_is_better": {TASK: {METRIC: true}}}, where it says so at all.
            for key in ("higher_is_better", task):
                found = found.get(key) if isinstance(found, dict) else None
            rising = found if isinstance(found, dict) else {}
            return frozenset(name for name, is_so in rising.items() if is_so is False)
    return frozenset()


def _comparable(task: str, logs: tuple[_Log, _Log], on_event: OnEvent) -> list[str]:
    """The metrics that both files have and that are a share for every question.

    Others cannot be averaged, or have no points that a gate could limit; a warning says why each of
    them is left out. Several that are equal for every question are one, and go by the first's name.
    """
    before, after = logs
    shares: list[str] = []
    for metric in [name for name in before.values if name in after.values]:
        why = _unfit(metric, logs)
        if why is not None:
            on_event(Warned("scores", f"{task}: {metric} is left out: {why}"))
        elif not any(_are_one(metric, other, logs) for other in shares):
            shares.append(metric)
    return shares


def _are_one(metric: str, other: str, logs: tuple[_Log, _Log]) -> bool:
    """Whether two metrics are equal for every question, before and after."""
    return all(log.values[metric] == log.values[other] for log in logs)


def _unfit(metric: str, logs: tuple[_Log, _Log]) -> str | None:
    """Why a metric is no share in [0, 1] of which more is better; None if it is one."""
    values = [value for log in logs for value in log.values[metric].values()]
    numbers = [value for value in values if value is not None]
    if len(numbers) < len(values):
        return "not one number a question"
    if any(metric.split(",")[0] in log.falling for log in logs):
        return "less of it is better"
    if min(numbers) < 0 or max(numbers) > 1:
        return f"from {min(numbers):g} to {max(numbers):g}, which are no shares"
    return None


def _drop(
    task: str,
    metric: str,
    logs: tuple[_Log, _Log],
    max_drop: float | None,
    gate: str,
    on_event: OnEvent,
) -> ScoreDrop:
    """What was lost of one metric."""
    _check_same(task, metric, logs)
    before, after = (log.values[metric] for log in logs)
    values = np.array([[before[question], after[question]] for question in before])  # [N, 2]
    # Pairs: what a question's own difficulty adds is in both and goes out of the difference.
    losses = values[:, 0] - values[:, 1]
    low, high = mean_loss_interval(losses, range(len(losses)))
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


def _check_same(task: str, metric: str, logs: tuple[_Log, _Log]) -> None:
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
