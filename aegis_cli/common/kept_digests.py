"""Digests of large files such as videos, which are cached until a file is written to.

Computing the digest of a data set of many gigabytes reads all of it. That is done once, by as many
threads as there are cores, and not again each time that some process reads from it.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import time
from collections.abc import Generator, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from aegis_cli.common import cache, files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress, Warned, ignore
from aegis_cli.common.processes import worker_count

LARGE = 2**20  # bytes; smaller files are read in no time
# A file written to this recently may be written to again within the clock's resolution, and its
# times would not show it.
_SETTLED_S = 2.0
_MB = 10**6

# What changes when a file is written to. Size and time alone would miss a file that was replaced by
# another one with the same time.
Stamp = tuple[int, int, int, int]
_known: dict[tuple[Path, Stamp], str] = {}


def of_files(
    paths: Iterable[Path], home: Path, on_event: OnEvent = ignore, fix: str = "check the path"
) -> dict[Path, str]:
    """Hex sha256 of each file's bytes.

    Args:
        home: the folder of their data set, whose digests are kept together.
        fix: the advice for a missing file.

    Raises:
        AegisError: a file cannot be read.
    """
    keys = {path: _key(path, fix) for path in paths}
    unknown = {path: key for path, key in keys.items() if key not in _known}
    large = {path: key for path, key in unknown.items() if key[1][1] >= LARGE}
    for path, key in unknown.items():
        if path not in large:
            _known[key] = files.sha256_file(path, fix)
    if large:
        _know(large, home, on_event)
    return {path: _known[key] for path, key in keys.items()}


def stamp(path: Path) -> Stamp:
    """Identifies the current state of the file at a path.

    Raises:
        OSError: there is no file.
    """
    state = path.stat()
    return state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns


def _key(path: Path, fix: str) -> tuple[Path, Stamp]:
    with files.reading(path, fix):
        return path.resolve(), stamp(path)


def _know(large: Mapping[Path, tuple[Path, Stamp]], home: Path, on_event: OnEvent) -> None:
    """Get the digests of large files, from the cache or by reading them."""
    store = cache.folder("digests") / f"{files.sha256_value(str(home.resolve()))[:32]}.json"
    cache.sweep(store.parent)
    try:
        # Other processes that start with the same data set wait for this one's result.
        with _locked(store, on_event):
            kept = _kept(store)
            cache.touch(store)
            _known.update({key: kept[key] for key in large.values() if key in kept})
            fresh = _read({p: key for p, key in large.items() if key not in kept}, on_event)
            if fresh:
                _keep(store, kept | fresh)
    except _Unkept as error:
        if left := {path: key for path, key in large.items() if key not in _known}:
            _read(left, on_event)
        text = f"cannot cache the digests of '{home}', so each start reads all of it ({error})"
        on_event(Warned("checksums", f"{text}: set AEGIS_CACHE to a folder that can be written"))


class _Unkept(Exception):
    """The cache cannot be written."""


@contextlib.contextmanager
def _locked(store: Path, on_event: OnEvent) -> Generator[None]:
    """Wait until no other process is computing the digests of this data set."""
    try:
        files.make_folder(store.parent)
        lock = os.open(store.with_suffix(".lock"), os.O_RDWR | os.O_CREAT, 0o644)
    except AegisError as error:
        raise _Unkept(error.found) from error
    except OSError as error:
        raise _Unkept(error.strerror or str(error)) from error
    try:
        with contextlib.suppress(OSError):  # a file system without locks: each reads by itself
            os.utime(lock)
            _lock(lock, on_event)
        yield
    finally:
        os.close(lock)


def _lock(lock: int, on_event: OnEvent) -> None:
    """Take a lock, and report if another process holds it, which may take minutes.

    Raises:
        OSError: the file system has no locks.
    """
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        waits = "checksums (waits for another process that reads the data set)"
        on_event(Progress(waits, 0, 1, "data set"))
        fcntl.flock(lock, fcntl.LOCK_EX)
        on_event(Progress(waits, 1, 1, "data set"))


def _read(unread: Mapping[Path, tuple[Path, Stamp]], on_event: OnEvent) -> dict[Any, str]:
    """Compute the digests of files.

    Returns:
        By key, the digests to keep: those of files that cannot change without being noticed.
    """
    if not unread:
        return {}
    total = sum(stamp[1] for _, stamp in unread.values())
    done = 0
    pool = ThreadPoolExecutor(worker_count(len(unread)))
    began_ns = time.time_ns()
    settled: dict[Any, str] = {}
    try:
        running = {pool.submit(files.sha256_file, path): path for path in unread}
        for each in as_completed(running):
            key = unread[running[each]]
            _known[key] = each.result()
            if began_ns - max(key[1][2:]) > _SETTLED_S * 1e9 and key == _key(
                running[each], "check the path"
            ):
                settled[key] = _known[key]
            done += key[1][1]
            on_event(Progress("checksums", done // _MB, max(total // _MB, 1), "MB"))
    finally:
        pool.shutdown(cancel_futures=True)
    return settled


def _kept(store: Path) -> dict[tuple[Path, Stamp], str]:
    """The kept digests; none if the cache file is damaged, as they can be computed again."""
    try:
        listed = json.loads(store.read_bytes())
        return {
            (Path(path), (ino, size, mtime, ctime)): digest
            for path, (ino, size, mtime, ctime, digest) in listed.items()
        }
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def _keep(store: Path, digests: Mapping[tuple[Path, Stamp], str]) -> None:
    """Write the digests, only the newest for each file that still exists."""
    listed = {
        str(path): (*stamp, digest) for (path, stamp), digest in digests.items() if path.exists()
    }
    try:
        files.save_json(store, listed)
    except AegisError as error:
        raise _Unkept(error.found) from error
