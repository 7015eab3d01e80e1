"""What VLMEvalKit records for each question, in tables.

`run.py --work-dir FOLDER` writes the predictions for a benchmark to
`FOLDER/MODEL/T20260131-120000/MODEL_BENCHMARK.xlsx`. A judge copies that table, appends columns,
including the verdict on each prediction, and writes it beside the first one under a longer name:
`MODEL_MMStar_exact_matching_result.xlsx`. The folder of the model has links to the files of its
newest evaluation. With PRED_FORMAT the tables are .tsv or .json instead.
"""

from __future__ import annotations

import math
import re
import string
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aegis_cli.common import tables
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress, Tally, ignore
from aegis_cli.evaluation.question_log import (
    Evaluation,
    Harness,
    QuestionLog,
    Tasks,
    newest,
)

# The folder of one evaluation: T20260131-120000, or T20260131_G1a2b3c4d of older versions, where
# the second half is the commit.
_RUN = re.compile(r"T(?P<day>\d{8})(-(?P<time>\d{6})|_G\w+)")
# Names that VLMEvalKit's judges give to columns with a verdict on each prediction.
_VERDICTS = frozenset("hit score match correct is_correct verifier_match".split())
_MATCHES = "eval_match"  # how well a prediction matches each of the reference answers
# In ANLS, an answer with a larger distance scores 0.
_FARTHEST = 0.5
# Benchmarks whose questions are asked once for each order of their options. Each time 1e6 is added
# to the index, so its last digits stay the same; `g_index`, if present, groups them too.
_CIRCULAR = ("mmbench", "ccbench", "circular", "mmcr")
_DIGITS = 6
# Column -> what VLMEvalKit writes into it if a verdict says nothing about the model, and why.
_DOUBTS = {
    "prediction": ("Failed to obtain answer", "without an answer, because asking the model failed"),
    "log": ("thus randomly generate one", "judged by chance, because the judge had no answer"),
}
WRITTEN = "the tables that VLMEvalKit's run.py writes to MODEL/T20260131-120000/MODEL_BENCHMARK*"
_JUDGE = "judge the predictions: run.py with --mode eval --reuse"
_ROWS = "one row for each question, with an index of its own and a verdict"
_APART = "judge the benchmark again, or take this table out of the folder"


@dataclass(frozen=True)
class _Table:
    """A table of a model, with predictions or verdicts.

    Attributes:
        model: the model's folder.
        name: the part of its file's name after the model's name.
        is_judged: whether it has verdicts.
    """

    path: Path
    model: Path
    name: str
    is_judged: bool


def holds(place: Path) -> bool:
    """Whether there is a table that is named like VLMEvalKit's.

    Other programs write .csv and .json files with many names, so those must also have its columns.
    """
    return any(
        path.suffix in (".xlsx", ".tsv") or _has_predictions(tables.columns(path))
        for path in _files(place)
        if _name(path) is not None
    )


def unnamed(place: Path) -> Path | None:
    """A table that is not named after its model's folder, if there is one."""
    return next((path for path in _files(place) if path.suffix == ".xlsx"), None)


def _has_predictions(columns: Sequence[str]) -> bool:
    return "index" in columns and "prediction" in columns


def _files(place: Path) -> list[Path]:
    """The files that may be tables, each once even if there are links to it."""
    every = [place] if place.is_file() else place.rglob("*")
    found = {path.resolve() for path in every if path.suffix in tables.SUFFIXES and path.is_file()}
    return sorted(found)


def _model_folder(path: Path) -> Path:
    """The folder of a table's model."""
    return path.parent.parent if _RUN.fullmatch(path.parent.name) else path.parent


def _name(path: Path) -> str | None:
    """The part of a table's name after the model's name; None if it does not begin with that."""
    begin = f"{_model_folder(path).name}_"
    return path.stem.removeprefix(begin) if path.stem.startswith(begin) else None


