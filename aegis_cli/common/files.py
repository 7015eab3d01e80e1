"""Files that are complete or absent: atomic writes, and reading with errors that name the fix."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import re
import secrets
import shutil
import stat
import sys
from collections.abc import Callable, Generator, Iterable
from pathlib import Path
from typing import Any, BinaryIO

from aegis_cli.common import commands
from aegis_cli.common.errors import AegisError

# The fix for an input whose path is not valid text.
RENAME = "rename that file or folder"
_REPEATED = 100  # most bytes of a name that a temporary one repeats; file systems allow >= 143
_NUMBER = r"\.\d+\.tmp"  # the end of such a temporary name
_LEFT = re.compile(r"\.(.+)" + _NUMBER)  # with the final name
_LFS = b"version https://git-lfs.github.com/spec/v1"  # how its pointers begin
# Characters that end a line for `str.splitlines` but not for JSON; escaped, they end none.
_LINE_ENDS = str.maketrans({end: f"\\u{ord(end):04x}" for end in "\x85\u2028\u2029"})
_ATTEMPTS = 100  # to make a folder while other processes create and remove those above
_AT_ONCE = 2**26  # bytes after which the disk starts to write them


def canonical(obj: Any) -> str:
    """One JSON text for equal values: sorted keys, no spaces; NaN is a ValueError."""
    return json.dumps(obj, sort_keys=True, separators=(",", ":"), allow_nan=False)


def sha256_value(obj: Any) -> str:
    """Hex digest of a value's `canonical` text; equal values have equal digests."""
    return hashlib.sha256(canonical(obj).encode()).hexdigest()


def sha256_file(path: str | Path, fix: str = "check the path") -> str:
    """Hex digest of a file's bytes; `fix` is the advice if it is missing."""
    with reading(path, fix), open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def save_json(path: str | Path, obj: Any) -> None:
    """Write JSON with sorted keys and without NaN: all of it, or nothing."""
    text = json.dumps(obj, sort_keys=True, indent=2, allow_nan=False) + "\n"
    write_atomically(Path(path), lambda file: file.write(text.encode()))


def write_text(path: str | Path, text: str) -> None:
    """Write a text file: all of it, or nothing."""
    write_atomically(Path(path), lambda file: file.write(text.encode()))


def save_json_lines(path: str | Path, objects: Iterable[Any]) -> None:
    """Write JSON Lines in plain UTF-8: all of it, or nothing."""
    lines = [json.dumps(obj, ensure_ascii=False) for obj in objects]
    text = "".join(line.translate(_LINE_ENDS) + "\n" for line in lines)
    # A lone surrogate has no UTF-8 encoding. Its backslash escape is also valid in JSON.
    data = text.encode("utf-8", "backslashreplace")
    write_atomically(Path(path), lambda file: file.write(data))


def load_json(path: str | Path) -> Any:
    """Read a JSON file."""
    with reading(path, "check the path"):
        text = Path(path).read_bytes()
    try:
        return parse_json(text)
    except ValueError as error:
        refuse_pointer(path)
        raise AegisError(
            f"'{path}' is not JSON: {error}", "a JSON file", "run its command again"
        ) from error


def parse_json(text: str | bytes) -> Any:
    """The value of a JSON text.

    Raises:
        ValueError: it is not JSON, or is nested too deeply to be read.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deep") from None


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write beside `path`, sync to disk, then rename, so that no half-written file remains.

    A link is followed: the file that it points to is replaced, and the link stays.

    Raises:
        AegisError: `path` exists and is not a regular file, or it cannot be written.
    """
    path = _target(path)
    try:
        with aside(path) as (temporary, file):
            write(file)
            # Sync before renaming: otherwise a power cut could leave an empty file.
            file.flush()
            os.fsync(file.fileno())
            os.replace(temporary, path)
    except OSError as error:
        problem = f"cannot write '{_meant(path)}': {error.strerror or error}"
        fix = cure(path.parent, error)
        raise AegisError(problem, "an output that can be written", fix) from error


