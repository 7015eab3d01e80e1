"""Digests of large files are cached, and computed again if a file was written to."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aegis_cli.common import files, kept_digests
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Progress, Warned

YESTERDAY = time.time() - 86_400
Forget = Callable[[], None]


@pytest.fixture
def forget(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Forget:
    """Forget what only a running process knows, leaving the cache; files of any size are large."""
    monkeypatch.setenv("AEGIS_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(kept_digests, "LARGE", 1)
    # The change time of an inode cannot be set back, unlike that of its content.
    monkeypatch.setattr(kept_digests, "_SETTLED_S", -1.0)

    def forget() -> None:
        monkeypatch.setattr(kept_digests, "_known", {})

    forget()
    return forget


def written(folder: Path, count: int = 4) -> list[Path]:
    folder.mkdir()
    rng = np.random.default_rng(0)
    paths = [folder / f"{number}.mp4" for number in range(count)]
    for path in paths:
        path.write_bytes(rng.bytes(1000))
        os.utime(path, (YESTERDAY, YESTERDAY))
    return paths


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the files that were read whole."""
    seen: list[str] = []
    plain = files.sha256_file

    def counted(path: Path, *fix: str) -> str:
        seen.append(Path(path).name)
        return plain(path, *fix)

    monkeypatch.setattr(files, "sha256_file", counted)
    return seen


def test_another_process_reads_nothing_again(
    forget: Forget, reads: list[str], tmp_path: Path
) -> None:
    paths = written(tmp_path / "set")
    expected = {path: digest(path) for path in paths}
    assert kept_digests.of_files(paths, tmp_path / "set") == expected
    assert sorted(reads) == [path.name for path in paths]
    forget()
    assert kept_digests.of_files(paths, tmp_path / "set") == expected
    assert len(reads) == len(paths)


@pytest.mark.parametrize("how", ["content", "same time", "another file", "touched"])
def test_a_file_that_was_written_to_is_read_again(
    how: str, forget: Forget, reads: list[str], tmp_path: Path
) -> None:
    """This includes a file of equal size whose time was set back, as archive tools do."""
    paths = written(tmp_path / "set")
    kept_digests.of_files(paths, tmp_path / "set")
    del reads[:]
    changed = paths[1]
    if how == "another file":
        other = tmp_path / "other"
        other.write_bytes(bytes(1000))
        os.utime(other, (YESTERDAY, YESTERDAY))
        other.replace(changed)
    elif how != "touched":
        changed.write_bytes(bytes(1000))
    if how == "same time":
        os.utime(changed, (YESTERDAY, YESTERDAY))
    if how == "touched":
        changed.touch()
    for _ in range(2):
        forget()
        found = kept_digests.of_files(paths, tmp_path / "set")
        assert found == {path: digest(path) for path in paths}
    assert reads == [changed.name]  # once: the new content's digest is cached


