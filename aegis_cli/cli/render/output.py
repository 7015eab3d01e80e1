"""The two streams: reports on stdout, everything else on stderr."""

from __future__ import annotations

import codecs
import dataclasses
import io
import json
import math
import os
import re
import sys
import unicodedata
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TextIO

from rich.console import Console, RenderableType
from rich.text import Text

from aegis_cli.common.errors import AegisError

_WIDE = 200  # columns if nothing sets a width, so that piped tables never wrap
_UNLIMITED = 10_000
STDOUT = "standard output"
_STYLE = re.compile(r"\x1b\[[0-9;]*m")
_TRAILING_BLANKS = re.compile(r"(?:[ ]|\x1b\[[0-9;]*m)+$", re.MULTILINE)  # and changes of style
# Replacements for our characters in an output whose encoding does not have them.
_PLAIN = {"²": "^2", "±": "+-", "→": "->", "≥": ">=", "≤": "<=", "…": "...", "–": "-", "·": "-"}


def error(problem: AegisError) -> None:
    """One block on stderr: found, expected, fix."""
    to = console(sys.stderr)
    for label, style in (("found", "bold red"), ("expected", "bold"), ("fix", "bold green")):
        text = visible(getattr(problem, label))
        between = "" if text.startswith("\n") else " "  # several problems are a list below
        # Not wrapped, so that commands in it can be copied and grep finds lines.
        to.print(Text.assemble((f"{label}:", style), between, text), soft_wrap=True)


def note(text: str) -> None:
    """One line on stderr."""
    console(sys.stderr).print(Text(visible(text)), soft_wrap=True)


def show(
    report: Any, table: Callable[[Any], RenderableType], as_json: bool, wide: bool = False
) -> None:
    """The report on stdout, as a table or as one JSON document (NaN and infinity become null).

    Args:
        wide: write each row of a table on a single line, even on a narrow terminal.
    """
    if as_json:
        text(json.dumps(document(report), indent=2, allow_nan=False) + "\n")
    else:
        to = console(sys.stdout)
        if wide:
            to.width = _UNLIMITED
        # Not printed directly, because rich pads the last column of a table with blanks.
        with to.capture() as printed:
            to.print(table(_visible_in(report)))
        text(_without_trailing_blanks(printed.get()))


def _without_trailing_blanks(text: str) -> str:
    """The lines without trailing blanks; changes of style stay."""
    return _TRAILING_BLANKS.sub(lambda end: "".join(_STYLE.findall(end[0])), text)


def visible(text: str) -> str:
    """A text with control characters written out, except line ends and tabs.

    Otherwise a file's metadata could move the terminal's cursor or set its title. Undecodable bytes
    of a file name, which Python represents as lone surrogates, are written out too, because they
    cannot be encoded in UTF-8.
    """
    return "".join(_escaped(char) if _is_unwritable(char) else char for char in text)


def _is_unwritable(char: str) -> bool:
    return char not in "\n\t" and unicodedata.category(char) in ("Cc", "Cs")


def _escaped(char: str) -> str:
    return char.encode("unicode_escape").decode()


def _visible_in(value: Any) -> Any:
    """A report with all its texts made `visible`."""
    # Unchanged values are returned without a copy, because a report may hold large arrays.
    if isinstance(value, str):
        shown = visible(value)
        return value if shown == value else shown
    if dataclasses.is_dataclass(value):
        changed = {}
        for field in dataclasses.fields(value):
            old = getattr(value, field.name) if field.init else None
            new = _visible_in(old)
            if new is not old:
                changed[field.name] = new
        return dataclasses.replace(value, **changed) if changed else value
    if isinstance(value, Mapping):
        items = {_visible_in(name): _visible_in(inner) for name, inner in value.items()}
        return value if items == value else items
    if type(value) in (list, tuple):  # not a named tuple, whose constructor takes single items
        parts = type(value)(_visible_in(inner) for inner in value)
        return value if parts == value else parts
    return value


def text(lines: str) -> None:
    """Lines on stdout unchanged and never wrapped, also for other programs.

    They are flushed at once, so that a full disk is noticed while the exit code can still show it.
    """
    sys.stdout.write(lines)
    sys.stdout.flush()


def console(file: TextIO) -> Console:
    """A console on `file`: as wide as the terminal or COLUMNS, otherwise very wide."""
    # By default rich uses 80 columns for a pipe, which would break lines for other programs.
    told = file.isatty() or os.environ.get("COLUMNS", "").isdigit()
    return Terminal(file=file, width=None if told else _WIDE, highlight=False)


def write_any_character(stream: TextIO) -> None:
    """Let a stream replace characters that its encoding does not have, instead of raising."""
    codecs.register_error("aegis.plain", _plainly)
    if isinstance(stream, io.TextIOWrapper):  # otherwise a test has replaced it
        stream.reconfigure(errors="aegis.plain")


def _plainly(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    plain = "".join(_PLAIN.get(char, "?") for char in error.object[error.start : error.end])
    return plain, error.end


def name_errors(stream: TextIO, name: str) -> None:
    """Add the stream's name to errors of writing to it, since the system knows no path for it.

    A second call changes nothing, so one process may run many commands.
    """
    for method in ("write", "flush"):
        call = getattr(stream, method)
        if not isinstance(call, _Naming):
            setattr(stream, method, _Naming(call, name))


@dataclasses.dataclass(frozen=True)
class _Naming:
    """A method of a stream whose errors name the stream."""

    call: Callable[..., Any]
    name: str

    def __call__(self, *args: Any) -> Any:
        try:
            return self.call(*args)
        except OSError as error:
            error.filename = self.name
            raise


class Terminal(Console):
    """A console that re-raises a broken pipe, so that exits.py decides on the exit code.

    Rich's own console would exit with 1, the code of a failed gate.
    """

    def on_broken_pipe(self) -> None:
        raise  # the error that is being handled


def document(report: Any) -> dict[str, Any]:
    """The plain values that `--json` prints for a report."""
    return _plain(_values(report))


def _values(report: Any) -> dict[str, Any]:
    """The report's fields, or its own `to_json`, which may add older names of some fields."""
    return report.to_json() if hasattr(report, "to_json") else dataclasses.asdict(report)


def _plain(value: Any) -> Any:
    """A value that JSON can represent: without paths, infinity and NaN."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