def pour(file: BinaryIO, parts: Iterable[memoryview]) -> None:
    """Write parts in order, while the disk is still writing the earlier ones.

    Otherwise the system keeps gigabytes in memory until the final sync needs them all at once.
    """
    begun = file.tell()
    for part in parts:
        for first in range(0, len(part), _AT_ONCE):
            file.write(part[first : first + _AT_ONCE])
            if file.tell() - begun >= _AT_ONCE:
                file.flush()
                _begin_to_write(file.fileno(), begun)
                begun = file.tell()
        del part  # before the next one is made, because that of a GPU tensor is a copy


def _begin_to_write(descriptor: int, start: int = 0) -> None:
    """Start writing a file's data to disk from byte `start` on, without waiting.

    Linux does so when told that it need not cache a file. Data that is not on the disk yet stays in
    memory, which here is all of it.
    """
    if hasattr(os, "posix_fadvise"):
        os.posix_fadvise(descriptor, start, 0, os.POSIX_FADV_DONTNEED)


def begin_to_write(folder: Path) -> None:
    """Start writing the files of a folder to disk that other code has just written.

    `reach_disk` then has less to wait for.
    """
    for path in folder.rglob("*"):
        if path.is_file():
            with open(path, "rb") as file:
                _begin_to_write(file.fileno())


def reach_disk(folder: Path) -> None:
    """Wait until everything in a folder is on the disk, so that it survives a power cut."""
    for path in (*folder.rglob("*"), folder):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextlib.contextmanager
def aside(path: Path) -> Generator[tuple[Path, BinaryIO]]:
    """A new file beside `path`, to be filled and renamed; if it is not renamed, it is removed.

    Leftovers of the same file from killed processes are removed first. Other processes that write
    it leave this one alone, because it is locked.
    """
    sweep(path)
    with contextlib.ExitStack() as stack:
        while True:
            place = _place(path)
            file = stack.enter_context(open(place, "xb"))
            stack.callback(_remove, place)  # has no effect after the rename
            if _is_locked(file.fileno(), place):
                break
        yield place, file


@contextlib.contextmanager
def folder_aside(path: Path) -> Generator[Path]:
    """A new folder beside `path`, like the file of `aside`."""
    sweep(path)
    with contextlib.ExitStack() as stack:
        while True:
            place = _place(path)
            place.mkdir()
            stack.callback(_remove, place)
            descriptor = os.open(place, os.O_RDONLY | os.O_DIRECTORY)
            stack.callback(os.close, descriptor)
            if _is_locked(descriptor, place):
                break
        yield place


def put(aside: Path, folder: Path) -> None:
    """Rename a folder that was written aside, once it is on the disk.

    No folder with that name may exist yet, except an empty one.

    Raises:
        AegisError: another process has written it meanwhile.
        OSError: the rename fails for another reason.
    """
    reach_disk(aside)
    try:
        os.rename(aside, folder)
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
            raise
        found = f"'{folder}', which another process wrote in the meantime"
        fix = "use that one, or choose another --out"
        raise AegisError(found, "a new or empty folder", fix) from error


def _place(path: Path) -> Path:
    """Where `path` is written until it is complete.

    The number is random, because process ids repeat: in a container, even for every command.
    """
    return path.with_name(f"{hidden(path)}.{secrets.randbelow(10**9)}.tmp")