def find(place: Path, on_event: OnEvent) -> Tasks:
    """The judged tables of each benchmark's newest evaluation.

    Raises:
        AegisError: no table is judged, a table cannot be read, or they belong to several models.
    """
    found = list(_tables(place, on_event))
    models = sorted({str(table.model) for table in found})
    if len(models) > 1:
        raise AegisError(
            f"tables of {len(models)} models below '{place}'",
            "the tables of one model",
            f"give one of them, such as '{models[0]}'",
        )
    if not any(table.is_judged for table in found):
        raise _nothing_judged(place, found)
    by_folder: dict[Path, list[_Table]] = defaultdict(list)
    for table in found:
        by_folder[table.path.parent].append(table)
    evaluations: dict[str, list[Evaluation]] = defaultdict(list)
    for folder, own in by_folder.items():
        for task, paths in _by_task(own, place).items():
            evaluation = Evaluation(_date(folder), own[0].model, folder.name, paths)
            evaluations[task].append(evaluation)
    return newest(place, evaluations, on_event)


def _tables(place: Path, on_event: OnEvent = ignore) -> Iterator[_Table]:
    """The tables of a folder that have a row for each question."""
    named = [(path, name) for path in _files(place) if (name := _name(path)) is not None]
    for number, (path, name) in enumerate(named, start=1):
        columns = tables.columns(path)
        # Opening a workbook takes seconds, since all its texts come before its first row.
        on_event(Progress("scores", number, len(named), "tables opened"))
        if _has_predictions(columns):
            yield _Table(path, _model_folder(path), name, bool(_verdicts(columns)))


def _nothing_judged(place: Path, found: Sequence[_Table]) -> AegisError:
    if place.is_file():
        return AegisError(
            f"'{place}' without a column of verdicts after those of 'index' and 'prediction'",
            f"one of {', '.join(sorted([*_VERDICTS, _MATCHES]))}",
            _JUDGE,
        )
    if found:
        names = ", ".join(sorted({table.name for table in found}))
        return AegisError(f"only predictions in '{place}', of {names}", "verdicts on them", _JUDGE)
    return AegisError(f"no table with a row for each question in '{place}'", WRITTEN, _JUDGE)


def _date(folder: Path) -> str:
    """A text by which evaluations can be sorted.

    In older versions the names of two evaluations on one day have no order; then the one written
    later is the newer one, as in VLMEvalKit itself.
    """
    if (match := _RUN.fullmatch(folder.name)) is None:
        return ""
    written = f"{folder.stat().st_mtime:020.6f}"
    return f"{match['day']} {match['time'] or ''} {written}"


def _by_task(own: Sequence[_Table], place: Path) -> dict[str, dict[str, Path]]:
    """The judged tables of one evaluation, by benchmark and by the rest of the name.

    A judged table belongs to the benchmark whose predictions it is named after: given `MMBench` and
    `MMBench_V11`, `MMBench_V11_openai_result` belongs to the latter. Without predictions beside it,
    its own name is the benchmark.
    """
    predicted = [table.name for table in _beside(own, place) if not table.is_judged]
    found: dict[str, dict[str, Path]] = {}
    for table in own:
        begins = [name for name in predicted if table.name.startswith(f"{name}_")]
        task = max(begins, key=len, default=table.name) if table.is_judged else table.name
        files_of_task = found.setdefault(task, {})
        if table.is_judged:
            # The same table may exist in several formats.
            files_of_task.setdefault(table.name.removeprefix(task).lstrip("_"), table.path)
    return found


def _beside(own: Sequence[_Table], place: Path) -> Sequence[_Table]:
    """All tables of an evaluation, even if the user gave only one."""
    folder = own[0].path.parent
    return [t for t in _tables(folder) if t.path.parent == folder] if place.is_file() else own


def _verdicts(columns: Sequence[str]) -> list[str]:
    """The columns with verdicts.

    A judge appends them. A column before the prediction is the benchmark's own, even if it is
    called a score.
    """
    judged = columns[columns.index("prediction") + 1 :]
    return [name for name in judged if name in _VERDICTS or name == _MATCHES]


def read(task: str, paths: Mapping[str, Path], tally: Tally) -> QuestionLog:
    """The verdicts on a benchmark's predictions, from all its judged tables.

    Raises:
        AegisError: a table cannot be read, a row has no index or no verdict, or an index repeats.
    """
    log = QuestionLog(next(iter(paths.values())))
    for judged, path in paths.items():
        _add(log, task, judged, path)
        tally.advance(path.stat().st_size)
    return log


