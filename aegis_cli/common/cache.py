"""Where Aegis keeps what it can make again, such as decoded frames."""

from __future__ import annotations

import os
from pathlib import Path


def folder(name: str) -> Path:
    """A folder in $AEGIS_CACHE, else in $XDG_CACHE_HOME/aegis or ~/.cache/aegis."""
    if own := os.environ.get("AEGIS_CACHE"):
        return Path(own) / name
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "aegis" / name