def test_what_was_written_just_now_is_not_kept(
    forget: Forget, reads: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may be written to again within the resolution of the clock."""
    monkeypatch.setattr(kept_digests, "_SETTLED_S", 60.0)
    paths = written(tmp_path / "set", 1)
    for _ in range(2):
        kept_digests.of_files(paths, tmp_path / "set")
        forget()
    assert reads == ["0.mp4", "0.mp4"]


def test_what_is_written_to_while_it_is_read_is_not_kept(
    forget: Forget, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (path,) = written(tmp_path / "set", 1)
    plain = files.sha256_file

    def interfered(at: Path, *fix: str) -> str:
        found = plain(at, *fix)
        at.write_bytes(bytes(1000))
        return found

    with monkeypatch.context() as patch:
        patch.setattr(files, "sha256_file", interfered)
        kept_digests.of_files([path], tmp_path / "set")
    forget()
    assert kept_digests.of_files([path], tmp_path / "set") == {path: digest(path)}


def test_small_files_are_not_kept(
    forget: Forget, reads: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kept_digests, "LARGE", 2**20)
    paths = written(tmp_path / "set")
    assert kept_digests.of_files(paths, tmp_path / "set") == {p: digest(p) for p in paths}
    assert not (tmp_path / "cache").exists() and len(reads) == len(paths)


@pytest.mark.parametrize("damage", ["", "[1]", '{"a": 3}', '{"a": [1, 2]}', "\x00"])
def test_a_damaged_cache_is_written_anew(
    damage: str, forget: Forget, reads: list[str], tmp_path: Path
) -> None:
    paths = written(tmp_path / "set")
    expected = kept_digests.of_files(paths, tmp_path / "set")
    (store,) = (tmp_path / "cache" / "digests").glob("*.json")
    before = store.read_bytes()
    store.write_text(damage)
    forget()
    assert kept_digests.of_files(paths, tmp_path / "set") == expected
    assert store.read_bytes() == before and len(reads) == 2 * len(paths)


def test_files_that_are_gone_are_forgotten(forget: Forget, tmp_path: Path) -> None:
    paths = written(tmp_path / "set")
    kept_digests.of_files(paths, tmp_path / "set")
    paths[0].unlink()
    paths[1].write_bytes(b"new")
    kept_digests.of_files(paths[1:], tmp_path / "set")
    (store,) = (tmp_path / "cache" / "digests").glob("*.json")
    assert sorted(json.loads(store.read_bytes())) == [str(path) for path in paths[1:]]


def test_a_cache_that_cannot_be_written_costs_a_warning(
    forget: Forget, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = written(tmp_path / "set")
    (tmp_path / "file").touch()
    monkeypatch.setenv("AEGIS_CACHE", str(tmp_path / "file"))
    events: list[Event] = []
    found = kept_digests.of_files(paths, tmp_path / "set", events.append)
    assert found == {path: digest(path) for path in paths}
    (warned,) = [event for event in events if isinstance(event, Warned)]
    assert "set AEGIS_CACHE" in warned.text


def test_progress_ends_with_all_of_it(
    forget: Forget, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kept_digests, "_MB", 100)
    events: list[Event] = []
    kept_digests.of_files(written(tmp_path / "set"), tmp_path / "set", events.append)
    told = [(each.done, each.total) for each in events if isinstance(each, Progress)]
    assert told == [(10, 40), (20, 40), (30, 40), (40, 40)]


def test_of_two_that_begin_at_once_one_reads(
    forget: Forget, reads: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other waits for the first one's lock, and then uses its cached digest."""
    paths = written(tmp_path / "set")
    expected = {path: digest(path) for path in paths}
    found: list[dict[Path, str]] = []
    with monkeypatch.context() as patch:
        # Each acts like a process without a cache of its own.
        patch.setattr(kept_digests, "_known", _Forgetful())
        both = [
            threading.Thread(
                target=lambda: found.append(kept_digests.of_files(paths, tmp_path / "set"))
            )
            for _ in range(2)
        ]
        for each in both:
            each.start()
        for each in both:
            each.join()
    assert found == [expected, expected] and len(reads) == len(paths)


def test_who_waits_for_another_process_is_told(
    forget: Forget, reads: list[str], tmp_path: Path
) -> None:
    paths = written(tmp_path / "set")
    kept_digests.of_files(paths, tmp_path / "set")
    forget()
    (lock,) = (tmp_path / "cache").rglob("*.lock")
    other = os.open(lock, os.O_RDWR)
    fcntl.flock(other, fcntl.LOCK_EX)
    told: list[tuple[str, int]] = []

    def heard(event: Event) -> None:
        assert isinstance(event, Progress)
        told.append((event.stage, event.done))
        if event.done == 0:
            os.close(other)  # the other process has read everything

    kept_digests.of_files(paths, tmp_path / "set", heard)
    waits = "checksums (waits for another process that reads the data set)"
    assert told == [(waits, 0), (waits, 1)] and len(reads) == len(paths)


class _Forgetful(dict):
    """Knows within a thread only what that thread has learned."""

    def __init__(self) -> None:
        super().__init__()
        self.own = threading.local()

    def _mine(self) -> dict:
        if not hasattr(self.own, "known"):
            self.own.known = {}
        return self.own.known

    def __contains__(self, key: object) -> bool:
        return key in self._mine()

    def __getitem__(self, key: object) -> str:
        return self._mine()[key]

    def __setitem__(self, key: object, value: str) -> None:
        self._mine()[key] = value

    def update(self, *others: dict) -> None:
        self._mine().update(*others)


def test_a_missing_file_is_told(forget: Forget, tmp_path: Path) -> None:
    (path,) = written(tmp_path / "set", 1)
    path.unlink()
    with pytest.raises(AegisError, match="no file"):
        kept_digests.of_files([path], tmp_path / "set")