def _add(log: QuestionLog, task: str, judged: str, path: Path) -> None:
    """Add a table's rows to a log."""
    indices: set[str] = set()
    for row in tables.rows(path):
        index = _text(row["index"])
        if index is None or index in indices:
            which = "a row without an index" if index is None else f"two rows of index {index}"
            raise AegisError(f"{which} in '{path}'", _ROWS, _APART)
        indices.add(index)
        asked = _asked(row)
        if log.asked.setdefault(index, asked) != asked:
            found = f"index {index} is one question in '{log.path}' and another in '{path}'"
            raise AegisError(found, f"tables of {task} alone", "take one of them out of the folder")
        if (shared := _shared(task, index, row)) is not None:
            log.alike[index] = shared
        for column, (text, doubt) in _DOUBTS.items():
            if text in str(row.get(column)):
                log.doubts[doubt].add(index)
        for column in _verdicts(list(row)):
            if _is_blank(row[column]):
                raise AegisError(f"index {index} of '{path}' has no {column}", _ROWS, _APART)
            metric = f"{column}, {judged}" if judged else column
            log.values[metric][index] = _verdict(task, column, row[column])
    if not indices:
        raise AegisError(f"no row in '{path}'", _ROWS, _APART)


def _asked(row: Mapping[str, Any]) -> tuple[Any, Any]:
    """The question with its options, and the reference answer, if the table has them."""
    options = {name: _text(cell) for name, cell in row.items() if name in string.ascii_uppercase}
    given = [f"{name}. {text}" for name, text in options.items() if text is not None]
    question = _text(row.get("question"))
    return "\n".join([question or "", *given]) or None, _text(row.get("answer"))


def _shared(task: str, index: str, row: Mapping[str, Any]) -> str | None:
    """What a question shares with others: its text in another order of options, or its image."""
    group = _text(row.get("g_index"))
    if group is None and index.isdecimal() and any(part in task.lower() for part in _CIRCULAR):
        group = index[-_DIGITS:].lstrip("0")
    image = _text(row.get("image_path"))
    return f"question {group}" if group is not None else image


def _is_blank(cell: Any) -> bool:
    """Whether a cell is empty, including pandas' missing values."""
    if isinstance(cell, float):
        return math.isnan(cell)
    return cell is None or (isinstance(cell, str) and cell.strip().lower() in ("", "nan"))


def _text(cell: Any) -> str | None:
    """A cell as text, whether its format stores a number or text; None if it is blank."""
    if _is_blank(cell):
        return None
    text = str(cell).strip()
    # In pandas, a column of integers with a blank becomes a column of floats.
    return text.removesuffix(".0") if re.fullmatch(r"-?\d+\.0", text) else text


def _verdict(task: str, column: str, cell: Any) -> float | None:
    """A verdict as a number; None if it is not one."""
    return _hit(task, cell) if column == _MATCHES else _number(cell)


def _hit(task: str, cell: Any) -> float | None:
    """The score of a prediction's matches with each reference answer, as VLMEvalKit computes it.

    This is `hit_calculate` of its `vqa_eval.py`. The column `eval_score` beside the matches is
    another figure: for DocVQA and InfoVQA it is a mean distance, for which lower is better.
    """
    parts = cell if isinstance(cell, list) else str(cell).strip().strip("[]").split(",")
    matches = [_number(part) for part in parts]
    numbers = [match for match in matches if match is not None]
    if not numbers or len(numbers) < len(matches):
        return None
    if any(name in task for name in ("DocVQA", "InfoVQA")):
        near = 1 - min(numbers)
        return near if near >= _FARTHEST else 0.0
    if any(name in task for name in ("ChartQA", "OCRVQA", "PlotQA")):
        return max(numbers)
    return sum(numbers) / len(numbers)


def _number(cell: Any) -> float | None:
    """A finite number, which may be written as text; a boolean is 1 or 0."""
    text = str(cell).strip()
    if text.lower() in ("true", "false"):
        return float(text.lower() == "true")
    try:
        number = float(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None


HARNESS = Harness("VLMEvalKit", holds, find, read)
