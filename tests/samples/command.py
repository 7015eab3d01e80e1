"""The command in a process of its own, and what an error looks like."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import typer

from aegis_cli.cli.app import app

ROOT = Path(__file__).parent.parent.parent


@cache
def command() -> Callable[..., Any]:
    """The click command that `app` builds whenever it is called, which is slow; built once."""
    return typer.main.get_command(app)


def finding(*folders: Path) -> dict[str, str]:
    """An environment in which Python finds modules in these folders first.

    The entries of PYTHONPATH stay behind them, since some packages may be found only there.
    """
    paths = [*map(str, folders), os.environ.get("PYTHONPATH")]
    return os.environ | {"PYTHONPATH": os.pathsep.join(path for path in paths if path)}


def python(code: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code], cwd=ROOT, capture_output=True, text=True
    )


def refused(result: tuple[int, str, str]) -> str:
    """The error block, after a check that the user saw nothing else: exit code 2, no traceback."""
    code, out, err = result
    assert (code, out) == (2, "")
    assert "Traceback" not in err
    assert all(err.count(f"{label}: ") == 1 for label in ("found", "expected", "fix"))
    return err
