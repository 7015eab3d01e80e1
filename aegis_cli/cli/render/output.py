"""The two streams: reports on stdout, everything else on stderr."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

from rich.console import Console, RenderableType
from rich.text import Text

from aegis_cli.common.errors import AegisError

_WIDE = 200  # columns where no terminal sets a width, so that piped tables never wrap


def error(problem: AegisError) -> None:
    """One block on stderr: found, expected, fix."""
    to = console(sys.stderr)
    for label, style in (("found", "bold red"), ("expected", "bold"), ("fix", "bold green")):
        text = getattr(problem, label)
        to.print(
            Text.assemble((f"{label}:", style), "" if text.startswith("\n") else " ", text),
            soft_wrap=True,
        )


def note(text: str) -> None:
    """One line on stderr."""
    console(sys.stderr).print(Text(text), soft_wrap=True)


def show(report: Any, table: Callable[[Any], RenderableType], as_json: bool) -> None:
    """The report on stdout, as a table or as one JSON document (NaN and infinity become null)."""
    if as_json:
        sys.stdout.write(json.dumps(_plain(_values(report)), indent=2, allow_nan=False) + "\n")
    else:
        console(sys.stdout).print(table(report))


def text(lines: str) -> None:
    """Lines on stdout just as they are, for another program too: never wrapped."""
    sys.stdout.write(lines)


def console(file: TextIO) -> Console:
    """A console on `file`: the terminal's width, or wide."""
    return Console(file=file, width=None if file.isatty() else _WIDE, highlight=False)


def _values(report: Any) -> dict[str, Any]:
    """The report's fields, or what it says itself: it may add the older names of some."""
    return report.to_json() if hasattr(report, "to_json") else dataclasses.asdict(report)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
