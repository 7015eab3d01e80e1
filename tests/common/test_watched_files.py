"""Memory-mapped files: writing into one is noticed; replacing it is harmless."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from aegis_cli.common.errors import AegisError
from aegis_cli.common.watched_files import WatchedFiles


def overwrite(path: Path) -> None:
    with open(path, "r+b") as file:
        file.write(b"X")
    os.utime(path, ns=(0, 12345))  # whatever the clock's resolution


def cut(path: Path) -> None:
    os.truncate(path, 1)


def lengthen(path: Path) -> None:
    with open(path, "ab") as file:
        file.write(b"more")


@pytest.mark.parametrize("change", [overwrite, cut, lengthen])
def test_a_file_that_is_written_to(tmp_path: Path, change: Callable[[Path], None]) -> None:
    paths = [tmp_path / "a", tmp_path / "b"]
    for path in paths:
        path.write_bytes(b"data")
    watched = WatchedFiles(paths)
    watched.check()
    change(paths[1])
    with pytest.raises(AegisError, match="b' was written to while it was being read"):
        watched.check()


def touch(path: Path) -> None:
    os.utime(path, ns=(0, path.stat().st_mtime_ns + 10**9))


def test_a_file_whose_time_alone_changes_is_the_same(tmp_path: Path) -> None:
    """Its content is compared, and again if its time changes once more."""
    path = tmp_path / "a"
    path.write_bytes(b"data")
    watched = WatchedFiles([path])
    for _ in range(2):
        touch(path)
        watched.check()
    path.write_bytes(b"Data")
    touch(path)
    with pytest.raises(AegisError, match="was written to"):
        watched.check()


def test_a_file_that_is_not_read_for_its_digest_is_watched_by_its_time(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"data")
    watched = WatchedFiles([path], by_content=False)
    watched.check()
    touch(path)
    with pytest.raises(AegisError, match="was written to"):
        watched.check()


def test_a_file_that_is_replaced_or_removed(tmp_path: Path) -> None:
    """The mapped data is the old file's, which no longer changes."""
    path, other = tmp_path / "a", tmp_path / "b"
    path.write_bytes(b"data")
    other.write_bytes(b"other data")
    watched = WatchedFiles([path])
    os.replace(other, path)
    watched.check()
    path.unlink()
    watched.check()


def test_files_are_closed_with_their_watcher(tmp_path: Path) -> None:
    (tmp_path / "a").touch()
    before = len(os.listdir("/proc/self/fd"))
    watched = WatchedFiles([tmp_path / "a"])
    assert len(os.listdir("/proc/self/fd")) == before + 1
    del watched
    assert len(os.listdir("/proc/self/fd")) == before


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(AegisError, match="no file"):
        WatchedFiles([tmp_path / "a"])
