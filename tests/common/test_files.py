"""JSON files and digests: canonical, atomic, and with clear errors for unreadable files."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shlex
import signal
import socket
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from samples.disk import disk

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError


def test_json_round_trip_is_canonical(tmp_path: Path) -> None:
    files.save_json(tmp_path / "a.json", {"b": [1, None], "a": {"y": 0.1, "x": "é"}})
    files.save_json(tmp_path / "b.json", {"a": {"x": "é", "y": 0.1}, "b": (1, None)})
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    assert files.load_json(tmp_path / "a.json") == {"a": {"x": "é", "y": 0.1}, "b": [1, None]}


def test_json_lines_are_plain_text_and_each_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "said.jsonl"
    odd = "\x85 \u2028 \u2029 \x1c \n \ud83d end"  # line ends, and half of a pair
    files.save_json_lines(path, [{"said": "größer: 苹果 😀"}, {"said": odd}])
    text = path.read_text(encoding="utf-8")
    assert "größer: 苹果 😀" in text
    assert [json.loads(line)["said"] for line in text.splitlines()] == ["größer: 苹果 😀", odd]


def test_nan_never_reaches_a_file(tmp_path: Path) -> None:
    files.save_json(tmp_path / "a.json", 1)
    with pytest.raises(ValueError, match="not JSON compliant"):
        files.save_json(tmp_path / "a.json", {"loss": float("nan")})
    assert files.load_json(tmp_path / "a.json") == 1 and os.listdir(tmp_path) == ["a.json"]


@pytest.mark.parametrize("content", [b"", b'{"a": ', b"\xff\xfe\x00", b"[" * 100_000])
def test_half_a_json_file_is_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(AegisError, match="a.json' is not JSON"):
        files.load_json(tmp_path / "a.json")
    with pytest.raises(AegisError, match="no file .*b.json"):
        files.load_json(tmp_path / "b.json")


def test_json_that_is_nested_too_deep_is_a_value_error() -> None:
    for text in ("[" * 100_000, b"[" * 100_000, '{"a":' * 5000 + "1" + "}" * 5000):
        with pytest.raises(ValueError, match="nested too deep"):
            files.parse_json(text)
    assert files.parse_json('{"a": [1]}') == {"a": [1]}


def test_links_in_a_circle_are_apart_from_others(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("a")
    files.check_apart("--out", tmp_path / "b", [tmp_path / "a"])
    with pytest.raises(AegisError, match="--out"):
        files.check_apart("--out", tmp_path / "a", [tmp_path / "a"])


def test_sha256_is_of_the_bytes(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"aegis")
    assert files.sha256_file(tmp_path / "a") == hashlib.sha256(b"aegis").hexdigest()


def test_equal_values_have_equal_digests_and_others_have_not() -> None:
    known = hashlib.sha256(b'{"a":1,"b":[2]}').hexdigest()
    assert files.sha256_value({"b": [2], "a": 1}) == known
    assert files.sha256_value({"b": [2], "a": 2}) != known
    with pytest.raises(ValueError, match="JSON compliant"):
        files.sha256_value(float("nan"))


WRITE_AND_DIE = """
import os, signal, sys
from pathlib import Path
from aegis_cli.common import files

def write(file):
    file.write(b'half')
    file.flush()
    os.kill(os.getpid(), getattr(signal, sys.argv[2]))

files.write_atomically(Path(sys.argv[1]), write)
"""


@pytest.mark.parametrize("name", ["out [1].json", "é" * 127 + "x"])
def test_what_a_killed_process_left_is_removed_by_the_next(name: str, tmp_path: Path) -> None:
    """This includes a name of the file system's maximum length, 255 bytes."""
    path = tmp_path / name
    command = [sys.executable, "-c", WRITE_AND_DIE, str(path), "SIGKILL"]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".") and left.name.endswith(".tmp")
    assert left.name.startswith(".out [1].json.") or name != "out [1].json"
    files.save_json(path, 1)
    assert list(tmp_path.iterdir()) == [path]