def _is_locked(descriptor: int, place: Path) -> bool:
    """Lock a file or folder that was just created, if the file system supports it.

    Returns:
        Whether it still exists. Before it was locked, another process may have removed it as the
        leftover of a killed one.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return place.exists()


def sweep(path: Path) -> None:
    """Remove leftovers of processes that were killed while writing `path`."""
    _sweep(path.parent, re.compile(re.escape(hidden(path)) + _NUMBER))


def sweep_all(folder: Path) -> None:
    """Remove leftovers of killed processes in a folder that only Aegis writes to."""
    _sweep(folder, _LEFT)


def is_left(path: Path) -> bool:
    """Whether a path has the name of a temporary file or folder, which is incomplete."""
    return _LEFT.fullmatch(path.name) is not None


def is_vacant(folder: Path) -> bool:
    """Whether a path does not exist, or is a folder that contains nothing complete."""
    if not folder.exists():
        return True
    return folder.is_dir() and all(map(is_left, folder.iterdir()))


def _sweep(folder: Path, name: re.Pattern[str]) -> None:
    with contextlib.suppress(OSError):  # writing there will report what is wrong
        for left in [path for path in folder.iterdir() if name.fullmatch(path.name)]:
            with contextlib.suppress(OSError):
                _remove_unlocked(left)


def _remove_unlocked(left: Path) -> None:
    """Remove a file or folder that no process is writing.

    Raises:
        OSError: a process is, or the file system cannot tell.
    """
    # Do not follow a link or wait at a pipe: anything may have such a name.
    descriptor = os.open(left, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        _remove(left)
    finally:
        os.close(descriptor)


def _remove(path: Path) -> None:
    """Remove a file or a folder, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
        return
    with contextlib.suppress(OSError):
        path.unlink()


def hidden(path: Path) -> str:
    """The beginning of the temporary names that are used beside `path`.

    A long name is hashed: with the additions it would be longer than a file system allows.
    """
    name = os.fsencode(path.name)
    short = path.name if len(name) <= _REPEATED else hashlib.sha256(name).hexdigest()
    return f".{short}"


def lies_in(path: Path, folder: Path) -> bool:
    """Whether an existing path lies in a folder or is the folder itself, with links resolved."""
    return path.exists() and path.resolve().is_relative_to(folder.resolve())


def check_writable(path: Path) -> None:
    """Fail before the work, not after it; writing still checks.

    Raises:
        AegisError: there is no folder to write to, or `path` is not a regular file.
    """
    path = _target(path)
    folder = path.parent
    if not folder.is_dir():
        raise AegisError(
            f"no folder '{folder}'",
            f"a folder to write '{path.name}' to",
            commands.shell("mkdir", "-p", folder),
        )
    if path.is_dir() or not os.access(folder, os.W_OK):
        raise AegisError(
            f"'{path}' cannot be written", "a file name in a writable folder", "choose another path"
        )


def _target(path: Path) -> Path:
    """The file that writing to `path` replaces or creates.

    Raises:
        AegisError: it is a device, a pipe or a socket. The rename would replace it by a file, for
            every program on the machine.
    """
    target = followed(path)
    if (special := _special(target)) is not None:
        raise AegisError(
            f"the output '{path}' is {special}",
            "a regular file, or a path where there is none",
            "choose another output",
        )
    return target


def followed(path: Path) -> Path:
    """The target of a link, whether or not it exists; any other path is returned unchanged."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


def _special(path: Path) -> str | None:
    """The kind of a path that is a device, pipe or socket; None for anything else."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):  # missing or not accessible: opening it will report that
        return None
    kinds = {
        stat.S_IFCHR: "a device",
        stat.S_IFBLK: "a device",
        stat.S_IFIFO: "a pipe",
        stat.S_IFSOCK: "a socket",
    }
    return kinds.get(stat.S_IFMT(mode))


