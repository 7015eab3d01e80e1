"""What lmms-eval and lm-evaluation-harness record for each question.

With `--log_samples --output_path FOLDER` they write one line of JSON per question.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Tally
from aegis_cli.evaluation.question_log import (
    Evaluation,
    Harness,
    QuestionLog,
    Tasks,
    newest,
)

# How the two harnesses name their files.
_SAMPLES = (
    re.compile(r"(?P<date>\d{8}_\d{6})_samples_(?P<task>.+)\.jsonl"),
    re.compile(r"samples_(?P<task>.+)_(?P<date>\d{4}-\d\d-\d\dT[\d.:-]+)\.jsonl"),
)
_RESULTS = ("{date}_results.json", "results_{date}.json")
# Keys of a line that are not metrics.
_NO_METRIC = frozenset(
    "doc_id doc target arguments input input_media resps filtered_resps filter metrics "
    "token_counts doc_hash prompt_hash target_hash".split()
)
# If a metric is an object, the keys that may say how the question was answered.
_NOTED = ("score", "is_correct", "correct")
WRITTEN = "what lmms-eval or lm-evaluation-harness writes with --log_samples --output_path FOLDER"


def holds(place: Path) -> bool:
    """Whether a folder has a file of samples, or a file is named like one."""
    return any(_named(path) is not None for path in _files(place))


def _files(place: Path) -> list[Path]:
    return [place] if place.is_file() else sorted(place.rglob("*.jsonl"))


def find(place: Path, on_event: OnEvent) -> Tasks:
    """Each task's newest file of samples."""
    found: dict[str, list[Evaluation]] = {}
    for path in _files(place):
        if (named := _named(path)) is not None:
            task, date = named
            evaluation = Evaluation(date, path.parent, path.name, {"": path})
            found.setdefault(task, []).append(evaluation)
    return newest(place, found, on_event)


def _named(path: Path) -> tuple[str, str] | None:
    """The task and the date in the name of a file of samples."""
    for shape in _SAMPLES:
        if (match := shape.fullmatch(path.name)) is not None:
            return match["task"], match["date"]
    return None


def read(task: str, paths: Mapping[str, Path], tally: Tally) -> QuestionLog:
    """Read a task's lines, which are in one file.

    Raises:
        AegisError: no line, a line that is not a question's, or one question twice.
    """
    (path,) = paths.values()
    log = QuestionLog(path, falling=_falling(path))
    with files.reading(path, "check the path"), open(path, "rb") as file:
        for number, line in enumerate(file, start=1):
            if line.strip():
                _add(log, number, line)
            tally.advance(len(line))
    if not log.asked:
        fix = "evaluate again: the harness wrote an empty file"
        raise AegisError(f"no question in '{path}'", WRITTEN, fix)
    _check_lines(log)
    return log


def _check_lines(log: QuestionLog) -> None:
    """Raise AegisError unless all questions have equally many lines, one per filter of the task."""
    if len(set(log.lines.values())) > 1:
        (most, count), (least, fewer) = log.lines.most_common()[0], log.lines.most_common()[-1]
        raise AegisError(
            f"question {most} on {count} lines of '{log.path}', and question {least} on {fewer}",
            "one line for each question, or one for each of the task's filters",
            "evaluate again, once",
        )


def _add(log: QuestionLog, number: int, line: bytes) -> None:
    where = f"line {number} of '{log.path}'"
    try:
        row = files.parse_json(line)
    except ValueError as error:
        raise AegisError(f"{where}: not JSON ({error})", WRITTEN, "evaluate again") from error
    if not isinstance(row, dict) or "doc_id" not in row:
        raise AegisError(f"{where}: no question's doc_id", WRITTEN, "evaluate again")
    question = str(row["doc_id"])
    if "filter" not in row:
        log.lines[question] += 1
    # lm-evaluation-harness records a digest of the prompt instead of its text.
    prompt = row.get("input", row.get("prompt_hash"))
    log.asked[question] = (prompt, row.get("target"))
    for name, value in _metrics(row, log.lines[question]):
        if question in log.values[name]:
            found = f"{where}: question {question} a second time"
            raise AegisError(found, "one line for each question", "evaluate again, once")
        log.values[name][question] = value


def _metrics(row: Mapping[str, Any], line: int) -> Iterator[tuple[str, float | None]]:
    """The names of a line's metrics, including the answer's filter, and their values.

    Args:
        line: which of the question's lines it is, from 1. lmms-eval names no filters, and writes
            one line per filter in the order in which the task lists them.
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
    """A metric's value for one question, or the value recorded by a task that aggregates itself."""
    if isinstance(value, dict):
        value = next((value[name] for name in _NOTED if name in value), None)
    # An integer too large for a float cannot be a share. NaN fails every comparison.
    if not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
        return None
    return float(value)


def _falling(path: Path) -> frozenset[str]:
    """The metrics of a task for which lower is better, according to the results file beside it."""
    named = _named(path)
    assert named is not None  # no other file is read
    task, date = named
    for shape in _RESULTS:
        beside = path.with_name(shape.format(date=date))
        if beside.is_file():
            found = files.load_json(beside)
            # {"higher_is_better": {TASK: {METRIC: true}}}, if it is there at all.
            for key in ("higher_is_better", task):
                found = found.get(key) if isinstance(found, dict) else None
            rising = found if isinstance(found, dict) else {}
            return frozenset(name for name, is_so in rising.items() if is_so is False)
    return frozenset()


HARNESS = Harness("lmms-eval or lm-evaluation-harness", holds, find, read)
