"""Cached measurements of long work, line by line, so that it resumes where it was interrupted.

A file in the cache holds the measurements made under one set of conditions. Several processes may
add to it at once.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from aegis_cli.common import cache, files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Warned

_SEAL = "sha256"


class KeptLines:
    """Lines of JSON that are kept for later measurements of the same thing.

    Args:
        kind: name of the folder in the cache.
        about: everything that the measurements depend on, as JSON; lines with other values of it
            are never found.
        on_event: called once if nothing can be kept; the work continues.
    """

    def __init__(self, kind: str, about: Mapping[str, Any], on_event: OnEvent) -> None:
        self.path = cache.folder(kind) / f"{files.sha256_value(about)[:32]}.jsonl"
        self._on_event = on_event
        self._can_keep = True
        cache.sweep(self.path.parent)

    def read(self) -> Iterator[dict[str, Any]]:
        """The kept lines. A line that was cut off, for example by a full disk, is left out."""
        try:
            raw = self.path.read_bytes()
        except OSError:  # nothing is kept, or not for this user: measure it
            return
        cache.touch(self.path)
        for line in raw.splitlines():
            with contextlib.suppress(ValueError):
                found = json.loads(line)
                if isinstance(found, dict):
                    yield found

    def add(self, lines: Iterable[Mapping[str, Any]]) -> None:
        """Keep some lines."""
        if not self._can_keep:
            return
        text = "".join(json.dumps(line) + "\n" for line in lines)
        try:
            files.make_folder(self.path.parent)
            # Reopened each time and written in one call, so that lines of several processes do not
            # mix. A line that was cut off is terminated first.
            with open(self.path, "ab") as file:
                file.write(b"\n" * (not _ends_a_line(self.path)) + text.encode())
        except (OSError, AegisError) as error:
            self._can_keep = False
            why = error.found if isinstance(error, AegisError) else error.strerror or str(error)
            text = f"cannot keep what is measured, so an interruption loses it ({why})"
            fix = "set AEGIS_CACHE to a folder that can be written"
            self._on_event(Warned(self.path.parent.name, f"{text}: {fix}"))


def sealed(line: Mapping[str, Any]) -> dict[str, Any]:
    """A line with a digest of what it says."""
    return {**line, _SEAL: files.sha256_value(dict(line))}


def unsealed(line: Mapping[str, Any]) -> dict[str, Any] | None:
    """What such a line says; None of one that is not as it was written."""
    said = {name: value for name, value in line.items() if name != _SEAL}
    with contextlib.suppress(ValueError):  # of a number that JSON has not
        if files.sha256_value(said) == line.get(_SEAL):
            return said
    return None


def packed(array: np.ndarray) -> dict[str, Any]:
    """An array as JSON, bit for bit."""
    said = base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()
    return {"type": array.dtype.str, "shape": list(array.shape), "bytes": said}


def unpacked(said: Mapping[str, Any]) -> np.ndarray:
    """The array that was packed."""
    flat = np.frombuffer(base64.b64decode(said["bytes"]), np.dtype(said["type"]))
    # A copy, since an array over bytes cannot be written, of which torch warns.
    return flat.reshape(said["shape"]).copy()


def _ends_a_line(path: Path) -> bool:
    with open(path, "rb") as file:
        if file.seek(0, os.SEEK_END) == 0:
            return True
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"
