"""Tables in files: .xlsx, .csv, .tsv, and .json with a list of records, read row by row."""

from __future__ import annotations

import contextlib
import csv
import sys
import warnings
from collections.abc import Generator, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError, in_short

# Suffixes of files that hold a table.
SUFFIXES = (".xlsx", ".tsv", ".csv", ".json")
_FIX = "write it again, or take it out of the folder"


def columns(path: Path) -> list[str]:
    """The names of a table's columns, in order; empty for a file that is not a table.

    Raises:
        AegisError: it cannot be read, or is damaged.
    """
    with contextlib.closing(_lines(path)) as lines:
        return next(lines, [])


def rows(path: Path) -> Iterator[dict[str, Any]]:
    """A table's rows, with a cell for each column. Rows without any content are left out.

    Raises:
        AegisError: it cannot be read, or is damaged.
    """
    with contextlib.closing(_lines(path)) as lines:
        names = next(lines, [])
        for cells in lines:
            if any(cell not in (None, "") for cell in cells):
                yield dict(zip(names, cells, strict=True))


def _lines(path: Path) -> Generator[list[Any]]:
    """The names of the columns, then the cells of each row, as many as there are names."""
    reader = {".xlsx": _workbook, ".json": _records}.get(path.suffix, _text)
    with files.reading(path, "check the path"):
        lines = _checked(path, reader(path))
        names = ["" if name is None else str(name) for name in next(lines, ())]
        yield names
        for number, cells in enumerate(lines, start=2):
            if cells:
                yield _fitted(path, number, cells, len(names))


def _fitted(path: Path, number: int, cells: Sequence[Any], width: int) -> list[Any]:
    """The cells of a row, padded, because a workbook may leave out empty cells at its end."""
    missing = width - len(cells) if path.suffix == ".xlsx" else 0
    fitted = [*cells, *[None] * missing]
    if len(fitted) != width:
        found = f"row {number} of '{path}' has {len(fitted)} cells"
        raise AegisError(found, f"{width}, one for each column", _FIX)
    return fitted


def _checked(path: Path, lines: Iterator[Sequence[Any]]) -> Iterator[Sequence[Any]]:
    """The same lines, with exceptions from reading a damaged file turned into AegisError."""
    try:
        yield from lines
    except AegisError:
        raise
    except Exception as error:  # readers of archives and XML raise a dozen types
        if isinstance(error, OSError) and error.errno is not None:
            raise  # from the system; openpyxl raises OSErrors without errno for other files
        files.refuse_pointer(path)
        found = f"'{path}' is not a table, or is damaged: {in_short(error)}"
        raise AegisError(found, f"a whole {path.suffix} file", _FIX) from error


def _workbook(path: Path) -> Iterator[Sequence[Any]]:
    """The rows of a workbook's first sheet."""
    if find_spec("openpyxl") is None:
        raise AegisError(
            f"'{path}', and no package 'openpyxl'",
            "the package that reads .xlsx",
            "pip install 'aegis-vla[benchmarks]'",
        )
    import openpyxl

    with open(path, "rb") as file:
        with warnings.catch_warnings():  # about styles and the like, which do not affect cells
            warnings.simplefilter("ignore")
            book = openpyxl.load_workbook(file, read_only=True, data_only=True)
        with contextlib.closing(book):
            yield from book.worksheets[0].iter_rows(values_only=True)


def _text(path: Path) -> Iterator[Sequence[Any]]:
    """The rows of a text file with commas or tabs."""
    # An answer may be longer than the default limit of a field.
    limit = csv.field_size_limit(sys.maxsize)
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            yield from csv.reader(file, delimiter="\t" if path.suffix == ".tsv" else ",")
    finally:
        csv.field_size_limit(limit)


def _records(path: Path) -> Iterator[Sequence[Any]]:
    """The rows of a list of records; nothing for any other JSON, such as a summary."""
    records = files.load_json(path)
    if not isinstance(records, list) or not records:
        return
    if not all(isinstance(record, dict) for record in records):
        return
    names = list(records[0])
    yield names
    for record in records:
        yield [record.get(name) for name in names]
