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

_WIDE = 200  # columns where nothing sets a width, so that piped tables never wrap
_UNLIMITED = 10_000
STDOUT = "standard output"
_STYLE = re.compile(r"\x1b\[[0-9;]*m")
_TRAILING_BLANKS = re.compile(r"(?:[ ]|\x1b\[[0-9;]*m)+$", re.MULTILINE)  # and changes of style
# What stands for characters of ours in an output whose encoding has not got them.
_PLAIN = {"²": "^2", "±": "+-", "→": "->", "≥": ">=", "≤": "<=", "…": "...", "–": "-", "·": "-"}


def error(problem: AegisError) -> None:
    """One block on stderr: found, expected, fix."""
    to = console(sys.stderr)
    for label, style in (("found", "bold red"), ("expected", "bold"), ("fix", "bold green")):
        text = visible(getattr(problem, label))
        between = "" if text.startswith("\n") else " "  # several problems are a list below
        # Not wrapped, so that a command in it can be copied, and a line is found by grep.
        to.print(Text.assemble((f"{label}:", style), between, text), soft_wrap=True)


def note(text: str) -> None:
    """One line on stderr."""
    console(sys.stderr).print(Text(visible(text)), soft_wrap=True)


def show(
    report: Any, table: Callable[[Any], RenderableType], as_json: bool, wide: bool = False
) -> None:
    """The report on stdout, as a table or as one JSON document (NaN and infinity become null).

    Args:
        wide: give each table one line a row, however narrow the terminal is.
    """
    if as_json:
        text(json.dumps(document(report), indent=2, allow_nan=False) + "\n")
    else:
        to = console(sys.stdout)
        if wide:
            to.width = _UNLIMITED
        # Not printed right away: rich fills the last column of a table with blanks.
        with to.capture() as printed:
            to.print(table(_visible_in(report)))
        text(_without_trailing_blanks(printed.get()))


def _without_trailing_blanks(text: str) -> str:
    """Lines that end with what can be seen; changes of style stay, blanks between them go."""
    return _TRAILING_BLANKS.sub(lambda end: "".join(_STYLE.findall(end[0])), text)


def visible(text: str) -> str:
    """A text whose control characters are written out, but for line ends and tabs.

    A file's metadata could else move the terminal's cursor, or set its title. Nor can a byte of a
    file's name that is no text, which Python has as half of a surrogate pair, be written in UTF-8.
    """
    return "".join(_escaped(char) if _is_unwritable(char) else char for char in text)


def _is_unwritable(char: str) -> bool:
    return char not in "\n\t" and unicodedata.category(char) in ("Cc", "Cs")


def _escaped(char: str) -> str:
    return char.encode("unicode_escape").decode()


def _visible_in(value: Any) -> Any:
    """A report whose texts are all `visible`."""
    # What has nothing to change is given back itself, for a report may hold large arrays.
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
    if type(value) in (list, tuple):  # not a named tuple, which takes its items one by one
        parts = type(value)(_visible_in(inner) for inner in value)
        return value if parts == value else parts
    return value


def text(lines: str) -> None:
    """Lines on stdout just as they are, for another program too: never wrapped.

    They are written at once, so that a full disk is found while the exit code can tell it.
    """
    sys.stdout.write(lines)
    sys.stdout.flush()


def console(file: TextIO) -> Console:
    """A console on `file`: as wide as the terminal or as COLUMNS says, else very wide."""
    # Else rich takes 80 columns for a pipe, and what reads it would find its lines broken.
    told = file.isatty() or os.environ.get("COLUMNS", "").isdigit()
    return Terminal(file=file, width=None if told else _WIDE, highlight=False)


def write_any_character(stream: TextIO) -> None:
    """Let a stream replace characters that its encoding has not got, where it would raise."""
    codecs.register_error("aegis.plain", _plainly)
    if isinstance(stream, io.TextIOWrapper):  # else a test has put something in its place
        stream.reconfigure(errors="aegis.plain")


def _plainly(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    plain = "".join(_PLAIN.get(char, "?") for char in error.object[error.start : error.end])
    return plain, error.end


def name_errors(stream: TextIO, name: str) -> None:
    """Let the errors of writing to a stream name it: the system has no path of it to tell.

    To do so again changes nothing, so that one process may run many commands.
    """
    for method in ("write", "flush"):
        call = getattr(stream, method)
        if not isinstance(call, _Naming):
            setattr(stream, method, _Naming(call, name))


@dataclasses.dataclass(frozen=True)
class _Naming:
    """A call whose errors name the stream that it is of."""

    call: Callable[..., Any]
    name: str

    def __call__(self, *args: Any) -> Any:
        try:
            return self.call(*args)
        except OSError as error:
            error.filename = self.name
            raise


class Terminal(Console):
    """A console that leaves a reader who has gone to whoever decides on exit codes.

    Rich's own would exit with 1, the code of a failed gate.
    """

    def on_broken_pipe(self) -> None:
        raise  # the error that is being handled


def document(report: Any) -> dict[str, Any]:
    """What `--json` prints of a report, as plain values."""
    return _plain(_values(report))


def _values(report: Any) -> dict[str, Any]:
    """The report's fields, or what it says itself: it may add the older names of some."""
    return report.to_json() if hasattr(report, "to_json") else dataclasses.asdict(report)


def _plain(value: Any) -> Any:
    """A value as JSON can have it, which knows no path, no infinity and no NaN."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
