"""A folder that one process writes to: the second is refused, and nothing is left behind."""

from __future__ import annotations

import errno
import fcntl
import os
import signal
import stat
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from samples.command import ROOT, finding

from aegis_cli.common import files, locks
from aegis_cli.common.errors import AegisError

TESTS = Path(__file__).parent.parent


@contextmanager
def another(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that holds the folder's lock."""
    process = subprocess.Popen(
        [sys.executable, "-m", "samples.workers", "hold", str(folder)],
        stdout=subprocess.PIPE,
        text=True,
        env=finding(ROOT, TESTS),
    )
    try:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        yield process
    finally:
        process.kill()
        process.communicate()


def refused(folder: Path) -> str:
    with pytest.raises(AegisError) as caught, locks.alone(folder):
        pass
    return caught.value.found


def test_the_second_is_told_who_is_at_work(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with another(folder) as holder:
        found = refused(folder)
        assert f"'{folder}' is being written to by process {holder.pid}" in found
        assert f"on {os.uname().nodename}, since 20" in found
        assert list(folder.iterdir()) == []


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_dead_process_holds_nothing(tmp_path: Path, number: int) -> None:
    folder = tmp_path / "run"
    with another(folder) as holder:
        holder.send_signal(number)
        holder.wait()
        with locks.alone(folder):
            pass


def test_the_same_process_is_refused_too(tmp_path: Path) -> None:
    """For example a program that trains twice at once, in two threads."""
    with locks.alone(tmp_path):
        assert f"process {os.getpid()} on" in refused(tmp_path)
    with locks.alone(tmp_path):
        pass


def test_a_folder_that_stays_empty_is_gone_again(tmp_path: Path) -> None:
    """So a refused command leaves nothing, and what was there before stays."""
    (tmp_path / "there").mkdir()
    for folder in (tmp_path / "there", tmp_path / "not" / "there"):
        with pytest.raises(KeyError), locks.alone(folder):
            assert folder.is_dir()
            raise KeyError
    assert [path.name for path in tmp_path.iterdir()] == ["there"]
    with locks.alone(tmp_path / "a" / "b"):
        (tmp_path / "a" / "b" / "kept").touch()
    assert (tmp_path / "a" / "b" / "kept").exists()


def test_a_folder_above_that_another_removes_meanwhile_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For example two cells of a study: one that ends removes a folder that the other needs."""
    folder, plain = tmp_path / "reach" / "naive" / "0", os.mkdir
    removed: list[Path] = []

    def make(path: str | Path, mode: int = 0o777) -> None:
        plain(path, mode)
        if Path(path) == folder.parent and len(removed) < 3:
            removed.append(folder.parent)
            os.rmdir(path)

    monkeypatch.setattr(os, "mkdir", make)
    with locks.alone(folder):
        assert folder.is_dir() and len(removed) == 3


def test_what_the_lock_is_on_may_be_moved_or_removed(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with locks.alone(folder):
        folder.rename(tmp_path / "aside")
    with locks.alone(folder):
        folder.rmdir()
    with locks.alone(folder):
        pass


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert "file' is no folder" in refused(tmp_path / "file")
    assert "file" in refused(tmp_path / "file" / "run")


@pytest.mark.parametrize("name", ["run", "x" * 255])
def test_where_folders_cannot_be_locked_a_file_beside_them_is(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on NFS. The file is removed with the lock."""
    real = fcntl.flock

    def flock(descriptor: int, how: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(errno.EBADF, "Bad file descriptor")
        real(descriptor, how)

    monkeypatch.setattr(locks.fcntl, "flock", flock)
    folder = tmp_path / name
    with locks.alone(folder):
        assert {path.name for path in tmp_path.iterdir()} == {name, f"{files.hidden(folder)}.lock"}
        assert f"process {os.getpid()} on" in refused(folder)
    assert list(tmp_path.iterdir()) == []
    with locks.alone(folder):
        pass