def test_what_another_process_is_writing_stays(tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    command = [sys.executable, "-c", WRITE_AND_DIE, str(path), "SIGSTOP"]
    other = subprocess.Popen(command)
    try:
        # A signal that arrives before it has stopped itself would not wake it.
        _, status = os.waitpid(other.pid, os.WUNTRACED)
        assert os.WIFSTOPPED(status)
        files.save_json(path, 1)
        assert len(list(tmp_path.iterdir())) == 2
        other.send_signal(signal.SIGCONT)
        assert other.wait(60) == 0 and path.read_bytes() == b"half"
    finally:
        other.kill()
    assert list(tmp_path.iterdir()) == [path]


FILL_AND_DIE = """
import os, signal, sys
from pathlib import Path
from aegis_cli.common import files

with files.folder_aside(Path(sys.argv[1])) as aside:
    (aside / "inside").mkdir()
    (aside / "inside" / "half").write_text("half")
    print(aside, flush=True)
    os.kill(os.getpid(), getattr(signal, sys.argv[2]))
    os.rename(aside, sys.argv[1])
"""


def test_half_a_folder_of_a_killed_process_is_removed_by_the_next(tmp_path: Path) -> None:
    path, mine = tmp_path / "out", tmp_path / ".out.old.tmp"
    mine.mkdir()
    command = [sys.executable, "-c", FILL_AND_DIE, str(path), "SIGKILL"]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL and (Path(done.stdout.strip()) / "inside").is_dir()
    with files.folder_aside(path) as aside:
        assert {*tmp_path.iterdir()} == {mine, aside}
        os.rename(aside, path)
    assert {*tmp_path.iterdir()} == {mine, path}


def test_a_folder_that_another_process_fills_stays(tmp_path: Path) -> None:
    path = tmp_path / "out"
    command = [sys.executable, "-c", FILL_AND_DIE, str(path), "SIGSTOP"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        try:
            assert other.stdout is not None
            theirs = Path(other.stdout.readline().strip())
            os.waitpid(other.pid, os.WUNTRACED)  # until it has stopped, or SIGCONT comes too early
            with files.folder_aside(path) as aside:
                assert {*tmp_path.iterdir()} == {theirs, aside}
            other.send_signal(signal.SIGCONT)
            assert other.wait(60) == 0
        finally:
            other.kill()
    assert list(tmp_path.iterdir()) == [path] and (path / "inside" / "half").is_file()


def test_the_disk_begins_with_many_bytes_before_all_are_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[int] = []
    monkeypatch.setattr(files, "_AT_ONCE", 100)
    monkeypatch.setattr(os, "posix_fadvise", lambda _, start, *rest: begun.append(start))
    parts = [bytes([number]) * size for number, size in enumerate((30, 250, 0, 60, 60))]
    with open(tmp_path / "x", "wb") as file:
        file.write(b"head")
        files.pour(file, map(memoryview, parts))
    assert (tmp_path / "x").read_bytes() == b"head" + b"".join(parts)
    assert begun == [4, 134, 234]


def test_a_folder_is_renamed_once_all_of_it_is_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[int] = []
    monkeypatch.setattr(os, "fsync", lambda number: synced.append(os.fstat(number).st_ino))
    rename = os.rename

    def renamed(aside: Path, folder: Path) -> None:
        inside = (aside, aside / "a", aside / "b", aside / "b" / "c")
        assert {path.stat().st_ino for path in inside} == set(synced)
        rename(aside, folder)

    monkeypatch.setattr(os, "rename", renamed)
    with files.folder_aside(tmp_path / "x") as aside:
        (aside / "b").mkdir()
        for name in ("a", "b/c"):
            (aside / name).write_text(name)
        files.put(aside, tmp_path / "x")
    assert (tmp_path / "x" / "b" / "c").read_text() == "b/c"


@pytest.mark.parametrize("removed", [False, True])
def test_what_is_swept_before_it_is_locked_is_made_again(
    removed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process looks for leftovers between the creation and the lock."""
    lock, seen = fcntl.flock, list[Path]()

    def flock(number: int, operation: int) -> None:
        if not seen:
            seen.extend(tmp_path.iterdir())
            if not removed:
                raise BlockingIOError
            seen[0].unlink()
        lock(number, operation)

    monkeypatch.setattr(fcntl, "flock", flock)
    files.save_json(tmp_path / "out.json", 1)
    assert [path.name for path in tmp_path.iterdir()] == ["out.json"] != [seen[0].name]
    assert files.load_json(tmp_path / "out.json") == 1


def test_a_full_disk_is_named_by_a_folder_that_stays(tmp_path: Path) -> None:
    """The temporary file is gone by the time the user reads the error."""
    with files.folder_aside(tmp_path / "runs") as aside:
        (aside / "backbone").mkdir()
        with disk(10), pytest.raises(AegisError) as caught:
            files.write_text(aside / "backbone" / "model", "x" * 100)
    assert f"the disk of '{tmp_path}'" in caught.value.fix
    assert f"cannot write '{tmp_path / 'runs' / 'backbone' / 'model'}'" in caught.value.found


@pytest.mark.parametrize("name", ["runs", "runs/x"])
def test_a_folder_behind_a_link_that_leads_nowhere_is_not_made(name: str, tmp_path: Path) -> None:
    """For example if the target disk is not mounted."""
    (tmp_path / "runs").symlink_to("disk/runs")
    with pytest.raises(AegisError) as caught:
        files.make_folder(tmp_path / name)
    assert "link to 'disk/runs'" in caught.value.found
    assert f"mkdir -p {tmp_path / 'disk' / 'runs'}" in caught.value.fix
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def test_a_command_in_an_error_can_be_pasted_whatever_the_name(tmp_path: Path) -> None:
    with pytest.raises(AegisError) as caught:
        files.check_writable(tmp_path / "ann's runs" / "x.safetensors")
    assert shlex.split(caught.value.fix) == ["mkdir", "-p", str(tmp_path / "ann's runs")]


# --- what is no regular file ----------------------------------------------------------------------


def make_device(path: Path) -> None:
    try:
        os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(1, 3))  # what /dev/null is
    except PermissionError:
        pytest.skip("only root makes devices")


def make_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(path))


SPECIAL = {"a device": make_device, "a pipe": os.mkfifo, "a socket": make_socket}


@pytest.mark.parametrize("linked", [False, True])
@pytest.mark.parametrize("kind", SPECIAL)
def test_an_output_replaces_no_device_and_no_pipe(kind: str, linked: bool, tmp_path: Path) -> None:
    """Renaming a file onto /dev/null would remove it for every program on the machine."""
    special = path = tmp_path / "special"
    SPECIAL[kind](special)
    if linked:
        path = tmp_path / "link"
        path.symlink_to(special)
    before = sorted(tmp_path.iterdir()), special.lstat().st_ino
    for write in (
        lambda: files.write_text(path, "text"),
        lambda: files.save_json(path, {}),
        lambda: files.check_writable(path),
    ):
        with pytest.raises(AegisError, match=f"'{path}' is {kind}"):
            write()
    assert (sorted(tmp_path.iterdir()), special.lstat().st_ino) == before


@pytest.mark.parametrize("kind", SPECIAL)
def test_an_input_that_is_no_file_is_refused_before_it_is_opened(kind: str, tmp_path: Path) -> None:
    """Opening a pipe without a writer would wait forever."""
    path = tmp_path / "special"
    SPECIAL[kind](path)
    for read in (files.load_json, files.sha256_file):
        with pytest.raises(AegisError, match=f"'{path}' is {kind}"):
            read(path)


@pytest.mark.parametrize("there", [True, False])
def test_a_linked_output_is_followed_and_the_link_stays(there: bool, tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    target, link = tmp_path / "disk" / "real", tmp_path / "link"
    link.symlink_to("disk/real")
    if there:
        target.write_text("old")
    files.check_writable(link)
    files.write_text(link, "new")
    assert link.is_symlink() and target.read_text() == "new"
    assert [path.name for path in (tmp_path / "disk").iterdir()] == ["real"]
