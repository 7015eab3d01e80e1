"""Files that are read as long as the work lasts, for they stay memory-mapped."""

from __future__ import annotations

import os
import weakref
from collections.abc import Iterable
from pathlib import Path

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError


class WatchedFiles:
    """Tells when somebody writes into a file that is being read.

    What is mapped changes with the file, and the work would go on with other numbers under the
    digest of the old ones. A file that is replaced as a whole is none of our concern: what is open
    and mapped is still the old one.
    """

    def __init__(self, paths: Iterable[Path] = ()) -> None:
        """Note size and time of each file as they are now.

        Raises:
            AegisError: one cannot be read.
        """
        self._open: dict[Path, int] = {}
        weakref.finalize(self, _close, self._open)
        for path in paths:
            with files.reading(path, "check the path"):
                self._open[Path(path)] = os.open(path, os.O_RDONLY)
        self._noted = {path: _stamp(number) for path, number in self._open.items()}

    def check(self) -> None:
        """Raise AegisError if one of the files has been written to since."""
        for path, number in self._open.items():
            if _stamp(number) != self._noted[path]:
                raise AegisError(
                    f"'{path}' was written to while it was being read",
                    "a file that nobody writes to before the work is done",
                    "bring back the file that the work began with, and resume; or start anew in "
                    "another --out",
                )


def _stamp(number: int) -> tuple[int, int]:
    found = os.fstat(number)
    return found.st_size, found.st_mtime_ns


def _close(numbers: dict[Path, int]) -> None:
    for number in numbers.values():
        os.close(number)