def check_utf8(path: str | Path, fix: str) -> None:
    """Refuse a path whose bytes are not UTF-8 text.

    safetensors, tokenizers and pyarrow do not accept one, and their errors sound like damage.

    Raises:
        AegisError: it is not UTF-8, or the locale reads names as something else.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        found = f"the path {str(path)!r}, whose bytes are not UTF-8"
        try:
            named = os.fsencode(path).decode()
        except UnicodeDecodeError:
            raise AegisError(found, "a path in UTF-8", fix) from error
        # The name is valid, but Python has been told that names are ASCII.
        raise AegisError(
            f"the path '{named}' in a locale of {sys.getfilesystemencoding()} names",
            "a locale that reads names as UTF-8",
            "export LC_ALL=C.UTF-8, and do not set PYTHONUTF8=0",
        ) from error


def check_apart(option: str, path: Path, others: Iterable[Path]) -> None:
    """Refuse an `option` that would overwrite a file that the same command reads or writes."""
    if os.path.realpath(path) in [os.path.realpath(other) for other in others]:
        found = f"{option} {path}, which this command also reads or writes"
        raise AegisError(found, "a file of its own", f"choose another {option}")


def make_folder(path: Path) -> None:
    """Create a folder and its parents.

    Another process may meanwhile remove an empty parent, as `locks.alone` does at its end. Then
    they are created again.

    Raises:
        AegisError: it cannot be created, or lies behind a broken link.
    """
    for above in (path, *path.parents):
        if above.is_symlink() and not above.exists():
            raise AegisError(
                f"'{above}' is a broken link to '{os.readlink(above)}'",
                "a link to a folder",
                commands.shell("mkdir", "-p", followed(above))
                + ", mount its disk, or choose another output",
            )
    try:
        for _ in range(_ATTEMPTS):
            with contextlib.suppress(FileNotFoundError):
                path.mkdir(parents=True, exist_ok=True)
                return
        path.mkdir(parents=True, exist_ok=True)  # a last attempt, which may raise
    except OSError as error:
        problem = f"cannot create the folder '{path}': {error.strerror or error}"
        raise AegisError(problem, "a place to write to", cure(path.parent, error)) from error


def refuse_special(path: str | Path) -> None:
    """Refuse a pipe, a socket or a device as an input, before it is opened.

    Opening a pipe blocks, and its bytes can be read only once.

    Raises:
        AegisError: it is one of them.
    """
    if (special := _special(Path(path))) is not None:
        raise AegisError(f"'{path}' is {special}", "a regular file", "write it to a file first")


def refuse_pointer(path: str | Path) -> None:
    """Refuse the pointer that Git LFS leaves in place of a large file until it is pulled.

    Readers of file formats call it once they have failed, because their own errors sound like
    damage.

    Raises:
        AegisError: it is such a pointer.
    """
    try:
        with open(path, "rb") as file:
            is_pointer = file.read(len(_LFS)) == _LFS
    except (OSError, ValueError):  # a folder, or missing: reading it reports that
        return
    if is_pointer:
        raise AegisError(
            f"'{path}' is a Git LFS pointer to a file that was not fetched",
            "the file itself",
            f"git lfs pull, in the repository of '{Path(path).parent}'",
        )


@contextlib.contextmanager
def reading(path: str | Path, fix: str) -> Generator[None]:
    """Turn a missing or unreadable file into an AegisError; `fix` is the advice if it is missing.

    Raises:
        AegisError: it is missing, cannot be read, or is not a regular file.
    """
    refuse_special(path)
    try:
        yield
    except FileNotFoundError as error:
        raise AegisError(f"no file '{path}'", "an existing file", fix) from error
    except OSError as error:
        problem = "it is a folder" if Path(path).is_dir() else error.strerror or error
        raise AegisError(
            f"cannot read '{path}': {problem}", "a readable file", commands.shell("ls", "-ld", path)
        ) from error


def cure(folder: Path, error: OSError) -> str:
    """The advice for a folder in which something could not be written."""
    folder = _lasting(folder)
    if error.errno == errno.ENOENT:
        return commands.shell("mkdir", "-p", folder)
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return f"free space on the disk of '{folder}', or choose another output"
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"make '{folder}' writable (chmod u+w), or choose another output"
    return "choose another output"


def _meant(path: Path) -> Path:
    """The final path of something written aside, which is the only one that a user knows."""
    found = path
    for around in path.parents:
        if match := _LEFT.fullmatch(around.name):
            found = around.with_name(match[1]) / path.relative_to(around)
    return found


def _lasting(folder: Path) -> Path:
    """The folder around anything written aside, because that is removed after an error."""
    around = (folder, *folder.parents)
    aside = [one for one in around if one.name.startswith(".") and one.suffix == ".tmp"]
    return aside[-1].parent if aside else folder
