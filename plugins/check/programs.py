"""Programs of this environment, and the files that they leave."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path


def command(program: str, *arguments: str | Path) -> None:
    """Run a program of this environment; what it says is shown where it fails."""
    done = run(program, *arguments)
    if done.returncode:
        print(done.stderr[-4000:], file=sys.stderr)
        done.check_returncode()


def run(program: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run a program of this environment, which finds the modules of this folder."""
    path = Path(sys.executable).parent / program
    here = (str(Path(__file__).parent), os.environ.get("PYTHONPATH", ""))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, here))}
    words = [path, *map(str, arguments)]
    return subprocess.run(words, capture_output=True, text=True, env=environment)


def remove(path: Path) -> Path:
    """The path itself, where nothing is any more of what an earlier call has left there."""
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    return path
