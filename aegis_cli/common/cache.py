"""The cache: files that Aegis can create again, such as decoded frames."""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path

_KEPT_S = 30 * 86_400.0  # files that were not used for this long are removed


def folder(name: str) -> Path:
    """A folder in $AEGIS_CACHE, else in $XDG_CACHE_HOME/aegis or ~/.cache/aegis."""
    if own := os.environ.get("AEGIS_CACHE"):
        return Path(own) / name
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "aegis" / name


def sweep(folder: Path) -> None:
    """Remove the files in a folder that were not used for a long time."""
    with contextlib.suppress(OSError):  # not there yet
        for path in folder.iterdir():
            with contextlib.suppress(OSError):  # owned by another user
                state = path.stat()
                if time.time() - max(state.st_mtime, state.st_atime) > _KEPT_S:
                    path.unlink()


def touch(path: Path) -> None:
    """Mark a file in the cache as used."""
    with contextlib.suppress(OSError):  # owned by another user, who marks it too
        os.utime(path)


def mark_read(path: Path) -> None:
    """Mark a file in the cache as used, without the time of writing, by which others watch it."""
    with contextlib.suppress(OSError):
        os.utime(path, ns=(time.time_ns(), path.stat().st_mtime_ns))
