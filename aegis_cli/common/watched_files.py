"""Files that are read throughout the work: memory-mapped ones, and ones opened on demand."""

from __future__ import annotations

import hashlib
import os
import weakref
from collections.abc import Iterable
from pathlib import Path

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError


class WatchedFiles:
    """Detects writes to a file that is being read.

    A memory map changes with its file, so the work would continue with other numbers under the
    digest of the old ones. A file that is replaced as a whole does no harm: the open and mapped one
    is still the old one.

    Attributes:
        sha256: hex digest of each file's content; empty unless they are watched `by_content`.
    """

    def __init__(self, paths: Iterable[Path] = (), by_content: bool = True) -> None:
        """Record the current size, time and content of each file.

        Args:
            by_content: whether a file of which only the time changes, as by `touch`, counts as
                unchanged. For this every file is read once, here.

        Raises:
            AegisError: one cannot be read.
        """
        self._open: dict[Path, int] = {}
        weakref.finalize(self, _close, self._open)
        for path in paths:
            with files.reading(path, "check the path"):
                self._open[Path(path)] = os.open(path, os.O_RDONLY)
        self._noted = {path: _stamp(number) for path, number in self._open.items()}
        self.sha256: dict[Path, str] = {}
        if by_content:
            self.sha256 = {path: _digest(path, number) for path, number in self._open.items()}

    def check(self) -> None:
        """Raise AegisError if one of the files has been written to since."""
        for path, number in self._open.items():
            stamp = _stamp(number)
            if stamp == self._noted[path]:
                continue
            same_size = stamp[0] == self._noted[path][0]
            if not same_size or self.sha256.get(path) != _digest(path, number):
                raise _written_to(path)
            self._noted[path] = stamp  # same content: do not read it again every time


class WatchedPaths:
    """Detects paths whose file was replaced or written to.

    It is for files that are opened on demand, which may be more than a process can have open at
    once.
    """

    def __init__(self, paths: Iterable[Path]) -> None:
        """Record the file at each path, its size and its time.

        Raises:
            AegisError: one cannot be read.
        """
        self._noted = {Path(path): _stamp_of(path) for path in paths}

    def check(self) -> None:
        """Raise AegisError if the file at one of the paths has been replaced or changed since."""
        for path, stamp in self._noted.items():
            if _stamp_of(path) != stamp:
                raise _written_to(path)


def _written_to(path: Path) -> AegisError:
    return AegisError(
        f"'{path}' was written to while it was being read",
        "a file that does not change while the command runs",
        "restore the file that the command began with, and resume; or start anew in another --out",
    )


def _stamp_of(path: Path) -> tuple[int, int, int]:
    with files.reading(path, "check the path"):
        found = os.stat(path)
    return found.st_ino, found.st_size, found.st_mtime_ns


def _stamp(number: int) -> tuple[int, int]:
    found = os.fstat(number)
    return found.st_size, found.st_mtime_ns


def _digest(path: Path, number: int) -> str:
    """sha256 of an open file's content, whatever is at its path by now."""
    with files.reading(path, "check the path"), open(number, "rb", closefd=False) as file:
        file.seek(0)
        return hashlib.file_digest(file, "sha256").hexdigest()


def _close(numbers: dict[Path, int]) -> None:
    for number in numbers.values():
        os.close(number)
